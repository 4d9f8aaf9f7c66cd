"""A node's life: configuration, time, shutdown, reset; node ids; many nodes in one process."""

import json
import random
import zlib

import numpy as np
import pytest

from nodes.support.errors import CanductorError
from tests import wire_twin
from tests.firmware import twin
from tests.firmware.host import FROM_NODE, NODE_ID, TO_NODE, Host
from tests.stages.sim_node import SimNode, edge_clocks

ROLLOVER = 1 << 32
FREQ = 168_000_000
UUID = bytes.fromhex("0123456789ab")


# ---------------------------------------------------------------------------------------------- configuration


def test_configuration_from_nothing_to_finalized_and_back() -> None:
    host = Host()
    empty = {"is_config": 0, "crc": 0, "is_shutdown": 0, "move_count": 0}
    assert host.ask("get_config").args == empty
    host.configure("config_digital_out oid=0 pin=5 value=1 default_value=0 max_duration=0")
    assert host.ask("get_config").args == {"is_config": 1, "crc": 1234, "is_shutdown": 0, "move_count": 1024}
    assert host.node.level(5) == 1
    assert host.send("config_reset") == []
    assert host.ask("get_config").args == empty
    assert host.node.level(5) == 0, "a reset drives the defaults"
    host.configure("config_trsync oid=0", oids=255)


def test_a_crc_is_kept_in_all_its_32_bits() -> None:
    host = Host()
    host.send("allocate_oids count=0", "finalize_config crc=4294967295")
    assert host.ask("get_config")["crc"] == 0xFFFFFFFF


@pytest.mark.parametrize(
    ("commands", "text"),
    [
        (["finalize_config crc=1"], "Already finalized"),
        (["allocate_oids count=1", "finalize_config crc=1", "finalize_config crc=1"], "Already finalized"),
        (["allocate_oids count=1", "finalize_config crc=1", "config_trsync oid=0"], "Can't assign oid"),
        (["allocate_oids count=1", "config_trsync oid=0", "config_trsync oid=0"], "Can't assign oid"),
        (["allocate_oids count=1", "allocate_oids count=1"], "oids already allocated"),
    ],
)
def test_configuration_out_of_order(commands: list[str], text: str) -> None:
    assert Host().dies(*commands) == text


def test_the_arena_is_bounded_and_its_end_is_a_shutdown() -> None:
    host = Host()
    host.send("allocate_oids count=255")
    for oid in range(255):
        host.send(f"config_analog_in oid={oid} pin=1")
    assert host.dies("finalize_config crc=1") == "alloc_chunk failed"
    host.send("config_reset")
    host.configure("config_trsync oid=0")


# ------------------------------------------------------------------------------------------------------- time


def test_clock_and_uptime_over_the_rollover() -> None:
    host = Host(start_clock=3 * ROLLOVER - 1000)
    assert host.ask("get_uptime").args == {"high": 2, "clock": ROLLOVER - 1000}
    host.run(1500)
    assert host.ask("get_clock").args == {"clock": 500}
    assert host.ask("get_uptime").args == {"high": 3, "clock": 500}
    for round_ in range(4, 12):
        host.run(ROLLOVER)
        assert host.ask("get_uptime").args == {"high": round_, "clock": 500}


def test_statistics_come_every_five_seconds() -> None:
    host = Host()
    host.node.run_until(50 * FREQ + 1)
    host.receive()
    stats = [a for a in host.unasked if a.name == "stats"]
    assert len(stats) == 10
    assert all(a["count"] >= 1 and a["sum"] == 0 for a in stats)
    assert len({a["count"] for a in stats[1:]}) == 1, "each is of its own five seconds"
    assert host.node.next_deadline() == 55 * FREQ


def test_the_first_word_on_a_uart_is_starting() -> None:
    host = Host()
    ((seq, content),) = twin.blocks(host.first_words)
    assert host.words.decode(seq, content).name == "starting"


# --------------------------------------------------------------------------------------------------- shutdown


def test_shut_down_it_answers_and_refuses_and_can_be_cleared() -> None:
    host = Host(start_clock=ROLLOVER - 100)
    host.configure("config_trsync oid=0")
    host.run(200)
    (report,) = host.send("emergency_stop")
    assert (report.name, report["clock"], host.text(report)) == ("shutdown", 100, "Command request")
    (refusal,) = host.send("trsync_trigger oid=0 reason=1")
    assert (refusal.name, host.text(refusal)) == ("is_shutdown", "Command request")
    assert host.send("emergency_stop") == [], "the first reason stays, and is told once"
    for allowed in ("get_clock", "get_uptime", "get_config", "debug_ping data=00", "get_canbus_id"):
        assert host.ask(allowed).name != "is_shutdown"
    assert host.send("clear_shutdown") == []
    assert host.ask("get_config").args == {"is_config": 1, "crc": 1234, "is_shutdown": 0, "move_count": 1024}
    assert host.ask("trsync_trigger oid=0 reason=1").name == "trsync_state"
    assert host.dies("clear_shutdown") == "Shutdown cleared when not shutdown"


def test_reset_restarts_the_node() -> None:
    host = Host()
    host.configure("config_digital_out oid=0 pin=5 value=1 default_value=1 max_duration=0")
    host.write(wire_twin.block(host.seq, host.words.encode("reset")))
    names = [host.words.decode(s, c).name for s, c in twin.blocks(host.read()) if c]
    assert names == ["starting"]
    assert host.node.level(5) == 0
    host.seq = 0
    assert host.ask("get_config")["is_config"] == 0


def test_reset_on_can_drops_the_id() -> None:
    host = Host(transport="can")
    assert host.node.node_id == NODE_ID
    host.write(wire_twin.block(host.seq, host.words.encode("reset")))
    assert host.node.node_id == 0
    host.node.take_frames()
    host.node.receive_frame(TO_NODE, wire_twin.block(0, b"")[:8])
    assert host.node.take_frames() == []


# --------------------------------------------------------------------------------------------------- node ids


def fresh(uuid: str = "0123456789ab") -> SimNode:
    return SimNode(uuid, transport="can")


@pytest.mark.parametrize(
    "frame",
    [
        b"",
        b"\x01",
        b"\x01" + UUID,
        b"\x02" + UUID,
        b"\x11" + UUID + b"\x05",
        b"\xff" * 8,
        b"\x01" + UUID[::-1] + b"\x05",
    ],
)
def test_other_admin_frames_are_ignored(frame: bytes) -> None:
    node = fresh()
    node.receive_frame(0x3F0, frame)
    assert (node.node_id, node.take_frames()) == (0, [])


def can_dies(host: Host) -> None:
    assert host.node.node_id == 0
    assert host.node.take_frames() == [], "it has no voice any more"
    host.assign()
    state = host.ask("get_config")
    assert state["is_shutdown"] == 1
    (refusal,) = host.send("allocate_oids count=1")
    assert host.text(refusal) == "Another CAN node assigned this ID"


def test_its_id_given_to_another_uuid_is_a_conflict() -> None:
    host = Host(transport="can")
    host.node.receive_frame(0x3F0, b"\x01" + b"\xaa" * 6 + bytes([NODE_ID + 1]))
    assert host.ask("get_config")["is_shutdown"] == 0
    host.node.receive_frame(0x3F0, b"\x01" + b"\xaa" * 6 + bytes([NODE_ID]))
    can_dies(host)


def test_data_on_its_own_transmit_id_is_a_conflict() -> None:
    host = Host(transport="can")
    host.node.receive_frame(FROM_NODE, b"\x7e")
    can_dies(host)


def test_the_same_id_again_changes_nothing_and_other_ids_are_not_heard() -> None:
    host = Host(transport="can")
    host.assign()
    block = wire_twin.block(host.seq, host.words.encode("get_config"))
    for can_id in (TO_NODE + 2, TO_NODE - 2, 0x000, 0x00F, 0x011, 0x030, 0x0FF, 0x7FF):
        for at in range(0, len(block), 8):
            host.node.receive_frame(can_id, block[at : at + 8])
    assert host.node.take_frames() == []
    assert host.ask("get_canbus_id").args == {"canbus_uuid": UUID, "canbus_nodeid": NODE_ID}
    assert host.ask("get_canbus_status")["canbus_bus_state"] == 0


def test_frames_may_cut_blocks_anywhere() -> None:
    rng = random.Random(7)
    host = Host(transport="can")
    stream = b""
    for _ in range(30):
        stream += wire_twin.block(
            host.seq, host.words.encode("debug_ping data=" + rng.randbytes(rng.randrange(30)).hex())
        )
        host.seq = (host.seq + 1) & 15
    answers = 0
    while stream:
        size = rng.randrange(1, 9)
        host.node.receive_frame(TO_NODE, stream[:size])
        stream = stream[size:]
        answers += len([a for _, a in host.receive() if a])
    assert answers == 30


# ------------------------------------------------------------------------------------------------- many nodes


def test_fifty_nodes_in_one_process_do_not_know_of_each_other() -> None:
    hosts = [Host(start_clock=k * 97_000_000) for k in range(50)]
    firsts = []
    for k, host in enumerate(hosts):
        host.configure("config_stepper oid=0 step_pin=3 dir_pin=4 invert_step=255 step_pulse_ticks=0")
        firsts.append(host.now + 1000)
        host.send(f"reset_step_clock oid=0 clock={firsts[-1] % ROLLOVER}")
        host.send(f"queue_step oid=0 interval={1000 + k} count={100 + k} add={k}")
    hosts[13].send("emergency_stop")
    for _ in range(200):
        for host in hosts:
            host.run(10_000)
    for k, host in enumerate(hosts):
        if k == 13:
            assert len(host.steps(3)) == 0
            continue
        steps = host.steps(3)
        j = np.arange(100 + k, dtype=np.uint64)
        wanted = firsts[k] + (j + 1) * (1000 + k) + k * (j * (j + 1) // 2)
        assert np.array_equal(steps, wanted.astype(np.uint64))
        assert host.ask("get_config")["is_shutdown"] == 0


def test_a_node_can_be_made_with_another_clock_queue_and_dictionary() -> None:
    host = Host(clock_freq=64_000_000, move_count=7)
    assert host.node.clock_freq == 64_000_000
    host.configure("config_trsync oid=0")
    assert host.ask("get_config")["move_count"] == 7
    host.node.run_until(5 * 64_000_000)
    host.receive()
    assert [a.name for a in host.unasked] == ["stats"], "five seconds of the other clock"
    words = host.words.raw | {"version": "another", "config": host.words.raw["config"] | {"MCU": "other"}}
    blob = zlib.compress(json.dumps(words).encode())
    other = Host(dictionary=blob)
    assert (other.blob, other.words.raw["config"]["MCU"]) == (blob, "other")
    for one in (host, other):
        one.node.reset()
        one.seq = 0
        one.receive()
    assert host.node.clock_freq == 64_000_000, "a restart changes none of it"
    for offset in (len(blob) - 1, len(blob), len(blob) + 1):
        assert other.ask(f"identify offset={offset} count=40").args["data"] == blob[offset:]


def test_bad_arguments_are_told() -> None:
    for arguments in (("xyz", 0), ("0123456789a", 0), ("0123456789ab", -1), ("0123456789ab", 1 << 47)):
        with pytest.raises(CanductorError):
            SimNode(*arguments)
    for clock_freq, move_count in ((0, 1), (-1, 1), (429_496_730, 1), (1, 0), (1, 65536)):
        with pytest.raises(CanductorError):
            SimNode(clock_freq=clock_freq, move_count=move_count)
    node = SimNode()
    with pytest.raises(CanductorError):
        node.set_input(144, 1)
    with pytest.raises(CanductorError):
        node.set_adc(0, 4096)
    with pytest.raises(CanductorError):
        node.receive_frame(0x3F0, bytes(9))
    assert len(edge_clocks(node.edges(), 3)) == 0
