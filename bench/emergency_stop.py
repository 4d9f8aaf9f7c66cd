"""From the emergency stop's last byte to the pin of a virtual node: with the loop free, and held.

The loop is held by a function that waits, and by one that calculates: alone, and with many clients.
"""

import contextlib
import json
import socket
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from coordinator.ipc.client.blocking import BlockingClient
from tests.stages.held_service import HeldService, serve_held, stopped_after_ms

ROUNDS = 6
CLIENTS = 100
STOP = json.dumps({"id": 1, "method": "emergency_stop"}).encode() + b"\x03"


def stop(held: HeldService) -> int:
    """Stop the machine by the Klippy API's socket; return when that was sent (CLOCK_MONOTONIC, ns)."""
    with socket.socket(socket.AF_UNIX) as opened:
        opened.connect(str(held.klippy_socket))
        sent_ns = time.monotonic_ns()
        opened.sendall(STOP)
        held.wait_for(lambda: not held.fan_turns, "the fan is off")
    return sent_ns


@contextlib.contextmanager
def clients(held: HeldService, count: int) -> Iterator[None]:
    """Have COUNT clients."""
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            stack.enter_context(BlockingClient(str(held.socket)))
        yield


def main() -> None:
    sent: dict[str, list[int]] = {}

    def rounds(held: HeldService) -> None:
        held.ready()
        for _ in range(ROUNDS):
            for what, count, hold in (
                ("the loop is free", 0, contextlib.nullcontext()),
                ("it waits", 0, held.held()),
                ("it calculates", 0, held.held(calculating=True)),
                (f"it calculates, {CLIENTS} clients", CLIENTS, held.held(calculating=True)),
            ):
                with clients(held, count):
                    with hold:
                        sent.setdefault(what, []).append(stop(held))
                    held.restart()

    with tempfile.TemporaryDirectory() as name:
        serve_held(Path(name), rounds)
        for what, times in sent.items():
            taken_ms = stopped_after_ms(Path(name), times)
            print(
                f"{what:<26} n {len(taken_ms)}, median {statistics.median(taken_ms):6.2f} ms,"
                f" worst {max(taken_ms):6.2f} ms"
            )


if __name__ == "__main__":
    main()
