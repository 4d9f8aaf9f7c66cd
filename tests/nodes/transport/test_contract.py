"""What every transport keeps to: in order, complete, the end is seen, nothing hangs."""

import os
import select
import struct
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import can
import pytest

from nodes.support.errors import CanductorError
from nodes.transport import (
    CanFrame,
    CanTransport,
    Transport,
    TransportBusyError,
    TransportClosedError,
    TransportKind,
    open_can,
    open_uart,
)
from nodes.transport.frame import RECORD_SIZE
from nodes.transport.python_can_bridge import PythonCanBridge
from nodes.virtual.hub import VirtualBus
from tests.vcan.kernel import INTERFACE, why_no_socketcan

BURST = 4_000
WAIT_S = 30.0


class End(Protocol):
    """One end of a connection, whatever it carries: numbers go in and come out."""

    @property
    def transport(self) -> Transport: ...

    def send(self, number: int, timeout_s: float) -> None: ...

    def receive(self, timeout_s: float) -> int | None: ...


@dataclass
class CanEnd:
    transport: CanTransport

    def send(self, number: int, timeout_s: float) -> None:
        self.transport.send(CanFrame(0x108, number.to_bytes(4)), timeout_s)

    def receive(self, timeout_s: float) -> int | None:
        frame = self.transport.receive(timeout_s)
        assert frame is None or (frame.id == 0x108 and len(frame.data) == 4)
        return None if frame is None else int.from_bytes(frame.data)


class PtyMaster:
    """The device side of a pseudo-terminal, with the transport's interface."""

    name = "pty master"
    kind = TransportKind.BYTES
    bitrate = None

    def __init__(self, fd: int) -> None:
        self._fd = fd
        os.set_blocking(fd, False)

    def fileno(self) -> int:
        return self._fd

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _wait(self, event: int, timeout_s: float) -> bool:
        poller = select.poll()
        poller.register(self._fd, event)
        return bool(poller.poll(timeout_s * 1000))

    def send(self, data: bytes, timeout_s: float = 1.0) -> int:
        if self._fd < 0:
            raise TransportClosedError("closed")
        if not self._wait(select.POLLOUT, timeout_s):
            raise TransportBusyError("full")
        try:
            return os.write(self._fd, data)
        except BlockingIOError as error:
            raise TransportBusyError("full") from error

    def receive(self, timeout_s: float) -> bytes | None:
        if self._fd < 0:
            raise TransportClosedError("closed")
        if not self._wait(select.POLLIN, timeout_s):
            return None
        try:
            return os.read(self._fd, 4096) or None
        except OSError as error:
            raise TransportClosedError("EIO: nobody holds the other side") from error


class ByteEnd:
    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self._received = b""
        self._unsent = b""

    def send(self, number: int, timeout_s: float) -> None:
        while self._unsent:
            self._unsent = self._unsent[self._send(self._unsent, timeout_s) :]
        record = number.to_bytes(4)
        self._unsent = record[self._send(record, timeout_s) :]

    def _send(self, data: bytes, timeout_s: float) -> int:
        sent = self.transport.send(data, timeout_s)  # type: ignore[attr-defined]
        assert sent > 0
        return int(sent)

    def receive(self, timeout_s: float) -> int | None:
        while len(self._received) < 4:
            data = self.transport.receive(timeout_s)  # type: ignore[attr-defined]
            if data is None:
                return None
            self._received += data
        number, self._received = int.from_bytes(self._received[:4]), self._received[4:]
        return number


@dataclass
class Pair:
    a: End
    b: End
    end_is_seen: bool = True
    """Whether B learns that A is gone (on a bus, others do not notice)."""
    end_all: Callable[[], None] = lambda: None
    """Ends what connects the two."""
    bounded: bool = True
    """Whether a receiver that does not read is noticed by the sender."""
    ahead_max: int = BURST
    """Numbers that may be on the way: a vcan, faster than any wire, drops what a receiver has no room for."""


def connect(kind: str, folder: Path, cleanup: ExitStack) -> Pair:
    if kind == "uart":
        master, slave = os.openpty()
        tty.setraw(slave)
        uart = open_uart(os.ttyname(slave))
        os.close(slave)
        device = PtyMaster(master)
        cleanup.callback(device.close)
        cleanup.callback(uart.close)
        return Pair(ByteEnd(uart), ByteEnd(device), end_all=device.close)
    if kind == "socketcan":
        if reason := why_no_socketcan():
            pytest.skip(reason)
        a, b = open_can(INTERFACE), open_can(INTERFACE)
        for transport in (a, b):
            cleanup.callback(transport.close)
        return Pair(CanEnd(a), CanEnd(b), end_is_seen=False, bounded=False, ahead_max=2_000)
    bus = cleanup.enter_context(VirtualBus(folder / "bus", bitrate=None, stuck_limit_s=100))
    if kind == "bridge over python-can's virtual":
        spec = f"contract {os.getpid()}"
        a, b = (PythonCanBridge.open("virtual", spec) for _ in range(2))
        pair = Pair(CanEnd(a), CanEnd(b), end_is_seen=False, bounded=False)
    else:
        prefix = "virtual:" if kind == "virtual" else "canductor:"
        a, b = open_can(f"{prefix}{bus.path}"), open_can(f"{prefix}{bus.path}")
        pair = Pair(CanEnd(a), CanEnd(b), end_is_seen=False, end_all=bus.close)
    for transport in (a, b):
        cleanup.callback(transport.close)
    return pair


KINDS = ("virtual", "socketcan", "bridge over canductor", "bridge over python-can's virtual", "uart")


@pytest.fixture(params=KINDS)
def pair(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Pair]:
    with ExitStack() as cleanup:
        yield connect(request.param, tmp_path, cleanup)


def transfer(sender: End, receiver: End, numbers: range, ahead_max: int) -> None:
    """Send while there is room, receive while there is something; both never waiting for each other."""
    waiting = iter(numbers)
    number = next(waiting, None)
    for expected in numbers:
        while number is not None and number < expected + ahead_max:
            try:
                sender.send(number, 0)
            except TransportBusyError:
                break
            number = next(waiting, None)
        assert receiver.receive(WAIT_S) == expected


def test_burst_arrives_complete_and_in_order_both_ways(pair: Pair) -> None:
    transfer(pair.a, pair.b, range(BURST), pair.ahead_max)
    transfer(pair.b, pair.a, range(BURST, 2 * BURST), pair.ahead_max)
    assert pair.a.receive(0) is None
    assert pair.b.receive(0) is None


def test_nothing_to_receive_is_none_after_the_timeout(pair: Pair) -> None:
    assert pair.a.receive(0) is None
    assert pair.a.receive(0.01) is None


def test_describes_itself(pair: Pair) -> None:
    transport = pair.a.transport
    assert transport.name
    assert transport.kind in TransportKind
    assert not os.get_blocking(transport.fileno())


def test_file_descriptor_carries_what_the_kind_says(pair: Pair) -> None:
    transport = pair.a.transport
    if transport.kind is TransportKind.BYTES:
        assert os.write(transport.fileno(), (77).to_bytes(4)) == 4
    else:
        record = struct.pack("=IB3x8s", 0x108, 4, (77).to_bytes(4))
        assert os.write(transport.fileno(), record) == RECORD_SIZE
    assert pair.b.receive(WAIT_S) == 77
    pair.b.send(78, WAIT_S)
    poller = select.poll()
    poller.register(transport.fileno(), select.POLLIN)
    assert poller.poll(WAIT_S * 1000)
    data = os.read(transport.fileno(), 4096)
    if transport.kind is TransportKind.BYTES:
        assert data == (78).to_bytes(4)
    else:
        assert CanFrame.from_record(data) == CanFrame(0x108, (78).to_bytes(4))


def test_close_is_final_and_may_be_repeated(pair: Pair) -> None:
    pair.a.transport.close()
    pair.a.transport.close()
    with pytest.raises(TransportClosedError):
        pair.a.send(1, 0.01)
    with pytest.raises(TransportClosedError):
        pair.a.receive(0.01)
    with pytest.raises(TransportClosedError):
        pair.a.transport.fileno()


def test_what_was_sent_before_close_arrives(pair: Pair) -> None:
    for number in range(20):
        pair.a.send(number, WAIT_S)
    if isinstance(pair.a, ByteEnd):
        assert [pair.b.receive(WAIT_S) for _ in range(20)] == list(range(20))  # a terminal may drop on close
        pair.a.transport.close()
    else:
        pair.a.transport.close()
        assert [pair.b.receive(WAIT_S) for _ in range(20)] == list(range(20))
    if pair.end_is_seen:
        with pytest.raises(TransportClosedError):
            pair.b.receive(WAIT_S)


def test_end_of_the_connection_is_seen(pair: Pair) -> None:
    if pair.end_all is Pair.end_all:
        pytest.skip("nothing that could end but the two transports themselves")
    pair.end_all()
    with pytest.raises(TransportClosedError):
        pair.a.receive(WAIT_S)
    with pytest.raises(TransportClosedError):
        pair.a.send(1, WAIT_S)


def send_until_busy(end: End) -> int:
    """Send numbers from 0 up; return how many were taken before the first that was not."""
    for number in range(1_000_000):
        try:
            # A bridge's threads take a moment to fill everything up; only a real standstill times out.
            end.send(number, 0.2)
        except TransportBusyError:
            return number
    pytest.fail("what nobody reads was taken without bound")


def test_sending_to_nobody_who_reads_does_not_hang(pair: Pair) -> None:
    if not pair.bounded:
        pytest.skip("this bus takes and drops what nobody reads")
    sent = send_until_busy(pair.a)
    # And nothing of it was lost.
    assert [pair.b.receive(WAIT_S) for _ in range(sent)] == list(range(sent))


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("", "not a bus"),
        ("virtual:", "not a bus"),
        (":can0", "not a bus"),
        ("virtual:/nowhere/at/all", "no virtual CAN bus answers there"),
        ("virtual:" + "x" * 200, "no virtual CAN bus answers there"),
        ("nonsense:can0", "python-can cannot open it"),
        ("canductor:/nowhere", "no virtual CAN bus answers there"),
        ("can77", "CAN interface can77: cannot open: "),
    ],
)
def test_bus_that_does_not_exist_is_told_in_one_sentence(spec: str, said: str) -> None:
    with pytest.raises(CanductorError, match=said) as caught:
        open_can(spec)
    assert "\n" not in str(caught.value)


def test_uart_that_cannot_be_had(tmp_path: Path) -> None:
    with pytest.raises(CanductorError, match="there is no such device"):
        open_uart(tmp_path / "tty")
    with pytest.raises(CanductorError, match="there is no such device"):
        open_uart(tmp_path / ("x" * 256))
    (tmp_path / "file").touch()
    with pytest.raises(CanductorError, match="is it a serial device"):
        open_uart(tmp_path / "file")


def test_uart_is_exclusive() -> None:
    master, slave = os.openpty()
    path = os.ttyname(slave)
    first = open_uart(path)
    with pytest.raises(CanductorError, match="another program uses it"):
        open_uart(path)
    first.close()
    os.close(slave)
    os.close(master)


def test_failure_of_a_backend_closes_the_bridge_with_its_cause(tmp_path: Path) -> None:
    with VirtualBus(tmp_path / "bus") as bus:
        bridge = PythonCanBridge.open("canductor", str(bus.path))
        bus.close()
        with pytest.raises(TransportClosedError, match="the bus ended the connection"):
            bridge.receive(WAIT_S)
        assert "the backend failed" in str(bridge.cause)
        bridge.close()


def test_bridge_drops_and_counts_what_is_no_plain_frame() -> None:
    bridge = PythonCanBridge.open("virtual", "odd frames")
    with can.Bus(interface="virtual", channel="odd frames") as bus:
        bus.send(can.Message(arbitration_id=0x12345, is_extended_id=True))
        bus.send(can.Message(arbitration_id=1, is_extended_id=False, is_remote_frame=True))
        bus.send(can.Message(arbitration_id=2, is_extended_id=False, data=b"x"))
        assert bridge.receive(WAIT_S) == CanFrame(2, b"x")
    assert bridge.dropped == 2
    bridge.close()


@pytest.mark.parametrize(("can_id", "data"), [(0x800, b""), (-1, b""), (1, bytes(9))])
def test_frames_that_are_none_are_refused(can_id: int, data: bytes) -> None:
    with pytest.raises(ValueError, match="fit"):
        CanFrame(can_id, data)


@pytest.mark.parametrize(
    "record",
    [b"", bytes(15), struct.pack("=IB3x8s", 0x800, 0, b""), struct.pack("=IB3x8s", 1, 9, b"")],
)
def test_records_that_are_no_frame_are_none(record: bytes) -> None:
    assert CanFrame.from_record(record) is None
