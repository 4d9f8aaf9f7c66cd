"""Recordings of every kind are read as they were written; broken ones as far as they go."""

import io
import struct
from collections.abc import Callable, Iterable
from itertools import chain
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canbus_tools.protocol.frame import Frame, FrameKind
from canbus_tools.recordings import pcap as _pcap
from canbus_tools.recordings.candump import candump_line, read_candump
from canbus_tools.recordings.mcap_file import McapWriter
from canbus_tools.recordings.recordings import read_frames
from nodes.support.errors import CanductorError

FRAMES = [
    Frame(1_700_000_000.25, 0x3F0, b"\x00", channel="can0"),
    Frame(1_700_000_000.5, 0x108, bytes(range(8)), channel="can0"),
    Frame(1_700_000_001.0, 0x109, b"", channel="can0"),
    Frame(1_700_000_002.0, 0x1ABCDEF0, b"\xff\x01", FrameKind.EXTENDED, "can0"),
]


def collect(source: Iterable[Frame]) -> tuple[list[Frame], str]:
    """Return what was read, and the sentence at the end."""
    found: list[Frame] = []
    try:
        for frame in source:
            found.append(frame)  # noqa: PERF402 (an error must not lose those before it)
    except CanductorError as error:
        return found, str(error)
    return found, ""


def flat(batches: Iterable[list[Frame]]) -> list[Frame]:
    return [frame for batch in batches for frame in batch]


def read_all(path: Path) -> tuple[list[Frame], str]:
    return collect(read_frames(path))


def same(found: list[Frame], *, with_channel: bool = True) -> bool:
    kept = [frame if with_channel else frame._replace(channel="can0") for frame in found]
    return kept == FRAMES


# ---------------------------------------------------------------------------------------------------- candump


def test_candump_log(tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    path.write_text("".join(map(candump_line, FRAMES)))
    assert read_all(path) == (FRAMES, "")


frames = st.builds(
    Frame,
    st.integers(0, 2_000_000_000).map(float),
    st.integers(0, 0x7FF),
    st.binary(max_size=8),
    st.sampled_from([FrameKind.DATA, FrameKind.EXTENDED, FrameKind.ERROR]),
    st.sampled_from(["can0", "vcan1"]),
) | st.builds(
    Frame, st.just(5.0), st.integers(0, 0x7FF), st.just(b""), st.just(FrameKind.REMOTE), st.just("can0")
)


@given(st.lists(frames))
def test_candump_lines_come_back(wanted: list[Frame]) -> None:
    log = "".join(map(candump_line, wanted)).encode()
    assert flat(read_candump(io.BytesIO(log), "log")) == wanted


@pytest.mark.parametrize(
    ("line", "frame"),
    [
        ("(5.000001) can0 108#0102 R", Frame(5.000001, 0x108, b"\1\2", channel="can0")),
        ("(5.0) can0 108#R4", Frame(5.0, 0x108, b"", FrameKind.REMOTE, "can0")),
        ("(5.0) can0 108##3" + "00" * 12, Frame(5.0, 0x108, bytes(12), FrameKind.FD, "can0")),
        ("(5.0) can0 20000040#" + "00" * 8, Frame(5.0, 0x40, bytes(8), FrameKind.ERROR, "can0")),
        ("  can0  3F0   [1]  00", Frame(0.0, 0x3F0, b"\0", channel="can0")),
        (" (7.5)  can0  3F1   [2]  20 AA   ' .'", Frame(7.5, 0x3F1, b"\x20\xaa", channel="can0")),
        (" (7.5)  can0  RX - -  108   [1]  05", Frame(7.5, 0x108, b"\5", channel="can0")),
        (" (7.5)  can0  108   [0]  remote request", Frame(7.5, 0x108, b"", FrameKind.REMOTE, "can0")),
        (
            " (7.5)  can0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME",
            Frame(7.5, 4, b"\0\4" + bytes(6), FrameKind.ERROR, "can0"),
        ),
    ],
)
def test_candump_forms(line: str, frame: Frame) -> None:
    assert flat(read_candump(io.BytesIO(line.encode()), "log")) == [frame]


@pytest.mark.parametrize(
    "line",
    [
        "(nan) can0 108#00",
        "(inf) can0 108#00",
        "(5.0) can0 8FF#00",
        "(5.0) can0 10#00",
        "(5.0) can0 108#0",
        "(5.0) can0 -12#00",
        "(5.0) can0",
        "hello",
        "(",
        "(5.0) can0 108##0" + "00" * 65,
        "(5.0) can0 108#" + "00" * 100_000,
    ],
)
def test_a_line_that_is_no_frame_is_told_and_the_rest_is_read(line: str) -> None:
    good = candump_line(FRAMES[0])
    log = f"{good}{line}\n{good}".encode()
    found, problem = collect(chain.from_iterable(read_candump(io.BytesIO(log), "log")))
    assert found == [FRAMES[0], FRAMES[0]]
    assert problem.startswith("log: line 2 ")
    assert problem.endswith(" is no frame of a candump log; the rest was read")


@given(st.binary(max_size=300))
def test_any_bytes_as_a_candump_log(log: bytes) -> None:
    found, problem = collect(chain.from_iterable(read_candump(io.BytesIO(log), "log")))
    assert all(frame.can_id < 1 << 29 for frame in found)
    assert problem == "" or "is no frame of a candump log" in problem


# -------------------------------------------------------------------------------------- formats of python-can


def to_message(frame: Frame) -> can.Message:
    return can.Message(
        timestamp=frame.time_s,
        arbitration_id=frame.can_id,
        data=frame.data,
        is_extended_id=frame.kind is FrameKind.EXTENDED,
        is_remote_frame=frame.kind is FrameKind.REMOTE,
        is_error_frame=frame.kind is FrameKind.ERROR,
        is_fd=frame.kind is FrameKind.FD,
    )


@pytest.mark.parametrize(("suffix", "writer"), [("blf", can.BLFWriter), ("asc", can.ASCWriter)])
def test_blf_and_asc(tmp_path: Path, suffix: str, writer: Callable[[str], can.Listener]) -> None:
    path = tmp_path / f"some.{suffix}"
    log = writer(str(path))
    for frame in FRAMES:
        message = to_message(frame)
        message.channel = 0
        log.on_message_received(message)
    log.stop()
    found, problem = read_all(path)
    assert problem == ""
    start_s = found[0].time_s
    assert [(f.can_id, f.data, f.kind) for f in found] == [(f.can_id, f.data, f.kind) for f in FRAMES]
    assert [round(f.time_s - start_s, 4) for f in found] == [0, 0.25, 0.75, 1.75]


def test_truncated_blf(tmp_path: Path) -> None:
    path = tmp_path / "some.blf"
    log = can.BLFWriter(str(path), max_container_size=400)
    for frame in FRAMES * 20:
        log.on_message_received(to_message(frame))
    log.stop()
    path.write_bytes(path.read_bytes()[:-150])
    found, problem = read_all(path)
    assert 0 < len(found) < 80
    assert problem.startswith(f"{path}: ")
    assert "truncated" in problem
    path.write_bytes(b"LOGGxxxx")
    assert read_all(path)[1].startswith(f"{path}: damaged or truncated after frame 0 (")


# ------------------------------------------------------------------------------------------------------- pcap


def packet(frame: Frame, order: str = ">") -> bytes:
    flags = 0x8000_0000 if frame.kind is FrameKind.EXTENDED else 0
    return struct.pack(f"{order}IB3x", frame.can_id | flags, len(frame.data)) + frame.data.ljust(8, b"\0")


def cooked(frame: Frame, order: str) -> bytes:
    return struct.pack(">HHH8sH", 0, 280, 0, b"", 0x000C) + packet(frame, order)


def pcap(order: str, *, nano: bool, link: int) -> bytes:
    magic = 0xA1B23C4D if nano else 0xA1B2C3D4
    out = struct.pack(f"{order}IHHIIII", magic, 2, 4, 0, 0, 65535, link)
    for frame in FRAMES:
        body = packet(frame) if link == 227 else cooked(frame, order)
        fraction = round(frame.time_s % 1 * (1e9 if nano else 1e6))
        out += struct.pack(f"{order}IIII", int(frame.time_s), fraction, len(body), len(body)) + body
    return out


def block(order: str, kind: int, body: bytes) -> bytes:
    body += bytes(-len(body) % 4)
    size = struct.pack(f"{order}I", len(body) + 12)
    return struct.pack(f"{order}I", kind) + size + body + size


def pcapng(order: str, *, nano: bool, link: int) -> bytes:
    out = block(order, 0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, 1, 0, -1))
    options = struct.pack(f"{order}HH4s", 2, 4, b"can0")
    if nano:
        options += struct.pack(f"{order}HHB3x", 9, 1, 9)
    out += block(order, 1, struct.pack(f"{order}HHI", link, 0, 0) + options + bytes(4))
    for frame in FRAMES:
        ticks = round(frame.time_s * (1e9 if nano else 1e6))
        body = packet(frame) if link == 227 else cooked(frame, order)
        head = struct.pack(f"{order}IIIII", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(body), len(body))
        out += block(order, 6, head + body)
    return out


@pytest.mark.parametrize("link", [227, 113])
@pytest.mark.parametrize("nano", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("form", [pcap, pcapng])
def test_captures(tmp_path: Path, form: Callable[..., bytes], order: str, nano: bool, link: int) -> None:
    path = tmp_path / "some.pcap"
    whole = form(order, nano=nano, link=link)
    path.write_bytes(whole)
    found, problem = read_all(path)
    assert problem == ""
    assert same(found, with_channel=form is pcapng)
    path.write_bytes(whole[:-5])
    found, problem = read_all(path)
    assert [f.can_id for f in found] == [f.can_id for f in FRAMES[:3]]
    assert problem == f"{path}: truncated packet at byte {len(whole) - 5}; the 3 frames before were read"


def test_a_capture_of_something_else(tmp_path: Path) -> None:
    path = tmp_path / "some.pcap"
    path.write_bytes(struct.pack("<IHHIIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))
    assert "not captured from a CAN bus (link type 1)" in read_all(path)[1]


@given(st.sampled_from([pcap, pcapng]), st.data())
def test_damaged_captures_never_fail(form: Callable[..., bytes], data: st.DataObject) -> None:
    whole = bytearray(form("<", nano=False, link=227))
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(4, len(whole) - 1))] = data.draw(st.integers(0, 255))
    reader = _pcap.read_pcap if form is pcap else _pcap.read_pcapng
    found, problem = collect(reader(io.BytesIO(bytes(whole)), "some"))
    assert all(len(frame.data) <= 64 for frame in found)
    assert problem == "" or problem.startswith("some: ")


# ------------------------------------------------------------------------------------------------------- mcap


def test_mcap(tmp_path: Path) -> None:
    path = tmp_path / "some.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        for frame in FRAMES:
            writer.frame(frame)
        writer.finish()
    assert read_all(path) == (FRAMES, "")
    path.write_bytes(path.read_bytes()[:-300])
    found, problem = read_all(path)
    assert found == FRAMES
    assert problem.startswith(f"{path}: damaged or truncated after frame 4 (")


# ----------------------------------------------------------------------------------------------------- others


def test_what_is_no_recording(tmp_path: Path) -> None:
    path = tmp_path / "some.bin"
    assert read_all(path)[1] == f"there is no file '{path}'"
    path.write_bytes(b"")
    assert read_all(path)[1] == f"{path}: is empty"
    path.write_bytes(b"\x7fELF\0\0\0")
    assert "unknown format; candump logs, BLF" in read_all(path)[1]
