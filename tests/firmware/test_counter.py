"""Counters: changes of an input between looks, reported with the clock of the last one."""

from tests.firmware.host import Host
from tests.firmware.twin import Answer

ROLLOVER = 1 << 32


def counting(start_clock: int = 0) -> tuple[Host, int]:
    host = Host(start_clock=start_clock)
    host.configure("config_counter oid=3 pin=70 pull_up=1")
    begin = host.now + 1000
    host.send(f"query_counter oid=3 clock={begin % ROLLOVER} poll_ticks=1000 sample_ticks=50000")
    return host, begin


def args(answer: Answer) -> tuple[int, int, int]:
    return answer["next_clock"], answer["count"], answer["count_clock"]


def test_changes_are_counted_over_the_rollover() -> None:
    host, begin = counting(ROLLOVER - 90_000)
    said = host.run(500)
    for change in range(40):
        host.node.set_input(70, (change + 1) & 1)
        said += host.run(4000)
    assert [answer.name for answer in said] == ["counter_state"] * 4
    # A change is seen by the first look after it: those of the n-th at begin + 4000 n.
    expected = [(begin + 50_000 * k, 12.5 * (k - 1)) for k in (1, 2, 3, 4)]
    for answer, (next_clock, changes) in zip(said, expected, strict=True):
        found = args(answer)
        assert found[0] == next_clock % ROLLOVER
        assert changes - 1 <= found[1] <= changes + 1
        if found[1]:
            assert found[2] == (begin + 4000 * (found[1] - 1)) % ROLLOVER


def test_nothing_changes_and_it_ends_with_a_poll_of_zero() -> None:
    host, begin = counting()
    (first,) = host.run(40_000)
    assert args(first) == (begin + 50_000, 0, begin)
    host.send("query_counter oid=3 clock=0 poll_ticks=0 sample_ticks=0")
    assert host.run(1_000_000) == []


def test_the_level_at_a_query_is_no_change_and_a_query_in_mid_count_begins_again() -> None:
    host = Host()
    host.configure("config_counter oid=3 pin=70 pull_up=1")
    host.node.set_input(70, 1)
    first, second = host.now + 1000, host.now + 20_000
    said = []
    for begin in (first, second):
        host.send(f"query_counter oid=3 clock={begin} poll_ticks=1000 sample_ticks=50000")
        said += host.run(begin + 500 - host.now)
    said += host.run(60_000)
    assert [args(answer) for answer in said] == [
        (first + 50_000, 0, first),
        (second + 50_000, 0, second),
        (second + 100_000, 0, second),
    ]


def test_a_shutdown_ends_it() -> None:
    host, _ = counting()
    host.dies("emergency_stop")
    assert host.run(1_000_000) == []


def test_pins_and_objects_are_checked() -> None:
    host = Host()
    host.send("allocate_oids count=2")
    assert host.dies("config_counter oid=0 pin=144 pull_up=0") == "Not a valid input pin"
    host, _ = counting()
    assert host.dies("query_counter oid=4 clock=0 poll_ticks=1 sample_ticks=1") == "Invalid oid type"
