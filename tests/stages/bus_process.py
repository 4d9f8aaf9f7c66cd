"""A virtual CAN bus as a process of its own: ``python -m tests.stages.bus_process PATH``."""

import argparse
import json
import signal
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nodes.support.errors import CanductorError
from nodes.virtual.hub import VirtualBus
from nodes.virtual.processes import ChildProcess


class BusProcess(ChildProcess):
    """The virtual bus as a process of its own; stop() returns its BusStats as a dictionary."""

    def __init__(
        self, path: str | Path, *, bitrate: int = 1_000_000, loss: float = 0.0, seed: int = 0
    ) -> None:
        """Start the bus; the arguments are those of VirtualBus."""
        options = ["--bitrate", str(bitrate), "--loss", str(loss), "--seed", str(seed)]
        super().__init__(f"virtual bus {path}", [sys.executable, "-m", __name__, path, *options])


def _parse_arguments(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Run a virtual CAN bus until SIGTERM or SIGINT. Print one JSON line when it is ready and"
        " one with its counters at the end."
    )
    parser.add_argument("path", metavar="PATH", help="Unix socket to which clients connect")
    parser.add_argument("--bitrate", type=int, default=1_000_000, help="bit/s; 0: no limit")
    parser.add_argument("--loss", type=float, default=0.0, help="share of frames that reach nobody")
    parser.add_argument("--seed", type=int, default=0, help="decides which frames are lost")
    return parser.parse_args(arguments)


def _print_json(value: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(value) + "\n")
    sys.stdout.flush()


def main(arguments: list[str]) -> int:
    """Run the bus; return the exit status."""
    options = _parse_arguments(arguments)
    ending = {signal.SIGTERM, signal.SIGINT}
    signal.pthread_sigmask(signal.SIG_BLOCK, ending)  # before the thread starts, which inherits it
    try:
        bus = VirtualBus(options.path, bitrate=options.bitrate, loss=options.loss, seed=options.seed).start()
        _print_json({"ready": True, "address": bus.address})
        while bus.running and signal.sigtimedwait(ending, 0.5) is None:
            pass
        bus.close()
    except CanductorError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    _print_json(asdict(bus.stats))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
