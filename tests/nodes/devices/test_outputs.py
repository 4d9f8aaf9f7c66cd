"""Outputs on a node of the real firmware: values at their clocks, and the node's own safety net."""

import asyncio

import pytest

from nodes.devices.digital_out import DigitalOut
from nodes.devices.pwm_out import PwmOut
from nodes.dictionary.dictionary import Dictionary
from nodes.node.config import NodeConfigError
from nodes.node.errors import NodeError
from tests.nodes.devices.machine import HZ, DeviceMachine


def on_time(edges: list[tuple[int, int]], begin: int, end: int) -> float:
    """Return which part of the time from BEGIN to END the pin was high."""
    level = next((level for clock, level in reversed(edges) if clock <= begin), 0)
    high, last = 0, begin
    for clock, new in (edge for edge in edges if begin < edge[0] <= end):
        high += (clock - last) * level
        last, level = clock, new
    return (high + (end - last) * level) / (end - begin)


@pytest.mark.parametrize("invert", [False, True])
def test_pwm_by_software_over_the_rollover(invert: bool) -> None:
    out = PwmOut("heater", pin="PA3", cycle_s=0.1, invert=invert, max_duration_s=3.0)
    machine = DeviceMachine(out)
    values = [0.3, 0.75, 1.0, 0.0, 0.5]
    begins: list[int] = []

    async def main() -> None:
        for value in values:
            begins.append(machine.clock(0.2))
            out.set(machine.node, begins[-1], value)
            await asyncio.sleep(2.0)
        out.set(machine.node, machine.clock(0.2), 0.0)
        await asyncio.sleep(10.0)
        assert machine.node.failure is None, "off needs no renewal"

    machine.run(main)
    edges = machine.edges("PA3")
    assert begins[0] < 1 << 32 < begins[-1], "the clock rolled over meanwhile"
    for begin, value in zip(begins, values, strict=True):
        found = on_time(edges, begin, begin + round(1.6 * HZ))
        assert (1 - found if invert else found) == pytest.approx(value, abs=1e-4)
    assert edges[-1][1] == int(invert)


def test_who_does_not_renew_ends_with_the_heater_off() -> None:
    out = PwmOut("heater", pin="PA3", cycle_s=0.1, max_duration_s=3.0)
    machine = DeviceMachine(out)
    renewed: list[int] = []

    async def main() -> None:
        for _ in range(10):
            renewed.append(machine.clock(0.1))
            out.set(machine.node, renewed[-1], 0.6)
            await asyncio.sleep(0.9)
        text = await machine.shut_down()
        assert "Missed scheduling of next digital out event" in text

    machine.run(main)
    clock, level = machine.edges("PA3")[-1]
    assert level == 0
    assert renewed[-1] < clock <= renewed[-1] + 3 * HZ


def test_pwm_by_hardware_has_the_same_net() -> None:
    out = PwmOut("heater", pin="PA3", cycle_s=0.01, hardware=True, max_duration_s=2.0)
    machine = DeviceMachine(out)

    async def main() -> None:
        for value in (0.2, 0.4):
            out.set(machine.node, machine.clock(0.1), value)
            await asyncio.sleep(1.5)
            assert machine.node.failure is None
        assert "Missed scheduling of next hard pwm event" in await machine.shut_down()

    machine.run(main)


def test_values_do_not_overtake_each_other() -> None:
    out = PwmOut("fan", pin="PA3", cycle_s=0.01)
    machine = DeviceMachine(out)

    async def main() -> None:
        late = machine.clock(1.0)
        out.set(machine.node, late, 1.0)
        out.set(machine.node, machine.clock(0.1), 0.0)
        await asyncio.sleep(2.0)
        assert machine.node.failure is None
        assert machine.edges("PA3") in ([], [(late, 1), (late, 0)])

    machine.run(main)


def test_a_digital_output() -> None:
    out = DigitalOut("enable", pin="PB1", invert=True, max_duration_s=1.0)
    machine = DeviceMachine(out)
    begins: list[int] = []

    async def main() -> None:
        begins.append(machine.clock(0.2))
        out.set(machine.node, begins[0], True)
        await asyncio.sleep(0.8)
        out.set_now(machine.node, True)
        await asyncio.sleep(0.8)
        out.set_now(machine.node, False)
        await asyncio.sleep(3.0)
        out.set(machine.node, machine.clock(0.2), True)
        assert "Missed scheduling" in await machine.shut_down()

    machine.run(main)
    edges = machine.edges("PB1")
    assert [level for _, level in edges] == [1, 0, 1, 0, 1], "inverted: off is high, also after a shutdown"
    assert edges[1][0] == begins[0]
    assert edges[4][0] - edges[3][0] == HZ


def test_what_cannot_be_is_told_when_it_is_configured() -> None:
    for out, text in (
        (PwmOut("fan", pin="PA3", cycle_s=1e-4), "set hardware_pwm"),
        (PwmOut("fan", pin="PA3", shutdown=0.5), "fully on or off"),
        (PwmOut("fan", pin="PA3", max_duration_s=100), "13 s that its clock can count"),
        (PwmOut("fan", pin="XY3"), "fan on node n1: .*XY3"),
    ):
        machine = DeviceMachine(out)
        with pytest.raises(NodeConfigError, match=text):
            machine.run(nothing)


async def nothing() -> None:
    pass


def test_an_output_without_node_is_told() -> None:
    machine = DeviceMachine()
    out = PwmOut("fan", pin="PA3")

    async def main() -> None:
        with pytest.raises(NodeError, match="not configured on any node"):
            out.set(machine.node, 1, 1.0)
        with pytest.raises(NodeError, match="not configured on any node"):
            DigitalOut("fan", pin="PA3").set_now(machine.node, True)

    machine.run(main)


def test_firmware_without_pwm_is_named() -> None:
    machine = DeviceMachine(PwmOut("fan", pin="PA3", hardware=True))
    bare = Dictionary.from_json(
        b'{"version": "v0-bare", "commands": {}, "responses": {}, "config": {"CLOCK_FREQ": 1000000}}'
    )
    with pytest.raises(NodeConfigError, match=r"the output of fan cannot work on node n1: .*config_pwm_out"):
        machine.configure_with(bare)
