"""Downloads in a simulated world: to many axles at once, on busy and lossy buses, through restarts."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence

import numpy as np
import pytest

from nodes.clock.clock import HostTime
from nodes.mt.download import BUS_SHARE, DownloadOutcome, DownloadTarget, download
from nodes.mt.mt import MtError, MtStatus, Pair, to_frames, transmission
from nodes.mt.table import Activation, AxleTable
from nodes.node.config import NodeConfigError
from nodes.virtual.world import run
from tests.nodes.mt.machines import TableMachine, UartTableMachine, wavy

FRAME_BITS_MAX = 135
TOGETHER_S = 50e-6


def perform(
    machine: TableMachine | UartTableMachine, act: Callable[[], Awaitable[None]], *, limit_s: float = 300
) -> None:
    async def main() -> None:
        await machine.bus.start()
        try:
            await act()
        finally:
            await machine.bus.close()

    run(machine.world, main(), limit_s=limit_s)


async def kept(place: DownloadTarget) -> list[Pair]:
    """Read the table that the node of PLACE keeps, pair by pair."""
    length = (await place.table.state(place.node)).length
    answers = [
        await place.node.query("table_read", "table_pair", oid=place.table.oid or 0, index=i)
        for i in range(length)
    ]
    return [(answer.integer("x"), answer.integer("y")) for answer in answers]


def told(outcomes: Sequence[DownloadOutcome]) -> list[str]:
    return [outcome.problem for outcome in outcomes if not outcome.ok]


def test_one_broadcast_reaches_28_axles_on_6_nodes() -> None:
    machine = TableMachine(1, capacity=64)
    table = wavy(64)

    async def act() -> None:
        report = await download(table, machine.places, now_ns=machine.now_ns)
        assert report.ok, told(report.outcomes)
        assert {(o.broadcasts, o.by_link, o.generation) for o in report.outcomes} == {(1, 0, 1)}
        frames = len(to_frames(transmission(table, range(1, 29))))
        (cast,) = report.casts
        assert (cast.bus, cast.times, cast.cost.frames) == ("can0", 1, frames)
        assert cast.cost.bits <= frames * FRAME_BITS_MAX
        assert cast.cost.bitrate == 1_000_000
        assert report.asking_s + cast.elapsed_s + report.links_s == pytest.approx(report.elapsed_s)
        for place in machine.places[:3]:
            assert await kept(place) == table

    perform(machine, act)


@pytest.mark.parametrize("seed", range(2))
def test_a_busy_bus_that_loses_frames(seed: int) -> None:
    """14 axes, each with its own table, forward and reverse; 70 % load, 1 % loss: all arrive."""
    machine = TableMachine(seed, capacity=64)

    async def act() -> None:
        machine.burden(0.7)
        machine.lose(0.01)
        for number, place in enumerate(machine.places):
            table = wavy(64, number)
            report = await download(table, [place], now_ns=machine.now_ns)
            (outcome,) = report.outcomes
            assert outcome.ok, outcome.problem
            state = await place.table.state(place.node)
            assert (state.status, state.generation, state.holds(table)) == (
                MtStatus.OK,
                outcome.generation,
                True,
            )
        assert 0.65 < machine.bus.load <= 1, "the load is what it is called, and what is ours besides"
        common = wavy(48, 99)
        report = await download(common, machine.places, now_ns=machine.now_ns)
        assert report.ok, told(report.outcomes)
        (cast,) = report.casts
        assert cast.cost.free_s == pytest.approx(cast.cost.alone_s / (1 - cast.cost.load))
        assert cast.elapsed_s >= 0.98 * cast.times * cast.cost.paced_s, "with other masks, other stuff bits"
        assert report.elapsed_s == pytest.approx(report.asking_s + cast.elapsed_s + report.links_s)
        for place in machine.places:
            assert (await place.table.state(place.node)).holds(common)

    perform(machine, act)


def test_a_long_table_on_a_lossy_bus_goes_through_the_links() -> None:
    """Hardly any node hears 500 frames when one in 50 is lost: the links repeat only what is lost."""
    machine = TableMachine(4, nodes=3, axles=3, capacity=500)
    table = wavy(500)

    async def act() -> None:
        machine.lose(0.02)
        report = await download(table, machine.places, now_ns=machine.now_ns)
        assert report.ok, told(report.outcomes)
        assert any(outcome.by_link for outcome in report.outcomes)
        assert max(outcome.broadcasts for outcome in report.outcomes) <= 2

    perform(machine, act)


def test_it_leaves_the_bus_to_others() -> None:
    machine = TableMachine(5, nodes=1, axles=1, capacity=500)

    async def act() -> None:
        before, began_ns = machine.wire.counters()["bits"], machine.now_ns()
        report = await download(wavy(500), machine.places, now_ns=machine.now_ns)
        assert report.ok
        share = (machine.wire.counters()["bits"] - before) / (machine.now_ns() - began_ns) * 1e3
        assert BUS_SHARE * 0.8 < share < BUS_SHARE + 0.05

    perform(machine, act)


def test_an_empty_table_removes() -> None:
    machine = TableMachine(6, nodes=2, axles=4)

    async def act() -> None:
        await download(wavy(9), machine.places, now_ns=machine.now_ns)
        report = await download([], machine.places[:2], now_ns=machine.now_ns)
        assert report.ok
        assert [len(await kept(place)) for place in machine.places] == [0, 0, 9, 9]
        assert [outcome.generation for outcome in report.outcomes] == [2, 2]

    perform(machine, act)


def test_a_node_that_is_gone_is_named_and_the_others_are_served() -> None:
    machine = TableMachine(7, nodes=3, axles=6)

    async def act() -> None:
        machine.boards[1].power_off()
        report = await download(wavy(20), machine.places, now_ns=machine.now_ns)
        assert [outcome.ok for outcome in report.outcomes] == [True, False, True] * 2
        assert all("n2" in text for text in told(report.outcomes))

    perform(machine, act)


def test_a_node_that_restarts_meanwhile_is_named() -> None:
    machine = TableMachine(8, nodes=2, axles=2)

    async def act() -> None:
        asyncio.get_running_loop().call_later(0.02, machine.boards[0].reset)
        report = await download(wavy(250), machine.places, now_ns=machine.now_ns)
        assert [outcome.ok for outcome in report.outcomes] == [False, True]
        assert "n1" in report.outcomes[0].problem

    perform(machine, act)


def test_other_words_on_the_bus_do_not_pass_for_a_table() -> None:
    """A second sender in the middle of a broadcast: what is kept is whole, and sent again until it is."""
    machine = TableMachine(9, nodes=2, axles=2)
    mine = wavy(250, 1)

    async def act() -> None:
        loop = asyncio.get_running_loop()
        for frame in to_frames(transmission(wavy(3, 2), [1, 2])):
            loop.call_later(0.03, machine.bus.send_frame, 0x3F2, frame)
        report = await download(mine, machine.places, now_ns=machine.now_ns)
        assert report.ok, told(report.outcomes)
        assert report.outcomes[0].broadcasts + report.outcomes[0].by_link > 1
        assert await kept(machine.places[0]) == mine

    perform(machine, act)


def test_a_serial_line_carries_the_same_stream() -> None:
    machine = UartTableMachine(10)
    table = wavy(256)

    async def act() -> None:
        for _ in range(2):
            report = await download(table, machine.places, now_ns=machine.now_ns)
            assert report.ok, told(report.outcomes)
        assert [(o.broadcasts, o.by_link, o.generation) for o in report.outcomes] == [(0, 1, 2)] * 2
        assert await kept(machine.places[1]) == table

    perform(machine, act)


def test_more_points_than_a_node_has_room_for_are_not_even_sent() -> None:
    machine = TableMachine(11, nodes=1, axles=1, capacity=8)

    async def act() -> None:
        with pytest.raises(MtError, match="axle 1 has room for 8 points on node n1, not for 9; thin"):
            await download(wavy(9), machine.places, now_ns=machine.now_ns)

    perform(machine, act)


def test_a_bus_that_ends_is_told_for_each_axle() -> None:
    machine = TableMachine(12, nodes=2, axles=2)

    async def act() -> None:
        asyncio.get_running_loop().call_later(0.02, machine.port.fail, 19)
        report = await download(wavy(250), machine.places, now_ns=machine.now_ns)
        assert [outcome.ok for outcome in report.outcomes] == [False, False]
        assert all(outcome.problem for outcome in report.outcomes)

    perform(machine, act)


@pytest.mark.parametrize(("axle", "capacity"), [(0, 4), (29, 4), (1, 0), (1, 65536)])
def test_axles_and_capacities_that_cannot_be(axle: int, capacity: int) -> None:
    with pytest.raises(NodeConfigError, match=r"give an axle of 1\.\.28 and 1\.\.65535 points"):
        AxleTable("x", axle, capacity)


def test_nodes_activate_together() -> None:
    """One moment in every node's own clock, with clocks up to 30 ppm apart: within the clocks' error."""
    machine = TableMachine(13, axles=14, ppm=30)

    async def act() -> None:
        machine.burden(0.7)
        machine.lose(0.01)
        report = await download(wavy(32), machine.places, now_ns=machine.now_ns)
        assert report.ok, told(report.outcomes)
        await asyncio.sleep(5)  # for the clocks to be known well
        at_ns = HostTime(machine.now_ns() + 200_000_000)
        for outcome in report.outcomes:
            place = outcome.place
            ticks = machine.node(place).best_clock.ticks_at(at_ns)
            place.table.activate(place.node, clock=int(ticks), generation=outcome.generation)
        await asyncio.sleep(0.3)
        moments_s, errors_s = [], []
        for outcome in report.outcomes:
            place, board = outcome.place, machine.board(outcome.place)
            found = await place.table.active(place.node)
            assert (found.activation, found.generation) == (Activation.DONE, outcome.generation)
            clock = board.clock - ((board.clock - found.clock32) & 0xFFFFFFFF)
            (true_ps,) = board.true_ps(np.array([clock], np.uint64))
            moments_s.append(true_ps * 1e-12)
            errors_s.append(machine.node(place).clock_error_s or 0.0)
        skew_s = max(moments_s) - min(moments_s)
        assert skew_s <= max(errors_s), "one clock error"
        assert skew_s < TOGETHER_S

    perform(machine, act)
