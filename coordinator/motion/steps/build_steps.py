"""Builds ``coordinator.motion.steps._steps``: step generation, compression and the nodes' command streams."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from nodes.support.native_build import ROOT, builder

ffibuilder = builder(
    "coordinator.motion.steps._steps",
    headers=["coordinator/motion/trapezoid.h", "coordinator/motion/steps/steps.h"],
    sources=[
        *sorted(
            str(source.relative_to(ROOT))
            for folder in ("coordinator/motion/steps", "coordinator/kinematics")
            for source in (ROOT / folder).rglob("*.c")
            if not source.name.startswith("_")
        ),
        "firmware/wire/vlq.c",
    ],
)
