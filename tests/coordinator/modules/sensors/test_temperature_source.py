"""A temperature and those who wait for it: when bad values stop the machine, and how a wait ends."""

import asyncio
from typing import TYPE_CHECKING, cast

import pytest

from coordinator.modules.sensors.temperature_source import (
    BAD_IN_A_ROW,
    MAX_WAITERS,
    SILENT_S,
    TemperatureSource,
)
from nodes.support.errors import CanductorError
from nodes.virtual.world import VirtualLoop, World

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from coordinator.runtime.module_context import ModuleContext


class Stops:
    """What a source asks of a machine that lives: to be stopped."""

    def __init__(self) -> None:
        self.causes: list[str] = []

    def stop(self, cause: str) -> None:
        self.causes.append(cause)

    @property
    def live(self) -> "ModuleContext":
        return cast("ModuleContext", self)


class Source(TemperatureSource):
    """A source whose measurements come from the test."""

    def __init__(self, node: str = "") -> None:
        super().__init__("chamber", 5.0, 80.0)
        self._node = node

    @property
    def node(self) -> str:
        return self._node


def run(main: "Callable[[], Awaitable[None]]") -> None:
    async def whole() -> None:
        await main()

    with asyncio.Runner(loop_factory=lambda: VirtualLoop(World(seed=1))) as runner:
        runner.run(whole())


@pytest.mark.parametrize("celsius", [4.99, 80.01])
def test_values_out_of_range_stop_the_machine_once_when_there_are_six_in_a_row(celsius: float) -> None:
    source, machine = Source(), Stops()
    for _ in range(BAD_IN_A_ROW - 1):
        source._watch(machine.live, celsius)
    assert machine.causes == []
    for good in (5.0, 80.0):
        source._watch(machine.live, good)
        for _ in range(5):
            source._watch(machine.live, celsius)
    assert machine.causes == [], "a good value between them begins the count again"
    source._watch(machine.live, celsius)
    (cause,) = machine.causes
    assert cause.startswith(
        f"[chamber] reads {celsius:.0f} °C, outside its min_temp of 5 and max_temp of 80 °C"
    )
    source._watch(machine.live, celsius)
    assert len(machine.causes) == 1


def test_a_source_is_on_no_node_unless_it_says_so() -> None:
    assert TemperatureSource("chamber", 5.0, 80.0).node == ""


def test_looks_without_a_measurement_are_counted_from_the_last_one() -> None:
    source = Source()
    assert [source.missed() for _ in range(3)] == [0, 1, 2]
    source._take(20.0, lambda _: 1.0)
    assert source.celsius == 20.0
    assert [source.missed() for _ in range(2)] == [0, 1]


@pytest.mark.parametrize(("celsius", "sound"), [(4.99, False), (5.0, True), (80.0, True), (80.01, False)])
def test_a_measurement_at_the_limits_is_sound_and_one_outside_is_not(celsius: float, sound: bool) -> None:
    source = Source()
    assert not source.is_sound
    source._take(20.0, lambda _: 1.0)
    source._take(celsius, lambda _: 1.0)
    assert source.is_sound is sound
    assert source.sound_c == (celsius if sound else 20.0)


def test_measurements_are_passed_on_from_the_connection_to_the_end() -> None:
    async def main() -> None:
        source = Source()
        seen: list[tuple[float, float]] = []
        source.on_measured = lambda at_s, celsius: seen.append((at_s, celsius))
        source._take(20.0, lambda _: 1.0)
        assert seen == []
        await source.connect(Stops().live)
        source._take(21.0, lambda _: 2.0)
        assert seen == [(2.0, 21.0)]
        source.end("over")
        source._take(22.0, lambda _: 3.0)
        assert seen == [(2.0, 21.0)]

    run(main)


def test_who_waits_gets_the_next_measurement_or_the_end() -> None:
    async def main() -> None:
        source = Source()
        waiting = [asyncio.ensure_future(source.next()) for _ in range(3)]
        await asyncio.sleep(SILENT_S - 0.1)
        assert not any(wait.done() for wait in waiting)
        source._take(20.0, lambda _: 1.0)
        await asyncio.gather(*waiting)
        waiting = [asyncio.ensure_future(source.next()) for _ in range(2)]
        await asyncio.sleep(0)
        source.end("the machine is stopped")
        for wait in (*waiting, asyncio.ensure_future(source.next())):
            with pytest.raises(CanductorError, match=r"^the machine is stopped$"):
                await wait

    run(main)


@pytest.mark.parametrize(("node", "hint"), [("", ""), ("toolhead", "; is its node toolhead there?")])
def test_a_sensor_that_is_silent_ends_the_wait_after_ten_seconds(node: str, hint: str) -> None:
    async def main() -> None:
        source, loop = Source(node), asyncio.get_running_loop()
        began_s = loop.time()
        with pytest.raises(CanductorError) as error:
            await source.next()
        assert str(error.value) == f"the sensor of [chamber] is silent{hint}"
        assert loop.time() - began_s == pytest.approx(10.0)

    run(main)


def test_so_many_may_wait_and_no_more_and_who_gives_up_makes_room() -> None:
    async def main() -> None:
        source = Source()
        waiting = [asyncio.ensure_future(source.next()) for _ in range(MAX_WAITERS)]
        await asyncio.sleep(0)
        with pytest.raises(CanductorError, match="more than 64 wait for the temperature of chamber"):
            await source.next()
        waiting[0].cancel()
        await asyncio.wait((waiting[0],))
        another = asyncio.ensure_future(source.next())
        await asyncio.sleep(0)
        source._take(20.0, lambda _: 1.0)
        await asyncio.gather(*waiting[1:], another)
        waiting = [asyncio.ensure_future(source.next()) for _ in range(MAX_WAITERS)]
        await asyncio.sleep(0)
        source._take(20.0, lambda _: 1.0)
        await asyncio.gather(*waiting)

    run(main)
