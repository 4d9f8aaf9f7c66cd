"""The running machine as its modules see it."""

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from typing import Final

from coordinator.config.saved import SaveError, checked
from coordinator.runtime.machine import Machine
from nodes.clock.clock import HostTime, extend32
from nodes.node.node import Node
from nodes.support.awake import call_between

AHEAD_S: Final = 0.1
"""How far ahead of now the earliest commands are timed: they need their time to the node."""

SLACK: Final = 0.35
"""By how much of its period something that is done again and again may be later: sensors that report every
0.3 s wake the host meanwhile for what comes every second."""


class ModuleContext:
    """MACHINE, connected. SAY shows a sentence to the user. Everything on the control loop."""

    def __init__(self, machine: Machine, say: Callable[[str], None]) -> None:
        self.machine = machine
        """For modules of the project: what others may rely upon are the methods."""
        self.say = say
        self._time_base = machine.time_base()
        self._periodic: dict[float, _PeriodicTimer] = {}
        """By their periods."""
        self._timers: set[Callable[[], None]] = set()
        """What cancels them."""
        self._loop = asyncio.get_running_loop()

    def node(self, name: str) -> Node:
        """Return a node by its name."""
        return self.machine.nodes[name]

    def now_s(self) -> float:
        """Return the host's time in s; only differences mean something."""
        return self.machine.host.now() * 1e-9

    def print_time_now(self) -> float:
        """Return the present print time in s."""
        return self._time_base.print_time_at(self.machine.host.now())

    def soon(self, print_time_s: float = 0.0) -> float:
        """Return a print time that commands for a node still reach in time, not before PRINT_TIME_S."""
        return max(print_time_s, self.print_time_now() + AHEAD_S)

    def ticks_at(self, node: str, print_time_s: float) -> int:
        """Return what the clock of a node shows at a print time; 64 bits."""
        return self._time_base.ticks_at(self.machine.nodes[node].best_clock, print_time_s)

    def ticks_in(self, node: str, seconds: float) -> int:
        """Return what the clock of a node shows so many seconds from now; 64 bits."""
        at_ns = HostTime(self.machine.host.now() + round(seconds * 1e9))
        return self.machine.nodes[node].best_clock.ticks_at(at_ns)

    def print_time_of(self, node: str, clock32: int) -> float:
        """Return the print time at which a node's clock shows CLOCK32, the nearest one to now."""
        clock = self.machine.nodes[node].best_clock
        ticks = extend32(clock32, clock.ticks_at(self.machine.host.now()))
        return self._time_base.print_time_of(clock, ticks)

    def soon_on_loop(self, call: Callable[[], None]) -> None:
        """Call CALL on the control loop; from any thread."""
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(call)

    def every(self, seconds: float, call: Callable[[], None]) -> Callable[[], None]:
        """Call CALL every so many seconds; returns what ends it. All end when the machine closes.

        Calls of one period come together, so that they wake the computer once, and up to SLACK of it later,
        when it is awake anyway: the first comes after half to one and a half periods.
        """
        if seconds not in self._periodic:
            self._periodic[seconds] = _PeriodicTimer(seconds)
        return self._periodic[seconds].add(call)

    def after(self, least_s: float, call: Callable[[], None], most_s: float = 0.0) -> Callable[[], None]:
        """Call CALL once after so many seconds; return what cancels it.

        With more than LEAST_S as MOST_S it comes between the two, when the computer is awake anyway.
        """
        now_s = self._loop.time()

        def fire() -> None:
            self._timers.discard(cancel)
            call()

        def end() -> None:
            self._timers.discard(cancel)
            cancel()

        cancel = call_between(now_s + least_s, now_s + max(least_s, most_s), fire)
        self._timers.add(cancel)
        return end

    def save(self, section: str, option: str, text: str) -> None:
        """Save a calibrated value with the next SAVE_CONFIG; raises SaveError for text it cannot write."""
        self.machine.unsaved.put(section, option, text)

    def save_soon(self, section: str, options: Mapping[str, str]) -> None:
        """Do the same with OPTIONS, from any thread; what takes long is done in that thread."""
        found = checked(section, options)
        self.soon_on_loop(lambda: self.machine.unsaved.put_checked(section, found))

    def remove_saved(self, section: str) -> None:
        """Have SAVE_CONFIG remove a section that it wrote; raises SaveError for one that the user wrote."""
        self.machine.unsaved.remove(section)

    def drop_saved(self, section: str) -> bool:
        """Do the same and say so where it cannot be; return whether it is removed."""
        try:
            self.remove_saved(section)
        except SaveError as error:
            self.say(str(error))
            return False
        return True

    def stop(self, cause: str) -> None:
        """Stop the whole machine for safety: CAUSE is a sentence with what to do."""
        self.machine.stop(cause)

    def close(self) -> None:
        """End all timers."""
        for timer in self._periodic.values():
            timer.close()
        for cancel in self._timers:
            cancel()
        self._timers.clear()


class _PeriodicTimer:
    """Calls what is to be called every so many SECONDS, all at once."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._loop = asyncio.get_running_loop()
        self._calls: dict[object, tuple[float, Callable[[], None]]] = {}
        """From when on it is called, the loop's time, and what."""
        self._due_s = 0.0
        self._cancel: Callable[[], None] | None = None

    def add(self, call: Callable[[], None]) -> Callable[[], None]:
        """Call CALL, too; return what ends that."""
        key, now_s = object(), self._loop.time()
        self._calls[key] = now_s + self._seconds / 2, call
        if self._cancel is None:
            self._due_s = round(now_s / self._seconds + 1) * self._seconds
            self._wait()

        def end() -> None:
            self._calls.pop(key, None)
            if not self._calls:
                self.close()

        return end

    def close(self) -> None:
        """Call nothing more."""
        self._calls.clear()
        if self._cancel is not None:
            self._cancel()
            self._cancel = None

    def _wait(self) -> None:
        self._cancel = call_between(self._due_s, self._due_s + SLACK * self._seconds, self._fire)

    def _fire(self) -> None:
        due_s = self._due_s
        # Missed calls are not repeated: the loop was busy, or the machine slept.
        self._due_s = max(due_s + self._seconds, self._loop.time())
        self._wait()
        for key, (from_s, call) in tuple(self._calls.items()):
            if key in self._calls and from_s <= due_s:
                try:
                    call()
                except Exception as bug:  # noqa: BLE001 (the others are called all the same)
                    self._loop.call_exception_handler({"message": "a regular call failed", "exception": bug})
