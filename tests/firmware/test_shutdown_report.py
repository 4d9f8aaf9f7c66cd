"""A shutdown is reported although what waits for the wire leaves no room for the report."""

from tests.firmware.host import Host
from tests.firmware.twin import Answer

LIMIT = 5000
"""Ticks for which the output may be on."""
ON = "config_digital_out oid=0 pin=40 value=0 default_value=0 max_duration=5000"
ASK_MUCH = "identify offset=0 count=52"
LONGEST_DATA = 57
ASK_MOST = f"debug_ping data={'00' * LONGEST_DATA}"
"""The answer fills a block."""
NEARLY_FULL = 77
FULL = 8
"""So many times 14 answers to the one, and answers to the other, fill the board's own room for bytes."""
STEP = 3
"""Finer than the report is long."""
HEADER, TRAILER = 2, 3
"""Bytes of a block around its content."""
ANSWER_SIZE = 50


def drain(host: Host) -> list[Answer]:
    """Take all that the node has to say; return what is no answer to a question."""
    stream = bytearray()
    while more := host.node.take_bytes():
        stream += more
    said, at = [], 0
    while at < len(stream):
        content = bytes(stream[at + HEADER : at + stream[at] - TRAILER])
        if content and len(content) < ANSWER_SIZE:  # there are many others
            said.append(host.words.decode(stream[at + 1], content))
        at += stream[at]
    assert at == len(stream)
    return [answer for answer in said if answer.name != "pong"]


def test_the_report_waits_for_room_and_comes_once() -> None:
    """The answers before the shutdown leave room for the whole report, for a part of it or for nothing."""
    host = Host(start_clock=1 << 31)
    for shift in range(0, LONGEST_DATA, STEP):
        host.restart()
        host.configure(ON)
        host.send(f"queue_digital_out oid=0 clock={host.now + 1000} on_ticks=1")
        for _ in range(NEARLY_FULL):
            host.pour(ASK_MUCH, 14)
        for _ in range(FULL):
            host.pour(ASK_MOST, 1)
        host.pour(f"debug_ping data={'00' * shift}", 1)
        while host.node.counters()["rx_overflow_bytes"] == 0:
            host.pour(ASK_MOST, 1)
        host.node.run_until(host.now + 1000 + LIMIT)
        assert host.node.level(40) == 0
        (report,) = drain(host)
        assert (report.name, host.text(report)) == ("shutdown", "Missed scheduling of next digital out event")
        assert report["clock"] == host.now % (1 << 32)
        assert host.node.counters()["tx_dropped"] == 0


def test_a_report_that_waits_for_room_is_dropped_by_a_shutdown() -> None:
    """A stop group expires when there is no room for its report; it is over when there is."""
    host = Host()
    host.configure(ON, "config_trsync oid=1")
    begin = host.now
    host.send(f"queue_digital_out oid=0 clock={begin + 1000} on_ticks=1")
    host.send("trsync_start oid=1 report_clock=0 report_ticks=0 expire_reason=2")
    host.send(f"trsync_set_timeout oid=1 clock={begin + 2000}")
    while host.node.counters()["rx_overflow_bytes"] == 0:
        host.pour(ASK_MOST, 1)
    host.node.run_until(begin + 1000 + LIMIT)
    assert [answer.name for answer in drain(host)] == ["shutdown"]
