"""Analog inputs and counters on a node of the real firmware."""

import asyncio
from itertools import pairwise

import pytest

from nodes.devices.analog_in import AnalogIn, AnalogValue
from nodes.devices.button import Button
from nodes.devices.counter import Counter
from nodes.devices.pwm_out import PwmOut
from nodes.dictionary.message_format import Message
from tests.nodes.devices.machine import HZ, DeviceMachine


def sensor(machine_pin: str = "PC2", **limits: float) -> tuple[AnalogIn, list[AnalogValue]]:
    analog = AnalogIn("hot end", pin=machine_pin, **limits)
    seen: list[AnalogValue] = []
    analog.on_value = seen.append
    return analog, seen


def test_sensors_of_a_node_report_together() -> None:
    """Reports that come at different times wake the host twice as often."""
    sensors = [sensor(), sensor("PC3")]
    machine = DeviceMachine(*(analog for analog, _ in sensors))

    async def main() -> None:
        await asyncio.sleep(0.5)
        sensors[1][0].started(machine.node)  # later than the other one
        await asyncio.sleep(1.0)

    machine.run(main)
    first, second = (seen[-1] for _, seen in sensors)
    assert (first.clock32 - second.clock32) % round(0.3 * HZ) == 0


def test_measurements_come_with_their_time_over_the_rollover() -> None:
    analog, seen = sensor()
    machine = DeviceMachine(analog, rolls_over_s=4.0)
    clocks: list[int] = []

    async def main() -> None:
        for value in (0, 1000, 4095):
            machine.board.set_adc(machine.pins["PC2"], value)
            await asyncio.sleep(1.5)
            clocks.append(machine.board.clock)

    machine.run(main)
    assert {round(value.ratio * 4095) for value in seen} >= {0, 1000, 4095}
    steps = {(b.clock32 - a.clock32) % (1 << 32) for a, b in pairwise(seen)}
    assert steps == {round(0.3 * HZ)}
    assert len(seen) >= 13
    assert 0 <= (clocks[-1] - seen[-1].clock32) % (1 << 32) < 0.4 * HZ
    assert seen[-1].clock32 < seen[0].clock32, "it rolled over"


def test_out_of_range_the_node_stops_itself_and_its_heater() -> None:
    analog, seen = sensor(low=0.1, high=0.9)
    heater = PwmOut("heater", pin="PA3", max_duration_s=5.0)
    machine = DeviceMachine(analog, heater)
    failed: list[int] = []

    async def main() -> None:
        pin = machine.pins["PC2"]
        machine.board.set_adc(pin, 2048)
        heater.set(machine.node, machine.clock(0.1), 1.0)
        await asyncio.sleep(1.0)
        machine.board.set_adc(pin, 4090)
        await asyncio.sleep(0.7)
        machine.board.set_adc(pin, 2048)
        heater.set(machine.node, machine.clock(0.1), 1.0)
        await asyncio.sleep(2.0)
        assert machine.node.failure is None, "a few bad values in a row are noise"
        machine.board.set_adc(pin, 100)
        failed.append(machine.board.clock)
        assert "ADC out of range" in await machine.shut_down()

    machine.run(main)
    clock, level = machine.edges("PA3")[-1]
    assert level == 0
    assert failed[0] < clock < failed[0] + 1.3 * HZ
    assert min(value.ratio for value in seen) > 0.02, "the last bad value is not reported any more"


def test_limits_are_those_of_the_ratio() -> None:
    """The sums of eight samples: 0.1 · 32760 = 3276 is inside, one less outside."""
    for adc, dies in ((410, False), (409, True), (3685, False), (3686, False), (3687, True)):
        analog, _ = sensor(low=0.1, high=0.9003)
        machine = DeviceMachine(analog)

        async def main(machine: DeviceMachine = machine, adc: int = adc, dies: bool = dies) -> None:
            machine.board.set_adc(machine.pins["PC2"], 2000)
            await asyncio.sleep(1.0)
            machine.board.set_adc(machine.pins["PC2"], adc)
            await asyncio.sleep(2.0)
            assert (machine.node.failure is not None) is dies, adc

        machine.run(main)


def test_it_can_be_stopped_and_begins_again_with_its_node() -> None:
    analog, seen = sensor()
    machine = DeviceMachine(analog)

    async def main() -> None:
        await asyncio.sleep(1.5)
        analog.stop(machine.node)
        await asyncio.sleep(0.5)
        count = len(seen)
        assert count >= 2
        await asyncio.sleep(2.0)
        assert len(seen) == count
        await machine.node.restart()
        await asyncio.sleep(2.0)
        more = len(seen) - count
        assert 4 <= more <= 7, "each value once, though it has started twice"

    machine.run(main)


def test_older_firmware_reports_one_value_at_a_time() -> None:
    analog, seen = sensor()
    analog._full, analog._times = 8 * 1023, {"rest_ticks": 100}
    analog._received(Message("analog_in_state", {"oid": 1, "next_clock": 50, "value": 4092}))
    assert seen == [AnalogValue(0.5, (50 - 100) % (1 << 32))]


@pytest.mark.parametrize(("rpm", "pulses"), [(1500, 2), (6000, 2), (300, 1)])
def test_a_fans_speed_by_its_tachometer(rpm: float, pulses: int) -> None:
    counter = Counter("fan", pin="PD4", pull=1, report_s=1.0)
    seen: list[float] = []
    counter.on_frequency = seen.append
    machine = DeviceMachine(counter, rolls_over_s=5.0)

    async def main() -> None:
        pin = machine.pins["PD4"]
        half_ns = round(30e9 / (rpm * pulses))
        begin_ns = machine.world.now_ns + 1_000_000_000
        for change in range(int(5e9 / half_ns)):
            machine.board.set_input(pin, (change + 1) & 1, begin_ns + change * half_ns)
        await asyncio.sleep(10.0)

    machine.run(main)
    speeds = [frequency * 60 / pulses for frequency in seen]
    full = [speed for speed in speeds if abs(speed - rpm) < 0.02 * rpm]
    assert len(full) >= 3
    assert speeds[-1] == 0, "it stands still in the end"


def test_changes_faster_than_the_polls_are_not_made_up() -> None:
    """What the polls miss makes the speed too low, never too high."""
    counter = Counter("fan", pin="PD4", poll_s=0.01)
    seen: list[float] = []
    counter.on_frequency = seen.append
    machine = DeviceMachine(counter)

    async def main() -> None:
        begin_ns = machine.world.now_ns + 700_000_000
        for change in range(2000):
            machine.board.set_input(machine.pins["PD4"], change & 1, begin_ns + change * 1_700_000)
        await asyncio.sleep(5.0)

    machine.run(main)
    assert 0 < max(seen) <= 50


def button(*, invert: bool = False) -> tuple[Button, list[bool]]:
    switch = Button("a door", pin="PC3", pull=1, invert=invert)
    seen: list[bool] = []
    switch.on_change = seen.append
    return switch, seen


@pytest.mark.parametrize("invert", [False, True])
def test_a_switch_tells_each_change_once_also_from_the_start_and_behind_a_restart(*, invert: bool) -> None:
    switch, seen = button(invert=invert)
    machine = DeviceMachine(switch)

    async def main() -> None:
        pin = machine.pins["PC3"]
        machine.board.set_input(pin, int(not invert))
        await asyncio.sleep(1)
        assert seen == [True]
        for pressed in (False, True, False, True):
            machine.board.set_input(pin, int(pressed != invert))
            await asyncio.sleep(0.3)
        assert seen == [True, False, True, False, True]
        assert switch.pressed
        machine.board.set_input(pin, int(invert))
        await machine.node.restart()
        await asyncio.sleep(1)
        assert seen == [True, False, True, False, True, False]

    machine.run(main)


def test_a_switch_that_bounces_is_not_told_of_and_many_changes_are_told_in_order() -> None:
    switch, seen = button()
    machine = DeviceMachine(switch)

    async def main() -> None:
        pin = machine.pins["PC3"]
        await asyncio.sleep(1)
        now = machine.world.now_ns
        for n in range(400):  # faster than two looks
            machine.board.set_input(pin, n % 2, now + 1_000_000 + n * 500_000)
        await asyncio.sleep(0.3)
        machine.board.set_input(pin, 0)
        await asyncio.sleep(0.3)
        seen.clear()
        now = machine.world.now_ns
        for n in range(300):  # more than a counter of acknowledgements holds
            machine.board.set_input(pin, (n + 1) % 2, now + n * 20_000_000)
        await asyncio.sleep(7)
        assert seen == [n % 2 == 0 for n in range(300)]

    machine.run(main)


def test_reports_that_come_again_and_those_of_before_are_passed_over() -> None:
    switch, seen = button()
    machine = DeviceMachine(switch)

    async def main() -> None:
        await asyncio.sleep(1)
        oid = switch.oid
        assert oid is not None

        def told(ack_count: int, *states: int) -> None:
            parameters: dict[str, int | bytes] = {
                "oid": oid,
                "ack_count": ack_count,
                "state": bytes(states),
            }
            switch._received(machine.node, Message("buttons_state", parameters))

        told(0, 1, 0)
        told(0, 1, 0)
        told(0, 1, 0, 1)
        told(2, 1)
        told(7, 0)
        assert seen == [True, False, True]

    machine.run(main)


def test_a_report_that_comes_when_its_node_has_failed_is_taken_all_the_same() -> None:
    """In one batch with the frame by which its node stops the bus. Failed before: NodeShutdown was raised."""
    switch, seen = button()
    machine = DeviceMachine(switch)

    async def main() -> None:
        await asyncio.sleep(1)
        machine.node.lose("it is gone")
        oid = switch.oid
        assert oid is not None
        switch._received(machine.node, Message("buttons_state", {"oid": oid, "ack_count": 0, "state": b"\1"}))
        assert seen == [True]

    machine.run(main)
