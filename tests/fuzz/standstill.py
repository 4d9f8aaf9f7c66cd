"""Notes when a processor runs nothing, not even a process of real-time priority: the computer stands still.

The host of a virtual machine has something else to do then (``steal`` in /proc/stat). One process for each
processor: `python -m tests.fuzz.standstill CPU`. It ends with its standard input, and prints a JSON list of
[since, until], in ns of CLOCK_MONOTONIC. Real-time priority needs root; for others the list is empty.
"""

import contextlib
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Final, Self

from tests.fuzz.live import ROOT

REST_MS: Final = 1
LATE_NS: Final = 1_000_000
"""From so late on a processor has stood still; waking takes some 0.1 ms."""
PRIORITY: Final = 50
Span = tuple[int, int]
"""Since when and until when, ns of CLOCK_MONOTONIC."""


class Standstills:
    """Watches all processors from ``__enter__`` to ``__exit__``."""

    def __init__(self) -> None:
        self.spans: list[Span] = []
        """When one of them stood still; complete at the end."""
        self._watching: list[subprocess.Popen[str]] = []

    def __enter__(self) -> Self:
        for cpu in sorted(os.sched_getaffinity(0)):
            command = [sys.executable, "-m", "tests.fuzz.standstill", str(cpu)]
            self._watching.append(
                subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            )
        return self

    def __exit__(self, *error: object) -> None:
        for process in self._watching:
            self.spans += [(since, until) for since, until in json.loads(process.communicate()[0])]


def stood_still_ms(spans: Sequence[Span], since_ns: int, until_ns: int) -> float:
    """Return how much of the time from SINCE_NS to UNTIL_NS lies in SPANS, which may overlap."""
    total_ns, done_ns = 0, since_ns
    for begun_ns, ended_ns in sorted(spans):
        first_ns, last_ns = max(begun_ns, done_ns), min(ended_ns, until_ns)
        if last_ns > first_ns:
            total_ns += last_ns - first_ns
            done_ns = last_ns
    return total_ns * 1e-6


def main() -> None:
    """Watch the processor that is given."""
    spans: list[Span] = []
    os.sched_setaffinity(0, {int(sys.argv[1])})
    poll = select.poll()
    poll.register(sys.stdin)
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        due_ns = time.monotonic_ns()
        while not poll.poll(REST_MS):
            due_ns += REST_MS * 1_000_000
            now_ns = time.monotonic_ns()
            if now_ns - due_ns > LATE_NS:
                spans.append((due_ns, now_ns))
            due_ns = now_ns
    sys.stdin.read()
    sys.stdout.write(json.dumps(spans))


if __name__ == "__main__":
    main()
