"""The virtual bus as a backend of python-can."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from nodes.virtual.hub import VirtualBus
from nodes.virtual.python_can import CanductorBus

WAIT_S = 30.0


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[VirtualBus]:
    with VirtualBus(tmp_path / "bus", bitrate=None) as running:
        yield running


def open_bus(bus: VirtualBus, **options: object) -> can.BusABC:
    return can.Bus(interface="canductor", channel=str(bus.path), **options)  # type: ignore[arg-type]


def plain(can_id: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def test_is_registered_and_carries_frames_both_ways(bus: VirtualBus) -> None:
    with open_bus(bus) as a, open_bus(bus) as b:
        assert isinstance(a, CanductorBus)
        a.send(plain(0x123, b"abc"))
        got = b.recv(WAIT_S)
        assert got is not None
        assert (got.arbitration_id, bytes(got.data), got.is_extended_id) == (0x123, b"abc", False)
        assert got.timestamp > 0
        b.send(plain(0x7FF, bytes(8)), timeout=WAIT_S)
        got = a.recv(WAIT_S)
        assert got is not None
        assert got.dlc == 8
        assert a.recv(0) is None


def test_filters(bus: VirtualBus) -> None:
    with open_bus(bus) as a, open_bus(bus, can_filters=[{"can_id": 0x200, "can_mask": 0x7F0}]) as b:
        for can_id in (0x1FF, 0x205, 0x210, 0x20F):
            a.send(plain(can_id))
        ids = [message.arbitration_id for message in (b.recv(WAIT_S), b.recv(WAIT_S)) if message]
        assert ids == [0x205, 0x20F]


@pytest.mark.parametrize(
    "message",
    [
        can.Message(arbitration_id=1, is_extended_id=True),
        can.Message(arbitration_id=1, is_extended_id=False, is_remote_frame=True),
        can.Message(arbitration_id=1, is_extended_id=False, is_error_frame=True),
        can.Message(arbitration_id=1, is_extended_id=False, is_fd=True, data=bytes(12)),
    ],
)
def test_other_frames_are_refused(bus: VirtualBus, message: can.Message) -> None:
    with open_bus(bus) as a, pytest.raises(can.CanOperationError, match="carries only data frames"):
        a.send(message)


def test_no_bus_is_told(tmp_path: Path) -> None:
    with pytest.raises(can.CanInitializationError, match="no virtual CAN bus answers there"):
        can.Bus(interface="canductor", channel=str(tmp_path / "none"))


def test_a_bus_that_ends_is_told(bus: VirtualBus) -> None:
    with open_bus(bus) as a:
        bus.close()
        with pytest.raises(can.CanOperationError, match="the bus ended the connection"):
            a.recv(WAIT_S)


def test_after_shutdown_nothing_works_and_nothing_hangs(bus: VirtualBus) -> None:
    a = open_bus(bus)
    a.shutdown()
    a.shutdown()
    with pytest.raises(can.CanOperationError, match="already closed"):
        a.send(plain(1))
    with pytest.raises(can.CanOperationError, match="already closed"):
        a.recv(0)


def test_asyncio_notifier_sees_every_frame_of_a_burst(bus: VirtualBus) -> None:
    """Whoever waits for the file descriptor must not miss frames that came with another one."""

    async def listen() -> list[int]:
        seen: list[int] = []
        done = asyncio.Event()

        def take(message: can.Message) -> None:
            seen.append(message.arbitration_id)
            if len(seen) == 500:
                done.set()

        with open_bus(bus) as a, open_bus(bus) as b:
            notifier = can.Notifier(b, [take], loop=asyncio.get_running_loop())
            for can_id in range(500):
                a.send(plain(can_id))
            await asyncio.wait_for(done.wait(), WAIT_S)
            notifier.stop()
        return seen

    assert asyncio.run(listen()) == list(range(500))
