"""Which files are mutated, in areas, and which tests may notice."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]

AREAS: Final[dict[str, tuple[str, ...]]] = {
    "core": ("firmware/core/*.[ch]",),
    "objects": ("firmware/objects/*.[ch]",),
    "net": ("firmware/net/*.[ch]",),
    "link": ("nodes/link/*/*.[ch]", "nodes/link/*.py"),
    "clock": ("nodes/clock/*.[ch]", "nodes/clock/*.py", "nodes/node/clock_keeper.py"),
    "homing": (
        "coordinator/runtime/moves/homing.py",
        "coordinator/modules/homing/homing.py",
        "coordinator/modules/homing/homing_plan.py",
        "coordinator/modules/homing/homing_override.py",
        "coordinator/modules/homing/safe_z_home.py",
    ),
    "heat": (
        "coordinator/heat/verify.py",
        "coordinator/heat/watermark.py",
        "coordinator/heat/pid.py",
        "coordinator/modules/heaters/heater.py",
        "coordinator/modules/heaters/heaters.py",
        "coordinator/modules/heaters/verify_heater.py",
        "coordinator/modules/sensors/temperature_source.py",
    ),
    "streams": ("coordinator/motion/steps/step_stream.c",),
}
"""Name of an area to the patterns of its files, from the project's root."""

LEFT_OUT: Final = ("build_*.py", "__init__.py", "_*", "interfaces.py")
"""Build scripts, packages' faces, generated files and protocols, which have no code."""

SAFETY: Final = (
    *(f"firmware/core/{name}" for name in ("sched.c", "node.h")),
    *(
        f"firmware/objects/{name}.c"
        for name in ("digital_out", "pwm_out", "timed_output", "trsync", "endstop")
    ),
    "firmware/net/bus_signals.c",
    "coordinator/heat/verify.py",
    "coordinator/modules/heaters/heater.py",
    "coordinator/modules/sensors/temperature_source.py",
)
"""What makes heat or stops motion: no mutant may survive here without a reason."""

TESTS: Final = (
    *(f"tests/{name}" for name in ("firmware", "nodes", "sim")),
    *(
        f"tests/coordinator/{name}"
        for name in ("heat", "modules", "motion", "kinematics", "demo", "runtime", "streaming")
    ),
)
"""Where tests are looked for."""

REAL_PROCESSES: Final = (
    *("tests/firmware/test_linux_board.py", "tests/nodes/virtual/test_", "tests/nodes/transport"),
    "tests/sim/test_mutants.py",
)
"""Tests that talk to processes in real time or read other things than the code under test: a busy computer
may fail them, which would count as a killed mutant."""

MODULES: Final = (
    "nodes/virtual/build_sim.py",
    "nodes/link/build_link.py",
    "nodes/clock/build_clock.py",
    "coordinator/motion/steps/build_steps.py",
)
"""Build scripts of the extension modules that contain mutated C."""


def files(area: str = "") -> list[str]:
    """Return the files of AREA, of all areas by default, sorted; raises KeyError for an unknown area."""
    chosen = [AREAS[area]] if area else list(AREAS.values())
    return sorted(set(_matches(pattern for patterns in chosen for pattern in patterns)))


def _matches(patterns: Iterator[str]) -> Iterator[str]:
    for pattern in patterns:
        for path in ROOT.glob(pattern):
            if not any(path.match(left_out) for left_out in LEFT_OUT):
                yield str(path.relative_to(ROOT))
