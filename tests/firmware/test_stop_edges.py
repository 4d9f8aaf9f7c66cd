"""The edges of what makes heat and stops motion: exact limits, what a shutdown or a new start ends."""

import pytest

from tests.firmware.host import Host

ROLLOVER = 1 << 32
PIN, OTHER_PIN, PWM_PIN = 40, 42, 41
DIGITAL = "config_digital_out oid={oid} pin={pin} value=0 default_value={default} max_duration={limit}"
PWM = "config_pwm_out oid=0 pin=41 cycle_ticks=1000 value=0 default_value={default} max_duration={limit}"
STEPPER = "config_stepper oid=1 step_pin=3 dir_pin=4 invert_step=255 step_pulse_ticks=0"


def digital(*, limit: int = 0, default: int = 0, cycle: int = 0, move_count: int = 1024) -> Host:
    host = Host(move_count=move_count)
    host.configure(DIGITAL.format(oid=0, pin=PIN, default=default, limit=limit))
    if cycle:
        host.send(f"set_digital_out_pwm_cycle oid=0 cycle_ticks={cycle}")
    host.node.forget_edges()
    return host


def queue(host: Host, clock: int, on_ticks: int, *, oid: int = 0) -> None:
    assert host.send(f"queue_digital_out oid={oid} clock={clock % ROLLOVER} on_ticks={on_ticks}") == []


def edges(host: Host) -> list[tuple[int, int, int]]:
    """Return (clock, pin, level) of all changes."""
    return [(int(e) >> 16, int(e) >> 1 & 0x7FFF, int(e) & 1) for e in host.node.edges()]


# ---------------------------------------------------------------------------------------------------- outputs


@pytest.mark.parametrize(("value", "default"), [(0, 1), (1, 0), (1, 1), (0, 0), (2, 0)])
def test_a_pin_has_its_first_value_from_the_beginning(value: int, default: int) -> None:
    host = Host()
    begin = host.now
    host.configure(f"config_digital_out oid=0 pin={PIN} value={value} default_value={default} max_duration=0")
    assert edges(host) == ([(begin, PIN, 1)] if value else [])


@pytest.mark.parametrize("on_ticks", [1000, 1001, 5000])
def test_a_whole_cycle_on_is_on_without_a_gap(on_ticks: int) -> None:
    host = digital(cycle=1000)
    begin = host.now
    queue(host, begin + 100, on_ticks)
    host.run(20_000)
    assert edges(host) == [(begin + 100, PIN, 1)]


def test_one_tick_less_than_a_cycle_has_a_gap_of_one_tick() -> None:
    host = digital(cycle=1000)
    begin = host.now
    queue(host, begin + 100, 999)
    host.run(2_500)
    assert edges(host)[:4] == [
        (begin + 100, PIN, 1),
        (begin + 1099, PIN, 0),
        (begin + 1100, PIN, 1),
        (begin + 2099, PIN, 0),
    ]


@pytest.mark.parametrize("at", [100, 250, 550, 850])
@pytest.mark.parametrize("default", [0, 1])
def test_a_shutdown_ends_software_pwm_at_its_default_in_every_part_of_the_cycle(
    at: int, default: int
) -> None:
    host = digital(cycle=1000, default=default)
    queue(host, host.now + 100, 500)
    host.run(7_000 + at)
    assert host.dies("emergency_stop") == "Command request"
    host.node.forget_edges()
    host.run(100_000)
    assert edges(host) == []
    assert host.node.level(PIN) == default


def test_values_that_have_had_their_turn_give_their_slots_back() -> None:
    host = digital(move_count=2)
    for value in range(20):
        queue(host, host.now + 100, value & 1)
        queue(host, host.now + 200, value & 1)
        assert host.run(300) == []


def test_one_value_more_than_there_are_slots_is_a_shutdown() -> None:
    host = digital(move_count=3)
    for k in range(3):
        queue(host, host.now + 1000 + k, 1)
    command = f"queue_digital_out oid=0 clock={host.now + 2000} on_ticks=1"
    assert host.dies(command) == "Move queue overflow"


def test_a_shutdown_empties_the_queue_and_what_comes_after_it_acts() -> None:
    host = digital(limit=5000, move_count=2)
    begin = host.now
    queue(host, begin + 1000, 1)
    host.run(1500)
    queue(host, begin + 5900, 1)
    queue(host, begin + 8000, 0)
    host.dies("emergency_stop")
    assert host.node.level(PIN) == 0
    host.node.forget_edges()
    host.run(20_000)
    assert edges(host) == [], "the values of before are gone"
    host.send("clear_shutdown")
    # Far behind the end of what was driven before: that no longer has to be renewed.
    clock = host.now + 50_000
    queue(host, clock, 1)
    queue(host, clock + 5000, 0)
    assert host.run(100_000) == []
    assert edges(host) == [(clock, PIN, 1), (clock + 5000, PIN, 0)]


def test_values_at_one_clock_act_in_the_order_in_which_they_came() -> None:
    host = Host()
    host.configure(
        *(DIGITAL.format(oid=k, pin=pin, default=0, limit=0) for k, pin in ((0, PIN), (1, OTHER_PIN)))
    )
    clock = host.now + 1000
    queue(host, clock, 1)
    queue(host, clock, 1, oid=1)
    queue(host, clock + 500, 0)
    host.run(1000)
    assert edges(host) == [(clock, PIN, 1), (clock, OTHER_PIN, 1)]


@pytest.mark.parametrize(
    ("config", "update", "text"),
    [
        (
            DIGITAL.format(oid=0, pin=144, default=0, limit=0),
            "queue_digital_out oid=0 clock=9 on_ticks=1",
            "Not an output pin",
        ),
        (
            "config_pwm_out oid=0 pin=300 cycle_ticks=1 value=0 default_value=0 max_duration=0",
            "queue_pwm_out oid=0 clock=9 value=1",
            "Not a valid PWM pin",
        ),
        (
            "config_endstop oid=0 pin=255 pull_up=1",
            "endstop_query_state oid=0",
            "Not a valid input pin",
        ),
    ],
)
def test_a_pin_that_cannot_do_it_makes_no_object(config: str, update: str, text: str) -> None:
    host = Host()
    host.send("allocate_oids count=5")
    assert host.dies(config).startswith(text)
    host.send("clear_shutdown")
    assert host.dies(update) == "Invalid oid type"


@pytest.mark.parametrize("oid", [1, 7])
@pytest.mark.parametrize(
    "command",
    [
        "set_digital_out_pwm_cycle oid={oid} cycle_ticks=100",
        "queue_digital_out oid={oid} clock=9 on_ticks=1",
        "update_digital_out oid={oid} value=1",
        "queue_pwm_out oid={oid} clock=9 value=1",
        "trsync_start oid={oid} report_clock=0 report_ticks=0 expire_reason=1",
        "trsync_set_timeout oid={oid} clock=0",
        "trsync_set_group oid={oid} group=1",
        "trsync_trigger oid={oid} reason=1",
        "endstop_query_state oid={oid}",
        (
            "endstop_home oid={oid} clock=0 sample_ticks=1 sample_count=1 rest_ticks=1 pin_value=1"
            " trsync_oid=0 trigger_reason=1"
        ),
        "stepper_stop_on_trigger oid={oid} trsync_oid=0",
    ],
)
def test_an_object_that_is_none_or_another_is_a_shutdown(command: str, oid: int) -> None:
    host = Host()
    host.configure("config_analog_in oid=1 pin=50", "config_trsync oid=0", oids=7)
    assert host.dies(command.format(oid=oid)) == "Invalid oid type"
    assert host.node.level(PIN) == 0


def test_a_cycle_makes_on_as_long_as_itself_and_the_default_with_it() -> None:
    host = digital(cycle=1000, default=1)
    host.send("update_digital_out oid=0 value=1")
    assert host.run(20_000) == []
    assert host.node.level(PIN) == 1
    assert len(edges(host)) == 1, "on, not switching"
    host.send("update_digital_out oid=0 value=0")
    assert host.node.level(PIN) == 0
    host.dies("emergency_stop")
    assert host.node.level(PIN) == 1


@pytest.mark.parametrize(("value", "lives"), [(1, True), (0, False)])
def test_what_is_the_default_needs_no_renewal_also_when_updated(value: int, lives: bool) -> None:
    host = digital(limit=5000, default=1, cycle=1000)
    host.send(f"update_digital_out oid=0 value={value}")
    host.run(4_999)
    assert host.ask("get_config")["is_shutdown"] == 0
    said = host.run(1)
    assert (said == []) == lives


def test_a_pin_is_set_without_an_object_on_and_off() -> None:
    host = digital()
    for pin, value in ((77, 1), (77, 0), (0, 1), (0, 0), (143, 2)):
        assert host.send(f"set_digital_out pin={pin} value={value}") == []
        assert host.node.level(pin) == min(value, 1)


@pytest.mark.parametrize(("value", "default"), [(0, 0), (5, 9), (9, 5)])
def test_hardware_pwm_begins_at_its_value_and_goes_to_its_default(value: int, default: int) -> None:
    host = Host()
    host.configure(
        f"config_pwm_out oid=0 pin=41 cycle_ticks=1000 value={value} default_value={default} max_duration=0"
    )
    assert host.node.pwm(PWM_PIN) == value
    assert host.run(1_000_000) == [], "without a limit nothing has to be renewed"
    host.dies("emergency_stop")
    assert host.node.pwm(PWM_PIN) == default


def test_hardware_pwm_within_its_limit_is_renewed_to_the_tick() -> None:
    host = Host()
    host.configure(PWM.format(default=0, limit=5000))
    clock = host.now + 1000
    for k in range(3):
        assert host.send(f"queue_pwm_out oid=0 clock={clock + 5000 * k} value={k + 1}") == []
    assert host.run(1000 + 14_999) == []
    assert host.node.pwm(PWM_PIN) == 3
    assert host.dies(run=1) == "Missed scheduling of next hard pwm event"


# ------------------------------------------------------------------------------------------------ stop groups


def stepping(interval: int = 1000) -> Host:
    """Return a node whose stepper moves as a member of the trsync."""
    host = Host()
    host.configure(STEPPER, "config_trsync oid=0", "config_endstop oid=2 pin=20 pull_up=1")
    start(host)
    move(host, interval)
    return host


def start(host: Host, *, report_clock: int = 0, report_ticks: int = 0, reason: int = 2, oid: int = 0) -> None:
    command = f"trsync_start oid={oid} report_clock={report_clock % ROLLOVER} report_ticks={report_ticks}"
    assert host.send(f"{command} expire_reason={reason}") == []


def move(host: Host, interval: int = 1000) -> None:
    commands = ["stepper_stop_on_trigger oid=1 trsync_oid=0", f"reset_step_clock oid=1 clock={host.now}"]
    commands.append("set_next_step_dir oid=1 dir=1")
    commands.append(f"queue_step oid=1 interval={interval} count=9999 add=0")
    assert host.send(*commands) == []


def position(host: Host) -> int:
    return host.ask("stepper_get_position oid=1")["pos"]


def test_a_new_round_stops_what_moves_in_the_old_one() -> None:
    host = stepping()
    host.run(5500)
    start(host)
    at = len(host.steps(3))
    assert host.run(20_000) == []
    assert len(host.steps(3)) == at
    move(host)  # may join again
    host.run(5500)
    assert len(host.steps(3)) == at + 5


def test_a_member_that_joins_when_the_round_is_over_stops_at_once() -> None:
    host = stepping()
    host.run(2500)
    host.ask("trsync_trigger oid=0 reason=3")
    at = len(host.steps(3))
    host.send(f"reset_step_clock oid=1 clock={host.now}", "queue_step oid=1 interval=1000 count=99 add=0")
    host.run(3500)
    assert len(host.steps(3)) == at + 3
    host.send("stepper_stop_on_trigger oid=1 trsync_oid=0")
    host.run(20_000)
    assert len(host.steps(3)) == at + 3


def test_who_comes_when_the_round_is_over_is_no_member_of_the_next_one() -> None:
    host = stepping()
    host.ask("trsync_trigger oid=0 reason=3")
    for _ in range(2):
        assert host.send("stepper_stop_on_trigger oid=1 trsync_oid=0") == []
    at = len(host.steps(3))
    host.send(f"reset_step_clock oid=1 clock={host.now}", "queue_step oid=1 interval=1000 count=99 add=0")
    host.run(1500)
    start(host)
    host.run(3000)
    assert len(host.steps(3)) == at + 4


def test_joining_twice_is_a_shutdown_that_stops_the_member() -> None:
    host = stepping()
    host.run(2500)
    assert "already active" in host.dies("stepper_stop_on_trigger oid=1 trsync_oid=0")
    at = len(host.steps(3))
    host.run(20_000)
    assert len(host.steps(3)) == at


def test_reports_come_at_their_clocks_until_the_trigger() -> None:
    host = stepping()
    begin = host.now
    start(host, report_clock=begin + 1000, report_ticks=2000)
    said = host.run(6000)
    assert [(a["clock"], a["can_trigger"], a["trigger_reason"]) for a in said] == [
        (begin + 1000, 1, 0),
        (begin + 3000, 1, 0),
        (begin + 5000, 1, 0),
    ]
    answer = host.ask("trsync_trigger oid=0 reason=7")
    assert (answer["can_trigger"], answer["trigger_reason"], answer["clock"]) == (0, 7, begin + 6000)
    assert host.run(20_000) == []


def test_a_round_that_begins_forgets_the_reason_and_the_report_of_the_one_before() -> None:
    host = stepping()
    host.ask("trsync_trigger oid=0 reason=7")
    start(host, report_clock=host.now + 10, report_ticks=1000)
    (answer,) = host.run(100)
    assert (answer["can_trigger"], answer["trigger_reason"]) == (1, 0)


def test_a_time_out_is_moved_on_and_expires_to_the_tick() -> None:
    host = stepping()
    begin = host.now
    host.send(f"trsync_set_timeout oid=0 clock={begin + 3000}")
    host.run(2999)
    host.send(f"trsync_set_timeout oid=0 clock={begin + 6500}")
    assert host.run(3500) == []
    (answer,) = host.run(1)
    assert (answer["can_trigger"], answer["trigger_reason"], answer["clock"]) == (0, 2, begin + 6500)
    assert host.run(50_000) == []
    assert position(host) == 6


def test_a_time_out_that_nobody_waits_for_does_nothing() -> None:
    host = stepping()
    host.ask("trsync_trigger oid=0 reason=7")
    # Also one in the past, which would be too close.
    assert host.send(f"trsync_set_timeout oid=0 clock={host.now - 1}") == []
    assert host.run(50_000) == []


def test_the_command_ends_the_time_out_and_the_reports() -> None:
    host = stepping()
    start(host, report_clock=host.now + 500, report_ticks=500)
    host.send(f"trsync_set_timeout oid=0 clock={host.now + 10_000}")
    host.ask("trsync_trigger oid=0 reason=7")
    start(host)  # neither of the old timers may act on the new round
    assert host.run(50_000) == []
    assert host.ask("trsync_trigger oid=0 reason=9")["trigger_reason"] == 9


def test_a_new_round_forgets_the_old_time_out_and_its_reports() -> None:
    host = stepping()
    start(host, report_clock=host.now + 500, report_ticks=500)
    host.send(f"trsync_set_timeout oid=0 clock={host.now + 10_000}")
    start(host)
    assert host.run(50_000) == []


def test_a_shutdown_ends_a_round_without_a_report() -> None:
    host = stepping()
    host.run(2500)
    host.dies("emergency_stop")
    at = len(host.steps(3))
    host.send("clear_shutdown")
    assert host.run(20_000) == []
    assert len(host.steps(3)) == at
    answer = host.ask("trsync_trigger oid=0 reason=9")
    assert (answer["can_trigger"], answer["trigger_reason"]) == (0, 0), "it was no longer armed"
    assert host.send("stepper_stop_on_trigger oid=1 trsync_oid=0") == [], "it is a member no more"
    start(host)
    move(host)
    host.run(2500)
    assert len(host.steps(3)) == at + 2


def test_all_stop_groups_of_a_node_that_belong_together_trigger_together() -> None:
    host = Host()
    host.configure(STEPPER, *(f"config_trsync oid={oid}" for oid in (0, 5, 6, 15)))
    for oid, group in ((0, 3), (5, 4), (15, 3)):
        host.send(f"trsync_set_group oid={oid} group={group}")
    for oid in (0, 5, 6, 15):
        start(host, oid=oid)
    host.send(f"trsync_set_timeout oid=15 clock={host.now + 2500}")
    move(host)
    at = host.now + 2500
    said = [(a["oid"], a["can_trigger"], a["trigger_reason"], a["clock"]) for a in host.run(20_000)]
    assert said == [(0, 0, 2, at), (15, 0, 2, at)]
    assert position(host) == 2
    assert host.ask("trsync_trigger oid=5 reason=9")["trigger_reason"] == 9, "it was still armed"


def test_groups_end_at_sixteen_and_none_is_255() -> None:
    host = stepping()
    for group in (0, 15, 255):
        assert host.send(f"trsync_set_group oid=0 group={group}") == []
    for group in (16, 254):
        assert host.dies(f"trsync_set_group oid=0 group={group}") == "Not a valid trigger group"
        host.send("clear_shutdown")


# -------------------------------------------------------------------------------------------------- endstops

HOME = (
    "endstop_home oid=2 clock={clock} sample_ticks={ticks} sample_count={count} rest_ticks={rest}"
    " pin_value={value} trsync_oid=0 trigger_reason=6"
)


def home(host: Host, clock: int, *, count: int = 4, value: int = 1) -> None:
    command = HOME.format(clock=clock % ROLLOVER, ticks=10, count=count, rest=1000, value=value)
    assert host.send(command) == []


def state(host: Host) -> tuple[int, int, int]:
    answer = host.ask("endstop_query_state oid=2")
    return answer["homing"], answer["next_clock"], answer["pin_value"]


@pytest.mark.parametrize("value", [0, 1])
def test_an_endstop_triggers_after_as_many_equal_samples_as_wanted(value: int) -> None:
    host = stepping()
    host.node.set_input(20, 1 - value)
    begin = host.now
    home(host, begin + 500, value=value)
    assert state(host) == (1, begin + 500, 1 - value)
    host.run(1600)  # looked at 500 and 1500
    assert state(host) == (1, begin + 2500, 1 - value)
    host.node.set_input(20, value)
    # Looks at 2500, 2510, 2520, 2530.
    assert host.run(929) == []
    assert state(host) == (1, begin + 3500, value)
    (answer,) = host.run(1)
    assert (answer["trigger_reason"], answer["clock"]) == (6, begin + 2530)
    assert state(host) == (0, begin + 3500, value)
    assert host.run(20_000) == []
    assert position(host) == 2


def test_a_bounce_between_the_samples_begins_at_the_next_look() -> None:
    host = stepping()
    host.node.set_input(20, 1)
    begin = host.now
    home(host, begin + 500)
    host.run(525)
    host.node.set_input(20, 0)
    host.run(10)
    assert state(host)[:2] == (1, begin + 1500)
    host.node.set_input(20, 1)
    assert host.run(1529 - 535) == []
    (answer,) = host.run(1)
    assert answer["clock"] == begin + 1530, "four samples again, not the two that were missing"


def test_a_count_of_zero_ends_the_looking_and_keeps_the_clock() -> None:
    host = stepping()
    begin = host.now
    home(host, begin + 500)
    host.run(600)
    home(host, 0, count=0)
    assert state(host)[:2] == (0, begin + 1500)
    host.node.set_input(20, 1)
    assert host.run(20_000) == []


def test_a_new_look_replaces_the_old_one() -> None:
    host = stepping()
    begin = host.now
    home(host, begin + 500)
    home(host, begin + 5000)
    host.node.set_input(20, 1)
    assert host.run(5029) == []
    assert len(host.run(1)) == 1


def test_an_endstop_that_would_stop_nothing_is_not_looked_at() -> None:
    host = stepping()
    command = HOME.format(clock=host.now + 10, ticks=1, count=1, rest=1, value=0)
    assert host.dies(command.replace("trsync_oid=0", "trsync_oid=2")) == "Invalid oid type"
    host.send("clear_shutdown")
    assert state(host)[0] == 0


def test_a_shutdown_ends_the_looking() -> None:
    host = stepping()
    home(host, host.now + 500)
    host.dies("emergency_stop")
    host.send("clear_shutdown")
    assert state(host)[0] == 0
    start(host)
    host.node.set_input(20, 1)
    assert host.run(20_000) == []


def test_a_shutdown_ends_the_looking_of_all_endstops() -> None:
    host = Host()
    host.configure(
        "config_endstop oid=0 pin=20 pull_up=1",
        "config_endstop oid=15 pin=21 pull_up=1",
        "config_trsync oid=3",
    )
    start(host, oid=3)
    for oid in (0, 15):
        host.send(
            f"endstop_home oid={oid} clock={host.now + 100} sample_ticks=10 sample_count=1 rest_ticks=100"
            " pin_value=1 trsync_oid=3 trigger_reason=1"
        )
    host.run(500)
    host.dies("emergency_stop")
    host.send("clear_shutdown")
    for oid in (0, 15):
        assert host.ask(f"endstop_query_state oid={oid}")["homing"] == 0
