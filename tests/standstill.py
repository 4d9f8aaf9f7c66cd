"""A test in real time proves nothing while the computer stands still: what failed then is done again.

Nodes have commands for about half a second, and a host that hears nothing from them gives them up: machines
stop, as they should, when all processors of a virtual machine are given to others for as long. A watcher in
each process of the tests measures how late it gets its turn; the processes of nodes and services may have
waited as long as the kernel says that the host of this virtual machine took its processors away. A test that
failed while either was more than STILL_S is begun anew, with new fixtures, TRIES times in all, and told of at
the end. Without a standstill it has failed.
"""

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest
from _pytest.runner import CallInfo, runtestprotocol

STILL_S: Final = 0.2
TRIES: Final = 3
LOOK_S: Final = 0.02
OUTCOME: Final = "repeated"
PROPERTY: Final = "stood still"


def kernel_stolen_s() -> float:
    """Return what the host took away of all processors since this kernel began; see proc(5), steal."""
    try:
        told = Path("/proc/stat").read_text(encoding="ascii").split("\n", 1)[0].split()
    except OSError:
        return 0.0
    return int(told[8]) / os.sysconf("SC_CLK_TCK") if len(told) > 8 else 0.0


class Watcher:
    """Measures for how long this process got no turn, and what was stolen from all, from ``begin`` on."""

    def __init__(
        self, now_s: Callable[[], float] = time.monotonic, stolen_s: Callable[[], float] = kernel_stolen_s
    ) -> None:
        self.longest_s = 0.0
        self._now_s, self._stolen_s = now_s, stolen_s
        self._looked_s, self._stolen_before_s = now_s(), stolen_s()

    def begin(self) -> None:
        """Forget what was."""
        self.longest_s, self._stolen_before_s = 0.0, self._stolen_s()

    def still_s(self) -> float:
        """Return for how long any process of a test may have got no turn."""
        return max(self.longest_s, self._stolen_s() - self._stolen_before_s)

    def look(self) -> None:
        """Take note of the time; called every LOOK_S."""
        now_s = self._now_s()
        self.longest_s = max(self.longest_s, now_s - self._looked_s - LOOK_S)
        self._looked_s = now_s

    def run(self) -> None:
        """Look for ever."""
        pause = threading.Event()
        while True:
            pause.wait(LOOK_S)
            self.look()


class Repeating:
    """The plugin: WATCHER tells how long the computer stood still."""

    def __init__(self, watcher: Watcher) -> None:
        self._watcher = watcher

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item, nextitem: pytest.Item | None) -> bool:
        """Play ITEM, again when it failed in a standstill."""
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        for tries_left in reversed(range(TRIES)):
            self._watcher.begin()
            reports = runtestprotocol(item, nextitem=nextitem, log=False)
            failed = any(report.failed for report in reports)
            still_s = self._watcher.still_s() if failed else 0.0
            again = tries_left > 0 and still_s > STILL_S
            for report in reports:
                if again and report.failed:
                    report.outcome = OUTCOME  # type: ignore[assignment]  # shown by pytest_report_teststatus
                    report.user_properties.append((PROPERTY, round(still_s, 2)))
                if not again or _is_repeated(report):
                    item.ihook.pytest_runtest_logreport(report=report)
            if not again or not _make_new(item):
                break
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    def pytest_report_teststatus(
        self, report: pytest.TestReport
    ) -> tuple[str, str, tuple[str, dict[str, bool]]] | None:
        """Show a try that did not count."""
        return (OUTCOME, "R", ("REPEATED", {"yellow": True})) if _is_repeated(report) else None

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """List the tries that did not count."""
        for report in terminalreporter.getreports(OUTCOME):
            still_s = dict(report.user_properties)[PROPERTY]
            why = str(report.longrepr).strip().splitlines()[-1:]
            terminalreporter.write_line(
                f"REPEATED {report.nodeid}: the computer stood still for {still_s} s; {''.join(why)[:200]}"
            )


def _is_repeated(report: pytest.TestReport) -> bool:
    return str(report.outcome) == OUTCOME


def _make_new(item: pytest.Item) -> bool:
    """End all fixtures, also those that others share; return whether ITEM can be begun anew."""
    ended = CallInfo.from_call(lambda: item.session._setupstate.teardown_exact(None), when="teardown")
    if ended.excinfo is not None:
        report = item.ihook.pytest_runtest_makereport(item=item, call=ended)
        item.ihook.pytest_runtest_logreport(report=report)
        return False
    item._initrequest()  # type: ignore[attr-defined]
    return True
