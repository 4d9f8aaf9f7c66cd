"""What modules have called again and again, and once, in virtual time."""

import asyncio
from collections.abc import Awaitable, Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from coordinator.runtime.machine import Machine
from coordinator.runtime.module_context import ModuleContext
from coordinator.runtime.timebase import TimeBase
from nodes.clock.clock import HostTime, Ticks
from tests.nodes import virtual_time


class Clock:
    """Of 1 MHz, 0.5 s behind the host."""

    def ticks_at(self, at_ns: HostTime, /) -> Ticks:
        return Ticks(round(at_ns / 1000) - 500_000)

    def ns_at(self, ticks: Ticks, /) -> HostTime:
        return HostTime((ticks + 500_000) * 1000)


class Calls:
    """When something was called, s after the start."""

    def __init__(self) -> None:
        self.came_s: list[float] = []
        self._loop = asyncio.get_running_loop()
        self._begun_s = self._loop.time()

    def __call__(self) -> None:
        self.came_s.append(round(self._loop.time() - self._begun_s, 6))


def run(check: Callable[[ModuleContext], Awaitable[None]]) -> list[dict[str, Any]]:
    """Run CHECK with a context, begun at a multiple of a second; return the errors that were reported."""
    failures: list[dict[str, Any]] = []
    primary, other = Clock(), Clock()
    nodes = {"mcu": SimpleNamespace(best_clock=primary), "toolhead": SimpleNamespace(best_clock=other)}

    async def main() -> None:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: failures.append(context))
        await asyncio.sleep(-loop.time() % 1.0)
        host = SimpleNamespace(now=lambda: HostTime(round(loop.time() * 1e9)))
        machine = SimpleNamespace(time_base=lambda: TimeBase(primary, 1e6), host=host, nodes=nodes)
        live = ModuleContext(cast("Machine", machine), lambda _: None)
        await check(live)
        live.close()
        await asyncio.sleep(3.0)

    virtual_time.run(main())
    return failures


def test_calls_of_one_period_come_together_and_not_too_early() -> None:
    async def check(live: ModuleContext) -> None:
        first, early, late, slow = Calls(), Calls(), Calls(), Calls()
        live.every(1.0, first)
        live.every(2.0, slow)
        await asyncio.sleep(0.4)
        live.every(1.0, early)
        await asyncio.sleep(0.3)
        live.every(1.0, late)
        await asyncio.sleep(3.5)
        assert first.came_s == [1.0, 2.0, 3.0, 4.0]
        assert early.came_s == [1.0, 2.0, 3.0, 4.0]
        assert late.came_s == [2.0, 3.0, 4.0], "half a period had not passed at 1.0"
        assert slow.came_s[0] - 2.0 <= 1.0
        assert slow.came_s[1] - slow.came_s[0] == pytest.approx(2.0)

    assert run(check) == []


def test_one_that_ends_does_not_end_the_others_and_may_end_itself() -> None:
    async def check(live: ModuleContext) -> None:
        stays, goes = Calls(), Calls()
        ends: list[Callable[[], None]] = []

        def last() -> None:
            goes()
            ends[0]()
            ends[1]()  # before its turn

        live.every(1.0, stays)
        ends += [live.every(1.0, last), live.every(1.0, goes)]
        await asyncio.sleep(2.5)
        assert goes.came_s == [1.0]
        assert stays.came_s == [1.0, 2.0]
        ends[0]()  # again: no effect

    assert run(check) == []


def test_the_last_one_that_ends_ends_all_and_another_begins_anew() -> None:
    async def check(live: ModuleContext) -> None:
        calls = Calls()
        live.every(1.0, calls)()
        await asyncio.sleep(1.7)
        live.every(1.0, calls)
        await asyncio.sleep(2.0)
        assert calls.came_s == [3.0]

    assert run(check) == []


def test_one_that_fails_is_reported_and_the_others_are_called() -> None:
    async def check(live: ModuleContext) -> None:
        calls = Calls()
        live.every(1.0, lambda: cast("None", 1 / 0))
        live.every(1.0, calls)
        await asyncio.sleep(2.5)
        assert calls.came_s == [1.0, 2.0]

    reported = run(check)
    assert [type(context["exception"]) for context in reported] == [ZeroDivisionError] * 2


def test_once_is_once_at_the_earlier_time_unless_it_is_cancelled() -> None:
    async def check(live: ModuleContext) -> None:
        calls, cancelled, closed = Calls(), Calls(), Calls()
        live.after(0.7, calls)
        live.after(0.8, calls, most_s=1.2)
        end = live.after(0.9, cancelled)
        live.after(5.0, closed)
        end()
        end()
        await asyncio.sleep(2.0)
        assert calls.came_s == [0.7, 0.8]
        live.close()
        await asyncio.sleep(5.0)
        assert (cancelled.came_s, closed.came_s) == ([], [])

    assert run(check) == []


@pytest.mark.parametrize("node", ["mcu", "toolhead"])
def test_clocks_and_print_times(node: str) -> None:
    """Those of the primary node need no estimate of its clock; the result is the same."""

    async def check(live: ModuleContext) -> None:
        at_s = live.print_time_now()
        ticks = live.ticks_at(node, at_s + 0.25)
        assert ticks == round((at_s + 0.25) * 1e6)
        assert live.print_time_of(node, ticks % 2**32) == pytest.approx(at_s + 0.25, abs=1e-6)
        assert live.soon(0.0) == pytest.approx(at_s + 0.1)

    assert run(check) == []
