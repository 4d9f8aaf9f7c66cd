"""A shutdown is reported although what waits for the wire leaves no room for the report."""

from tests.firmware.host import Host
from tests.firmware.twin import Answer

LIMIT = 5000
"""Ticks for which the output may be on."""
ON = "config_digital_out oid=0 pin=40 value=0 default_value=0 max_duration=5000"
ANSWERED_AT_LENGTH = "identify offset=0 count=52"
"""The answer fills a block."""
HEADER, TRAILER = 2, 3
"""Bytes of a block around its content."""


def drain(host: Host) -> list[Answer]:
    """Take all that the node has to say, as often as there is more; return what is no answer to a question."""
    stream = bytearray()
    while more := host.node.take_bytes():
        stream += more
    said, at = [], 0
    while at < len(stream):
        content = bytes(stream[at + HEADER : at + stream[at] - TRAILER])
        if content and len(content) < 20:  # blocks of identify are longer, and many
            said.append(host.words.decode(stream[at + 1], content))
        at += stream[at]
    assert at == len(stream)
    return [answer for answer in said if answer.name != "pong"]


def test_the_report_waits_for_room_and_comes_once() -> None:
    """The answers before the shutdown leave room for the whole report, for a part of it or for nothing."""
    host = Host()
    for shift in range(0, 50, 4):
        host.restart()
        host.configure(ON)
        host.send(f"queue_digital_out oid=0 clock={host.now + 1000} on_ticks=1")
        host.pour(f"debug_ping data={'00' * shift}", 1)
        while host.node.counters()["rx_overflow_bytes"] == 0:
            host.pour(ANSWERED_AT_LENGTH, 14)
        host.node.run_until(host.now + 1000 + LIMIT)
        assert host.node.level(40) == 0
        (report,) = drain(host)
        assert (report.name, host.text(report)) == ("shutdown", "Missed scheduling of next digital out event")
        assert report["clock"] == host.now % (1 << 32)
        assert host.node.counters()["tx_dropped"] == 0
