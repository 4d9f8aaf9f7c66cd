"""Stops a machine that prints, again and again, while fuzzers are at all of its ways in; takes the times.

Usage, from the project's root: python -m tests.fuzz.live_stops [--minutes M] [--seed N]

A service on virtual nodes prints. All the time clients that are random, wrong, slow or rude come and go
on the Unix socket and TCP (live_visits.py), and random bytes come on the Klippy API's socket and at the
terminal. Every few seconds, as fast as the machine restarts and moves again, an emergency stop is sent by
the next way in, by turns while the control loop is free and while it is held; a plain restart follows.
Each time is from before the stop's last bytes are sent to the edge of the node's pin. A stop that has no
effect, names another cause, or a restart that fails ends the program with status 1; times are printed
beside their bounds, for a busy computer may be late itself.
"""

import argparse
import contextlib
import json
import os
import random
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from coordinator.ipc.client.blocking import BlockingClient
from coordinator.ipc.protocol.limits import Limits
from coordinator.ipc.protocol.methods import ApiError, Registry, Scope
from coordinator.ipc.server.server import IpcServer
from coordinator.ipc.server.settings import IpcSettings, TcpSettings
from coordinator.service.api.methods import add_methods
from nodes.virtual.edge_log import EdgeLog
from nodes.virtual.firmware import firmware_dictionary
from tests.fuzz.ipc_target import line
from tests.fuzz.live import ROOT
from tests.fuzz.proved_service import ADMIN_TOKEN, WATCH_TOKEN
from tests.stages.held_service import NODE, HeldService, serve_held

PIN: Final = "PB2"
FREE_MS, HELD_MS = 10.0, 50.0
"""Bounds of the time to the node's pin, with the loop free and held."""
NOISE_S: Final = 0.02
"""Between two bursts of random bytes."""
PROGRAM: Final = "SET_KINEMATIC_POSITION X=100 Y=100 Z=10\n" + "G1 X20 F3000\nG1 X180\n" * 500


@dataclass(frozen=True, slots=True)
class Stop:
    """One emergency stop."""

    way: str
    held: bool
    sent_ns: int
    """CLOCK_MONOTONIC."""


@dataclass
class Found:
    """What came out."""

    stops: list[Stop] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)


class FuzzedService(HeldService):
    """Also lets in whoever comes, to watch."""

    port: int

    @asynccontextmanager
    async def interfaces(self) -> AsyncIterator[None]:
        """Serve on all ways in."""
        tokens = self.folder / "tokens"
        tokens.touch(0o600)
        tokens.write_text(f"watch fuzzer {WATCH_TOKEN}\nadmin operator {ADMIN_TOKEN}\n")
        settings = IpcSettings(
            unix_path=self.open_socket,
            unix_scope=Scope.WATCH,
            tcp=TcpSettings(host="127.0.0.1", port=0, tokens=tokens, plain_on_loopback=True),
            limits=Limits(message_timeout_s=1.0),
        )
        async with super().interfaces():
            registry = Registry()
            add_methods(self.service, registry)
            server = IpcServer(registry, self.tree, settings, stop_lane=self.stop_path.lane)
            await server.start()
            assert server.tcp_port is not None
            self.port = server.tcp_port
            try:
                yield
            finally:
                await server.close()

    @property
    def open_socket(self) -> Path:
        """Who comes here may watch."""
        return self.folder / "open.sock"


# ------------------------------------------------------------------------------------------ ways to stop

Send = Callable[[], object]
"""Sends the stop's last bytes."""


def hello(token: str | None = None) -> bytes:
    """Return the first message of a client."""
    params = {"version": 1, "client": "stop"} | ({} if token is None else {"token": token})
    return line({"id": 1, "method": "api.hello", "params": params})


STOP: Final = line({"id": 2, "method": "machine.emergency_stop", "params": {}})


def come(opened: socket.socket, address: str | tuple[str, int], data: bytes) -> None:
    """Connect to ADDRESS and send DATA."""
    opened.connect(address)
    opened.sendall(data)


@contextlib.contextmanager
def unix(held: FuzzedService) -> Iterator[Send]:
    """A connection to the Unix socket that comes with its stop."""
    with socket.socket(socket.AF_UNIX) as opened:
        yield lambda: come(opened, str(held.socket), hello() + STOP)


@contextlib.contextmanager
def unix_open(held: FuzzedService) -> Iterator[Send]:
    """A connection to the Unix socket that is served already."""
    with socket.socket(socket.AF_UNIX) as opened:
        opened.connect(str(held.socket))
        opened.sendall(hello())
        assert opened.recv(1 << 16)
        yield lambda: opened.sendall(STOP)


@contextlib.contextmanager
def tcp(held: FuzzedService) -> Iterator[Send]:
    """A connection over TCP that comes with its token and its stop."""
    with socket.socket() as opened:
        yield lambda: come(opened, ("127.0.0.1", held.port), hello(ADMIN_TOKEN) + STOP)


@contextlib.contextmanager
def klippy(held: FuzzedService, method: str, params: Mapping[str, str]) -> Iterator[Send]:
    """A connection of the Klippy API that comes with its stop."""
    message = json.dumps({"id": 1, "method": method, "params": params}).encode() + b"\x03"
    with socket.socket(socket.AF_UNIX) as opened:
        yield lambda: come(opened, str(held.klippy_socket), message)


@contextlib.contextmanager
def typed(held: FuzzedService) -> Iterator[Send]:
    """A line at the terminal."""
    yield lambda: os.write(held.terminal, b"\nM112\n")


WAYS: Final[Mapping[str, Callable[[FuzzedService], contextlib.AbstractContextManager[Send]]]] = {
    "Unix socket, new": unix,
    "Unix socket, open": unix_open,
    "TCP, new": tcp,
    "Klippy API, emergency_stop": lambda held: klippy(held, "emergency_stop", {}),
    "Klippy API, M112": lambda held: klippy(held, "gcode/script", {"script": "M112"}),
    "terminal, M112": typed,
}


# --------------------------------------------------------------------------------------------- the fuzzing


@contextlib.contextmanager
def visitors(held: FuzzedService, seed: int, found: Found) -> Iterator[None]:
    """Have clients of live_visits.py come and go, in a process of their own."""
    command = [sys.executable, "-m", "tests.fuzz.live_visits", str(held.open_socket), str(held.port)]
    with subprocess.Popen(
        [*command, WATCH_TOKEN, str(seed)], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield
        finally:
            told = json.loads(process.communicate()[0])
            found.counts.update(told["counts"])
            found.problems += told["problems"]


@contextlib.contextmanager
def noise(held: FuzzedService, seed: int, found: Found) -> Iterator[None]:
    """Send random bytes to the Klippy API's socket and to the terminal."""
    chance, over = random.Random(seed), threading.Event()

    def make() -> None:
        while not over.wait(NOISE_S):
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as opened:  # it is cut off
                opened.settimeout(1.0)
                opened.connect(str(held.klippy_socket))
                opened.sendall(chance.randbytes(chance.randrange(1, 3000)) + b"\x03")
            text = bytes(chance.choices(b"abcxyz0189 =;#(\t\x00\x7f\xc3\n", k=chance.randrange(1, 80)))
            os.write(held.terminal, text + b"\n")
            found.counts["bursts of noise"] += 1

    thread = threading.Thread(target=make, name="noise")
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def start_print(held: FuzzedService) -> None:
    """Print; lines that were typed are done before."""
    with BlockingClient(str(held.socket)) as client:

        def started() -> bool:
            try:
                client.call("job.start", {"file": "long.gcode"})
            except ApiError as error:
                if error.code != "busy":
                    raise
                return False
            return True

        held.wait_for(started, "the print begins")
    held.wait_for(lambda: held.service.moves, "it moves")


def stop_again_and_again(held: FuzzedService, minutes: float, found: Found) -> None:
    """Print, stop, restart, for MINUTES."""
    (held.folder / "long.gcode").write_text(PROGRAM, encoding="ascii")
    ends_s, turn = time.monotonic() + 60 * minutes, 0
    while time.monotonic() < ends_s:
        way, hold = list(WAYS)[turn // 2 % len(WAYS)], turn % 2 == 1
        turn += 1
        start_print(held)
        with WAYS[way](held) as send, held.held() if hold else contextlib.nullcontext():
            found.stops.append(Stop(way, hold, time.monotonic_ns()))
            send()
            held.wait_for(lambda: not held.fan_turns, f"the node is stopped by {way}")
        held.wait_for(lambda: held.service.cause != "", "the cause is there")
        cause = held.service.cause
        if not any(word in cause.lower() for word in ("emergency", "m112", "stopped by")):
            found.problems.append(f"stop {turn} by {way}: the cause is {cause!r}")
        held.restart(firmware=False)


# ---------------------------------------------------------------------------------------------- the figures


def times_ms(stops: Sequence[Stop], folder: Path) -> list[float]:
    """Return how long each stop took to the pin of its node."""
    log = EdgeLog(folder / f"{NODE}.edges")
    pin = firmware_dictionary("canductor-node-toolhead").enumerations["pin"].values[PIN]
    off = [
        int(at_ns)
        for clocks, _, levels in log.edges(pin)
        for at_ns, level in zip(log.ticks_to_monotonic_ns(clocks), levels, strict=True)
        if not level
    ]
    return [(min(at for at in off if at > stop.sent_ns) - stop.sent_ns) / 1e6 for stop in stops]


def table(stops: Sequence[Stop], taken_ms: Sequence[float]) -> Iterator[str]:
    """Yield a line for each way in, with the loop free and held."""
    for held, bound_ms in ((False, FREE_MS), (True, HELD_MS)):
        every: list[float] = []
        state = "held" if held else "free"
        for way in WAYS:
            found = [
                ms for stop, ms in zip(stops, taken_ms, strict=True) if (stop.way, stop.held) == (way, held)
            ]
            every += found
            if found:
                yield (
                    f"loop {state}  {way:<27} n {len(found):4}, median {statistics.median(found):6.2f} ms,"
                    f" worst {max(found):6.2f} ms"
                )
        above = sum(ms > bound_ms for ms in every)
        if every:
            yield (f"loop {state}: n {len(every)}, worst {max(every):.2f} ms, {above} above {bound_ms:g} ms")


def verdict(found: Found) -> list[str]:
    """Return what does not hold, in sentences; none of them is about times."""
    wrong = [f"PROBLEM: {sentence}" for sentence in found.problems]
    missing = [
        f"{way} with the loop {'held' if held else 'free'}"
        for way in WAYS
        for held in (False, True)
        if not any((stop.way, stop.held) == (way, held) for stop in found.stops)
    ]
    if missing:
        wrong.append(f"nobody stopped the machine by {', '.join(missing)}; give it more minutes")
    if not found.counts["visits"] or not found.counts["bursts of noise"]:
        wrong.append("no fuzzer came in")
    return wrong


def main() -> int:
    """Fuzz and stop; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    found = Found()

    def test(held: FuzzedService) -> None:
        held.ready()
        with visitors(held, given.seed, found), noise(held, given.seed, found):
            stop_again_and_again(held, given.minutes, found)

    begun_s = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        serve_held(Path(name), test, FuzzedService)
        taken_ms = times_ms(found.stops, Path(name))
    for row in table(found.stops, taken_ms):
        sys.stdout.write(row + "\n")
    load = " ".join(f"{value:.1f}" for value in os.getloadavg())
    each_s = (time.monotonic() - begun_s) / max(1, len(found.stops))
    counts: dict[str, Any] = dict(found.counts)
    sys.stdout.write(
        f"{len(found.stops)} stops, one in {each_s:.1f} s; {counts.get('visits', 0):,} visits,"
        f" {counts.get('requests sent', 0):,} requests, {counts.get('bursts of noise', 0):,} bursts of noise;"
        f" load {load}\n"
    )
    wrong = verdict(found)
    for sentence in wrong:
        sys.stdout.write(sentence + "\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
