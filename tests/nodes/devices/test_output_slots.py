"""Timed outputs keep to their part of a node's queue slots, however many values they are given at once."""

import asyncio

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.devices.digital_out import DigitalOut
from nodes.devices.pwm_out import PwmOut
from nodes.devices.timed_output import TRANSIT_S
from nodes.node.errors import NodeError, NodeLost
from nodes.node.queue_slots import OUTPUT_SLOTS_MAX, OUTPUT_SLOTS_MIN, STEP_SLOTS_MIN, share_slots
from nodes.node.states import NodeState
from tests.nodes.devices.machine import HZ, DeviceMachine

SLOTS = 16


@given(st.integers(1, 65535), st.integers(0, 255))
def test_the_parts_fit_into_the_queue_and_none_is_empty(move_count: int, outputs: int) -> None:
    steps, each = share_slots(move_count, outputs)
    assert steps >= 1
    assert (each >= 1) == (outputs > 0)
    if move_count > outputs:
        assert steps + each * outputs <= move_count
    if move_count >= OUTPUT_SLOTS_MIN * outputs + STEP_SLOTS_MIN and outputs:
        assert OUTPUT_SLOTS_MIN <= each <= OUTPUT_SLOTS_MAX
        assert steps >= STEP_SLOTS_MIN


@pytest.mark.parametrize(
    ("move_count", "outputs", "parts"), [(1024, 0, (1024, 0)), (1024, 6, (928, 16)), (16, 1, (12, 4))]
)
def test_steps_have_most_of_the_slots(move_count: int, outputs: int, parts: tuple[int, int]) -> None:
    assert share_slots(move_count, outputs) == parts


def test_values_wait_for_slots_and_come_at_their_clocks_all_the_same() -> None:
    """Of forty values a second ahead and more, a few fit into the queue at once."""
    out = DigitalOut("lamp", pin="PA3")
    machine = DeviceMachine(out, move_count=SLOTS)
    begin = 0

    async def main() -> None:
        nonlocal begin
        assert machine.node.output_slots == 4
        begin = machine.clock(1.0)
        for k in range(40):
            out.set(machine.node, begin + round(0.05 * k * HZ), on=k % 2 == 0)
        await asyncio.sleep(4.0)
        assert machine.node.failure is None

    machine.run(main)
    wanted = [(begin + round(0.05 * k * HZ), (k + 1) % 2) for k in range(40)]
    assert machine.edges("PA3") == wanted


def test_of_values_too_close_together_the_last_one_comes_and_nothing_stops() -> None:
    lamp, pump = DigitalOut("lamp", pin="PA3"), PwmOut("pump", pin="PA4", cycle_s=0.01)
    machine = DeviceMachine(lamp, pump, move_count=SLOTS)
    last = 0

    async def main() -> None:
        nonlocal last
        begin = machine.clock(0.5)
        for k in range(401):
            last = begin + round(0.001 * k * HZ)
            lamp.set(machine.node, last, on=k % 2 == 0)
            pump.set(machine.node, last, k / 400)
        await asyncio.sleep(2.0)
        assert machine.node.failure is None
        for k in range(401):
            lamp.set(machine.node, machine.clock(0.5 + 0.001 * k), on=False)
        await asyncio.sleep(2.0)
        assert machine.node.failure is None

    machine.run(main)
    clock, level = machine.edges("PA4")[-1]
    assert level == 1
    assert clock <= last + round(2 * TRANSIT_S * HZ)
    assert machine.edges("PA3")[-1][1] == 0


def test_values_that_wait_are_forgotten_with_the_life_of_their_node() -> None:
    out = DigitalOut("lamp", pin="PA3")
    machine = DeviceMachine(out, move_count=SLOTS)

    async def main() -> None:
        begin = machine.clock(0.5)
        for k in range(41):
            out.set(machine.node, begin + round(0.05 * k * HZ), on=k % 2 == 0)
        await asyncio.sleep(0.6)
        machine.node.emergency_stop()
        await asyncio.sleep(0.5)
        await machine.node.restart()
        await asyncio.sleep(4.0)
        assert machine.node.failure is None
        assert machine.board.level(machine.pins["PA3"]) == 0
        out.set(machine.node, machine.clock(0.3), on=True)
        await asyncio.sleep(0.5)
        assert machine.board.level(machine.pins["PA3"]) == 1

    machine.run(main)


@pytest.mark.parametrize(
    ("state", "failure", "sentence"),
    [
        (NodeState.CONFIGURING, None, "node n1 is being configured and not ready yet"),
        (NodeState.LOST, NodeLost("lost node n1: no answer"), "lost node n1: no answer"),
    ],
)
def test_nothing_waits_for_the_slots_of_a_node_that_has_none(
    state: NodeState, failure: NodeLost | None, sentence: str
) -> None:
    """As while it is configured, and when that failed. Failed before: IndexError, and each value waited."""
    out = DigitalOut("lamp", pin="PA3")
    machine = DeviceMachine(out)

    async def main() -> None:
        node = machine.node
        node.output_slots, node.state, node.failure = 0, state, failure
        for _ in range(3):
            with pytest.raises(NodeError, match=sentence):
                out.set(node, machine.clock(0.5), on=True)
        assert not out._waiting

    machine.run(main)
