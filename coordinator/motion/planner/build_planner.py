"""Builds ``coordinator.motion.planner._planner``: the G-code hot path and the look-ahead."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from nodes.support.native_build import builder

ffibuilder = builder(
    "coordinator.motion.planner._planner",
    headers=[
        "coordinator/motion/trapezoid.h",
        "coordinator/motion/planner/planner_queue.h",
        "coordinator/motion/planner/gcode_lines.h",
    ],
    sources=[
        "coordinator/motion/planner/planner_queue.c",
        "coordinator/motion/planner/planner_move.c",
        "coordinator/motion/planner/gcode_lines.c",
        "coordinator/motion/planner/gcode_arcs.c",
    ],
)
