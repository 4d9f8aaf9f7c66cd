"""A board on a serial line that answers every block, but whose dictionary is garbage."""

import os
import pty
import threading
import tty
from typing import Self

from tests.wire_twin import block, blocks, encode_message, vlq_decode

GARBAGE = bytes(range(7, 250, 3)) * 3


class GarbageNode:
    """Runs in a thread of its own between ``with`` and its end; ``path`` is the serial device."""

    def __enter__(self) -> Self:
        self._end, self._other = pty.openpty()
        tty.setraw(self._other)
        self.path = os.ttyname(self._other)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over = True
        os.write(self._other, b"\x00")  # wakes the reader, which sees that it is over
        self._thread.join()
        os.close(self._other)
        os.close(self._end)

    _over = False

    def _serve(self) -> None:
        stream = b""
        while not self._over:
            stream += os.read(self._end, 4096)
            found, _, stream = blocks(stream)
            for each in found:
                os.write(self._end, self._answer(each.sequence, each.content))

    def _answer(self, sequence: int, content: bytes) -> bytes:
        """Acknowledge, and answer identify (1) with a piece of GARBAGE in identify_response (0)."""
        following = sequence + 1
        ack = block(following, b"")
        number = vlq_decode(content)
        if number is None or number[0] != 1:
            return ack
        offset = vlq_decode(number[1])
        assert offset is not None
        count = vlq_decode(offset[1])
        assert count is not None
        piece = GARBAGE[offset[0] : offset[0] + count[0]]
        return ack + block(following, encode_message(0, ["%u", "%.*s"], [offset[0], piece]))
