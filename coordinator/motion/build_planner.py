"""Builds ``coordinator.motion._planner``: the G-code hot path and the look-ahead."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from nodes.native_build import builder

ffibuilder = builder(
    "coordinator.motion._planner",
    headers=[
        "coordinator/motion/trapezoid.h",
        "coordinator/motion/planner_queue.h",
        "coordinator/motion/gcode_lines.h",
    ],
    sources=[
        "coordinator/motion/planner_queue.c",
        "coordinator/motion/planner_move.c",
        "coordinator/motion/gcode_lines.c",
        "coordinator/motion/gcode_arcs.c",
    ],
)
