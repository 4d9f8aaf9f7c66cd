"""From the emergency stop's last byte to the pin of a virtual node: with the loop free, and held."""

import json
import socket
import statistics
import tempfile
import time
from pathlib import Path

from nodes.virtual.edge_log import EdgeLog
from nodes.virtual.firmware import firmware_dictionary
from tests.stages.held_service import NODE, HeldService, serve_held

ROUNDS = 6
PIN = "PB2"
STOP = json.dumps({"id": 1, "method": "emergency_stop"}).encode() + b"\x03"


def stop(held: HeldService) -> int:
    """Stop the machine by the Klippy API's socket; return when that was sent (CLOCK_MONOTONIC, ns)."""
    with socket.socket(socket.AF_UNIX) as opened:
        opened.connect(str(held.klippy_socket))
        sent_ns = time.monotonic_ns()
        opened.sendall(STOP)
        held.wait_for(lambda: not held.fan_turns, "the fan is off")
    return sent_ns


def main() -> None:
    sent: dict[str, list[int]] = {"the loop is free": [], "the loop is held": []}
    free, held_ns = sent.values()

    def rounds(held: HeldService) -> None:
        held.ready()
        for _ in range(ROUNDS):
            free.append(stop(held))
            held.restart()
            with held.held():
                held_ns.append(stop(held))
            held.restart()

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        serve_held(folder, rounds)
        log = EdgeLog(folder / f"{NODE}.edges")
        pin = firmware_dictionary("canductor-node-toolhead").enumerations["pin"].values[PIN]
        off = [
            int(at_ns)
            for clocks, _, levels in log.edges(pin)
            for at_ns, level in zip(log.ticks_to_monotonic_ns(clocks), levels, strict=True)
            if not level
        ]
        for what, times in sent.items():
            taken_ms = [min(at - sent_ns for at in off if at > sent_ns) / 1e6 for sent_ns in times]
            print(
                f"{what:<18} n {len(taken_ms)}, median {statistics.median(taken_ms):6.2f} ms,"
                f" worst {max(taken_ms):6.2f} ms"
            )


if __name__ == "__main__":
    main()
