"""Steps: exact times over the rollover, both kinds of pulses, the move queue, stop groups and endstops."""

import random

import numpy as np
import pytest

from tests.firmware.host import Host

STEP, DIR = 3, 4
ROLLOVER = 1 << 32
BOTH_EDGES = "config_stepper oid=0 step_pin=3 dir_pin=4 invert_step=255 step_pulse_ticks=0"
PULSED = "config_stepper oid=0 step_pin=3 dir_pin=4 invert_step={invert} step_pulse_ticks={pulse}"


def machine(*commands: str, start_clock: int = 0) -> Host:
    host = Host(start_clock=start_clock)
    host.configure(*(commands or (BOTH_EDGES,)))
    return host


def expected_steps(first: int, moves: list[tuple[int, int, int]]) -> list[int]:
    """Say when steps come: the definition of queue_step, step by step."""
    clock, steps = first, []
    for interval, count, add in moves:
        wait = interval
        for _ in range(count):
            clock += wait
            steps.append(clock)
            wait += add
    return steps


def queue(host: Host, moves: list[tuple[int, int, int]], oid: int = 0) -> None:
    for interval, count, add in moves:
        assert host.send(f"queue_step oid={oid} interval={interval} count={count} add={add}") == []


def random_moves(seed: int, count: int) -> list[tuple[int, int, int]]:
    rng = random.Random(seed)
    moves = []
    for _ in range(count):
        steps = rng.randrange(1, 60)
        add = rng.randrange(-50, 50)
        moves.append((rng.randrange(4000, 200000), steps, add))
    return moves


@pytest.mark.parametrize("invert", [255, 0, 1])
def test_step_times_are_exact_over_several_rollovers(invert: int) -> None:
    config = BOTH_EDGES if invert == 255 else PULSED.format(invert=invert, pulse=300)
    host = machine(config, start_clock=ROLLOVER - 168_000_000)
    first = host.now + 100_000
    host.send(f"reset_step_clock oid=0 clock={first % ROLLOVER}")
    host.send("set_next_step_dir oid=0 dir=1")
    moves: list[tuple[int, int, int]] = []
    for part in range(54):
        chunk = random_moves(part, 40)
        if part % 9 == 8:
            chunk.append((2_000_000_000, 1, 0))  # nearly half a clock round
        moves += chunk
        queue(host, chunk)
        wanted = expected_steps(first, moves)
        assert host.run(wanted[-1] - host.now - 1000) == []
        host.node.edges()
    host.run(2000)
    edges = host.steps(STEP)
    if invert != 255:
        begin, end = edges[invert ^ 1 :: 2], edges[invert::2]
        if invert == 1:  # the idle level is high: the very first edge is the configuration's
            begin, end = edges[1::2], edges[2::2]
        else:
            begin, end = edges[0::2], edges[1::2]
        assert np.array_equal(end - begin, np.full(len(begin), 300, np.uint64))
        edges = begin
    assert wanted[-1] > 5 * ROLLOVER
    assert edges.tolist() == wanted
    assert host.ask("stepper_get_position oid=0")["pos"] == len(wanted)


def test_pulses_of_no_length_are_two_edges_at_once() -> None:
    host = machine(PULSED.format(invert=0, pulse=0))
    first = host.now + 1000
    host.send(f"reset_step_clock oid=0 clock={first}")
    queue(host, [(500, 3, 10)])
    host.run(5000)
    assert host.steps(STEP).tolist() == [c for c in expected_steps(first, [(500, 3, 10)]) for _ in range(2)]


def test_steps_too_close_for_their_pulses_are_spread_not_lost() -> None:
    host = machine(PULSED.format(invert=0, pulse=100))
    first = host.now + 1000
    host.send(f"reset_step_clock oid=0 clock={first}")
    queue(host, [(150, 4, 0), (1000, 2, 0)])
    host.run(10000)
    begin, end = host.steps(STEP)[0::2], host.steps(STEP)[1::2]
    assert (end - begin).tolist() == [100] * 6
    assert (begin[1:] - end[:-1]).min() >= 100
    assert begin[-1] == first + 4 * 150 + 2 * 1000, "it caught up"


def test_direction_changes_between_moves_and_counts() -> None:
    host = machine()
    first = host.now + 1000
    host.send(f"reset_step_clock oid=0 clock={first}")
    position = 0
    for dir_, count in ((1, 5), (0, 12), (0, 1), (1, 3)):
        host.send(
            f"set_next_step_dir oid=0 dir={dir_}", f"queue_step oid=0 interval=1000 count={count} add=0"
        )
        position += count if dir_ else -count
    assert host.ask("stepper_get_position oid=0")["pos"] == 0
    host.run(1000 + 1000 * 7 + 1)
    assert host.ask("stepper_get_position oid=0")["pos"] == 5 - 2
    host.run(100_000)
    assert host.ask("stepper_get_position oid=0")["pos"] == position == -5
    dir_edges = host.steps(DIR).tolist()
    # Up with the first move's arrival, then with the last step of the move before.
    assert dir_edges[1:] == [first + 5000, first + 18000]


def test_an_idle_stepper_goes_on_from_its_last_step() -> None:
    host = machine()
    first = host.now + 1000
    host.send(f"reset_step_clock oid=0 clock={first}")
    queue(host, [(1000, 1, 0)])
    host.run(5000)
    queue(host, [(10_000, 1, 0)])
    host.run(50_000)
    assert host.steps(STEP).tolist() == [first + 1000, first + 11_000]


def test_a_first_step_in_the_past_shuts_down() -> None:
    host = machine(start_clock=ROLLOVER - 5000)
    host.send(f"reset_step_clock oid=0 clock={host.now % ROLLOVER}")
    host.run(10_000)
    assert host.dies("queue_step oid=0 interval=9999 count=1 add=0") == "Stepper too far in past"
    assert len(host.steps(STEP)) == 0


def test_a_first_step_right_now_is_in_time() -> None:
    host = machine()
    host.send(f"reset_step_clock oid=0 clock={host.now}")
    host.run(10_000)
    queue(host, [(10_000, 1, 0)])
    host.run(1)
    assert host.steps(STEP).tolist() == [host.now - 1]


def test_an_interval_that_runs_backwards_shuts_down() -> None:
    host = machine()
    host.send(f"reset_step_clock oid=0 clock={host.now + 1000}")
    queue(host, [(100, 5, -60)])
    assert host.dies(run=10_000) == "Rescheduled timer in the past"


@pytest.mark.parametrize(
    ("command", "text"),
    [
        ("queue_step oid=0 interval=100 count=0 add=0", "Invalid count parameter"),
        ("queue_step oid=1 interval=100 count=1 add=0", "Invalid oid type"),
        ("queue_step oid=99 interval=100 count=1 add=0", "Invalid oid type"),
        ("stepper_get_position oid=1", "Invalid oid type"),
        ("stepper_stop_on_trigger oid=0 trsync_oid=0", "Invalid oid type"),
    ],
)
def test_senseless_stepper_commands_shut_down(command: str, text: str) -> None:
    assert machine().dies(command) == text


def test_the_clock_of_a_moving_stepper_cannot_be_reset() -> None:
    host = machine()
    host.send(f"reset_step_clock oid=0 clock={host.now}")
    queue(host, [(1_000_000, 1, 0)])
    assert host.dies("reset_step_clock oid=0 clock=0") == "Can't reset time when stepper active"


def test_the_move_queue_holds_what_it_says_and_one_more_is_an_overflow() -> None:
    second = "config_stepper oid=1 step_pin=5 dir_pin=6 invert_step=255 step_pulse_ticks=0"
    host = machine(BOTH_EDGES, second)
    slots = host.ask("get_config")["move_count"]
    assert slots == 1024
    start = host.now + 100_000_000
    for oid in (0, 1):
        host.send(f"reset_step_clock oid={oid} clock={start}")
    for k in range(slots):  # a move holds its slot until its last step
        assert host.send(f"queue_step oid={k & 1} interval=1000 count=2 add=0") == [], k
    host.run(start - host.now + 1999)  # each stepper did one of its two steps
    assert len(host.steps(STEP)) == len(host.steps(5)) == 1
    assert host.dies("queue_step oid=0 interval=1000 count=1 add=0") == "Move queue overflow"
    host.run(1_000_000)
    assert len(host.steps(STEP)) == 1, "nothing moves after a shutdown"


def test_slots_come_back_for_ever() -> None:
    host = machine()
    host.send(f"reset_step_clock oid=0 clock={host.now + 1000}")
    for _ in range(5000):
        queue(host, [(100, 3, 0)])
        host.run(300)
    host.run(1000)
    assert host.ask("stepper_get_position oid=0")["pos"] == -15000


TRSYNC = "config_trsync oid=8"


def home(host: Host) -> int:
    first = host.now + 10_000
    host.send(f"reset_step_clock oid=0 clock={first}", "set_next_step_dir oid=0 dir=1")
    host.send(
        "queue_step oid=0 interval=1000 count=5000 add=0", "queue_step oid=0 interval=1000 count=50 add=0"
    )
    return first


def test_a_trigger_stops_in_place_and_moves_are_ignored_until_the_clock_is_reset() -> None:
    host = machine(BOTH_EDGES, TRSYNC)
    first = home(host)
    host.send("trsync_start oid=8 report_clock=0 report_ticks=0 expire_reason=2")
    host.send("stepper_stop_on_trigger oid=0 trsync_oid=8")
    host.run(first + 100_500 - host.now)
    (answer,) = host.send("trsync_trigger oid=8 reason=3")
    assert (answer.name, answer["can_trigger"], answer["trigger_reason"]) == ("trsync_state", 0, 3)
    assert answer["clock"] == host.now
    queue(host, [(1000, 7, 0)])
    host.run(10_000_000)
    assert len(host.steps(STEP)) == 100
    assert host.ask("stepper_get_position oid=0")["pos"] == 100
    slots = host.ask("get_config")["move_count"]
    host.send(f"reset_step_clock oid=0 clock={host.now + 1000}")
    for _ in range(slots):  # all slots are free again
        queue(host, [(1_000_000, 1, 0)])
    host.run(1_100_000)
    assert host.ask("stepper_get_position oid=0")["pos"] == 101
    assert host.ask("trsync_trigger oid=8 reason=9")["trigger_reason"] == 3, "the first reason counts"


def test_a_stop_in_the_middle_of_a_pulse_ends_it() -> None:
    host = machine(PULSED.format(invert=0, pulse=400), TRSYNC)
    first = home(host)
    host.send("trsync_start oid=8 report_clock=0 report_ticks=0 expire_reason=2")
    host.send("stepper_stop_on_trigger oid=0 trsync_oid=8")
    host.run(first + 3000 + 100 - host.now)
    assert host.node.level(STEP) == 1
    host.ask("trsync_trigger oid=8 reason=3")
    assert host.node.level(STEP) == 0
    assert host.ask("stepper_get_position oid=0")["pos"] == 3


def test_a_trsync_reports_expires_and_can_be_prolonged() -> None:
    host = machine(BOTH_EDGES, TRSYNC, start_clock=ROLLOVER - 500_000)
    first = home(host)
    begin = host.now
    host.send(
        f"trsync_start oid=8 report_clock={(begin + 100_000) % ROLLOVER} report_ticks=200000 expire_reason=7"
    )
    host.send("stepper_stop_on_trigger oid=0 trsync_oid=8")
    host.send(f"trsync_set_timeout oid=8 clock={(begin + 250_000) % ROLLOVER}")
    host.run(200_000)
    host.send(f"trsync_set_timeout oid=8 clock={(begin + 1_050_500) % ROLLOVER}")
    host.receive()
    said = host.run(2_000_000)
    reports = [(a["can_trigger"], a["trigger_reason"], a["clock"]) for a in said]
    wanted = [(1, 0, (begin + 100_000 + 200_000 * k) % ROLLOVER) for k in range(1, 5)]
    assert reports == [*wanted, (0, 7, (begin + 1_050_500) % ROLLOVER)]
    assert host.steps(STEP)[-1] <= begin + 1_050_500 < host.steps(STEP)[-1] + 1000
    assert len(host.steps(STEP)) == (begin + 1_050_500 - first) // 1000


def test_joining_a_trsync_twice_shuts_down_and_joining_too_late_stops_at_once() -> None:
    host = machine(BOTH_EDGES, TRSYNC)
    host.send("trsync_start oid=8 report_clock=0 report_ticks=0 expire_reason=2")
    host.send("stepper_stop_on_trigger oid=0 trsync_oid=8")
    assert "already active" in host.dies("stepper_stop_on_trigger oid=0 trsync_oid=8")
    host = machine(BOTH_EDGES, TRSYNC)
    home(host)
    host.send("stepper_stop_on_trigger oid=0 trsync_oid=8")
    host.run(1_000_000)
    assert len(host.steps(STEP)) == 0


def test_a_stepper_is_in_one_trsync_at_a_time() -> None:
    host = machine(BOTH_EDGES, TRSYNC, "config_trsync oid=9")
    for oid in (8, 9):
        host.send(f"trsync_start oid={oid} report_clock=0 report_ticks=0 expire_reason=2")
    host.send("stepper_stop_on_trigger oid=0 trsync_oid=8")
    host.ask("trsync_trigger oid=8 reason=3")
    host.send("stepper_stop_on_trigger oid=0 trsync_oid=9")  # it has left the first one
    host.send("trsync_start oid=8 report_clock=0 report_ticks=0 expire_reason=2")
    assert "already active" in host.dies("stepper_stop_on_trigger oid=0 trsync_oid=8")


ENDSTOP = "config_endstop oid=9 pin=20 pull_up=1"
HOME = (
    "endstop_home oid=9 clock={clock} sample_ticks=100 sample_count={count} rest_ticks=5000"
    " pin_value=1 trsync_oid=8 trigger_reason=1"
)


def endstop_machine(start_clock: int = 0) -> tuple[Host, int]:
    host = machine(BOTH_EDGES, TRSYNC, ENDSTOP, start_clock=start_clock)
    first = home(host)
    host.send("trsync_start oid=8 report_clock=0 report_ticks=0 expire_reason=2")
    host.send("stepper_stop_on_trigger oid=0 trsync_oid=8")
    host.send(HOME.format(clock=first % ROLLOVER, count=4))
    return host, first


def test_an_endstop_stops_after_all_its_samples_and_tells_when() -> None:
    host, first = endstop_machine(ROLLOVER - 60_000)
    assert host.ask("endstop_query_state oid=9").args == {
        "oid": 9,
        "homing": 1,
        "next_clock": first % ROLLOVER,
        "pin_value": 0,
    }
    host.run(first + 22_000 - host.now)
    host.node.set_input(20, 1)
    (report,) = host.run(100_000)
    hit = first + 25_000
    assert (report["can_trigger"], report["trigger_reason"]) == (0, 1)
    assert report["clock"] == (hit + 300) % ROLLOVER
    state = host.ask("endstop_query_state oid=9")
    assert (state["homing"], state["pin_value"]) == (0, 1)
    assert state["next_clock"] == (hit + 5000) % ROLLOVER
    assert host.ask("stepper_get_position oid=0")["pos"] == (hit + 300 - first) // 1000


def test_a_bouncing_endstop_does_not_stop() -> None:
    host, first = endstop_machine()
    host.run(first + 9_950 - host.now)
    for _ in range(20):  # high for two of four samples, round after round
        host.node.set_input(20, 1)
        assert host.run(200) == []
        host.node.set_input(20, 0)
        assert host.run(4_800) == []
    assert host.ask("endstop_query_state oid=9")["homing"] == 1


def test_sampling_can_be_ended() -> None:
    host, _ = endstop_machine()
    host.send(HOME.format(clock=0, count=0))
    host.node.set_input(20, 1)
    assert host.run(1_000_000) == []
    assert host.ask("endstop_query_state oid=9")["homing"] == 0


@pytest.mark.parametrize("sample_count", [1, 4])
def test_a_timer_that_never_lets_the_clock_move_shuts_down(sample_count: int) -> None:
    host = machine(BOTH_EDGES, TRSYNC, ENDSTOP)
    host.send(
        f"endstop_home oid=9 clock={host.now + 100} sample_ticks=0 sample_count={sample_count} rest_ticks=0"
        " pin_value=1 trsync_oid=8 trigger_reason=1"
    )
    assert host.dies(run=200) == "Rescheduled timer in the past"
