"""The bit-banged UART of stepper drivers, on pins of the real firmware: bits, times, what is refused."""

from itertools import pairwise

from tests.firmware.host import Host
from tests.firmware.twin import Answer

RX, TX = 70, 71
BIT = 400
"""Ticks."""


def talking(*, tx: int = TX, start_clock: int = 0) -> Host:
    host = Host(start_clock=start_clock)
    host.node.set_input(RX, 1)
    host.configure(f"config_tmcuart oid=3 rx_pin={RX} pull_up=1 tx_pin={tx} bit_time={BIT}")
    return host


def send(host: Host, data: bytes, read: int) -> list[Answer]:
    return host.send(f"tmcuart_send oid=3 write={data.hex()} read={read}")


def sent_levels(host: Host, pin: int, begin: int, count: int) -> list[int]:
    """Return the levels in the middle of COUNT bits, the first of which begins at BEGIN."""
    edges = [(int(edge) >> 16, int(edge) & 1) for edge in host.node.edges() if int(edge) >> 1 & 0x7FFF == pin]
    middles = [begin + BIT * bit + BIT // 2 for bit in range(count)]
    return [[level for at, level in edges if at <= middle][-1] for middle in middles]


def play(host: Host, begin: int, bits: list[int], bit_ticks: float) -> list[Answer]:
    """Put BITS onto the line from BEGIN on; return what the node says."""
    said = []
    for number, level in enumerate([*bits, 1]):
        said += host.run(begin + round(number * bit_ticks) - host.now)
        host.node.set_input(RX, level)
    return said


def test_bits_are_written_lowest_first_each_for_its_time_over_the_rollover() -> None:
    host = talking(start_clock=(1 << 32) - 10 * BIT)
    data = bytes((0x05, 0xC3, 0xF0))
    first_write = host.now + 4 * BIT
    assert send(host, data, 0) == []
    (answer,) = host.run(40 * BIT)
    assert (answer.name, answer.args["read"]) == ("tmcuart_response", b"")
    assert host.now > 1 << 32
    assert sent_levels(host, TX, first_write, 24) == [byte >> at & 1 for byte in data for at in range(8)]
    changes = [int(edge) >> 16 for edge in host.node.edges() if int(edge) >> 1 & 0x7FFF == TX][1:]
    assert all((later - earlier) % BIT == 0 for earlier, later in pairwise(changes))


def test_an_answer_is_read_though_its_clock_is_another() -> None:
    for error in (-0.004, 0.0, 0.004):
        for phase in (0, BIT // 4 + 3, BIT // 2, BIT - 1):
            host = talking()
            send(host, b"\x05", 10)
            said = host.run(15 * BIT + phase)
            bits = [0, *(number * 7 % 5 % 2 for number in range(79))]
            said += play(host, host.now, bits, BIT * (1 + error))
            said += host.run(3 * BIT)
            (answer,) = said
            assert answer.args["read"] == sum(bit << at for at, bit in enumerate(bits)).to_bytes(10, "little")


def test_silence_is_an_empty_answer() -> None:
    host = talking(tx=RX)
    send(host, b"\x05\xff", 10)
    assert host.run(100 * BIT) == []
    (answer,) = host.run(200 * BIT)
    assert answer.args["read"] == b""


def test_what_comes_too_early_is_dropped_and_asked_again() -> None:
    host = talking()
    assert send(host, b"\xff", 0) + send(host, b"\x00", 0) == []
    (answer,) = host.run(30 * BIT)
    assert answer.args["read"] == b""
    assert send(host, b"\x00", 0) == []
    assert len(host.run(30 * BIT)) == 1


def test_limits_are_the_nodes_own() -> None:
    host = talking()
    assert host.dies(f"tmcuart_send oid=3 write={'00' * 11} read=0") == "tmcuart data too large"
    host = talking()
    assert host.dies("tmcuart_send oid=3 write=00 read=11") == "tmcuart data too large"
    for pins in ("rx_pin=144 pull_up=0 tx_pin=3", "rx_pin=3 pull_up=0 tx_pin=144"):
        host = Host()
        host.send("allocate_oids count=2")
        assert host.dies(f"config_tmcuart oid=0 {pins} bit_time=400") == "Not a valid tmcuart pin"
    for bit_time in (7, (1 << 20) + 1):
        host = Host()
        host.send("allocate_oids count=2")
        text = f"config_tmcuart oid=0 rx_pin=3 pull_up=0 tx_pin=3 bit_time={bit_time}"
        assert host.dies(text) == "Invalid tmcuart bit time"
    for bit_time in (8, 1 << 20):
        Host().configure(f"config_tmcuart oid=0 rx_pin=3 pull_up=0 tx_pin=3 bit_time={bit_time}")


def test_a_shutdown_ends_it_with_the_line_idle() -> None:
    host = talking()
    send(host, b"\x00", 10)
    host.run(6 * BIT)
    assert host.node.level(TX) == 0
    host.dies("emergency_stop")
    assert host.node.level(TX) == 1
    assert host.run(300 * BIT) == []
