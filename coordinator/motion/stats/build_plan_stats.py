"""Builds ``coordinator.motion.stats._plan_stats``: what a plan asks of machine and buses."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from nodes.support.native_build import builder

ffibuilder = builder(
    "coordinator.motion.stats._plan_stats",
    headers=["coordinator/motion/trapezoid.h", "coordinator/motion/stats/plan_stats.h"],
    sources=[
        "coordinator/motion/stats/plan_stats.c",
        "nodes/support/can_bits.c",
        "firmware/wire/vlq.c",
        "firmware/wire/block.c",
    ],
)
