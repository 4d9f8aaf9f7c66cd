"""Builds ``nodes.support._can_bits``: the true length of frames."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from nodes.support.native_build import builder

ffibuilder = builder(
    "nodes.support._can_bits", headers=["nodes/support/can_bits.h"], sources=["nodes/support/can_bits.c"]
)
