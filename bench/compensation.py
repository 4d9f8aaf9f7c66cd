"""What an axis table is worth: position error on a virtual screw with and without the table measured on it.

    python bench/compensation.py

The screw is too long, wobbles once a turn and has backlash; the table is measured at its points by stopping
there from both sides. Errors are of the axis, all the time, moves and standstill, against the planned motion.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.coordinator.screw import Screw, Trial, carry_out, measure, workout

CASES = (
    ("progressive, periodic, backlash", Screw()),
    ("backlash alone", Screw(stretch=0, wobble_mm=0)),
    ("periodic alone", Screw(stretch=0, backlash_mm=0)),
)


def main() -> None:
    """Print the figures."""
    lines = workout(1, 40)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for case, screw in CASES:
            table = measure(screw, folder)
            without, corrected = (carry_out(lines, screw, folder, t) for t in ({}, {"x": table}))
            ratio = without.rms_mm / corrected.rms_mm
            say(f"{case}: rms {told(without)}, with table {told(corrected)}: 1/{ratio:.0f}")


def told(trial: Trial) -> str:
    """Return rms and largest error, in µm."""
    return f"{1e3 * trial.rms_mm:.2f} µm (largest {1e3 * float(np.abs(trial.errors_mm).max()):.1f})"


def say(text: str) -> None:
    """Print at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
