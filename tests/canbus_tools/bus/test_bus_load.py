"""LoadMeter: the length of every kind of frame, shares, windows, and what keeps it small."""

import can
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from canbus_tools.bus.bus_load import (
    ERROR_BITS,
    EXTENDED,
    IDS_MAX,
    OTHER_IDS,
    WINDOWS_MAX,
    LoadMeter,
    TrafficClass,
    frame_bits,
)
from canbus_tools.protocol.frame import Frame, FrameKind
from nodes.support.errors import CanductorError
from tests.nodes.wire_bits import bits_on_wire, crc15

BITRATE = 100_000
EMPTY = bits_on_wire(0x555, b"")


@given(can_id=st.integers(0, 0x7FF), data=st.binary(max_size=8))
@example(can_id=0, data=bytes(8))
@example(can_id=0x7FF, data=b"\xff" * 8)
def test_data_frames(can_id: int, data: bytes) -> None:
    assert frame_bits(Frame(0.0, can_id, data)) == bits_on_wire(can_id, data)


@given(can_id=st.integers(0, 0x1FFFFFFF), data=st.binary(max_size=8))
@example(can_id=0, data=bytes(8))
@example(can_id=0x1FFFFFFF, data=b"\xff" * 8)
def test_extended_frames(can_id: int, data: bytes) -> None:
    bits = frame_bits(Frame(0.0, can_id, data, FrameKind.EXTENDED))
    assert bits == bits_on_wire(can_id, data, extended=True)
    assert 67 + 8 * len(data) <= bits <= 67 + 8 * len(data) + (54 + 8 * len(data) - 1) // 4


@given(can_id=st.integers(0, 0x7FF), length=st.integers(0, 8))
def test_remote_frames_have_no_data_but_a_length(can_id: int, length: int) -> None:
    message = can.Message(
        arbitration_id=can_id, is_extended_id=False, is_remote_frame=True, dlc=length, timestamp=1.0
    )
    assert LoadMeter(BITRATE).feed(message) == bits_on_wire(can_id, b"", asks_for=length)


@given(can_id=st.integers(0x800, 0x1FFFFFFF), length=st.integers(0, 8))
def test_extended_remote_frames(can_id: int, length: int) -> None:
    message = can.Message(arbitration_id=can_id, is_remote_frame=True, dlc=length, timestamp=1.0)
    assert LoadMeter(BITRATE).feed(message) == bits_on_wire(can_id, b"", extended=True, asks_for=length)


def test_the_independent_count_knows_a_published_checksum() -> None:
    # ISO 11898-1's polynomial 0x4599: what is left of x^15.
    assert crc15("1") == f"{0x4599:015b}"


def test_what_the_traffic_is_for() -> None:
    meter = LoadMeter(BITRATE)
    ids = {
        0x3F0: TrafficClass.ADMIN,
        0x3F1: TrafficClass.ADMIN,
        0x010: TrafficClass.SIGNAL,
        0x020: TrafficClass.SIGNAL,
        0x02F: TrafficClass.SIGNAL,
        0x030: TrafficClass.OTHER,
        0x100: TrafficClass.OTHER,  # of node id 0, which no node has
        0x108: TrafficClass.TO_NODES,
        0x109: TrafficClass.FROM_NODES,
        0x2FF: TrafficClass.FROM_NODES,
        0x300: TrafficClass.OTHER,
    }
    for can_id in ids:
        meter.feed(Frame(1.0, can_id, b"\x01"))
    load = meter.load()
    for kind in set(ids.values()):
        of_kind = [can_id for can_id in ids if ids[can_id] is kind]
        assert load.classes[kind].frames == len(of_kind)
        assert load.classes[kind].bits == sum(bits_on_wire(can_id, b"\x01") for can_id in of_kind)
    assert sum(part.frames for part in load.ids.values()) == load.frames == len(ids)


def test_shares_and_peak() -> None:
    meter = LoadMeter(BITRATE, window_s=1.0)
    meter.begin(100.0)
    for i in range(100):  # in the third second
        meter.feed(Frame(102.0 + i / 100, 0x555, b""))
    meter.advance(110.0)
    load = meter.load()
    assert load.duration_s == 10.0
    assert load.mean == pytest.approx(100 * EMPTY / (10 * BITRATE))
    assert load.peak == pytest.approx(100 * EMPTY / BITRATE)
    assert load.peak_at_s == 2.0
    assert load.frames_per_s == pytest.approx(10.0)
    assert [window.frames for window in load.windows] == [0, 0, 100, 0, 0, 0, 0, 0, 0, 0]
    assert load.windows[2].bits == {TrafficClass.OTHER: 100 * EMPTY}


def test_a_full_bus_is_full() -> None:
    meter = LoadMeter(BITRATE)
    time_s = 5.0
    for _ in range(5000):
        time_s += EMPTY / BITRATE  # a frame is received at its end
        meter.feed(Frame(time_s, 0x555, b""))
    load = meter.load()
    assert load.mean == pytest.approx(1.0)
    assert load.peak == pytest.approx(1.0, abs=0.001)


def test_errors_are_estimated_and_shown_apart() -> None:
    meter = LoadMeter(BITRATE)
    meter.feed(Frame(1.0, 0x20000088, bytes(8), FrameKind.ERROR))
    meter.feed(Frame(2.0, 0x20000004, bytes(8), FrameKind.ERROR))  # a change of state takes no time
    load = meter.load()
    assert load.error_reports == 2
    assert load.frames == 0
    assert load.classes[TrafficClass.ERROR].bits == ERROR_BITS
    assert not load.ids


def test_fd_frames_are_counted_not_measured() -> None:
    meter = LoadMeter(BITRATE)
    assert meter.feed(Frame(1.0, 0x123, bytes(64), FrameKind.FD)) == 0
    assert meter.load().unmeasured == 1


def test_memory_is_bounded_by_ids() -> None:
    meter = LoadMeter(BITRATE)
    for can_id in range(2 * IDS_MAX):
        meter.feed(Frame(1.0, can_id, b"", FrameKind.EXTENDED))
    ids = meter.load().ids
    assert len(ids) == IDS_MAX + 1
    assert ids[OTHER_IDS].frames == IDS_MAX
    assert ids[EXTENDED | 7].frames == 1


@given(times=st.lists(st.floats(-1e11, 1e11), min_size=1, max_size=30))
@example(times=[0.0, 1e11])
@example(times=[5.0, 1.0])
def test_memory_is_bounded_whatever_the_clock_does(times: list[float]) -> None:
    meter = LoadMeter(BITRATE, window_s=0.01)
    for time_s in times:
        meter.feed(Frame(time_s, 0x555, b""))
    load = meter.load()
    assert len(load.windows) <= WINDOWS_MAX
    assert sum(window.frames for window in load.windows) == load.frames == len(times)
    assert load.bits == EMPTY * len(times)


def test_the_peak_survives_longer_windows() -> None:
    meter = LoadMeter(BITRATE, window_s=1.0)
    for i in range(100):
        meter.feed(Frame(i / 100, 0x555, b""))
    meter.advance(1e6)
    load = meter.load()
    assert load.peak == pytest.approx(100 * EMPTY / BITRATE, rel=0.02)
    assert len(load.windows) <= WINDOWS_MAX


def test_nothing_measured_is_no_load() -> None:
    load = LoadMeter(BITRATE).load()
    assert (load.mean, load.peak, load.frames_per_s, load.windows) == (0.0, 0.0, 0.0, ())


@pytest.mark.parametrize(
    ("bitrate", "window_s"), [(0, 1.0), (2_000_000, 1.0), (500_000, 0.0), (500_000, 1e9)]
)
def test_out_of_range(bitrate: int, window_s: float) -> None:
    with pytest.raises(CanductorError, match="is not between"):
        LoadMeter(bitrate, window_s=window_s)
