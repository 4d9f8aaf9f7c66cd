"""Builds ``coordinator.motion._plan_stats``: what a plan asks of machine and buses."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from nodes.native_build import builder

ffibuilder = builder(
    "coordinator.motion._plan_stats",
    headers=["coordinator/motion/trapezoid.h", "coordinator/motion/plan_stats.h"],
    sources=[
        "coordinator/motion/plan_stats.c",
        "nodes/can_bits.c",
        "firmware/wire/vlq.c",
        "firmware/wire/block.c",
    ],
)
