"""Random bytes on the ways into a service that live_visits.py does not know.

Usage: python -m tests.fuzz.live_noise FOLDER PAGE TLS METRICS FD SEED; ends with its standard input, and is
quiet from a line ``rest`` there to a line ``go``. PAGE,
TLS and METRICS are ports, PAGE several with commas between; FD is the file descriptor of the terminal.
What is sent is bytes, requests of HTTP and parts of them, beginnings of TLS, lines of nonsense, hundreds of
empty ones at once, and uploads that are broken off. Prints one JSON line: how many bursts came on each way.
"""

import json
import os
import random
import select
import socket
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from tests.fuzz.ipc_target import line

PAUSE_S: Final = 0.01
"""Between two bursts."""
LETTERS: Final = b"abcxyz0189 =;#(\t\x00\x7f\xc3\n"
"""No command of any machine, and no stop, is made of them."""
REQUESTS: Final = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    (
        b"GET /socket HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    ),
    b'POST /login HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 20\r\n\r\n{"token":"abcdefgh"}',
    (
        b"POST /emergency-stop HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://127.0.0.1\r\n"
        b'Cookie: canductor-8080=x\r\nContent-Length: 19\r\n\r\n{"key":"abcdefghi"}'
    ),
    b"PUT /../../etc/passwd HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\nffffffff\r\n",
)
CLIENT_HELLO: Final = b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"
NAMES: Final = ("a.gcode", "../a.gcode", "", "a" * 300 + ".gcode", "\x1b[2J.gcode", "tokens", "b.gco", "/a.g")


def main() -> None:
    """Make noise until standard input ends."""
    folder, seed = Path(sys.argv[1]), int(sys.argv[6])
    pages = [int(port) for port in sys.argv[2].split(",")]
    tls, metrics, terminal_fd = (int(given) for given in sys.argv[3:6])
    chance, counts = random.Random(seed), Counter[str]()

    def some(size: int) -> bytes:
        return chance.randbytes(chance.randrange(1, size))

    def nonsense() -> bytes:
        if chance.random() < 0.05:
            return chance.choice((b"\n", b";\n")) * chance.randrange(1, 1500)
        return bytes(chance.choices(LETTERS, k=chance.randrange(1, 80))) + b"\n"

    def request() -> bytes:
        data = bytearray(chance.choice(REQUESTS))
        if chance.random() < 0.5:
            data[chance.randrange(len(data))] = chance.randrange(256)
        return bytes(data[: chance.randrange(1, len(data) + 1)])

    def upload() -> bytes:
        params = {
            "file": chance.choice(NAMES),
            "offset": chance.choice((0, 1, 5, -1, 2**40)),
            "text": "x" * chance.randrange(3000),
            "done": chance.random() < 0.3,
            "replace": chance.random() < 0.5,
        }
        return line({"id": 2, "method": "job.upload", "params": params})

    def uploads() -> bytes:
        hello = {"id": 1, "method": "api.hello", "params": {"version": 1, "client": "noise"}}
        data = line(hello) + b"".join(upload() for _ in range(chance.randrange(1, 5)))
        return data[: len(data) - chance.choice((0, 0, chance.randrange(1, 50)))]

    def visit(address: str | tuple[str, int], data: bytes) -> None:
        kind = socket.AF_UNIX if isinstance(address, str) else socket.AF_INET
        with suppress(OSError), socket.socket(kind) as opened:  # it is cut off
            opened.settimeout(0.2)
            opened.connect(address)
            opened.sendall(data)
            if chance.random() < 0.5:
                opened.recv(1 << 16)

    def host() -> None:
        with suppress(OSError):
            opened = os.open(folder / "host.pty", os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
            with suppress(BlockingIOError):
                os.write(opened, nonsense())
            os.close(opened)

    def terminal() -> None:
        with suppress(BlockingIOError):
            os.write(terminal_fd, nonsense())

    ways: Mapping[str, Callable[[], None]] = {
        "Klippy API": lambda: visit(str(folder / "klippy.sock"), some(3000) + b"\x03"),
        "terminal": terminal,
        "serial host": host,
        "page": lambda: visit(("127.0.0.1", chance.choice(pages)), request()),
        "TLS": lambda: visit(("127.0.0.1", tls), chance.choice((CLIENT_HELLO, b"")) + some(700)),
        "metrics": lambda: visit(("127.0.0.1", metrics), request()),
        "uploads": lambda: visit(str(folder / "api.sock"), uploads()),
    }
    os.set_blocking(terminal_fd, False)
    while True:
        order = b"go"
        while order == b"rest" or select.select([sys.stdin], [], [], PAUSE_S)[0]:
            order = b"".join(os.read(sys.stdin.fileno(), 4096).split()[-1:])  # what was said last counts
            if not order:
                sys.stdout.write(json.dumps(counts) + "\n")
                return
        way = chance.choice(list(ways))
        ways[way]()
        counts[way] += 1


if __name__ == "__main__":
    main()
