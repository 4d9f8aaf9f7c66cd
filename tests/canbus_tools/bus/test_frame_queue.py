"""FrameQueue: receives from a bus of python-can, in a thread."""

from collections.abc import Iterator

import can
import pytest

from canbus_tools.bus.computer import Computer, Listener
from canbus_tools.bus.frame_queue import FrameQueue
from canbus_tools.bus.open_bus import BusOptions, open_bus
from canbus_tools.protocol.frame import Frame
from nodes.support.errors import CanductorError

WAIT_S = 60.0
OPTIONS = BusOptions(interface="virtual", channel="a/frame queue")


@pytest.fixture
def sender() -> Iterator[can.BusABC]:
    with can.Bus(interface="virtual", channel=OPTIONS.channel) as bus:
        yield bus


def send(bus: can.BusABC, numbers: range, can_id: int = 0x108) -> None:
    for n in numbers:
        bus.send(can.Message(arbitration_id=can_id, data=n.to_bytes(8, "little"), is_extended_id=False))


def take(queue: Listener, count: int) -> list[Frame]:
    got: list[Frame] = []
    while len(got) < count:
        new = queue.take(WAIT_S)
        assert new, f"only {len(got)} came"
        got += new
    return got


def numbers_of(frames: list[Frame]) -> list[int]:
    return [int.from_bytes(frame.data, "little") for frame in frames]


def test_all_is_received_in_order(sender: can.BusABC) -> None:
    with Computer().listen(OPTIONS) as queue:
        send(sender, range(2000))
        got = take(queue, 2000)
        assert numbers_of(got) == list(range(2000))
        assert (queue.dropped, got[0].channel) == (0, "frame queue")
        assert queue.take() == []


def test_what_waits_too_long_gives_way_and_is_counted(sender: can.BusABC) -> None:
    with FrameQueue(open_bus(OPTIONS), OPTIONS, limit=10) as queue:
        send(sender, range(25))
        with queue._changed:
            assert queue._changed.wait_for(lambda: queue.dropped == 15, WAIT_S)
        assert numbers_of(queue.take()) == list(range(15, 25))


def test_the_rest_is_what_had_arrived_when_listening_ends(sender: can.BusABC) -> None:
    with Computer().listen(OPTIONS) as queue:
        send(sender, range(1000))
        assert numbers_of(queue.rest(quiet_s=0.01, limit_s=WAIT_S)) == list(range(1000))
        send(sender, range(5))
        assert queue.rest(quiet_s=0.0, limit_s=0.0) == [], "it listens no more"


def test_other_frames_can_be_left_out(sender: can.BusABC) -> None:
    with Computer().listen(OPTIONS) as queue:
        queue.only(0x3F1)
        send(sender, range(5))
        send(sender, range(5, 6), 0x3F1)
        assert numbers_of(take(queue, 1)) == [5]


def test_a_bus_that_fails_is_told_once_its_frames_were_taken(sender: can.BusABC) -> None:
    with FrameQueue(can.Bus(interface="virtual", channel=OPTIONS.channel), OPTIONS) as queue:
        send(sender, range(1))
        assert numbers_of(take(queue, 1)) == [0]
        queue._bus.shutdown()
        with pytest.raises(CanductorError, match=r"^CAN bus virtual:a/frame queue: receiving failed"):
            take(queue, 1)
