"""Builds ``coordinator.motion._steps``: step generation, compression and the nodes' command streams."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from nodes.native_build import builder

ffibuilder = builder(
    "coordinator.motion._steps",
    headers=["coordinator/motion/trapezoid.h", "coordinator/motion/steps.h"],
    sources=[
        "coordinator/motion/steps.c",
        "coordinator/motion/step_change.c",
        "coordinator/motion/step_table.c",
        "coordinator/motion/step_times.c",
        "coordinator/motion/step_axes.c",
        "coordinator/motion/step_smooth.c",
        "coordinator/motion/step_kinematics.c",
        "coordinator/motion/kin_delta.c",
        "coordinator/motion/kin_deltesian.c",
        "coordinator/motion/kin_polar.c",
        "coordinator/motion/kin_rotary_delta.c",
        "coordinator/motion/kin_winch.c",
        "coordinator/motion/step_curve.c",
        "coordinator/motion/step_compress.c",
        "coordinator/motion/step_fit.c",
        "coordinator/motion/step_bands.c",
        "coordinator/motion/step_arithmetic.c",
        "coordinator/motion/step_stream.c",
        "firmware/wire/vlq.c",
    ],
)
