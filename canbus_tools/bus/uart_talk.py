"""Talking to the node at the other end of a UART, as ``talk`` does on a bus."""

import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

from canbus_tools.bus.computer import Computer
from canbus_tools.bus.talk import NodeTalk
from nodes.dictionary.cache import DictionaryCache
from nodes.transport import BAUD_DEFAULT


class UartLine:
    """An open UART, and why it ended."""

    def __init__(self, name: str) -> None:
        self.closed_because: str | None = None
        self.name = f"UART {name}"


@contextlib.asynccontextmanager
async def open_uart_talk(
    computer: Computer, path: str | Path, baud: int = BAUD_DEFAULT, cache: DictionaryCache | None = None
) -> AsyncIterator[NodeTalk]:
    """Open the serial device at PATH for this program alone, and talk to its node; raises CanductorError."""
    with contextlib.closing(computer.open_uart(path, baud)) as port:
        line = UartLine(port.name)
        talk = NodeTalk(line, None)

        def ended(sentence: str) -> None:
            line.closed_because = sentence
            talk.lost(sentence)

        with contextlib.closing(port.start_io(on_closed=ended)) as io:
            try:
                talk.connect(io)
                await talk.identify(cache if cache is not None else DictionaryCache.of_user())
                yield talk
            finally:
                talk.close()
