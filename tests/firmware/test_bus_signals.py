"""Signals from node to node: emergency stop of the bus, and the pulse that latches all clocks."""

import struct

import pytest

from tests.firmware.host import NODE_ID, Host, NodeOptions
from tests.firmware.wire import Wire

ROLLOVER = 1 << 32
STOP, ADMIN = 0x010, 0x3F0
STEPPER = "config_stepper oid=0 step_pin=3 dir_pin=4 invert_step=255 step_pulse_ticks=0"
HEATER = "config_digital_out oid=1 pin=5 value=1 default_value=0 max_duration=0"
LATENCY = 20_000


def member(number: int = 0, *, start_clock: int = 0, enable: int = 1, legacy: bool = False) -> Host:
    """Make a configured node on CAN."""
    options: NodeOptions = {"legacy": legacy}
    host = Host(
        transport="can",
        uuid=f"00000000000{number}",
        node_id=NODE_ID + number,
        start_clock=start_clock,
        **options,
    )
    host.configure(STEPPER, HEATER)
    if enable:
        assert host.send(f"set_bus_stop enable={enable}") == []
    return host


def stop_text(host: Host) -> str:
    """Return why HOST's node shut down, from the report it gave of its own accord."""
    (report,) = [answer for answer in host.unasked if answer.name == "shutdown"]
    host.unasked.clear()
    return host.text(report)


# --------------------------------------------------------------------------------------------------- the stop


@pytest.mark.parametrize("data", [b"\x00\x00", b"\x17\x09", b"", b"\xff" * 8])
def test_a_stop_from_the_bus_shuts_down_at_once_and_is_not_passed_on(data: bytes) -> None:
    host = member(start_clock=ROLLOVER - 5_000)
    first = host.now + 1_000
    host.send(
        f"reset_step_clock oid=0 clock={first % ROLLOVER}", "queue_step oid=0 interval=1000 count=99 add=0"
    )
    host.run(9_500)
    assert host.node.level(5) == 1
    host.node.receive_frame(STOP, data)
    assert host.node.level(5) == 0, "outputs went to their defaults"
    host.receive()
    (report,) = host.unasked
    assert (report.name, report["clock"]) == ("shutdown", host.now % ROLLOVER)
    assert stop_text(host) == "Bus-wide emergency stop"
    host.run(1_000_000)
    assert len(host.steps(3)) == 8
    host.node.receive_frame(STOP, data)
    assert host.run(1_000_000) == [], "once is enough"
    host.send("clear_shutdown")
    assert host.ask("stepper_get_position oid=0")["pos"] == -8
    assert host.signals == []


def test_a_node_without_id_stops_too() -> None:
    host = member()
    host.node.reset()
    host.seq = 0
    host.node.receive_frame(STOP, b"\x01\x00")
    host.assign()
    assert host.ask("get_config")["is_shutdown"] == 1
    (refusal,) = host.send("allocate_oids count=1")
    assert host.text(refusal) == "Bus-wide emergency stop"
    host.send("config_reset")
    host.configure(STEPPER)


def trip(host: Host) -> str:
    """Let the node shut down by itself."""
    host.send("queue_step oid=0 interval=1 count=0 add=0")
    return "Invalid count parameter"


def test_a_node_that_shuts_down_by_itself_stops_the_others_where_the_host_wants_that() -> None:
    hosts = [
        member(0, start_clock=ROLLOVER - LATENCY // 2),
        member(1),
        member(2, enable=0),
        member(3, legacy=True),
    ]
    wire = Wire(hosts, LATENCY)
    begin = hosts[0].now
    for host in hosts[1:3]:
        clock = (host.now + 1_000) % ROLLOVER
        host.send(f"reset_step_clock oid=0 clock={clock}", "queue_step oid=0 interval=1000 count=999 add=0")
    (report,) = hosts[0].send("queue_step oid=0 interval=1 count=0 add=0")
    wire.run(10 * LATENCY)
    (signal,) = wire.heard
    assert (signal.at, signal.sender, signal.can_id) == (0, 0, STOP)
    assert signal.data == struct.pack("<BBI", report["static_string_id"], NODE_ID, report["clock"])
    assert hosts[0].text(report) == "Invalid count parameter"
    assert hosts[0].ask("get_clock")["clock"] == (begin + 10 * LATENCY) % ROLLOVER
    for host in hosts[1:3]:
        assert stop_text(host) == "Bus-wide emergency stop"
        assert len(host.steps(3)) == LATENCY // 1000 - 1
    assert hosts[3].ask("get_config")["is_shutdown"] == 0


def test_it_says_nothing_unless_told_to_nor_after_a_configuration_is_gone() -> None:
    for wish in ([], ["set_bus_stop enable=1", "set_bus_stop enable=0"]):
        host = member(enable=0)
        host.send(*wish)
        assert host.dies("queue_step oid=0 interval=1 count=0 add=0") == "Invalid count parameter"
        assert host.signals == []
    host = member()
    host.send("config_reset")  # runs the shutdown's hooks without being one
    host.configure(STEPPER)
    trip(host)
    assert host.signals == []
    host = member()
    host.restart()
    host.assign()
    host.configure(STEPPER)
    trip(host)
    assert host.signals == []


def test_the_hosts_own_stop_of_one_node_is_for_that_node() -> None:
    host = member()
    assert host.dies("emergency_stop") == "Command request"
    assert host.signals == []
    host.send("clear_shutdown")
    trip(host)
    assert [can_id for can_id, _ in host.signals] == [STOP]
    trip(host)
    host.send("clear_shutdown")
    assert len(host.signals) == 1, "once for each shutdown"
    trip(host)
    assert len(host.signals) == 2


def test_a_node_that_loses_its_id_stops_the_bus_under_that_id() -> None:
    host = member(1)
    host.node.receive_frame(ADMIN, b"\x01" + b"\xaa" * 6 + bytes([NODE_ID + 1]))
    assert host.node.node_id == 0
    ((can_id, data),) = host.node.take_frames()
    assert (can_id, data[1]) == (STOP, NODE_ID + 1)


def test_older_firmware_neither_hears_nor_sends_a_stop() -> None:
    host = member(legacy=True)
    host.node.receive_frame(STOP, b"\x01\x00")
    assert host.ask("get_config")["is_shutdown"] == 0
    trip(host)
    assert host.signals == []


def test_a_stop_leaves_before_data_that_waits() -> None:
    host = member()
    host.pour("get_uptime", 50)
    host.pour("finalize_config crc=1", 1)
    frames = host.node.take_frames()
    assert [can_id for can_id, _ in frames[:2]] == [STOP, host.node_id * 2 + 0x101]
    assert len(frames) > 50


def test_a_stop_which_the_board_refuses_is_the_next_frame_to_leave() -> None:
    host = member()
    host.send(f"reset_step_clock oid=0 clock={host.now + 1000}")
    host.send("queue_step oid=0 interval=100 count=5 add=-60")  # runs backwards
    host.fill()
    host.node.run_until(host.now + 2000)
    frames = host.node.take_frames()
    refused = [can_id for can_id, _ in frames].index(STOP)
    assert refused == 4096, "behind all the board had taken, before what the node still held"
    assert len(frames) > refused + 1
    assert {can_id for can_id, _ in frames} == {STOP, host.node_id * 2 + 0x101}
    assert [can_id for can_id, _ in frames].count(STOP) == 1


def test_a_stop_which_the_board_refuses_is_forgotten_when_the_shutdown_is_cleared() -> None:
    host = member()
    host.send(f"reset_step_clock oid=0 clock={host.now + 1000}")
    host.send("queue_step oid=0 interval=100 count=5 add=-60")
    host.fill_board()
    host.node.run_until(host.now + 2000)
    host.pour("clear_shutdown", 1)
    assert STOP not in [can_id for can_id, _ in host.node.take_frames()]
    host = member()
    host.fill_board()
    host.pour("finalize_config crc=1", 1)
    assert [can_id for can_id, _ in host.node.take_frames()].count(STOP) == 1


# -------------------------------------------------------------------------------------------------- the pulse


def pulse(host: Host, seq: int) -> int:
    host.node.receive_frame(ADMIN, bytes([0x40, seq]))
    return host.now % ROLLOVER


def latched(host: Host) -> tuple[int, int]:
    answer = host.ask("get_sync_pulse")
    return answer["seq"], answer["clock"]


def test_a_pulse_latches_the_clock_over_the_rollover_until_the_next_one() -> None:
    host = member(start_clock=ROLLOVER - 50_000)
    assert latched(host) == (0, 0), "there was none yet"
    for seq in (*range(1, 256), 1, 2):
        clock = pulse(host, seq)
        host.run(777)
        assert latched(host) == (seq, clock)
        assert latched(host) == (seq, clock)
    assert host.now > ROLLOVER
    clock = pulse(host, 7)
    host.run(100)
    assert pulse(host, 7) == clock + 100
    assert latched(host) == (7, clock + 100), "the last of two counts: it is the one that all nodes heard"


def test_what_is_no_pulse_latches_nothing() -> None:
    host = member()
    pulse(host, 9)
    before = latched(host)
    host.run(100)
    for data in (b"\x40", b"\x40\x00", b"\x42\x05"):
        host.node.receive_frame(ADMIN, data)
    assert latched(host) == before
    host.restart()
    host.assign()
    assert latched(host) == (0, 0)


def test_pulses_are_latched_by_nodes_that_are_shut_down_or_have_no_id_yet() -> None:
    host = member()
    host.send("emergency_stop")
    host.run(100)
    assert latched_after(host, 3)
    host.node.reset()
    host.seq = 0
    clock = pulse(host, 5)
    host.run(50)
    host.assign()
    host.receive()
    assert latched(host) == (5, clock)


def latched_after(host: Host, seq: int) -> bool:
    clock = pulse(host, seq)
    host.run(100)
    return latched(host) == (seq, clock)


def test_one_pulse_latches_all_nodes_at_one_time() -> None:
    hosts = [member(number, start_clock=number * (ROLLOVER - 1000)) for number in range(4)]
    origins = [host.now for host in hosts]
    for host in hosts:
        host.run(123_456)
    for host in hosts:
        pulse(host, 77)
    assert [latched(host) for host in hosts] == [(77, (origin + 123_456) % ROLLOVER) for origin in origins]


def test_older_firmware_and_a_uart_know_no_pulse() -> None:
    host = member(legacy=True)
    pulse(host, 9)
    assert latched(host) == (0, 0)
    assert latched(Host()) == (0, 0)


# ----------------------------------------------------------------------------------------------- how it looks


def test_the_dictionary_announces_each_extension() -> None:
    config: dict[str, object] = dict(Host().words.raw["config"])
    announced = {"CAN_BUS_STOP": 1, "CAN_SYNC_PULSE": 1, "CAN_TRIGGER_GROUPS": 16, "CAN_WHO_IS_HERE": 1}
    assert announced.items() <= config.items()
