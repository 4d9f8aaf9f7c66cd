"""Nodes of a simulated world: crystals, resets, power, inputs that follow an axis, slowness, host queues."""

import asyncio
from fractions import Fraction

import numpy as np
import pytest

from nodes.node.states import NodeState
from nodes.virtual.world import (
    CanState,
    Latency,
    NodeSettings,
    PortSettings,
    UartSettings,
    World,
    WorldError,
    run,
)
from tests.nodes.virtual.world.machines import CanMachine, UartMachine, uuid
from tests.stages.sim_node import SimNode

HZ = 168_000_000
S = 1_000_000_000


def exact_ticks(start: int, pieces: list[tuple[int, float, float]], at_ns: int) -> Fraction:
    """PIECES: (length ns, ppm at its begin, ppm per s); the last one is as long as needed."""
    ticks, left = Fraction(start), at_ns
    for length_ns, ppm, ppm_per_s in pieces:
        passed = Fraction(min(left, length_ns), S)
        rate = HZ * (1 + Fraction(ppm) / 10**6)
        ticks += rate * passed + HZ * Fraction(ppm_per_s) / 10**6 * passed * passed / 2
        left -= min(left, length_ns)
    return ticks


def test_a_crystal_is_exact_to_a_tick_over_hours_a_ramp_and_the_rollover() -> None:
    world = World(1)
    start = (1 << 32) - 12345
    node = world.add_node(world.add_can(), uuid(1), start_clock=start, settings=NodeSettings(ppm=37.25))
    begin_ns = world.now_ns
    world.run_for(3600)
    node.set_rate(37.25, 0.0625)
    world.run_for(600)
    assert node.ppm == pytest.approx(37.25 + 37.5, abs=1e-6)
    node.set_rate(node.ppm)
    pieces = [(3600 * S, 37.25, 0.0625 * 0), (600 * S, 37.25, 0.0625), (10**18, 74.75, 0.0)]
    for _ in range(50):
        world.run_for(123.456789012)
        truth = exact_ticks(start, pieces, world.now_ns - begin_ns)
        assert abs(node.clock - truth) < 1.01
        # And back: the instant at which the clock became this number is not later than now.
        became_ps = int(node.true_ps(np.array([node.clock], np.uint64))[0])
        assert 0 <= world.now_ns * 1000 - became_ps < 1000 * (1000 / 168 + 1)


def test_a_crystal_and_its_inverse_agree_for_every_tick() -> None:
    world = World(1)
    node = world.add_node(world.add_can(), uuid(1), settings=NodeSettings(ppm=-50))
    world.run_for(1)
    node.set_rate(-50, 3)
    world.run_for(100)
    clocks = np.arange(node.clock - 10_000, node.clock, dtype=np.uint64)
    steps_ps = np.diff(node.true_ps(clocks))
    assert steps_ps.min() >= 5950
    assert steps_ps.max() <= 5954


def test_rates_can_be_changed_a_bounded_number_of_times() -> None:
    world = World(1)
    node = world.add_node(world.add_can(), uuid(1))
    for _ in range(63):
        world.run_for(0.001)
        node.set_rate(1.0)
    world.run_for(0.001)
    with pytest.raises(WorldError, match="64 times"):
        node.set_rate(1.0)


def assigned(machine: CanMachine) -> list[int]:
    return [board.counters()["node_id"] for board in machine.boards]


def test_a_reset_at_any_instant_leaves_an_unassigned_node_whose_clock_goes_on() -> None:
    machine = CanMachine(1)
    board = machine.boards[0]

    async def main() -> None:
        await machine.bus.start()
        assert assigned(machine) == [4]
        before = board.clock
        board.reset()
        assert board.counters()["running"] == 0
        await asyncio.sleep(0.01)
        assert assigned(machine) == [0]
        assert board.counters()["running"] == 1
        assert board.clock - before == pytest.approx(0.01 * HZ, rel=1e-2)
        await machine.nodes[0].close()
        await machine.bus.close()

    run(machine.world, main(), limit_s=60)


def test_power_off_is_silence_and_power_on_another_clock() -> None:
    machine = CanMachine(1)
    board = machine.boards[0]
    assert board.controller is not None
    machine.world.run_for(0.01)
    board.power_off()
    machine.port.controller.send(0x3F0, b"\0")
    machine.world.run_for(0.01)
    assert machine.wire.counters()["frames"] == 0
    assert machine.wire.counters()["unacknowledged"] > 16
    assert machine.port.controller.state is CanState.PASSIVE
    board.power_on(start_clock=777)
    machine.world.run_for(0.01)
    assert board.clock == 777 + HZ // 100
    assert machine.wire.counters()["frames"] == 2


def test_a_slow_node_loses_what_does_not_fit_and_the_link_repeats_it() -> None:
    machine = CanMachine(6)
    slow = Latency(2e-3, 2e-3, 8e-3)

    async def main() -> None:
        await machine.bus.start()
        machine.boards[0].set_pace(task=slow)
        for _ in range(20):
            for _ in range(8):
                machine.port.controller.send(0x108, b"garbage!")
            await machine.nodes[0].query("get_uptime", "uptime")
        assert machine.nodes[0].state is NodeState.READY
        await machine.bus.close()

    run(machine.world, main(), limit_s=60)
    assert machine.boards[0].counters()["rx_lost"] > 0


def test_a_full_receive_queue_of_the_host_drops_and_counts() -> None:
    machine = CanMachine(1)
    port = machine.world.add_can_port(machine.wire, name="slow", settings=PortSettings(receive_queue=10))
    driver = port.open()
    driver.listen(lambda: None)
    machine.world.run_for(0.01)
    machine.world.stall(0.1, python=False)
    sender = machine.boards[0].controller
    assert sender is not None
    sender.babble(0x700, b"", 0.01)
    machine.world.run_for(0.05)
    counters = port.counters()
    assert counters["overflow"] == machine.wire.counters()["frames"] - 10
    assert counters["receive_max"] == 10
    driver.close()


def test_bytes_on_a_serial_line_last_ten_bits() -> None:
    machine = UartMachine(1, UartSettings(baud=250_000, read=Latency()))
    driver = machine.port.open()
    assert machine.world.run_until(machine.world.now_ns + S // 100) is False
    # The node's first words, "starting": one block of six bytes and its acknowledgement's none.
    assert machine.uart.counters()["to_host"] == 6
    assert driver.serial
    driver.close()


def test_a_board_that_belongs_to_nobody_still_runs_by_itself() -> None:
    node = SimNode(transport="uart")
    assert node.take_bytes()
