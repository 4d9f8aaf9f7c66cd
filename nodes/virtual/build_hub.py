"""Builds ``nodes.virtual._hub``: the virtual CAN bus."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent.parent))

from nodes.support.native_build import builder

ffibuilder = builder(
    "nodes.virtual._hub",
    headers=[
        "nodes/support/can_bits.h",
        "nodes/virtual/hub_faults.h",
        "nodes/virtual/hub.h",
        "nodes/virtual/hub_loop.h",
    ],
    sources=[
        "nodes/support/can_bits.c",
        "nodes/virtual/hub_faults.c",
        "nodes/virtual/hub.c",
        "nodes/virtual/hub_loop.c",
    ],
)
