"""The emergency stop while the control loop is held: what finds it, and what it does without the loop."""

import asyncio
import contextlib
import signal
from collections.abc import Callable
from typing import Final

from coordinator.ipc.server.stop_lane import StopLane
from coordinator.runtime.machine import Machine
from coordinator.service.core.machine_service import MachineService
from coordinator.support.loop_watchdog import LoopWatchdog, WatchedLoop
from nodes.support.termination import TERMINATION

SIGNALS: Final = frozenset((signal.SIGINT, *TERMINATION))


class StopPath:
    """Watches the running loop for SERVICE from ``start`` to ``close``, and stops its nodes when it is held.

    The servers of its front ends get ``lane``. All that it does in the watchdog's thread is to send the stop
    to the nodes, by calls that any thread may make; the loop carries out the rest of it when it can.
    """

    def __init__(self, service: MachineService) -> None:
        self.lane = StopLane(self._stop)
        service.find_unread_stop = self.lane.find
        self._service = service
        self._loop = asyncio.get_running_loop()
        self._looked_for: Machine | None = None
        """The machine that ran when a look began: what is found in it does not concern a later one."""
        self._stopped: Machine | None = None
        self._watchdog: LoopWatchdog | None = None
        if isinstance(self._loop, WatchedLoop):
            self._watchdog = LoopWatchdog(
                self._loop, self._report, self._while_held, self.lane.events_fd, self._handle_events
            )

    def start(self) -> None:
        """Begin to watch; without effect on a loop that cannot be watched, such as a simulation's."""
        if self._watchdog is not None:
            self._watchdog.start()

    def close(self) -> None:
        """Watch no more."""
        if self._watchdog is not None:
            self._watchdog.close()
        self.lane.close()

    def _stop(self, who: str) -> None:
        """Have WHO stop the machine: its nodes are stopped, and the loop enters the rest."""
        self._stop_nodes(lambda: self._service.emergency_stop(who))

    def _stop_nodes(self, then: Callable[[], None]) -> None:
        """Stop the nodes of the machine, unless that was done; the loop calls THEN when it can."""
        machine = self._looked_for
        if machine is None or machine is self._stopped or machine.stopped is not None:
            return
        self._stopped = machine

        def announced() -> None:
            if self._service.machine is machine:  # else the loop has read it before: a later one runs
                then()

        # First: what the nodes report of their stop must not come to the loop before the cause.
        machine.announced_stop = announced
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(machine.stop_as_announced)
        machine.stop_nodes()

    def _handle_events(self) -> None:
        self._looked_for = self._service.machine
        self.lane.handle_events()

    def _while_held(self, is_held: Callable[[], bool]) -> None:
        self._looked_for = self._service.machine
        self.lane.look(is_held)
        if (
            isinstance(self._loop, WatchedLoop)
            and self._service.moves
            and SIGNALS.intersection(self._loop.pending_signals())
        ):
            self._stop_nodes(self._service.cut_off_motion)

    def _report(self, sentence: str) -> None:
        self._service.log.add("notice", sentence)
