"""The real host and the real firmware talk through a simulated world, from reset to READY."""

import asyncio
import os
import subprocess
import sys

import pytest

from nodes.clock.clock import HostTime
from nodes.node.errors import NodeLost
from nodes.node.states import NodeState
from nodes.virtual.world import Stuck, UartSettings, World, run
from tests.nodes.virtual.world.machines import CanMachine, UartMachine, ready, trace_of


def test_four_nodes_get_ready_and_their_clocks_are_known() -> None:
    machine = CanMachine(1, 4)

    async def main() -> None:
        await machine.bus.start()
        for node, board in zip(machine.nodes, machine.boards, strict=True):
            true_ticks = board.clock
            estimate = node.clock.estimate()
            error_s = (estimate.ticks_at(HostTime(machine.world.now_ns)) - true_ticks) / 168e6
            assert abs(error_s) < 50e-6
        await machine.bus.close()

    run(machine.world, main(), limit_s=60)


def test_a_bus_that_loses_and_disturbs_still_gets_ready() -> None:
    machine = CanMachine(2, 3)
    machine.wire.set_bit_errors(2e-5)
    machine.port.controller.set_faults(loss=0.01)
    for board in machine.boards:
        assert board.controller is not None
        board.controller.set_faults(loss=0.01)
    run(machine.world, ready(machine), limit_s=60)
    assert machine.wire.counters()["disturbed"] > 0
    assert machine.port.controller.counters()["lost"] > 0


@pytest.mark.parametrize(
    "settings", [UartSettings(), UartSettings(loss=2e-3, corruption=2e-3, noise_bytes=90)]
)
def test_a_serial_line_gets_ready(settings: UartSettings) -> None:
    machine = UartMachine(3, settings)

    async def main() -> None:
        await machine.bus.start()
        assert machine.node.state is NodeState.READY
        await machine.bus.close()

    run(machine.world, main(), limit_s=60)
    counters = machine.uart.counters()
    assert counters["noise"] == 2 * settings.noise_bytes
    assert (counters["lost"] > 0) == (settings.loss > 0)


def test_a_node_without_power_is_lost_and_can_be_started_again() -> None:
    machine = CanMachine(4)
    node, board = machine.nodes[0], machine.boards[0]

    async def main() -> None:
        await machine.bus.start()
        board.power_off()
        with pytest.raises(NodeLost):
            await node.query("get_uptime", "uptime")
        board.power_on(start_clock=12345)
        await node.restart()
        assert node.state is NodeState.READY
        await machine.bus.close()

    run(machine.world, main(), limit_s=60)


def test_a_stall_of_the_host_is_survived_and_nobody_runs_meanwhile() -> None:
    machine = CanMachine(5, 2)

    async def main() -> float:
        await machine.bus.start()
        before, wakeups = machine.world.now_ns, machine.port.counters()["wakeups"]
        machine.world.stall(0.4)
        await asyncio.sleep(0)
        passed_s = (machine.world.now_ns - before) / 1e9
        assert machine.port.counters()["wakeups"] <= wakeups + 1
        await asyncio.sleep(1.0)
        assert [node.state for node in machine.nodes] == [NodeState.READY] * 2
        await machine.bus.close()
        return passed_s

    assert run(machine.world, main(), limit_s=60) == pytest.approx(0.4, abs=1e-3)


def test_a_seed_decides_everything() -> None:
    assert trace_of(7) == trace_of(7)
    assert trace_of(7) != trace_of(8)


def test_hash_seeds_of_python_decide_nothing() -> None:
    other = "2" if os.environ.get("PYTHONHASHSEED") == "1" else "1"
    code = "from tests.nodes.virtual.world.machines import trace_of; print(trace_of(7))"
    found = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONHASHSEED": other},
        check=True,
        capture_output=True,
        text=True,
    )
    assert int(found.stdout) == trace_of(7)


def test_a_deadlock_is_told_from_patience() -> None:
    async def forever() -> None:
        await asyncio.get_running_loop().create_future()

    with pytest.raises(Stuck, match="nothing can happen"):
        run(World(1), forever())

    async def ages() -> None:
        await asyncio.sleep(1000)
        await asyncio.sleep(10)

    with pytest.raises(Stuck, match="not finished after 100"):
        run(World(1), ages(), limit_s=100)


def test_executor_work_takes_virtual_time_only() -> None:
    world = World(1)

    async def main() -> int:
        begin_ns = world.now_ns
        assert await asyncio.to_thread(lambda: 7) == 7
        return world.now_ns - begin_ns

    assert run(world, main(), executor_s=0.25) == pytest.approx(250_000_000, abs=1000)
