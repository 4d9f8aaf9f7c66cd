"""An output that runs PWM in software takes its shutdown value in every part of a cycle, and keeps it."""

from collections.abc import Callable

import pytest

from tests.firmware.host import Host

PIN, OTHER_PIN = 40, 41
CYCLE, ON = 1000, 300
"""Ticks."""
STOP = 0x010

CONFIG = (
    "config_digital_out oid=0 pin=40 value={default} default_value={default} max_duration=0",
    "set_digital_out_pwm_cycle oid=0 cycle_ticks=1000",
    "config_digital_out oid=1 pin=41 value=0 default_value=0 max_duration=5000",
)
HIGH, LOW = ON // 2, (ON + CYCLE) // 2
"""Ticks behind the begin of a cycle."""


def emergency_stop(host: Host) -> None:
    host.pour("emergency_stop", 1)


def stop_of_the_bus(host: Host) -> None:
    host.node.receive_frame(STOP, b"\x00\x00")


def invalid_command(host: Host) -> None:
    host.pour("finalize_config crc=1", 1)


def config_reset(host: Host) -> None:
    host.pour("config_reset", 1)


STOPS = [emergency_stop, stop_of_the_bus, invalid_command, config_reset]


def running(default: int, phase: int) -> Host:
    """Return a node whose output is PHASE ticks into its fifth cycle."""
    host = Host(transport="can", start_clock=(1 << 32) - 6000)
    host.configure(*(command.format(default=default) for command in CONFIG))
    begin = host.now + 1000
    assert host.send(f"queue_digital_out oid=0 clock={begin % (1 << 32)} on_ticks={ON}") == []
    host.run(begin + 4 * CYCLE + phase - host.now)
    assert host.node.level(PIN) == (phase < ON)
    return host


@pytest.mark.parametrize("phase", [HIGH, LOW])
@pytest.mark.parametrize("default", [0, 1])
@pytest.mark.parametrize("stop", STOPS)
def test_a_stop_drives_the_shutdown_value_in_both_parts_of_a_cycle(
    stop: Callable[[Host], None], default: int, phase: int
) -> None:
    host = running(default, phase)
    stop(host)
    assert host.node.level(PIN) == default, "at once"
    host.node.forget_edges()
    host.run(20 * CYCLE)
    assert host.steps(PIN).tolist() == [], "for good"


@pytest.mark.parametrize("phase", [HIGH, LOW])
@pytest.mark.parametrize("default", [0, 1])
def test_another_output_that_is_not_renewed_stops_it_too(default: int, phase: int) -> None:
    host = running(default, phase)
    begin = host.now - phase + CYCLE
    last = begin + phase - 5000 + 20 * CYCLE
    host.send(f"queue_digital_out oid=1 clock={last % (1 << 32)} on_ticks=1")
    host.run(last + 4999 - host.now)
    assert host.node.level(PIN) == (phase < ON)
    assert host.dies(run=1) == "Missed scheduling of next digital out event"
    assert host.node.level(PIN) == default
    host.node.forget_edges()
    host.run(20 * CYCLE)
    assert host.steps(PIN).tolist() == []


@pytest.mark.parametrize("phase", [HIGH, LOW])
@pytest.mark.parametrize("default", [0, 1])
def test_it_stays_so_when_the_shutdown_is_cleared_and_obeys_the_next_value(default: int, phase: int) -> None:
    host = running(default, phase)
    host.send("emergency_stop")
    host.node.forget_edges()
    host.send("clear_shutdown")
    host.run(20 * CYCLE)
    assert host.steps(PIN).tolist() == []
    begin = host.now + CYCLE
    host.send(f"queue_digital_out oid=0 clock={begin % (1 << 32)} on_ticks={ON}")
    host.run(3 * CYCLE - 1)
    wanted = [begin + part for part in (0, ON, CYCLE, CYCLE + ON)]
    assert host.steps(PIN).tolist() == wanted[default:]


@pytest.mark.parametrize("value", [0, CYCLE])
@pytest.mark.parametrize("phase", [HIGH, LOW])
def test_a_value_without_pwm_ends_it_in_both_parts_of_a_cycle(value: int, phase: int) -> None:
    host = running(0, phase)
    change = host.now + 2 * CYCLE
    host.send(f"queue_digital_out oid=0 clock={change % (1 << 32)} on_ticks={value}")
    host.run(2 * CYCLE)
    assert host.node.level(PIN) == (value != 0)
    host.node.forget_edges()
    host.run(20 * CYCLE)
    assert host.steps(PIN).tolist() == []


@pytest.mark.parametrize("cycle", [0, 1, 1000])
def test_whatever_the_cycle_the_shutdown_value_is_on_where_it_was_configured_so(cycle: int) -> None:
    """An inverted heater is off when its pin is high."""
    host = Host()
    host.configure(
        "config_digital_out oid=0 pin=40 value=0 default_value=1 max_duration=0",
        f"set_digital_out_pwm_cycle oid=0 cycle_ticks={cycle}",
    )
    assert host.node.level(PIN) == 0
    host.dies("emergency_stop")
    assert host.node.level(PIN) == 1
