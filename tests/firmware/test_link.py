"""The node's end of the link: dictionary, sequence numbers, damage, back-pressure."""

import json
import random
import zlib

import pytest

from tests import real_dictionaries, wire_twin
from tests.firmware import twin
from tests.firmware.host import Host
from tests.stages.sim_node import SimNode

CODES = {"%u", "%i", "%hu", "%hi", "%c", "%s", "%*s", "%.*s"}


def bare(text: str) -> bytes:
    return twin.Vocabulary().encode(text)


@pytest.mark.parametrize("transport", ["can", "uart"])
def test_dictionary_downloads_and_is_sound(transport: str) -> None:
    host = Host(transport="can" if transport == "can" else "uart")
    words = host.words.raw
    assert json.loads(zlib.decompress(host.blob)) == words
    ids = [*words["commands"].values(), *words["responses"].values()]
    assert len(ids) == len(set(ids))
    assert all(-32 <= value <= 95 for value in ids), "all of them fit into one byte"
    for fmt in [*words["commands"], *words["responses"]]:
        for parameter in fmt.split()[1:]:
            assert parameter.partition("=")[2] in CODES, fmt
    assert words["commands"]["identify offset=%u count=%c"] == 1
    assert words["responses"]["identify_response offset=%u data=%.*s"] == 0
    assert words["app"] == "canductor"
    constants = {
        "CLOCK_FREQ": 168000000,
        "MCU": "virtual-mainboard",
        "STATS_SUMSQ_BASE": 256,
        "RECEIVE_WINDOW": 192,
        "ADC_MAX": 4095,
        "STEPPER_BOTH_EDGE": 1,
        "STEPPER_STEP_BOTH_EDGE": 1,
        "CANBUS_FREQUENCY": 1000000,
    }
    config: dict[str, object] = dict(words["config"])
    assert constants.items() <= config.items()
    assert words["enumerations"]["pin"]["PB0"] == [16, 16]


@pytest.mark.skipif(not real_dictionaries.PATHS, reason=real_dictionaries.MISSING)
def test_formats_are_those_of_real_boards() -> None:
    ours = Host().words.raw
    compared = set()
    for path in real_dictionaries.PATHS:
        real = json.loads(path.read_text())
        for kind in ("commands", "responses"):
            theirs = {fmt.split()[0]: fmt for fmt in real[kind]}
            for fmt in ours[kind]:
                name = fmt.split()[0]
                if name in theirs:
                    assert fmt == theirs[name], path.name
                    compared.add(name)
    assert len(compared) > 45


def test_a_block_is_acknowledged_with_the_next_number_and_so_is_every_answer() -> None:
    host = Host()
    for _ in range(40):
        host.write(wire_twin.block(host.seq, host.words.encode("get_clock")))
        host.seq = (host.seq + 1) & 15
        answer, ack = twin.blocks(host.read())
        assert (answer[0], ack) == (host.seq, (host.seq, b""))


def test_duplicates_and_blocks_out_of_order_are_refused_with_the_expected_number() -> None:
    host = Host()
    nop = host.words.encode("debug_ping data=01")
    for wrong in (1, 2, 7, 8, 15):
        host.write(wire_twin.block(host.seq + wrong, nop))
        assert list(twin.blocks(host.read())) == [(host.seq, b"")]
    assert host.node.counters()["rx_out_of_order"] == 5
    assert host.ask("debug_ping data=0203").args == {"data": b"\x02\x03"}


def pings(host: Host) -> tuple[bytes, bytes]:
    host.configure()
    return host.words.encode("debug_ping data=01"), host.words.encode("debug_ping data=02")


def said(host: Host) -> list[str]:
    host.receive()
    return [host.text(a) if a.name == "shutdown" else a.name for a in host.unasked]


def test_a_repeat_with_other_content_shows_a_second_host() -> None:
    host = Host()
    other, own = pings(host)
    for content in (other, other, b""):
        host.write(wire_twin.block(host.seq, content))
    assert said(host) == ["pong"]
    host.write(wire_twin.block(host.seq, own))
    assert said(host) == ["pong", "Another host sends to this node"]


def test_who_begins_or_is_ahead_is_no_second_host() -> None:
    host = Host()
    first, second = pings(host)
    host.write(wire_twin.block(host.seq, first))
    for ahead in range(2, 16):
        host.write(wire_twin.block(host.seq + ahead, second))
    host.node.run_until(host.now + host.node.clock_freq // 10)
    host.write(wire_twin.block(host.seq, second))
    assert said(host) == ["pong"]


def test_a_node_that_is_not_configured_has_nothing_to_lose() -> None:
    host = Host()
    for data in ("01", "02"):
        host.write(wire_twin.block(host.seq, host.words.encode(f"debug_ping data={data}")))
    assert said(host) == ["pong"]


def test_every_single_damaged_byte_costs_one_nak_and_nothing_else() -> None:
    host = Host()
    good = wire_twin.block(host.seq, host.words.encode("debug_ping data=0102030405"))
    for place in range(len(good)):
        for flip in (1, 0x80, 0x7E):
            bad = bytearray(good)
            bad[place] ^= flip
            if bad[place] == 0x7E:
                continue  # a sync byte cuts the block in two: legal to be nakked once for each part
            fresh = Host()
            # The sync byte ends whatever the damage makes the node wait for.
            fresh.write(bytes(bad) + b"\x7e" * 64)
            answers = list(twin.blocks(fresh.read()))
            assert answers == [(fresh.seq, b"")], (place, flip)
            assert fresh.ask("debug_ping data=01").name == "pong"


def test_a_stretch_of_garbage_is_nakked_once() -> None:
    host = Host()
    host.write(bytes([0xFF] * 100))
    assert list(twin.blocks(host.read())) == [(host.seq, b"")]
    host.write(bytes([0xAA] * 50))  # still the same loss: no sync byte came
    assert host.read() == b""
    host.write(b"\x7e")
    assert host.send("get_config")[0].name == "config"
    assert host.node.counters()["rx_lost"] == 1


def test_sync_bytes_before_a_block_are_ignored() -> None:
    host = Host()
    host.write(b"\x7e" * 5 + wire_twin.block(host.seq, host.words.encode("get_config")) + b"\x7e")
    assert len(list(twin.blocks(host.read()))) == 2


def test_what_exceeds_the_window_is_lost_and_can_be_repeated() -> None:
    host = Host()
    blocks = [
        wire_twin.block(host.seq + k, host.words.encode("debug_ping data=" + "ab" * 40)) for k in range(5)
    ]
    host.write(b"".join(blocks))  # 5 * 47 = 235 bytes at once; 192 fit: four whole blocks
    seqs = [seq for seq, content in twin.blocks(host.read()) if not content]
    assert seqs == [(host.seq + k + 1) & 15 for k in range(4)]
    assert host.node.counters()["rx_overflow_bytes"] == 235 - 192
    host.write(b"\x7e" + blocks[4])
    last = list(twin.blocks(host.read()))
    assert (host.seq + 5) & 15 in {seq for seq, _ in last}


def test_a_flood_of_answers_waits_for_the_wire_and_loses_none() -> None:
    host = Host()
    content = host.words.encode("get_uptime") * 59
    assert len(content) == 59
    before = host.node.counters()["rx_blocks"]
    sent = 0
    # Nothing is taken: the outbound room fills up, then the node stops executing, then its window overflows.
    while host.node.counters()["rx_overflow_bytes"] == 0:
        host.write(wire_twin.block(host.seq + sent, content))
        sent += 1
        assert sent < 1000
    stalled = host.node.counters()["rx_blocks"]
    answers = [content for _, content in twin.blocks(host.node.take_bytes()) if content]
    accepted = host.node.counters()["rx_blocks"]
    assert accepted > stalled, "it went on once there was room"
    assert len(answers) == 59 * (accepted - before)
    assert host.node.counters()["tx_dropped"] == 0


def test_unknown_and_unreadable_commands_shut_down() -> None:
    for content, text in (
        (b"\x5f", "Invalid command"),
        (b"\x81\x00", "Invalid command"),
        (b"\x60", "Invalid command"),
    ):
        host = Host()
        host.write(wire_twin.block(host.seq, content))
        host.seq = (host.seq + 1) & 15
        host.receive()
        (report,) = host.unasked
        assert host.text(report) == text
    host = Host()
    host.write(wire_twin.block(host.seq, host.words.encode("identify offset=1000 count=4")[:-1]))
    host.seq = (host.seq + 1) & 15
    host.receive()
    assert host.text(host.unasked[0]) == "Command parser error"


def test_identify_behind_the_end_and_with_any_count() -> None:
    host = Host()
    size = len(host.blob)
    for offset in (0, 1, size - 1, size, size + 1, 0xFFFFFFFF):
        for count in (0, 1, 40, 52, 53, 255):
            answer = host.ask(f"identify offset={offset} count={count}")
            assert answer["offset"] == offset
            assert answer.args["data"] == host.blob[offset : offset + min(count, 52)]


def test_random_bytes_never_upset_the_node() -> None:
    rng = random.Random(4711)
    node = SimNode(transport="uart")
    node.take_bytes()
    for _ in range(2000):
        junk = rng.randbytes(rng.randrange(1, 80))
        node.receive_bytes(junk)
        assert all(content == b"" for _, content in twin.blocks(node.take_bytes()))
    node.receive_bytes(b"\x7e" * 64 + wire_twin.block(0, bare("identify offset=0 count=9")))
    assert any(content for _, content in twin.blocks(node.take_bytes()))
