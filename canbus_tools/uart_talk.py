"""Talking to the node at the other end of a UART, as ``talk`` does on a bus."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

from canbus_tools.talk import NodeTalk
from nodes.dictionary_cache import DictionaryCache
from nodes.link import LinkIO
from nodes.transport import BAUD_DEFAULT, ByteTransport, open_uart


class UartLine:
    """An open UART, and why it ended."""

    def __init__(self, transport: ByteTransport) -> None:
        self.closed_because: str | None = None
        self.name = f"UART {transport.name}"


@contextlib.asynccontextmanager
async def open_uart_talk(
    path: str | Path, baud: int = BAUD_DEFAULT, cache: DictionaryCache | None = None
) -> AsyncIterator[NodeTalk]:
    """Open the serial device at PATH for this program alone, and talk to its node; raises CanductorError."""
    with contextlib.closing(open_uart(path, baud)) as transport:
        line = UartLine(transport)
        talk = NodeTalk(line, None)

        def ended(sentence: str) -> None:
            line.closed_because = sentence
            talk.lost(sentence)

        with contextlib.closing(LinkIO(transport, asyncio.get_running_loop(), on_closed=ended)) as io:
            try:
                talk.connect(io)
                await talk.identify(cache if cache is not None else DictionaryCache.of_user())
                yield talk
            finally:
                talk.close()
