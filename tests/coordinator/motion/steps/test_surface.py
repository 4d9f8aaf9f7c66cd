"""The shape of a bed as an object of Python; what it does to steps is in test_exact_bed.py."""

import subprocess
import sys

# In a process of its own, which it would end.
DROPPED_IN_A_CYCLE = """
import gc
from coordinator.motion.steps.surface import Surface

class Machine:
    def __init__(self, surface):
        self.surface, self.itself = surface, self

gc.disable()
Machine(Surface((0.0, 0.0), (10.0, 10.0), [[(0.0,) * 4] * 3] * 3))
print(gc.collect() > 0)
"""


def test_a_machine_with_a_bed_that_is_older_than_it_is_freed() -> None:
    done = subprocess.run(
        [sys.executable, "-c", DROPPED_IN_A_CYCLE], check=False, capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "True\n", "")
