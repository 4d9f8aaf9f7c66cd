"""The script of a world: things happen at their true time, whatever the host does meanwhile."""

import asyncio
from functools import partial

from coordinator.simulate.script import ScriptedWorld
from nodes.virtual.world import VirtualLoop

MS = 1_000_000


def test_things_happen_at_their_time_and_in_the_order_in_which_they_were_put_in() -> None:
    world = ScriptedWorld(1)
    begin_ns = world.now_ns
    seen: list[tuple[str, int]] = []

    def see(name: str) -> None:
        seen.append((name, world.now_ns))

    for name, at_ms in (("b", 20), ("a", 10), ("c", 20)):
        world.at(begin_ns + at_ms * MS, partial(see, name))
    world.run_for(0.015)
    assert seen == [("a", begin_ns + 10 * MS)]
    world.run_for(0.015)
    assert [name for name, _ in seen] == ["a", "b", "c"]
    assert world.now_ns == begin_ns + 30 * MS


def test_what_happens_may_put_in_more() -> None:
    world = ScriptedWorld(1)
    begin_ns, seen = world.now_ns, []

    def again() -> None:
        seen.append(world.now_ns - begin_ns)
        world.at(world.now_ns + 5 * MS, again)

    world.at(begin_ns, again)
    world.run_for(0.012)
    assert seen == [0, 5 * MS, 10 * MS]


def test_a_stalled_host_oversleeps_but_the_script_does_not() -> None:
    world = ScriptedWorld(1)
    begin_ns, seen = world.now_ns, []
    world.at(begin_ns + 10 * MS, lambda: world.stall(0.1))
    world.at(begin_ns + 50 * MS, lambda: seen.append(world.now_ns - begin_ns))

    async def sleeper() -> int:
        await asyncio.sleep(0.02)
        return world.now_ns - begin_ns

    with asyncio.Runner(loop_factory=lambda: VirtualLoop(world)) as runner:
        woke_ns = runner.run(sleeper())
    assert seen == [50 * MS]
    assert 110 * MS <= woke_ns < 120 * MS


def test_a_call_wakes_the_host() -> None:
    world = ScriptedWorld(1)
    begin_ns = world.now_ns

    async def waiter() -> int:
        event = asyncio.Event()
        world.at(begin_ns + 3 * MS, event.set, wakes=True)
        async with asyncio.timeout(10):
            await event.wait()
        return world.now_ns - begin_ns

    with asyncio.Runner(loop_factory=lambda: VirtualLoop(world)) as runner:
        assert runner.run(waiter()) < 4 * MS
