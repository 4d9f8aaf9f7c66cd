"""Elements of the protocol: characters, block check, headers and blocks of text."""

from dataclasses import dataclass
from typing import Final

from nodes.support.errors import CanductorError

SOH: Final = 0x01
STX: Final = 0x02
ETX: Final = 0x03
EOT: Final = 0x04
ACK: Final = 0x06
LF: Final = 0x0A
CR: Final = 0x0D
DC1: Final = 0x11
DC3: Final = 0x13
NAK: Final = 0x15
ETB: Final = 0x17
ESC: Final = 0x1B
SPACE: Final = 0x20

CRLF: Final = b"\r\n"
DIRECTORY_REQUEST: Final = bytes((DC3, ESC, DC1)) + b"0 D" + CRLF
"""Request for the directory, as of the FE 401."""
NAME_MAX: Final = 64
"""Characters of a file's name in a header."""
INPUT: Final = "E"
"""Mode of a header: the control requests the file."""
OUTPUT: Final = "A"
"""Mode of a header: the control sends the file."""
CODES: Final = {
    "H": "dialog program",
    "D": "ISO program",
    "L": "pallet table",
    "S": "axis-correction table",
    "M": "machine parameters",
    "P": "PLC program",
    "T": "tool table",
}
"""File codes known by name; any other letter is transferred as well."""


class BadText(CanductorError):  # noqa: N818 (the message is about a text)
    """A text that cannot be sent in a block."""


def block_check(data: bytes | bytearray) -> int:
    """Return the XOR of all characters, parity not included.

    >>> hex(block_check(bytes.fromhex("014831354517")))
    '0x1f'
    """
    value = 0
    for character in data:
        value ^= character
    return value


def write_block(start: int, content: bytes, *, avoid_control: bool = False, dc1: bool = False) -> bytes:
    """Return START content ETB BCC [DC1].

    AVOID_CONTROL: insert a space before ETB if the check character would be below 20 hex.
    """
    body = bytes((start,)) + content + bytes((ETB,))
    check = block_check(body)
    if avoid_control and check < SPACE:
        body = body[:-1] + bytes((SPACE, ETB))
        check ^= SPACE
    return body + bytes((check, DC1) if dc1 else (check,))


def strip_text(content: bytes, check: int, *, avoid_control: bool) -> bytes:
    """Return the line in a block's content: without one stuffed space, then without CR LF.

    A space after CR LF is always stuffed. Without CR LF it is if the option is on and CHECK, the check
    character, would have been a control character without it.
    """
    if content.endswith(CRLF + b" ") or (
        avoid_control and content.endswith(b" ") and check ^ SPACE < SPACE and not content.endswith(CRLF)
    ):
        content = content[:-1]
    return content.removesuffix(CRLF)


def is_text(content: bytes, data_bits: int = 8) -> bool:
    """Return whether CONTENT may be sent: it has no control characters except CR LF pairs."""
    bare = content.replace(CRLF, b"")
    return not any(c < SPACE or c == 0x7F or (data_bits == 7 and c > 0x7F) for c in bare)


@dataclass(frozen=True, slots=True)
class Header:
    """File and direction of a transfer. An empty NAME requests the next file."""

    code: str
    """One letter: what kind of file."""
    name: str
    mode: str
    """INPUT or OUTPUT, as seen by the control."""

    def __post_init__(self) -> None:
        """Check; raises BadText."""
        if len(self.code) != 1 or not (self.code.isascii() and (self.code.isalpha() or self.code == "%")):
            raise BadText(f"the file code is {self.code!r}, must be one letter such as H, D or S")
        if len(self.name) > NAME_MAX or not (self.name.isascii() and self.name.isprintable()):
            raise BadText(
                f"{self.name[:NAME_MAX]!a} is not a valid name for the other side: at most"
                f" {NAME_MAX} ASCII characters"
            )
        if self.name != self.name.strip():
            raise BadText(f"{self.name!a} begins or ends with a space; a name must not")
        if self.mode not in (INPUT, OUTPUT):
            raise BadText(f"a header's mode is {self.mode!r}, must be {INPUT} or {OUTPUT}")

    def to_content(self) -> bytes:
        """Return the characters between SOH and ETB."""
        return f"{self.code}{self.name}{self.mode}".encode("ascii")


def read_header(content: bytes) -> Header | None:
    """Return the header in CONTENT, or None: one stuffed space goes first, then CR LF, then the mode."""
    bare = content.removesuffix(b" ").removesuffix(CRLF)
    try:
        text = bare.decode("ascii")
        return Header(text[:1], text[1:-1], text[-1:]) if len(text) >= 2 else None
    except (UnicodeDecodeError, BadText):
        return None
