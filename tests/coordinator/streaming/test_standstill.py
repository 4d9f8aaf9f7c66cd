"""What is performed at rest: ended on its way it tidies up undisturbed; the program hears what became."""

import asyncio

import pytest

from coordinator.gcode.events import Done, StandstillAction
from coordinator.streaming.standstill import StandstillTask
from nodes.support.errors import CanductorError


async def look_until_over(task: StandstillTask) -> None:
    for _ in range(100):
        if task.look():
            return
        await asyncio.sleep(0)
    raise AssertionError


def test_what_is_ended_tidies_up_though_it_is_looked_at_meanwhile() -> None:
    steps: list[int] = []

    async def perform() -> Done:
        try:
            await asyncio.Event().wait()
        finally:
            for step in range(5):  # such as stopping one node after the other
                await asyncio.sleep(0)
                steps.append(step)
        raise AssertionError

    async def go() -> StandstillAction:
        event = StandstillAction(1, 0.0, perform, Done(("planned",)))
        task = StandstillTask(event)
        await asyncio.sleep(0)
        event.cancelled = True
        await look_until_over(task)
        return event

    event = asyncio.run(go())
    assert steps == [0, 1, 2, 3, 4]
    assert (event.over, event.moved, event.done, event.failure) == (True, True, None, "")


def test_a_cancel_of_whoever_waits_for_the_end_is_not_lost() -> None:
    """A service that was ended right behind an emergency stop went on, and waited for a restart."""
    steps: list[int] = []

    async def perform() -> Done:
        try:
            await asyncio.Event().wait()
        finally:
            for step in range(5):
                await asyncio.sleep(0)
                steps.append(step)
        raise AssertionError

    async def go() -> asyncio.Task[None]:
        task = StandstillTask(StandstillAction(1, 0.0, perform, None))
        await asyncio.sleep(0)
        closing = asyncio.create_task(task.close())
        await asyncio.sleep(0)
        closing.cancel()
        await asyncio.wait([closing])
        return closing

    assert asyncio.run(go()).cancelled()
    assert steps == [0, 1, 2, 3, 4]


def test_what_fails_is_told_and_may_have_moved() -> None:
    async def perform() -> Done:
        raise CanductorError("no switch")

    async def go() -> StandstillAction:
        event = StandstillAction(1, 0.0, perform, None)
        await look_until_over(StandstillTask(event))
        return event

    event = asyncio.run(go())
    assert (event.over, event.moved, event.done, event.failure) == (True, True, None, "no switch")


@pytest.mark.parametrize("done", [Done(("hot",)), Done(moved=True), None])
def test_what_is_done_is_kept(done: Done | None) -> None:
    async def perform() -> Done | None:
        return done

    async def go() -> StandstillAction:
        event = StandstillAction(1, 0.0, perform, None)
        await look_until_over(StandstillTask(event))
        return event

    event = asyncio.run(go())
    assert event.done == (done or Done())
    assert event.moved is (done is not None and done.moved)
