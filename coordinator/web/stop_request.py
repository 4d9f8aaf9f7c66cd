"""The emergency stop as one HTTP request, for a page whose WebSocket is not open.

A WebSocket needs answers before a stop can be sent on it. This request needs none: all that it takes to judge
it comes with it. While the loop is held, the stop lane reads it where it waits (docs/adr/0016-stop-path.md).
"""

import asyncio
import json
from dataclasses import dataclass
from typing import Any, Final

from aiohttp.base_protocol import BaseProtocol
from aiohttp.http import HttpProcessingError, HttpRequestParser
from multidict import MultiMapping

STOP_PATH: Final = "/emergency-stop"
BODY_BYTES_MAX: Final = 1_024
REQUEST_BYTES_MAX: Final = 16_384
"""What is looked at of a connection while the loop is held."""
_END_OF_HEAD: Final = b"\r\n\r\n"
_BEGIN: Final = f"POST {STOP_PATH} ".encode()


@dataclass(frozen=True, slots=True)
class StopBody:
    """What the body of the request says."""

    key: str
    """Of the browser's session."""
    params: dict[str, Any]
    """Of ``machine.emergency_stop``."""


def parse_request(data: bytes, loop: asyncio.AbstractEventLoop) -> tuple[MultiMapping[str], bytes] | None:
    """Return headers and body of the stop that DATA begins with; None if it begins with anything else.

    In any thread: LOOP is not used, though the parser needs to have it. The head goes to the parser with
    which LOOP's server reads what comes, so that both understand it in the same way. The parser gets no body:
    it would want to slow down the connection, which it does not have.
    """
    if not data.startswith(_BEGIN):
        return None
    head, end, rest = data[:REQUEST_BYTES_MAX].partition(_END_OF_HEAD)
    if not end:
        return None
    parser = HttpRequestParser(BaseProtocol(loop), loop, REQUEST_BYTES_MAX)
    try:
        ((message, _),), _, _ = parser.feed_data(head + end)
        size = int(message.headers.get("Content-Length", ""))
    except (HttpProcessingError, ValueError):
        return None
    if message.chunked or not 0 <= size <= min(len(rest), BODY_BYTES_MAX):
        return None
    return message.headers, rest[:size]


def read_body(body: bytes) -> StopBody | None:
    """Return what BODY says; None if that is no stop."""
    try:
        given: Any = json.loads(body)
    except (ValueError, RecursionError):
        return None
    if not isinstance(given, dict) or type(given.get("key")) is not str:
        return None
    return StopBody(given["key"], {"who": given["who"]} if "who" in given else {})
