"""A stand-in for a serial CAN adapter: speaks slcan (LAWICEL) at a pseudo-terminal, and CAN on an interface.

It runs as a process of its own, as an adapter is a computer of its own: ``python slcan_adapter.py vcan1``.
It prints the pseudo-terminal's path when it is ready, and its counters on SIGTERM (``ChildProcess``).
"""

import json
import os
import select
import signal
import socket
import struct
import sys
import tty
from collections.abc import Mapping
from types import FrameType

RECORD = struct.Struct("=IB3x8s")
SPEED_1_MBIT = b"S8"
BELL = b"\a"
"""Its answer to what it does not understand."""


class Adapter:
    """Its state; bytes and frames go in, bytes and frames come out."""

    def __init__(self) -> None:
        self.is_open = False
        self.counts = {"to_bus": 0, "from_bus": 0, "refused": 0}
        self._line = b""

    def take(self, received: bytes) -> tuple[bytes, list[bytes]]:
        """Return what to answer, and the records to send, for bytes of the host."""
        *lines, self._line = (self._line + received).split(b"\r")
        answers = b""
        records = []
        for line in lines:
            record = self._record(line)
            if record is not None:
                records.append(record)
            answers += b"z\r" if record is not None else self._obey(line)
        self.counts["to_bus"] += len(records)
        return answers, records

    def show(self, record: bytes) -> bytes:
        """Return what to tell the host of a frame on the bus."""
        if not self.is_open:
            return b""
        self.counts["from_bus"] += 1
        can_id, size, data = RECORD.unpack(record)
        return b"t%03X%d%b\r" % (can_id, size, data[:size].hex().upper().encode())

    def _record(self, line: bytes) -> bytes | None:
        if not self.is_open or not line.startswith(b"t") or len(line) < 5:
            return None
        try:
            data = bytes.fromhex(line[5:].decode())
            can_id, size = int(line[1:4], 16), int(line[4:5])
        except ValueError:
            return None
        return RECORD.pack(can_id, size, data) if size == len(data) <= 8 else None

    def _obey(self, line: bytes) -> bytes:
        match line[:1]:
            case b"":
                return b"\r"
            case b"S" if line == SPEED_1_MBIT and not self.is_open:
                return b"\r"
            case b"O" | b"C":
                self.is_open = line[:1] == b"O"
                return b"\r"
            case b"F" if self.is_open:
                return b"F00\r"
            case b"V" | b"N":
                return line + b"0101\r"
        self.counts["refused"] += 1
        return BELL


class Ended(Exception):  # noqa: N818 (it is none)
    """SIGTERM."""


def end(_signal: int, _frame: FrameType | None) -> None:
    raise Ended


def say(values: Mapping[str, object]) -> None:
    sys.stdout.write(json.dumps(values) + "\n")
    sys.stdout.flush()


def main(interface: str) -> None:
    signal.signal(signal.SIGTERM, end)
    host, terminal = os.openpty()
    tty.setraw(terminal)
    adapter = Adapter()
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
        bus.bind((interface,))
        say({"ready": True, "path": os.ttyname(terminal)})
        try:
            while True:
                readable, _, _ = select.select([host, bus.fileno()], [], [])
                if host in readable:
                    answers, records = adapter.take(os.read(host, 4096))
                    for record in records:
                        bus.send(record)
                    os.write(host, answers)
                if bus.fileno() in readable:
                    os.write(host, adapter.show(bus.recv(RECORD.size)))
        except Ended:
            say(adapter.counts)


if __name__ == "__main__":
    main(sys.argv[1])
