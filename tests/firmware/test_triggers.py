"""Stop groups over the bus: one node's trigger stops the steppers of others without the host."""

import pytest

from tests.firmware.host import NODE_ID, Host
from tests.firmware.wire import Signal, Wire
from tests.stages.sim_node import SimNode

ROLLOVER = 1 << 32
STEPPER = "config_stepper oid=0 step_pin=3 dir_pin=4 invert_step=255 step_pulse_ticks=0"
TRSYNC = "config_trsync oid=8"
ENDSTOP = "config_endstop oid=9 pin=20 pull_up=1"
INTERVAL = 1_000
LATENCY = 25_300
GROUP = 5
ENDSTOP_REASON, EXPIRED, HOST_REASON = 1, 2, 3


def member(number: int, *, group: int | None = GROUP, start_clock: int = 0, legacy: bool = False) -> Host:
    """Make a node with a stepper, a stop group and an endstop."""
    uuid = f"00000000000{number}"
    host = Host(transport="can", uuid=uuid, node_id=NODE_ID + number, start_clock=start_clock, legacy=legacy)
    host.configure(STEPPER, TRSYNC, ENDSTOP, "config_trsync oid=10")
    if group is not None:
        assert host.send(f"trsync_set_group oid=8 group={group}") == []
    return host


def arm(host: Host, *, timeout: int | None = None, oid: int = 8) -> None:
    host.send(f"trsync_start oid={oid} report_clock=0 report_ticks=0 expire_reason={EXPIRED}")
    if timeout is not None:
        host.send(f"trsync_set_timeout oid={oid} clock={(host.now + timeout) % ROLLOVER}")


def move(host: Host, *, timeout: int | None = None) -> None:
    """Arm the trsync and step every INTERVAL ticks, from INTERVAL ticks from now on."""
    arm(host, timeout=timeout)
    host.send("stepper_stop_on_trigger oid=0 trsync_oid=8")
    host.send(f"reset_step_clock oid=0 clock={host.now % ROLLOVER}")
    host.send("set_next_step_dir oid=0 dir=1", f"queue_step oid=0 interval={INTERVAL} count=9999 add=0")


def watch_endstop(host: Host) -> None:
    host.send(
        f"endstop_home oid=9 clock={(host.now + 50) % ROLLOVER} sample_ticks=100 sample_count=4"
        f" rest_ticks=5000 pin_value=1 trsync_oid=8 trigger_reason={ENDSTOP_REASON}"
    )


def frame(group: int, reason: int, clock: int = 0) -> tuple[int, bytes]:
    return 0x020 + group, bytes([group, reason]) + clock.to_bytes(4, "little")


def position(host: Host) -> int:
    return host.ask("stepper_get_position oid=0")["pos"]


def reports(host: Host) -> list[tuple[int, int, int]]:
    """Return (oid, reason, clock) of what the stop groups reported."""
    answers, host.unasked = host.unasked, []
    return [(a["oid"], a["trigger_reason"], a["clock"]) for a in answers if a.name == "trsync_state"]


def test_an_endstop_stops_the_steppers_of_its_group_on_other_nodes_after_the_frames_way() -> None:
    hosts = [
        member(0, start_clock=ROLLOVER - 60_000),
        member(1, start_clock=ROLLOVER - 70_000),
        member(2),
        member(3, group=GROUP + 1),
        member(4, group=None),
        member(5, legacy=True),
    ]
    wire = Wire(hosts, LATENCY)
    for host in hosts:
        move(host)
    watch_endstop(hosts[0])
    wire.run(40_000)
    hosts[0].node.set_input(20, 1)
    wire.run(100_000)
    hit = 40_050 + 300
    clock = wire.local(0, hit)
    assert wire.heard == [Signal(hit, 0, *frame(GROUP, ENDSTOP_REASON, clock))]
    assert reports(hosts[0]) == [(8, ENDSTOP_REASON, clock)]
    assert position(hosts[0]) == hit // INTERVAL == len(hosts[0].steps(3))
    for number in (1, 2):
        stopped = hit + LATENCY
        assert reports(hosts[number]) == [(8, ENDSTOP_REASON, wire.local(number, stopped))]
        assert position(hosts[number]) == stopped // INTERVAL == len(hosts[number].steps(3))
        assert position(hosts[number]) - position(hosts[0]) == 25, "the overshoot is what the way lasts"
    for number in (3, 4, 5):
        assert reports(hosts[number]) == []
        assert position(hosts[number]) == wire.now // INTERVAL, "it is of no group, or of another"


@pytest.mark.parametrize("timeout", [90_500, None])
def test_a_time_out_or_the_host_on_one_node_triggers_the_group(timeout: int | None) -> None:
    hosts = [member(0), member(1, start_clock=ROLLOVER - 95_000)]
    wire = Wire(hosts, LATENCY)
    move(hosts[0])
    move(hosts[1], timeout=timeout)
    wire.run(90_500)
    if timeout is None:
        hosts[1].ask(f"trsync_trigger oid=8 reason={HOST_REASON}")
    reason = HOST_REASON if timeout is None else EXPIRED
    wire.run(100_000)
    assert wire.heard == [Signal(90_500, 1, *frame(GROUP, reason, wire.local(1, 90_500)))], (
        "nobody passed it on"
    )
    assert reports(hosts[0]) == [(8, reason, wire.local(0, 90_500 + LATENCY))]
    assert (position(hosts[1]), position(hosts[0])) == (90, (90_500 + LATENCY) // INTERVAL)


def test_two_triggers_that_cross_are_each_told_once_and_the_first_reason_counts() -> None:
    hosts = [member(0), member(1)]
    wire = Wire(hosts, LATENCY)
    move(hosts[0], timeout=50_000)
    move(hosts[1])
    wire.run(50_000 + LATENCY // 2)
    hosts[1].ask(f"trsync_trigger oid=8 reason={HOST_REASON}")
    wire.run(100_000)
    assert [(s.sender, s.data[1]) for s in wire.heard] == [(0, EXPIRED), (1, HOST_REASON)]
    assert [r for _, r, _ in reports(hosts[0])] == [EXPIRED]
    assert [r for _, r, _ in reports(hosts[1])] == [], "the host's command was answered at once"
    assert hosts[1].ask("trsync_trigger oid=8 reason=9")["trigger_reason"] == HOST_REASON


def test_a_group_that_there_is_not_leaves_the_one_that_was_joined() -> None:
    host = member(0)
    assert host.dies("trsync_set_group oid=8 group=16") == "Not a valid trigger group"
    host.send("clear_shutdown")
    move(host)
    host.run(10_500)
    host.node.receive_frame(*frame(GROUP, 7, 123))
    assert [(a["oid"], a["trigger_reason"]) for a in host.run(100)] == [(8, 7)]
    assert position(host) == 10


def test_duplicates_are_harmless_and_the_stepper_moves_again_after_a_new_start() -> None:
    host = member(0)
    move(host)
    host.run(10_500)
    said: list[tuple[int, int, int]] = []
    for _ in range(3):
        host.node.receive_frame(*frame(GROUP, 7, 123))
        said += [(a["oid"], a["trigger_reason"], a["clock"]) for a in host.run(100)]
    assert said == [(8, 7, 10_500)]
    assert position(host) == 10
    move(host)
    host.run(10_500)
    assert position(host) == 20
    assert host.signals == []


@pytest.mark.parametrize(
    ("can_id", "data"),
    [
        (0x020 + GROUP, b""),
        (0x020 + GROUP, bytes([GROUP, 1, 0, 0, 0])),
        (0x020 + GROUP, bytes([GROUP + 1, 1, 0, 0, 0, 0])),
        (0x021 + GROUP, bytes([GROUP, 1, 0, 0, 0, 0])),
        (0x021 + GROUP, bytes([GROUP + 1, 1, 0, 0, 0, 0])),
        (0x01F, bytes([255, 1, 0, 0, 0, 0])),
        (0x030, bytes([16, 1, 0, 0, 0, 0])),
        (0x020, bytes([0, 1, 0, 0, 0, 0])),
    ],
)
def test_other_frames_trigger_nothing(can_id: int, data: bytes) -> None:
    host = member(0)
    move(host)
    host.run(10_500)
    host.node.receive_frame(can_id, data)
    assert host.run(10_000) == []
    assert position(host) == 20


def test_255_leaves_the_group_and_nothing_is_sent_or_heard_any_more() -> None:
    host = member(0)
    host.send("trsync_set_group oid=8 group=255")
    move(host)
    host.run(10_500)
    for group in range(16):
        host.node.receive_frame(*frame(group, 1))
    host.node.receive_frame(0x020 + 255, b"\xff\x01\x00\x00\x00\x00")
    assert host.run(1000) == []
    host.ask("trsync_trigger oid=8 reason=3")
    assert host.signals == []


def test_each_of_the_sixteen_groups_works_and_others_are_refused() -> None:
    for group in range(16):
        host = member(0, group=group)
        arm(host)
        host.ask("trsync_trigger oid=8 reason=3")
        assert host.signals == [frame(group, 3)]
    for group in (16, 254):
        assert member(0).dies(f"trsync_set_group oid=8 group={group}") == "Not a valid trigger group"
    assert member(0).dies("trsync_set_group oid=9 group=1") == "Invalid oid type"


def test_stop_groups_of_one_node_in_one_group_trigger_together_and_are_told_once() -> None:
    host = member(0)
    host.send(f"trsync_set_group oid=10 group={GROUP}")
    arm(host, oid=10)
    move(host)
    host.run(5_500)
    both = host.send(f"trsync_trigger oid=10 reason={HOST_REASON}")
    assert [(a["oid"], a["trigger_reason"]) for a in both] == [(10, HOST_REASON), (8, HOST_REASON)]
    host.run(5_000)
    assert position(host) == 5
    assert host.signals == [frame(GROUP, HOST_REASON, 5_500)]
    local = Host()  # on a UART the group is the node's own
    local.configure(STEPPER, TRSYNC, "config_trsync oid=10")
    local.send("trsync_set_group oid=8 group=1", "trsync_set_group oid=10 group=1")
    arm(local, oid=10)
    move(local)
    local.run(5_500)
    assert [a["oid"] for a in local.send("trsync_trigger oid=10 reason=3")] == [10, 8]
    local.run(5_000)
    assert position(local) == 5


def test_nothing_is_heard_that_is_not_armed_nor_while_shut_down() -> None:
    host = member(0)
    host.node.receive_frame(*frame(GROUP, 1))
    assert host.run(1000) == []
    move(host)
    host.run(5_500)
    host.send("emergency_stop")
    host.node.receive_frame(*frame(GROUP, 1))
    assert host.run(1000) == []
    host.send("clear_shutdown")
    assert position(host) == 5
    assert host.signals == [], "a shutdown is no trigger"
    SimNode().receive_frame(*frame(GROUP, 1))  # without id and objects


def test_a_trigger_leaves_before_data_and_when_refused_before_all_that_waits() -> None:
    host = member(0)
    arm(host)
    host.pour("get_uptime", 50)
    host.pour("trsync_trigger oid=8 reason=3", 1)
    frames = host.node.take_frames()
    assert frames[0] == frame(GROUP, 3)
    assert len(frames) > 50
    host = member(0)
    arm(host, timeout=1000)
    host.fill()
    host.node.run_until(host.now + 2000)
    frames = host.node.take_frames()
    assert frames.index(frame(GROUP, EXPIRED, 1000)) == 4096
    assert len(frames) > 4100
    assert [can_id for can_id, _ in frames].count(0x020 + GROUP) == 1


def test_a_refused_trigger_is_forgotten_when_the_next_round_begins() -> None:
    host = member(0)
    arm(host, timeout=1000)
    host.fill_board()
    host.node.run_until(host.now + 2000)
    host.pour("trsync_start oid=8 report_clock=0 report_ticks=0 expire_reason=2", 1)
    assert 0x020 + GROUP not in {can_id for can_id, _ in host.node.take_frames()}


def test_older_firmware_triggers_alone() -> None:
    host = member(0, legacy=True)
    move(host)
    host.run(5_500)
    host.node.receive_frame(*frame(GROUP, 1))
    host.run(5_000)
    assert position(host) == 10
    host.ask("trsync_trigger oid=8 reason=3")
    assert host.signals == []


def test_a_host_that_knows_nothing_of_this_sees_nothing_of_it() -> None:
    host = member(0, group=None)
    move(host, timeout=20_000)
    watch_endstop(host)
    host.run(9_000)
    host.node.set_input(20, 1)
    assert [a["trigger_reason"] for a in host.run(30_000)] == [ENDSTOP_REASON]
    host.ask("trsync_trigger oid=8 reason=3")
    host.send("emergency_stop")
    assert host.signals == []
