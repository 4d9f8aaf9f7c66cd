"""Builds ``nodes.clock._clock``: the arithmetic of the clock's fits."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from nodes.support.native_build import builder

NAMES = ("linear", "normal", "start_fit", "pulse_parabola")

ffibuilder = builder(
    "nodes.clock._clock",
    headers=[f"nodes/clock/{name}.h" for name in NAMES],
    sources=[f"nodes/clock/{name}.c" for name in NAMES],
)
