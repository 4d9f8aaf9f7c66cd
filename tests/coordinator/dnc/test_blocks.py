import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.dnc.protocol.blocks import (
    INPUT,
    OUTPUT,
    SOH,
    STX,
    BadText,
    Header,
    block_check,
    is_text,
    read_header,
    strip_text,
    write_block,
)

texts = st.binary(max_size=80).map(lambda t: bytes(c for c in t if c >= 0x20 and c != 0x7F))


@pytest.mark.parametrize(
    ("data", "check"),
    [
        (bytes.fromhex("014831354517"), 0x1F),
        (b"\x01LPPPA\x17", 0x4B),
        (b"\x020 BEGIN PGM 1 MM\r\n\x17", 0x0E),
    ],
)
def test_check_character(data: bytes, check: int) -> None:
    assert block_check(data) == check
    assert write_block(data[0], data[1:-1]) == data + bytes([check])


def test_avoiding_control_characters() -> None:
    block = write_block(STX, b"0 BEGIN PGM 1 MM\r\n", avoid_control=True, dc1=True)
    assert block == b"\x020 BEGIN PGM 1 MM\r\n \x17\x2e\x11"
    assert write_block(SOH, b"LPPPA", avoid_control=True) == b"\x01LPPPA\x17\x4b"
    header = write_block(SOH, b"H15E", avoid_control=True)
    assert header == b"\x01H15E \x17\x3f"
    assert read_header(header[1:-2]) == Header("H", "15", INPUT)


@given(texts, st.booleans())
def test_what_is_stuffed_is_taken_off_and_nothing_else(text: bytes, avoid: bool) -> None:
    block = write_block(STX, text + b"\r\n", avoid_control=avoid)
    assert strip_text(block[1:-2], block[-1], avoid_control=avoid) == text
    assert not avoid or block[-1] >= 0x20


@pytest.mark.parametrize("text", [b"X1 ", b"X1  ", b" ", b"X1"])
def test_blocks_without_line_ends(text: bytes) -> None:
    """A foreign sender's: their own last space stays, a stuffed one goes."""
    block = write_block(STX, text)
    assert strip_text(block[1:-2], block[-1], avoid_control=False) == text
    stuffed = write_block(STX, text, avoid_control=True)
    if len(stuffed) > len(block):
        assert strip_text(stuffed[1:-2], stuffed[-1], avoid_control=True) == text


@given(st.sampled_from("HDLSMPT%x"), st.from_regex(r"[A-Za-z0-9_.]{0,20}", fullmatch=True))
def test_header_there_and_back(code: str, name: str) -> None:
    for mode in (INPUT, OUTPUT):
        header = Header(code, name, mode)
        assert read_header(header.to_content()) == header
        assert read_header(header.to_content() + b"\r\n") == header
        assert read_header(header.to_content() + b"\r\n ") == header


@pytest.mark.parametrize(
    "content", [b"", b"H", b"H15", b"H15X", b"\xc415E", b"115E", b"H1\x075E", b"H" + b"1" * 70 + b"E"]
)
def test_no_headers(content: bytes) -> None:
    assert read_header(content) is None


@pytest.mark.parametrize("content", [b"A\tB", b"A\rB", b"A\nB", b"A\x7f", b"A\x00"])
def test_what_no_block_carries(content: bytes) -> None:
    assert not is_text(content)
    assert not is_text(content + b"\r\n")


def test_seven_bits() -> None:
    assert is_text(b"\xc4\r\n", 8)
    assert not is_text(b"\xc4\r\n", 7)
    assert is_text(b"A\r\nB\r\n", 7)


@pytest.mark.parametrize(
    ("code", "name"), [("", "A"), ("HH", "A"), ("1", "A"), ("H", "A\n"), ("H", "A" * 65), ("H", " A")]
)
def test_bad_headers_are_told(code: str, name: str) -> None:
    with pytest.raises(BadText):
        Header(code, name, INPUT)
