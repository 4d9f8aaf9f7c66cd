"""Tables on a node: downloaded over CAN, through the link or a polled register; kept and activated."""

from collections.abc import Iterable, Sequence

import pytest

from nodes.mt.mt import Pair, checksum, to_bytes, to_frames, transmission
from nodes.mt.pace import PacedWords
from nodes.support.can_protocol import MT_CAN_ID
from tests.firmware.host import Host

TABLE: tuple[Pair, ...] = ((-50_000, 12), (0, -7), (0, -7), (50_001, 0))
OTHER: tuple[Pair, ...] = ((1, 2), (3, 4))
OK, TRANSMITTING, CHECKSUM_ERROR, LENGTH_ERROR = range(4)
NEVER, WAITING, DONE, LATE, MOVING, REPLACED = range(6)
ROOM = 8
CONFIG = (
    "config_stepper oid=0 step_pin=1 dir_pin=2 invert_step=-1 step_pulse_ticks=0",
    f"config_table oid=1 axle=1 capacity={ROOM} stepper_oid=0",
    f"config_table oid=2 axle=2 capacity={ROOM} stepper_oid=255",
    "config_table_register oid=3",
)


@pytest.fixture(params=["can", "uart"])
def host(request: pytest.FixtureRequest) -> Host:
    host = Host(transport=request.param)
    host.configure(*CONFIG)
    return host


@pytest.fixture
def can_host() -> Host:
    host = Host(transport="can")
    host.configure(*CONFIG)
    return host


def download(host: Host, table: Sequence[Pair], axles: Iterable[int], *, lost: Iterable[int] = ()) -> None:
    """Send TABLE by the way the transport has, without the pieces LOST."""
    words = transmission(table, axles)
    if host.transport == "can":
        for number, frame in enumerate(to_frames(words)):
            if number not in lost:
                host.node.receive_frame(MT_CAN_ID, frame)
        return
    for at in range(0, len(words), 10):
        if at // 10 not in lost:
            assert host.send(f"table_bytes data={to_bytes(words[at : at + 10]).hex()}") == []


def state(host: Host, oid: int = 1) -> tuple[int, int, int, int]:
    """Return status, generation, length and checksum."""
    answer = host.ask(f"table_query oid={oid}")
    return answer["table_status"], answer["generation"], answer["length"], answer["checksum"]


def kept(host: Host, oid: int = 1) -> tuple[Pair, ...]:
    """Return the table that OID keeps."""
    pairs = [host.ask(f"table_read oid={oid} index={i}") for i in range(state(host, oid)[2])]
    return tuple((pair["x"], pair["y"]) for pair in pairs)


def active(host: Host, oid: int = 1) -> tuple[int, int, int, int]:
    answer = host.ask(f"table_query_active oid={oid}")
    return answer["table_activation"], answer["generation"], answer["length"], answer["clock"]


def test_the_dictionary_announces_it() -> None:
    raw = Host().words.raw
    assert raw["config"]["MT_AXLES"] == 28
    assert raw["enumerations"]["table_status"]["length_error"] == LENGTH_ERROR


def test_a_table_reaches_the_axles_of_its_mask(host: Host) -> None:
    assert state(host) == (OK, 0, 0, 0)
    download(host, TABLE, [1])
    assert (state(host), kept(host)) == ((OK, 1, len(TABLE), checksum(TABLE)), TABLE)
    assert state(host, 2) == (OK, 0, 0, 0)
    download(host, OTHER, [1, 2])
    assert (kept(host, 1), kept(host, 2)) == (OTHER, OTHER)
    assert (state(host)[1], state(host, 2)[1]) == (2, 1)


def test_every_lost_piece_shows_and_the_table_stays(host: Host) -> None:
    download(host, OTHER, [1])
    pieces = len(to_frames(transmission(TABLE, [1]))) if host.transport == "can" else 2
    for lost in range(pieces):
        before = state(host)[1]
        download(host, TABLE, [1], lost=[lost])
        if state(host)[1] == before:
            assert kept(host) == OTHER, lost
        else:  # the piece was none that counts
            assert (state(host)[:2], kept(host)) == ((OK, before + 1), TABLE), lost
            download(host, OTHER, [1])
    download(host, TABLE, [1])
    assert kept(host) == TABLE


def test_firmware_without_the_extensions_hears_no_tables() -> None:
    legacy = Host(transport="can", legacy=True)
    legacy.configure(*CONFIG)
    download(legacy, TABLE, [1])
    assert state(legacy) == (OK, 0, 0, 0)


@pytest.mark.parametrize("size", [0, 1, 3, 5, 7])
def test_frames_that_are_no_words_are_dropped(can_host: Host, size: int) -> None:
    frames = to_frames(transmission(TABLE, [1]))
    for frame in frames[:3]:
        can_host.node.receive_frame(MT_CAN_ID, frame)
    can_host.node.receive_frame(MT_CAN_ID, bytes(size))
    for frame in frames[3:]:
        can_host.node.receive_frame(MT_CAN_ID, frame)
    assert kept(can_host) == TABLE


def test_more_than_its_capacity(host: Host) -> None:
    download(host, [(i, i) for i in range(ROOM + 1)], [1])
    assert state(host) == (LENGTH_ERROR, 0, 0, 0)
    full = tuple((i, -i) for i in range(ROOM))
    download(host, full, [1])
    assert kept(host) == full


def test_a_pause_within_a_word_begins_a_new_word() -> None:
    host = Host(transport="uart")
    host.configure(*CONFIG)
    host.send("table_bytes data=0000")
    host.run(host.node.clock_freq // 10 + 1)
    download(host, TABLE, [1])
    assert kept(host) == TABLE


# ---------------------------------------------------------------------------------------------- activation


def test_behind_the_end_of_a_table_there_are_zeros(host: Host) -> None:
    for table in ((*TABLE, (7, 7)), TABLE, (*TABLE, (7, 7)), TABLE):
        download(host, table, [1])
    answer = host.ask(f"table_read oid=1 index={len(TABLE)}")
    assert (answer["x"], answer["y"]) == (0, 0)


def test_an_activation_happens_at_its_very_clock(host: Host) -> None:
    download(host, TABLE, [1])
    assert active(host) == (NEVER, 0, 0, 0)
    clock = host.now + 10_000
    host.send(f"table_activate oid=1 clock={clock} generation=1")
    host.run(9_999)
    assert active(host) == (WAITING, 0, 0, 0)
    host.run(1)
    assert active(host) == (DONE, 1, len(TABLE), clock)


def test_activation_over_the_rollover_of_the_clock() -> None:
    host = Host(start_clock=(1 << 32) - 5_000)
    host.configure(*CONFIG)
    download(host, TABLE, [1])
    clock = (host.now + 20_000) & 0xFFFFFFFF
    assert clock < 20_000
    host.send(f"table_activate oid=1 clock={clock} generation=1")
    host.run(20_000)
    assert active(host) == (DONE, 1, len(TABLE), clock)


def test_downloads_leave_the_active_table_alone(host: Host) -> None:
    """Kept, active and what is being received are three: none is written over for another."""
    for number in range(1, 7):
        table = tuple((i, number) for i in range(number))
        download(host, table, [1])
        assert kept(host) == table
        if number % 2:
            clock = host.now + 1000
            host.send(f"table_activate oid=1 clock={clock} generation={number}")
            host.run(1000)
            assert active(host) == (DONE, number, number, clock)
        download(host, [(9, 9)] * (ROOM + 1), [1])
        assert state(host)[0] == LENGTH_ERROR
        assert kept(host) == table
        assert active(host)[1:3] == (number - (number + 1) % 2,) * 2


def test_an_activation_is_refused_while_the_stepper_moves(host: Host) -> None:
    download(host, TABLE, [1, 2])
    start = host.now + 5_000
    host.send(f"reset_step_clock oid=0 clock={start}", "queue_step oid=0 interval=1000 count=100 add=0")
    for oid in (1, 2):
        host.send(f"table_activate oid={oid} clock={start + 50_000} generation=1")
    host.run(60_000)
    assert active(host)[:2] == (MOVING, 0)
    assert active(host, 2)[:2] == (DONE, 1), "it has no stepper"
    host.run(60_000)
    host.send(f"table_activate oid=1 clock={host.now + 1000} generation=1")
    host.run(1000)
    assert active(host)[:2] == (DONE, 1)


def test_removing_needs_the_stepper_to_stand_too(host: Host) -> None:
    download(host, TABLE, [1])
    host.send(f"table_activate oid=1 clock={host.now + 1000} generation=1")
    host.run(1000)
    start = host.now + 1000
    host.send(f"reset_step_clock oid=0 clock={start}", "queue_step oid=0 interval=1000 count=10 add=0")
    host.send(f"table_activate oid=1 clock={start + 5000} generation=0")
    host.run(20_000)
    assert active(host)[:2] == (MOVING, 1)
    host.send(f"table_activate oid=1 clock={host.now + 1000} generation=0")
    host.run(1000)
    assert active(host)[:3] == (DONE, 0, 0)


def test_what_cannot_be_activated_says_why(host: Host) -> None:
    download(host, TABLE, [1])
    host.send(f"table_activate oid=1 clock={(host.now - 1) & 0xFFFFFFFF} generation=1")
    assert active(host)[:2] == (LATE, 0)
    host.send(f"table_activate oid=1 clock={host.now + 1000} generation=1")
    download(host, OTHER, [1])
    host.run(1000)
    assert active(host)[:2] == (REPLACED, 0)


def test_a_shutdown_ends_what_waits_and_keeps_the_tables(host: Host) -> None:
    download(host, TABLE, [1])
    host.send(f"table_activate oid=1 clock={host.now + 1000} generation=1")
    host.send("emergency_stop")
    host.run(2000)
    assert active(host)[:2] == (LATE, 0)
    assert kept(host) == TABLE


def test_a_restart_forgets_the_tables(host: Host) -> None:
    download(host, TABLE, [1])
    host.restart()
    if host.transport == "can":
        host.assign()
    host.configure(*CONFIG)
    assert state(host) == (OK, 0, 0, 0)


# -------------------------------------------------------------------------------------------- configuration


@pytest.mark.parametrize("bad", ["axle=0 capacity=4", "axle=29 capacity=4", "axle=1 capacity=0"])
def test_a_table_needs_an_axle_and_room(bad: str) -> None:
    host = Host()
    host.send("allocate_oids count=4")
    assert host.dies(f"config_table oid=1 {bad} stepper_oid=255") == "Not a valid axle or size of a table"


def test_a_table_needs_memory_and_a_stepper_that_is_one() -> None:
    host = Host()
    host.send("allocate_oids count=4")
    assert host.dies("config_table oid=1 axle=1 capacity=65535 stepper_oid=255") == "alloc_chunk failed"
    host.restart()
    host.send("allocate_oids count=4", "config_trsync oid=0")
    assert host.dies("config_table oid=1 axle=1 capacity=4 stepper_oid=0") == "Invalid oid type"


def test_tables_are_found_by_axle(host: Host) -> None:
    for axle, found in ((1, (1, ROOM)), (2, (2, ROOM)), (3, (255, 0)), (28, (255, 0))):
        answer = host.ask(f"table_find axle={axle}")
        assert (answer["axle"], answer["oid"], answer["capacity"]) == (axle, *found)
    assert Host().ask("table_find axle=1")["oid"] == 255, "nor does a node that is not configured have one"


# ------------------------------------------------------------------------------------------ polled register


def write_register(host: Host, words: Sequence[int], delay_ticks: int) -> None:
    """Write WORDS to the register, DELAY_TICKS apart."""
    paced = PacedWords(words, delay_ticks, host.now)
    while paced.deadline_ns is not None:
        host.run(max(0, paced.deadline_ns - host.now))
        word = paced.take(host.now)
        assert word is not None
        host.send(f"table_register_write oid=3 value={word}")
    host.run(delay_ticks)


def poll(host: Host, rest_ticks: int) -> None:
    host.send(f"table_register_poll oid=3 clock={host.now + 100} rest_ticks={rest_ticks}")
    host.run(100)


def test_a_polled_register_sees_every_word_that_stands_for_t(host: Host) -> None:
    poll(host, 1000)
    for number, table in enumerate((TABLE, ((5, 5),) * 4, (), OTHER)):
        write_register(host, transmission(table, [1]), 1000)
        assert (state(host)[:2], kept(host)) == ((OK, number + 1), table)


def test_polling_begins_at_its_clock(host: Host) -> None:
    host.send(f"table_register_poll oid=3 clock={host.now + 50_000} rest_ticks=1000")
    words_before = host.ask("table_query oid=1")["words"]
    write_register(host, transmission(TABLE, [1])[:10], 1000)
    assert host.ask("table_query oid=1")["words"] == words_before
    host.run(50_000)
    write_register(host, transmission(TABLE, [1]), 1000)
    assert kept(host) == TABLE


def test_a_polled_register_misses_words_that_come_too_fast(host: Host) -> None:
    poll(host, 1000)
    write_register(host, transmission(TABLE, [1]), 400)
    assert state(host)[1] == 0
    write_register(host, transmission(TABLE, [1]), 1000)
    assert kept(host) == TABLE


def test_a_register_that_is_not_polled_sees_nothing(host: Host) -> None:
    poll(host, 1000)
    poll(host, 0)
    words_before = host.ask("table_query oid=1")["words"]
    write_register(host, transmission(TABLE, [1]), 1000)
    assert host.ask("table_query oid=1")["words"] == words_before
