"""Short time slices; each in a process of its own."""

import json
import os
import platform
import subprocess
import sys

import pytest

from coordinator.support.time_slice import SLICE_NS

SHOWN = """
import json, threading
from coordinator.support.time_slice import shorten_time_slice, slice_attributes
def look():
    found = slice_attributes()
    seen.append(None if found is None else [found.policy, found.runtime_ns])
seen = []
shorten_time_slice(1_000_000)  # whatever the tests' own process has
look()
shorten_time_slice()
thread = threading.Thread(target=look)
thread.start()
thread.join()
print(json.dumps(seen))
"""


def policies_and_slices(*prefix: str) -> list[list[int] | None]:
    """Return both before, and those of a thread that was begun after it, ns."""
    shown = subprocess.run(
        [*prefix, sys.executable, "-c", SHOWN], capture_output=True, text=True, check=True, timeout=60
    )
    found: list[list[int] | None] = json.loads(shown.stdout)
    return found


def test_threads_begun_from_then_on_have_short_slices() -> None:
    before, after = policies_and_slices()
    if before is None or before[1] == 0:
        pytest.skip(f"Linux {platform.release()} on {platform.machine()} has no time slices to choose")
    assert before == [os.SCHED_OTHER, 1_000_000]
    assert after == [os.SCHED_OTHER, SLICE_NS]


def test_a_policy_that_somebody_has_chosen_stays() -> None:
    before, after = policies_and_slices("chrt", "--batch", "0")
    assert before == after
