"""Hosts that end with the heater on, as processes: by SIGKILL, and stopped for two seconds by SIGSTOP.

The nodes are virtual nodes in processes of their own, with a plant; what is told comes from the log of the
toolhead's pins, whose times are those of CLOCK_MONOTONIC.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from nodes.support.errors import CanductorError
from nodes.virtual.edge_log import EdgeLog
from nodes.virtual.firmware import firmware_dictionary
from nodes.virtual.plant_page import PlantItemKind, PlantPage
from tests.sim.safety.row import MAX_DURATION_S, Row
from tests.stages.real_nodes import CONFIG, real_nodes
from tests.stages.safety_rig import HEATERS, MACHINE

PATIENCE_S: Final = 60.0
STALL_S: Final = 2.0
STILL_S: Final = 1.5
"""A heater that gave nothing for so long is off: longer than a cycle of its PWM."""
TARGET_C: Final = 250.0
WARM_C: Final = 27.0
"""From which on it is seen to heat."""
UNCERTAIN_S: Final = 0.05
"""Of the relation between a node's clock and the host's, and of the kernel's turns."""
NODE, PIN = HEATERS["extruder"]
FLAVOUR: Final = {"mcu": "canductor-node-mainboard", "toolhead": "canductor-node-toolhead"}
End = Callable[["subprocess.Popen[bytes]"], int]
"""What is done to a host; returns when that was (CLOCK_MONOTONIC, ns)."""


def rows() -> list[Row]:
    """Return what happened; raises CanductorError when it could not be tried."""
    return [row("host killed (SIGKILL)", killed), row("host stopped 2 s (SIGSTOP)", stopped)]


def row(case: str, end: End) -> Row:
    """Return how soon the heater was off when END was done to a host that heats."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        page = stack.enter_context(real_nodes(MACHINE, folder))[NODE]
        with _host(folder / CONFIG) as host:
            _wait_for(lambda: page.temperature("extruder") > WARM_C, "the hotend gets warm")
            since_ns = end(host)
            _wait_until_it_is_off(page)
            told = _last_words(host)
        stack.close()
        off_s = (_last_off_ns(folder) - since_ns) * 1e-9
    bound_s = MAX_DURATION_S + UNCERTAIN_S
    return Row(case, "extruder", max(0.0, off_s), bound_s, "-", off_s <= bound_s, told)


def killed(host: "subprocess.Popen[bytes]") -> int:
    """Kill it."""
    host.kill()
    host.wait()
    return time.monotonic_ns()


def stopped(host: "subprocess.Popen[bytes]") -> int:
    """Let it stand still for STALL_S."""
    host.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, host.pid, os.WSTOPPED | os.WNOWAIT)
    since_ns = time.monotonic_ns()
    time.sleep(STALL_S)
    host.send_signal(signal.SIGCONT)
    return since_ns


def _last_words(host: "subprocess.Popen[bytes]") -> str:
    """Return the last line that a host wrote before it ended."""
    _, errors = host.communicate(timeout=PATIENCE_S)
    return errors.decode(errors="replace").strip().rpartition("\n")[2]


@contextmanager
def _host(config: Path) -> "Iterator[subprocess.Popen[bytes]]":
    """Run a host that heats."""
    command = [sys.executable, "-m", "tests.sim.safety.heating_host", str(config), f"{TARGET_C:g}"]
    host = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        assert host.stdout is not None
        if host.stdout.readline() != b"heating\n":
            raise CanductorError(f"the host did not begin to heat: {_last_words(host)}")
        yield host
    finally:
        host.kill()
        host.communicate()


def _wait_until_it_is_off(page: PlantPage) -> None:
    given_j, since_s = -1.0, time.monotonic()

    def off() -> bool:
        nonlocal given_j, since_s
        now_j = page.item(PlantItemKind.HEATER, "extruder").extra
        if now_j != given_j:
            given_j, since_s = now_j, time.monotonic()
        return time.monotonic() - since_s > STILL_S

    _wait_for(off, "the heater is off")


def _wait_for(true: Callable[[], bool], what: str) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not true():
        if time.monotonic() > deadline_s:
            raise CanductorError(f"it took more than {PATIENCE_S:g} s until {what}")
        time.sleep(0.02)


def _last_off_ns(folder: Path) -> int:
    """Return when the heater's pin went off for good, by the node's log."""
    log = EdgeLog(folder / f"{NODE}.edges")
    number = firmware_dictionary(FLAVOUR[NODE]).enumerations["pin"].values[PIN]
    *_, (clocks, _, levels) = log.edges(number)
    if levels[-1]:
        raise CanductorError("the heater is on")
    return int(log.ticks_to_monotonic_ns(clocks)[-1])
