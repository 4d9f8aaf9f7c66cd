"""Timed outputs with their safety net, analog inputs with their range check, buttons with their acks."""

import pytest

from tests.firmware.host import Host
from tests.firmware.twin import Answer

ROLLOVER = 1 << 32
PIN = 40
OUT = "config_digital_out oid=0 pin=40 value=0 default_value={default} max_duration={limit}"


def output(limit: int = 0, default: int = 0, *, start_clock: int = 0) -> Host:
    host = Host(start_clock=start_clock)
    host.configure(OUT.format(default=default, limit=limit))
    host.node.forget_edges()
    return host


def at(host: Host, clock: int, on_ticks: int) -> None:
    assert host.send(f"queue_digital_out oid=0 clock={clock % ROLLOVER} on_ticks={on_ticks}") == []


def test_queued_values_come_at_their_clocks_over_the_rollover() -> None:
    host = output(start_clock=ROLLOVER - 3500)
    begin = host.now
    for k in range(1, 11):
        at(host, begin + 1000 * k, k & 1)
    host.run(100_000)
    assert host.steps(PIN).tolist() == [begin + 1000 * k for k in range(1, 11)]


def test_an_unrenewed_output_shuts_down_and_goes_to_its_default() -> None:
    host = output(limit=5000)
    begin = host.now
    at(host, begin + 1000, 1)
    host.run(5_999)
    assert host.node.level(PIN) == 1
    assert host.dies(run=1) == "Missed scheduling of next digital out event"
    assert host.steps(PIN).tolist() == [begin + 1000, begin + 6000]
    assert host.node.level(PIN) == 0


def test_renewed_in_time_it_lives_and_the_default_needs_no_renewal() -> None:
    host = output(limit=5000)
    begin = host.now
    for k in range(1, 8):
        at(host, begin + 5000 * k, 1)
    at(host, begin + 40_000, 0)
    assert host.run(10_000_000) == []
    assert host.steps(PIN).tolist() == [begin + 5000, begin + 40_000]


def test_values_too_far_apart_are_refused() -> None:
    host = output(limit=5000)
    at(host, host.now + 1000, 1)
    host.run(2000)
    late = (host.now + 4001) % ROLLOVER
    assert host.dies(f"queue_digital_out oid=0 clock={late} on_ticks=0") == (
        "Scheduled digital out event will exceed max_duration"
    )


def test_values_too_far_apart_within_the_queue_are_refused_when_their_turn_comes() -> None:
    host = output(limit=5000)
    at(host, host.now + 1000, 1)
    at(host, host.now + 6001, 1)
    assert host.dies(run=1000) == "Scheduled digital out event will exceed max_duration"


def test_a_value_in_the_past_is_too_close() -> None:
    host = output()
    host.run(1000)
    assert host.dies(f"queue_digital_out oid=0 clock={host.now - 1} on_ticks=1") == "Timer too close"


@pytest.mark.parametrize("limit", [0, 1_000_000])
def test_pwm_in_software(limit: int) -> None:
    host = output(limit=limit, start_clock=ROLLOVER - 15_000)
    host.send("set_digital_out_pwm_cycle oid=0 cycle_ticks=1000")
    begin = host.now + 1000
    at(host, begin, 300)
    at(host, begin + 10_000, 1000)
    at(host, begin + 20_000, 900)
    at(host, begin + 25_000, 0)
    host.run(100_000)
    wanted = [begin + 1000 * k + part for k in range(10) for part in (0, 300)]
    wanted += [begin + 10_000]
    wanted += [begin + 20_000 + 1000 * k + part for k in range(5) for part in (900, 1000)][:-1]
    # Where the end of a cycle and a new value fall together, two changes cancel out; it ends in an off phase.
    assert cancelled(host.steps(PIN).tolist()) == cancelled(wanted)
    assert host.run(10_000_000) == []


def cancelled(clocks: list[int]) -> list[int]:
    """Drop pairs of changes at the same clock."""
    return sorted(c for c in set(clocks) if clocks.count(c) % 2)


def test_full_on_is_not_default_and_must_be_renewed_with_a_cycle() -> None:
    host = output(limit=50_000)
    host.send("set_digital_out_pwm_cycle oid=0 cycle_ticks=1000")
    at(host, host.now + 1000, 500)
    assert host.dies(run=51_000) == "Missed scheduling of next digital out event"
    assert host.node.level(PIN) == 0
    level_changes = len(host.steps(PIN))
    host.run(100_000)
    assert len(host.steps(PIN)) == level_changes, "the toggling ended too"


def test_the_cycle_cannot_change_under_a_queue() -> None:
    host = output()
    at(host, host.now + 1000, 1)
    assert "soft pwm" in host.dies("set_digital_out_pwm_cycle oid=0 cycle_ticks=1000")


def test_update_acts_at_once_but_not_on_a_queue() -> None:
    host = output(limit=5000)
    host.send("update_digital_out oid=0 value=1")
    assert host.node.level(PIN) == 1
    host.run(4999)
    host.send("update_digital_out oid=0 value=1")
    host.run(4999)
    host.send("update_digital_out oid=0 value=0")
    host.run(1_000_000)
    at(host, host.now + 1000, 0)
    assert host.dies("update_digital_out oid=0 value=1") == "update_digital_out not valid with active queue"


def test_a_configured_value_that_is_not_the_default_must_be_renewed_too() -> None:
    host = Host()
    host.configure("config_digital_out oid=0 pin=40 value=1 default_value=0 max_duration=5000")
    assert host.dies(run=5000) == "Missed scheduling of next digital out event"


def test_a_shutdown_drives_the_default_whatever_it_is() -> None:
    host = output(default=1)
    assert host.node.level(PIN) == 0
    assert host.dies("emergency_stop") == "Command request"
    assert host.node.level(PIN) == 1


def test_set_digital_out_needs_no_object() -> None:
    host = output()
    host.send("set_digital_out pin=77 value=1")
    assert host.node.level(77) == 1
    assert host.dies("set_digital_out pin=144 value=1") == "Not an output pin"


PWM = "config_pwm_out oid=0 pin=41 cycle_ticks=1000 value=0 default_value={default} max_duration=5000"


def test_hardware_pwm_follows_its_queue_and_its_safety_net() -> None:
    host = Host(start_clock=ROLLOVER - 2500)
    host.configure(PWM.format(default=7))
    begin = host.now
    assert host.node.pwm(41) == 0
    for k, value in ((1, 32768), (2, 100), (3, 7), (40, 9)):
        host.send(f"queue_pwm_out oid=0 clock={(begin + 1000 * k) % ROLLOVER} value={value}")
    for k, value in ((1, 32768), (2, 100), (3, 7), (39, 7), (40, 9), (44, 9)):
        host.run(begin + 1000 * k - host.now)
        assert host.node.pwm(41) == value, k
    assert host.dies(run=1000) == "Missed scheduling of next hard pwm event"
    assert host.node.pwm(41) == 7


def test_hardware_pwm_refuses_values_too_far_apart() -> None:
    host = Host()
    host.configure(PWM.format(default=0))
    host.send(f"queue_pwm_out oid=0 clock={host.now + 100} value=5")
    host.run(200)
    assert host.dies(f"queue_pwm_out oid=0 clock={host.now + 5000} value=5") == (
        "Scheduled pwm event will exceed max_duration"
    )


@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("config_digital_out oid=0 pin=144 value=1 default_value=1 max_duration=0", "Not an output pin"),
        (
            "config_pwm_out oid=0 pin=300 cycle_ticks=1 value=0 default_value=0 max_duration=0",
            "Not a valid PWM pin",
        ),
        ("config_analog_in oid=0 pin=144", "Not a valid ADC pin"),
        ("config_endstop oid=0 pin=255 pull_up=1", "Not a valid input pin"),
        ("config_stepper oid=0 step_pin=3 dir_pin=144 invert_step=0 step_pulse_ticks=2", "Not a valid pin"),
        ("config_buttons oid=0 button_count=9", "Max of 8 buttons"),
        ("buttons_add oid=0 pos=0 pin=1 pull_up=1", "Invalid oid type"),
        ("config_trsync oid=5", "Can't assign oid"),
        ("allocate_oids count=3", "oids already allocated"),
    ],
)
def test_bad_configurations_shut_down_and_can_be_reset(command: str, text: str) -> None:
    host = Host()
    host.send("allocate_oids count=5")
    assert host.dies(command) == text
    assert host.send("config_reset") == []
    host.configure(OUT.format(default=0, limit=0))


# ----------------------------------------------------------------------------------------------------- analog

QUERY = (
    "query_analog_in oid=1 clock={clock} sample_ticks=100 sample_count={count} rest_ticks=10000"
    " bytes_per_report={size} min_value={low} max_value={high} range_check_count={checks}"
)


def analog(start_clock: int = 0) -> Host:
    host = Host(start_clock=start_clock)
    host.configure("config_analog_in oid=1 pin=50")
    return host


def values(answer: Answer) -> list[int]:
    data = answer.args["values"]
    assert isinstance(data, bytes)
    return [int.from_bytes(data[k : k + 2], "little") for k in range(0, len(data), 2)]


def test_sums_are_gathered_into_reports() -> None:
    host = analog(ROLLOVER - 55_000)
    begin = host.now + 1000
    host.send(QUERY.format(clock=begin % ROLLOVER, count=8, size=8, low=0, high=65535, checks=0))
    said: list[Answer] = []
    for k in range(13):
        host.node.set_adc(50, 100 * k)
        said += host.run(begin + 10_000 * k + 9_000 - host.now)
    assert [values(answer) for answer in said] == [[800 * k for k in range(j, j + 4)] for j in (0, 4, 8)]
    assert [a["next_clock"] for a in said] == [(begin + 10_000 * k) % ROLLOVER for k in (4, 8, 12)]


def test_samples_of_a_sum_are_apart_by_the_time_asked_for() -> None:
    host = analog()
    begin = host.now + 1000
    host.node.set_adc(50, 1)
    host.send(QUERY.format(clock=begin, count=3, size=2, low=0, high=65535, checks=0))
    for k, value in enumerate((10, 100)):  # the samples are at 0, 100 and 200 ticks
        assert host.run(begin + 100 * k + 60 - host.now) == []
        host.node.set_adc(50, value)
    (answer,) = host.run(begin + 260 - host.now)
    assert values(answer) == [111]


def test_a_value_out_of_range_too_often_in_a_row_shuts_down() -> None:
    host = analog()
    begin = host.now + 1000
    host.send(QUERY.format(clock=begin, count=1, size=2, low=1000, high=3000, checks=3))
    for k, sample in enumerate([2000, 999, 3001, 3000, 999, 999, 1000, 3001, 3001]):
        host.node.set_adc(50, sample)
        (answer,) = host.run(begin + 10_000 * k + 50 - host.now)
        assert values(answer) == [sample]
    assert host.dies(run=10_000) == "ADC out of range"


def test_sampling_ends_with_a_count_of_zero() -> None:
    host = analog()
    host.send(QUERY.format(clock=host.now + 1, count=1, size=2, low=0, high=4095, checks=1))
    assert len(host.run(25_000)) == 3
    host.send(QUERY.format(clock=0, count=0, size=2, low=0, high=4095, checks=1))
    assert host.run(1_000_000) == []


@pytest.mark.parametrize("size", [0, 1, 3, 50, 255])
def test_odd_report_sizes_are_refused(size: int) -> None:
    query = QUERY.format(clock=1, count=1, size=size, low=0, high=4095, checks=1)
    assert analog().dies(query) == "Invalid analog_in bytes_per_report"


# ---------------------------------------------------------------------------------------------------- buttons


def buttons() -> Host:
    host = Host()
    host.configure(
        "config_buttons oid=2 button_count=3",
        "buttons_add oid=2 pos=0 pin=60 pull_up=1",
        "buttons_add oid=2 pos=1 pin=61 pull_up=1",
        "buttons_add oid=2 pos=2 pin=62 pull_up=-1",
    )
    host.send(f"buttons_query oid=2 clock={host.now + 1000} rest_ticks=1000 retransmit_count=10 invert=2")
    host.node.set_input(61, 1)
    return host


def test_presses_are_reported_until_acknowledged() -> None:
    host = buttons()
    assert host.run(50_000) == []
    host.node.set_input(60, 1)
    first = host.run(2500)
    assert [a.args for a in first] == [{"oid": 2, "ack_count": 0, "state": b"\x01"}]
    host.node.set_input(61, 0)
    assert [a.args for a in host.run(2500)] == [{"oid": 2, "ack_count": 0, "state": b"\x01\x03"}]
    again = host.run(20_000)
    assert [a.args["state"] for a in again] == [b"\x01\x03"] * 2, "every ten samples"
    host.send("buttons_ack oid=2 count=1")
    assert [a.args for a in host.run(10_000)] == [{"oid": 2, "ack_count": 1, "state": b"\x03"}]
    host.send("buttons_ack oid=2 count=200")
    assert host.run(100_000) == []
    host.node.set_input(60, 0)
    assert [a.args for a in host.run(2500)] == [{"oid": 2, "ack_count": 2, "state": b"\x02"}]


def test_a_position_without_a_pin_is_open() -> None:
    host = Host()
    host.configure("config_buttons oid=2 button_count=2", "buttons_add oid=2 pos=1 pin=61 pull_up=1")
    for pin in (0, 61):
        host.node.set_input(pin, 1)
    host.send(f"buttons_query oid=2 clock={host.now + 1000} rest_ticks=1000 retransmit_count=10 invert=0")
    assert [a.args["state"] for a in host.run(4000)] == [b"\x02"]


def test_a_bounce_shorter_than_two_samples_is_no_press() -> None:
    host = buttons()
    host.run(10_500)
    host.node.set_input(60, 1)
    host.run(1000)
    host.node.set_input(60, 0)
    assert host.run(100_000) == []


def test_the_event_buffer_is_bounded_and_keeps_the_last_state() -> None:
    host = buttons()
    host.run(10_500)
    for k in range(9):
        host.node.set_input(60, (k + 1) & 1)
        host.run(3000)
    state = host.run(20_000)[-1].args["state"]
    assert state == bytes([1, 0] * 4)
    host.send("buttons_ack oid=2 count=8")
    assert host.run(3000)[0].args == {"oid": 2, "ack_count": 8, "state": b"\x01"}


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (
            "buttons_query oid=2 clock=0 rest_ticks=1000 retransmit_count=0 invert=0",
            "Invalid buttons retransmit count",
        ),
        ("buttons_add oid=2 pos=3 pin=60 pull_up=1", "Set button past maximum button count"),
        ("buttons_add oid=2 pos=1 pin=4660 pull_up=1", "Not a valid input pin"),
        ("buttons_add oid=2 pos=1 pin=144 pull_up=1", "Not a valid input pin"),
    ],
)
def test_senseless_button_commands_shut_down(command: str, text: str) -> None:
    assert buttons().dies(command) == text
