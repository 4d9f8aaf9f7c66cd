"""Builds ``coordinator.motion.history._history``: the path that moves make, and the filament they push."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from nodes.support.native_build import builder

ffibuilder = builder(
    "coordinator.motion.history._history",
    headers=["coordinator/motion/trapezoid.h", "coordinator/motion/history/history.h"],
    sources=["coordinator/motion/history/history.c", "coordinator/motion/history/toolpath.c"],
)
