"""debug_read and debug_write: memory where the board allows it, and a shutdown elsewhere."""

import pytest

from tests.firmware.host import Host

BASE = 0x20000000
SIZE = 256


def read(host: Host, order: int, addr: int) -> int:
    return host.ask(f"debug_read order={order} addr={addr}")["val"]


def test_bytes_halves_and_words_are_read_as_they_were_written() -> None:
    host = Host()
    assert host.send(f"debug_write order=2 addr={BASE} val={0xFEDCBA98}") == []
    assert read(host, 2, BASE) == 0xFEDCBA98
    assert [read(host, 1, BASE + at) for at in (0, 2)] == [0xBA98, 0xFEDC]
    assert [read(host, 0, BASE + at) for at in range(4)] == [0x98, 0xBA, 0xDC, 0xFE]
    host.send(f"debug_write order=0 addr={BASE + 1} val={0x1FF}")
    host.send(f"debug_write order=1 addr={BASE + 2} val={0x12345}")
    assert read(host, 2, BASE) == 0x2345FF98, "only the bytes of its width"
    assert read(host, 2, BASE + 4) == 0


@pytest.mark.parametrize("order", [0, 1, 2])
def test_the_first_and_the_last_address(order: int) -> None:
    host = Host()
    last = BASE + SIZE - (1 << order)
    host.send(f"debug_write order={order} addr={last} val=77")
    assert (read(host, order, last), read(host, order, BASE)) == (77, 0)
    for addr in (BASE - (1 << order), BASE + SIZE, 0, 0x100000000 - (1 << order)):
        assert Host().dies(f"debug_read order={order} addr={addr}") == "Debug address not accessible"
        assert Host().dies(f"debug_write order={order} addr={addr} val=1") == "Debug address not accessible"


@pytest.mark.parametrize(
    ("order", "addr"), [(1, BASE + 1), (2, BASE + 1), (2, BASE + 2), (3, BASE), (255, BASE)]
)
def test_addresses_that_are_not_aligned_and_other_widths(order: int, addr: int) -> None:
    assert Host().dies(f"debug_read order={order} addr={addr}") == "Debug address not accessible"
    assert Host().dies(f"debug_write order={order} addr={addr} val=1") == "Debug address not accessible"


def test_a_node_that_is_shut_down_can_be_looked_at() -> None:
    host = Host()
    host.send(f"debug_write order=2 addr={BASE} val=9", "emergency_stop")
    assert read(host, 2, BASE) == 9
