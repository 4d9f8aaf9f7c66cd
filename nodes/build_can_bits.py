"""Builds ``nodes._can_bits``: the true length of frames."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from nodes.native_build import builder

ffibuilder = builder("nodes._can_bits", headers=["nodes/can_bits.h"], sources=["nodes/can_bits.c"])
