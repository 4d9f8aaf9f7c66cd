"""Watches the control loop: who holds it is named in the log, and what cannot wait is done meanwhile.

A callback that calculates, or waits for a disk, holds everything that lives on the loop. A timer of the
kernel is set whenever the loop begins to work and disarmed when it rests, so that watching costs two short
calls of the system for each rest, and wakes nobody while the loop is quick. It expires into a thread, which
also handles the events of one more descriptor.
"""

import asyncio
import ctypes
import faulthandler
import functools
import math
import os
import re
import select
import selectors
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from nodes.support.awake import WakingLoop
from nodes.support.terminal import show_error

LOOK_S: Final = 0.005
"""From so long on, a loop that is still at work is looked at: half of what a stop may take if it is quick."""
AGAIN_S: Final = 0.001
"""Between further looks; a TLS handshake takes three of them."""
HELD_S: Final = 0.05
"""Nothing may hold the loop for so long; it is reported."""
REPORT_EVERY_S: Final = 10.0
"""Reports between are left out, and counted."""
TURN_S: Final = 0.0001
"""The interpreter's switch interval while the loop is watched. Who calculates takes the interpreter at each
call of the system that another thread makes, and with the usual interval would give it back after 5 ms."""
STUCK_S: Final = 2.0
"""A loop that is held for so long may never write its log: the report goes to standard error."""
FRAMES_MAX: Final = 8
"""Of a report, the innermost ones."""
STACKS_BYTES_MAX: Final = 1 << 20
"""faulthandler writes 100 calls of 100 threads at most."""
_CLOCK_MONOTONIC: Final = 1
_TIMER_FLAGS: Final = os.O_CLOEXEC | os.O_NONBLOCK
_SIGNALS_BYTES: Final = 65_536
_STANDARD_ERROR: Final = 2
_CALL: Final = re.compile(r'^  File "(.*)", line (\d+|\?\?\?) in (.*)$', re.MULTILINE)
"""As faulthandler writes it."""


class _Times(ctypes.Structure):
    """``struct itimerspec``."""

    _fields_ = tuple(
        (f"{what}_{unit}", ctypes.c_long) for what in ("interval", "value") for unit in ("s", "ns")
    )


class _Timer:
    """A timer of the kernel that a thread can wait for; the calls take about a microsecond."""

    def __init__(self, first_s: float, again_s: float) -> None:
        self.fd: int = ctypes.PyDLL(None, use_errno=True).timerfd_create(_CLOCK_MONOTONIC, _TIMER_FLAGS)
        """Readable when ``has_expired``."""
        if self.fd < 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number))
        self._set: Any = ctypes.PyDLL(None).timerfd_settime  # without errno, for which ctypes takes a while
        self._armed = ctypes.byref(_Times(0, round(again_s * 1e9), 0, round(first_s * 1e9)))
        self._at_rest = ctypes.byref(_Times(0, 0, 0, 0))

    def arm(self) -> None:
        """Begin, from now on."""
        self._set(self.fd, 0, self._armed, None)

    def disarm(self) -> None:
        """Expire no more."""
        self._set(self.fd, 0, self._at_rest, None)

    def has_expired(self) -> bool:
        """Return whether it has expired since this was called last, or since it was set."""
        try:
            return bool(os.read(self.fd, 8))
        except BlockingIOError:
            return False

    def close(self) -> None:
        """Let go of it."""
        fd, self.fd = self.fd, -1
        if fd >= 0:
            os.close(fd)


class _WatchedSelector(selectors.DefaultSelector):
    """Where a loop rests; between two ``select`` it works."""

    def __init__(self) -> None:
        super().__init__()
        self.timer = _Timer(LOOK_S, AGAIN_S)
        self.busy_since_s = 0.0
        """When the loop began to work; 0: it rests."""
        self.rested = False
        """Whether it might have rested before that."""
        self.wake_by_s = math.inf
        """It rests until then at most."""
        self._armed_s = 0.0
        """When the timer was set."""

    def close(self) -> None:
        super().close()
        self.timer.close()

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        self.busy_since_s = 0.0
        self.rested = timeout != 0
        if self.rested:
            self.timer.disarm()
            if self.wake_by_s < math.inf:
                most_s = max(self.wake_by_s - time.monotonic(), 0.0)
                timeout = most_s if timeout is None else min(timeout, most_s)
        events = super().select(timeout)
        self.busy_since_s = now_s = time.monotonic()
        if self.rested or now_s > self._armed_s + AGAIN_S:  # else it has time for this turn, too
            self._armed_s = now_s
            self.timer.arm()
        return events


@dataclass(slots=True, eq=False)
class _Flexible:
    """What is called from a time on when the loop is awake, and at a later time at the latest."""

    earliest_s: float
    latest_s: float
    call: Callable[[], None]
    called: asyncio.Handle | None = None


class WatchedLoop(asyncio.SelectorEventLoop, WakingLoop):
    """asyncio's loop, which a LoopWatchdog can watch."""

    _ssock: socket.socket

    def __init__(self) -> None:
        self.watched = _WatchedSelector()
        self._flexible: list[_Flexible] = []
        self._when_awake: dict[Callable[[], None], int | None] = {}
        """With the descriptor whose events come to the same, and let others go on who have time."""
        super().__init__(self.watched)

    def when_awake(self, call: Callable[[], None], *, also_by: int | None = None) -> Callable[[], None]:
        """Call CALL whenever a timer or the descriptor ALSO_BY has woken the loop; return what ends that.

        Who has sent something to the program does not wait for what has time.

        It must be quick and not raise; what it has to do is for ``call_soon``, behind what has come.
        """
        self._when_awake[call] = also_by

        def end() -> None:
            del self._when_awake[call]

        return end

    def _process_events(self, event_list: list[tuple[selectors.SelectorKey, int]]) -> None:
        super()._process_events(event_list)  # type: ignore[misc]
        now_s, fds = self.watched.busy_since_s, {key.fd for key, _ in event_list}
        if self.watched.rested and fds.issubset(self._when_awake.values()):
            self._call_flexible([flexible for flexible in self._flexible if flexible.earliest_s <= now_s])
            for call, fd in tuple(self._when_awake.items()):
                if fd not in fds:
                    call()
        elif now_s >= self.watched.wake_by_s:
            self._call_flexible([flexible for flexible in self._flexible if flexible.latest_s <= now_s])

    def call_between(
        self, earliest_s: float, latest_s: float, call: Callable[[], None]
    ) -> Callable[[], None]:
        """Call CALL once, when the loop is awake anyway between two of its times, else at the later one.

        Return what cancels it.
        """
        flexible = _Flexible(earliest_s, latest_s, call)
        self._flexible.append(flexible)
        self.watched.wake_by_s = min(self.watched.wake_by_s, latest_s)

        def end() -> None:
            if flexible.called is not None:
                flexible.called.cancel()
            elif flexible in self._flexible:
                self._forget(flexible)

        return end

    def _call_flexible(self, due: Sequence[_Flexible]) -> None:
        for flexible in due:
            self._forget(flexible)
            flexible.called = self.call_soon(flexible.call)

    def _forget(self, flexible: _Flexible) -> None:
        self._flexible.remove(flexible)
        self.watched.wake_by_s = min((other.latest_s for other in self._flexible), default=math.inf)

    def pending_signals(self) -> list[int]:
        """Return the numbers of the signals that came and were not handled yet; from any thread."""
        try:
            found = self._ssock.recv(_SIGNALS_BYTES, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        except (OSError, AttributeError):  # nothing came; or the loop has closed
            return []
        return [number for number in found if number]


class LoopWatchdog:
    """Watches LOOP from ``start`` to ``close``, both on it.

    REPORT gets a sentence when something held the loop, on the loop; WHILE_HELD is called in the watchdog's
    thread again and again while something does; its argument returns whether that is still so. ON_EVENTS is
    called in this thread whenever the descriptor EVENTS_FD is readable, whatever the loop does.
    """

    def __init__(
        self,
        loop: WatchedLoop,
        report: Callable[[str], None],
        while_held: Callable[[Callable[[], bool]], None],
        events_fd: int,
        on_events: Callable[[], None],
    ) -> None:
        self._loop = loop
        self._report = report
        self._while_held = while_held
        self._events_fd = events_fd
        self._on_events = on_events
        self._selector = loop.watched
        self._loop_thread = threading.get_ident()
        self._thread = threading.Thread(target=self._run, name="loop watchdog", daemon=True)
        self._usual_switch_s = sys.getswitchinterval()
        self._closing = False
        self._reported_s = -REPORT_EVERY_S
        self._left_out = 0
        self._seen_s = 0.0
        self._stuck_s = 0.0
        self._failed_s = -REPORT_EVERY_S
        self._stacks = _Stacks()
        self._cpu_clock = time.pthread_getcpuclockid(self._loop_thread)
        self._first = (0.0, 0.0, 0.0)
        """Of the hold at hand: since when, when it was looked at first, the loop's processor time then."""

    def start(self) -> None:
        """Begin to watch."""
        sys.setswitchinterval(TURN_S)
        self._thread.start()

    def close(self) -> None:
        """Watch no more; also where it was never started, because something before it failed."""
        if self._thread.ident is not None:
            self._closing = True
            self._selector.timer.arm()
            self._thread.join()
        self._stacks.close()
        sys.setswitchinterval(self._usual_switch_s)

    def _run(self) -> None:
        poll = select.poll()
        for fd in (self._events_fd, self._selector.timer.fd):
            poll.register(fd, select.POLLIN)
        while True:
            ready = [fd for fd, _ in poll.poll()]
            if self._closing:
                return
            try:
                if self._events_fd in ready:
                    self._on_events()
                if self._selector.timer.has_expired() and (since_s := self._selector.busy_since_s):
                    self._while_held(functools.partial(self._is_held, since_s))
                    self._look(since_s)
            except Exception:  # noqa: BLE001 (it has to go on: it may be what stops the machine)
                self._say_failure()

    def _say_failure(self) -> None:
        now_s = time.monotonic()
        if now_s - self._failed_s >= REPORT_EVERY_S:
            self._failed_s = now_s
            _say(traceback.format_exc())

    def _is_held(self, since_s: float) -> bool:
        return self._selector.busy_since_s == since_s

    def _look(self, since_s: float) -> None:
        """Report a hold that began at SINCE_S, once."""
        now_s = time.monotonic()
        if self._first[0] != since_s:
            self._first = (since_s, now_s, time.clock_gettime(self._cpu_clock))
        if now_s - since_s >= STUCK_S and self._stuck_s != since_s:
            self._stuck_s = since_s
            _say(f"canductor: the control loop is held for {STUCK_S:g} s by {self._where()}")
        if now_s - since_s < HELD_S or self._seen_s == since_s:
            return
        self._seen_s = since_s
        if now_s - self._reported_s < REPORT_EVERY_S:
            self._left_out += 1
            return
        where = self._where()
        self._reported_s, left_out, self._left_out = now_s, self._left_out, 0
        _, first_s, cpu_s = self._first
        calculated_ms = (time.clock_gettime(self._cpu_clock) - cpu_s) * 1e3
        more = (
            f"; it calculated for {calculated_ms:.0f} of {(now_s - first_s) * 1e3:.0f} ms that were looked at"
        )
        more += f"; {left_out} times more since the last report" if left_out else ""
        try:
            self._loop.call_soon_threadsafe(self._tell, since_s, where, more)
        except RuntimeError:  # the loop has ended
            return

    def _where(self) -> str:
        return self._stacks.of(self._loop_thread)

    def _tell(self, since_s: float, where: str, more: str) -> None:
        held_ms = (time.monotonic() - since_s) * 1e3
        self._report(f"the control loop was held for {held_ms:.0f} ms by {where}{more}; please report it")


class _Stacks:
    """What threads are doing, as the interpreter itself writes it.

    Frames of a thread that goes on meanwhile must not be looked at from Python: with CPython 3.11 their
    ``f_back`` was found to be something else. faulthandler writes all stacks before any thread goes on.
    """

    def __init__(self) -> None:
        self._fd = os.memfd_create("stacks")

    def of(self, thread: int) -> str:
        """Return the innermost functions of the thread THREAD, the last first, without asyncio's own."""
        os.ftruncate(self._fd, 0)
        os.lseek(self._fd, 0, os.SEEK_SET)
        faulthandler.dump_traceback(self._fd, all_threads=True)
        stacks = os.pread(self._fd, STACKS_BYTES_MAX, 0).decode(errors="replace").split("\n\n")
        head = re.compile(f".*hread 0x0*{thread:x} ")
        calls = []
        for path, line, name in _CALL.findall(next(filter(head.match, stacks), "")):
            if name == "_run_once":
                break  # the rest is who runs the loop
            if "/asyncio/" not in path:
                calls.append(f"{name} ({'/'.join(path.split('/')[-2:])}:{line})")
        return " < ".join(calls[:FRAMES_MAX]) or "asyncio itself"

    def close(self) -> None:
        """Let go of the memory."""
        os.close(self._fd)


def _say(text: str) -> None:
    """Write the line TEXT to standard error, unless nobody reads there: this thread must not wait."""
    poll = select.poll()
    poll.register(_STANDARD_ERROR, select.POLLOUT)
    if poll.poll(0) == [(_STANDARD_ERROR, select.POLLOUT)]:
        show_error(text)
