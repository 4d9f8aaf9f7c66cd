"""What an axis table is worth: position error on a virtual screw with and without the table measured on it.

    python bench/compensation.py

The screw is too long, wobbles once a turn and has backlash; the table is measured at its points by stopping
there from both sides. Errors are of the axis, all the time, moves and standstill, against the planned motion.

The floor is the error of the same program on a perfect screw without a table: steps are whole, and may come
12.5 µs early or late. What a table leaves is the floor and what is between its points.
"""

import math
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.coordinator.screw import KNOT_MM, PERFECT, Screw, Trial, carry_out, measure, workout

CASES = (
    ("progressive, periodic, backlash", Screw()),
    ("progressive alone", Screw(wobble_mm=0, backlash_mm=0)),
    ("backlash alone", Screw(stretch=0, wobble_mm=0)),
    ("periodic alone", Screw(stretch=0, backlash_mm=0)),
)
MICROSTEPS = (32, 64)
COARSE_MM = 2 * KNOT_MM


def main() -> None:
    """Print the figures."""
    with tempfile.TemporaryDirectory() as name:
        for microsteps in MICROSTEPS:
            one_machine(Path(name), microsteps)


def one_machine(folder: Path, microsteps: int) -> None:
    """Try all cases with that many microsteps."""
    lines = workout(1, 40)
    floor = carry_out(lines, PERFECT, folder, {}, microsteps=microsteps)
    step_um = 1e3 * PERFECT.lead_mm / (200 * microsteps)
    say(
        f"steps of {step_um:g} µm: floor {told(floor)}; of rounding to whole steps alone "
        f"{step_um / math.sqrt(12):.2f} µm"
    )
    for case, screw in CASES:
        without = carry_out(lines, screw, folder, {}, microsteps=microsteps)
        for knot_mm in (KNOT_MM, COARSE_MM) if screw.wobble_mm else (KNOT_MM,):
            table = measure(screw, folder, knot_mm=knot_mm, microsteps=microsteps)
            corrected = carry_out(lines, screw, folder, {"x": table}, microsteps=microsteps)
            say(
                f"  {case}, points {knot_mm:g} mm apart: rms {told(without)}, with table {told(corrected)}: "
                f"1/{without.rms_mm / corrected.rms_mm:.0f}; the floor would be "
                f"1/{without.rms_mm / floor.rms_mm:.0f}"
            )


def told(trial: Trial) -> str:
    """Return rms and largest error, in µm."""
    return f"{1e3 * trial.rms_mm:.2f} µm (largest {1e3 * float(np.abs(trial.errors_mm).max()):.1f})"


def say(text: str) -> None:
    """Print at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
