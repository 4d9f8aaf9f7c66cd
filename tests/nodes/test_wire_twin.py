"""The C codec against the slow Python twin, garbage included."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.dictionary.message_format import CODES, MessageFormat, vlq, vlq_read
from nodes.support._wire import ffi, lib
from tests import wire_twin as twin

NUMBERS = st.integers(-(1 << 31), (1 << 32) - 1)
LIMITS = sorted({edge + d for pair in twin.VLQ_RANGES for edge in pair for d in (-1, 0, 1)})


@pytest.mark.parametrize("value", [*LIMITS, 0, -(1 << 31), (1 << 31) - 1, 1 << 31, (1 << 32) - 1])
def test_numbers_at_the_edges_of_their_sizes(value: int) -> None:
    assert vlq(value) == twin.vlq_encode(value)
    assert vlq_read(vlq(value), 0) == (value & 0xFFFFFFFF, len(vlq(value)))


@given(NUMBERS, st.binary(max_size=3))
def test_every_number(value: int, behind: bytes) -> None:
    encoded = vlq(value)
    assert encoded == twin.vlq_encode(value)
    assert vlq_read(encoded + behind, 0) == (value & 0xFFFFFFFF, len(encoded))


@given(st.binary(max_size=8))
def test_garbage_as_a_number(data: bytes) -> None:
    expected = twin.vlq_decode(data)
    assert vlq_read(data, 0) == (expected and (expected[0], len(data) - len(expected[1])))


@given(st.binary(max_size=80))
def test_checksum(data: bytes) -> None:
    assert lib.wire_crc16(data, len(data)) == twin.crc16(data)


@given(
    st.lists(st.sampled_from(sorted(CODES)), min_size=1, max_size=5),
    st.binary(min_size=1, max_size=3),
    st.binary(max_size=24),
)
def test_garbage_as_values(codes: list[str], before: bytes, data: bytes) -> None:
    expected = twin.decode_values(codes, data)
    format_ = MessageFormat("garbage", 7, [f"p{i}" for i in range(len(codes))], codes)
    found = format_.read_values(before + data, len(before))
    assert (found is None) == (expected is None)
    if found is None or expected is None:
        return
    values, end = found
    assert end == len(before) + len(data) - len(expected[1])
    assert [v if isinstance(v, bytes) else v & 0xFFFFFFFF for v in values] == [
        v if isinstance(v, bytes) else v & 0xFFFFFFFF for v in expected[0]
    ]


@given(st.lists(st.sampled_from(sorted(CODES)), max_size=5), st.binary(max_size=24))
def test_garbage_as_parameters(codes: list[str], data: bytes) -> None:
    expected = twin.decode_values(codes, data)
    types = ffi.new("uint8_t[]", bytes(CODES[code].wire_type for code in codes) or b"\0")
    args = ffi.new("struct wire_arg[]", max(1, len(codes)))
    held = ffi.from_buffer("uint8_t[]", data)
    cursor = ffi.new("const uint8_t *[1]", [held + 0])
    result = lib.wire_unpack(types, len(codes), cursor, held + len(data), args)
    assert (result == 0) == (expected is not None)
    if expected is None:
        return
    assert cursor[0] - held == len(data) - len(expected[1])
    for code, arg, value in zip(codes, args, expected[0], strict=False):
        if isinstance(value, bytes):
            assert bytes(ffi.buffer(arg.data, arg.value)) == value
        else:
            assert arg.value == value & 0xFFFFFFFF, code


def scan_all(stream: bytes, chunk: int) -> tuple[list[bytes], int]:
    """Feed STREAM to the C scanner CHUNK bytes at a time; returns contents found and losses."""
    scanner = ffi.new("struct wire_scanner *")
    skip, length = ffi.new("size_t *"), ffi.new("size_t *")
    buffered, found, losses = b"", [], 0
    for start in range(0, len(stream), chunk):
        buffered += stream[start : start + chunk]
        while True:
            scan = lib.wire_scan(scanner, buffered, len(buffered), skip, length)
            whole = buffered[skip[0] : skip[0] + length[0]]
            buffered = buffered[skip[0] + length[0] :]
            if scan == lib.WIRE_BLOCK:
                found.append(whole[2:-3])
            elif scan == lib.WIRE_LOST:
                losses += 1
            else:
                break
        assert len(buffered) < lib.WIRE_BLOCK_MAX
    return found, losses


PIECES = st.one_of(
    st.builds(twin.block, st.integers(0, 15), st.binary(max_size=59)),
    st.binary(max_size=20),
    st.just(b"\x7e"),
)


@given(st.lists(PIECES, max_size=6).map(b"".join), st.integers(1, 70))
def test_a_damaged_stream_in_any_pieces(stream: bytes, chunk: int) -> None:
    expected, losses, _ = twin.blocks(stream)
    assert scan_all(stream, max(1, len(stream))) == ([b.content for b in expected], losses)
    # How the stream is cut changes neither what is found nor, a trailing damage apart, what is lost.
    found, lost = scan_all(stream, chunk)
    assert found == [b.content for b in expected]
    assert abs(lost - losses) <= 1


@given(st.integers(0, 1 << 20), st.binary(max_size=59))
def test_blocks(sequence: int, content: bytes) -> None:
    out = ffi.new("uint8_t[]", lib.WIRE_BLOCK_MAX)
    ffi.memmove(out + lib.WIRE_HEADER, content, len(content))
    size = lib.wire_block_finish(out, len(content), sequence)
    assert bytes(ffi.buffer(out, size)) == twin.block(sequence, content)
