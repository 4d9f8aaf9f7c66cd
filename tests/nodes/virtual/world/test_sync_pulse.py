"""Sync pulses with the real firmware on a simulated bus: how well the nodes' clocks agree in truth."""

import asyncio
import math
from collections.abc import Callable

import pytest

from nodes.clock.clock import Ticks
from nodes.virtual.world import run
from tests.nodes.virtual.world.machines import CanMachine


def watch(machine: CanMachine, seconds: int, found: list[tuple[float, float]]) -> Callable[[], object]:
    """Return what looks for SECONDS by how much each secondary's clock is wrong, and at the bound."""

    async def look() -> None:
        primary, *others = machine.nodes
        for _ in range(2 * seconds):
            await asyncio.sleep(0.5)
            # What counts is the primary's clock, so the host may be as wrong about it as it likes.
            believed_ns = primary.clock.ns_at(Ticks(machine.boards[0].clock))
            for node, board in zip(others, machine.boards[1:], strict=True):
                assert node.clock_source == "pulse"
                off = node.best_clock.ticks_at(believed_ns) - board.clock
                assert node.clock_error_s is not None
                found.append((off / node.clock_freq_hz, node.clock_error_s))

    return look


def play(machine: CanMachine, *steps: Callable[[], object]) -> None:
    async def main() -> None:
        await machine.bus.start()
        for step in steps:
            result = step()
            if asyncio.iscoroutine(result):
                await result
        await machine.bus.close()

    run(machine.world, main(), limit_s=200)


def drift(machine: CanMachine) -> None:
    """Let the boards warm up, apart from each other by 20 ppm in ten minutes."""
    for board, ppm, change in zip(machine.boards, (40, -60, 10), (10, -10, 0), strict=True):
        board.set_rate(ppm, change / 600)


@pytest.mark.parametrize("loss", [0.0, 0.01])
def test_warming_nodes_agree_within_a_microsecond(loss: float) -> None:
    machine = CanMachine(11, 3)
    for controller in (machine.port.controller, *(board.controller for board in machine.boards)):
        assert controller is not None
        controller.set_faults(loss=loss)
    drift(machine)
    found: list[tuple[float, float]] = []
    play(machine, lambda: asyncio.sleep(8), watch(machine, 60, found))
    assert math.sqrt(sum(off * off for off, _ in found) / len(found)) < 0.5e-6
    assert all(abs(off) <= bound < 4e-6 for off, bound in found)


def test_where_interrupts_come_unevenly_exchanges_are_trusted_more() -> None:
    machine = CanMachine(12, 2)
    for board in machine.boards:
        board.set_pace(irq_jitter_s=300e-6)

    def look() -> None:
        assert machine.nodes[1].pulse_clock is not None
        assert machine.nodes[1].clock_source == "exchange"
        assert machine.nodes[1].clock_error_s == machine.nodes[1].clock.estimate().bound_s

    play(machine, lambda: asyncio.sleep(10), look)


def test_pulses_end_and_begin_with_the_second_node() -> None:
    machine = CanMachine(13, 2)
    second, board = machine.nodes[1], machine.boards[1]

    async def lose() -> None:
        assert second.clock_source == "pulse"
        board.power_off()
        await asyncio.sleep(3)
        assert second.pulse_clock is None
        board.power_on(5)
        await asyncio.sleep(0.1)
        await second.restart()
        await asyncio.sleep(8)

    found: list[tuple[float, float]] = []
    play(machine, lambda: asyncio.sleep(8), lose, watch(machine, 5, found))
    assert all(abs(off) <= bound < 4e-6 for off, bound in found)
