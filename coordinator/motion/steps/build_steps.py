"""Builds ``coordinator.motion.steps._steps``: step generation, compression and the nodes' command streams."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from nodes.support.native_build import builder

ffibuilder = builder(
    "coordinator.motion.steps._steps",
    headers=["coordinator/motion/trapezoid.h", "coordinator/motion/steps/steps.h"],
    sources=[
        "coordinator/motion/steps/steps.c",
        "coordinator/motion/steps/step_change.c",
        "coordinator/motion/steps/step_table.c",
        "coordinator/motion/steps/step_times.c",
        "coordinator/motion/steps/step_axes.c",
        "coordinator/motion/steps/step_smooth.c",
        "coordinator/motion/steps/step_kinematics.c",
        "coordinator/kinematics/delta.c",
        "coordinator/kinematics/deltesian.c",
        "coordinator/kinematics/polar.c",
        "coordinator/kinematics/rotary_delta.c",
        "coordinator/kinematics/winch.c",
        "coordinator/motion/steps/step_curve.c",
        "coordinator/motion/steps/step_compress.c",
        "coordinator/motion/steps/step_fit.c",
        "coordinator/motion/steps/step_bands.c",
        "coordinator/motion/steps/step_arithmetic.c",
        "coordinator/motion/steps/step_stream.c",
        "firmware/wire/vlq.c",
    ],
)
