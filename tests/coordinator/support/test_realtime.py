"""What a service with real-time priority starts has none; each service is a process of its own."""

import os
import subprocess
import sys

import pytest

TEMPLATES = """
import os
from coordinator.gcode.templates.renderer import TemplateRenderer
from tests.coordinator.gcode.templates.workers import children
renderer = TemplateRenderer()  # kept: its process ends with it
renderer.render("{ 1 }", {}, {})
print(os.sched_getscheduler(0), *map(os.sched_getscheduler, children()))
"""
ANNOUNCEMENT = """
import asyncio, os
from coordinator.ipc.discovery.announcer_process import launch_process
async def launch():
    process = await launch_process(["127.0.0.1"])
    print(os.sched_getscheduler(0), os.sched_getscheduler(process.pid))
    process.stdin.close()
    await process.wait()
asyncio.run(launch())
"""


def policies(program: str, *prefix: str) -> list[int]:
    """Return what PROGRAM prints: its own policy, and that of the process that it has started."""
    command = [*prefix, sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    if "failed to set" in done.stderr:
        pytest.skip(f"this user may not choose a policy: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    return [int(word) for word in done.stdout.split()]


@pytest.mark.parametrize("program", [TEMPLATES, ANNOUNCEMENT])
@pytest.mark.parametrize(
    ("policy", "own", "started"),
    [
        (("--rr", "5"), os.SCHED_RR, os.SCHED_OTHER),
        (("--fifo", "5"), os.SCHED_FIFO, os.SCHED_OTHER),
        (("--batch", "0"), os.SCHED_BATCH, os.SCHED_BATCH),  # chosen for all of it
    ],
)
def test_what_is_started_has_no_realtime_priority(
    program: str, policy: tuple[str, ...], own: int, started: int
) -> None:
    assert policies(program, "chrt", *policy) == [own, started]
