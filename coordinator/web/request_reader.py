"""Takes whole requests from what an HTTP client sends, and refuses what the page has no use for; sans-IO.

aiohttp parses a body as it comes, whether or not anybody wants it, and a body in chunks of one byte costs
thousands of times what it weighs. So aiohttp gets one request at a time, whole, and only if it is small.
"""

import re
from dataclasses import dataclass
from http import HTTPStatus
from typing import Final

HEAD_BYTES_MAX: Final = 16_384
"""Of the request's line and headers; browsers send the cookies of all programs on the computer."""
BODY_BYTES_MAX: Final = 4_096
"""The longest body that the page sends has a token in it."""
_END_OF_HEAD: Final = b"\r\n\r\n"
_ENCODED: Final = re.compile(rb"[\r\n][ \t]*(?:transfer|content)-encoding[ \t]*:", re.IGNORECASE)
_LENGTH: Final = re.compile(rb"[\r\n][ \t]*content-length[ \t]*:([^\r\n]*)", re.IGNORECASE)
_DIGITS: Final = re.compile(rb"[0-9]{1,9}")


@dataclass(frozen=True, slots=True)
class HttpRefusal:
    """Why a request is not even parsed."""

    status: HTTPStatus
    sentence: str


class RequestReader:
    """What a client has sent and aiohttp has not got."""

    def __init__(self) -> None:
        self.waiting = bytearray()

    def next_request(self) -> bytes | HttpRefusal | None:
        """Take the next request, head and body; None: it is not there as a whole."""
        del self.waiting[: len(self.waiting) - len(self.waiting.lstrip(b"\r\n"))]  # as aiohttp's parser does
        end = self.waiting.find(_END_OF_HEAD, 0, HEAD_BYTES_MAX)
        if end < 0:
            return _TOO_LONG_HEAD if len(self.waiting) >= HEAD_BYTES_MAX else None
        end += len(_END_OF_HEAD)
        size = _body_size(bytes(self.waiting[:end]))
        if isinstance(size, HttpRefusal):
            return size
        if len(self.waiting) < end + size:
            return None
        request = bytes(self.waiting[: end + size])
        del self.waiting[: end + size]
        return request


_TOO_LONG_HEAD: Final = HttpRefusal(
    HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, f"headers have less than {HEAD_BYTES_MAX:,} bytes here"
)
_BAD_LENGTH: Final = HttpRefusal(HTTPStatus.BAD_REQUEST, "Content-Length must be one number")
_TOO_LONG_BODY: Final = HttpRefusal(
    HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a body has at most {BODY_BYTES_MAX:,} bytes here"
)
_ENCODED_BODY: Final = HttpRefusal(
    HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "a body is neither encoded nor in chunks here; send Content-Length"
)


def _body_size(head: bytes) -> int | HttpRefusal:
    """Return how many bytes follow HEAD, as any parser of HTTP would find; or why they are not taken."""
    if _ENCODED.search(head):
        return _ENCODED_BODY
    lengths = [length.strip() for length in _LENGTH.findall(head)]
    if not lengths:
        return 0
    if len(lengths) > 1 or not lengths[0].isdigit():
        return _BAD_LENGTH
    if not _DIGITS.fullmatch(lengths[0]) or int(lengths[0]) > BODY_BYTES_MAX:
        return _TOO_LONG_BODY
    return int(lengths[0])
