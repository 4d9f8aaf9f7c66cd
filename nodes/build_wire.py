"""Builds ``nodes._wire``: the wire codec of ``firmware/wire``, as the host's Python uses it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from nodes.native_build import builder

ffibuilder = builder(
    "nodes._wire",
    headers=["firmware/wire/wire.h"],
    sources=["firmware/wire/vlq.c", "firmware/wire/message.c", "firmware/wire/block.c"],
)
