"""What the interface costs: rates, delays, subscribers, and the memory of a client that stalls.

The server runs in a process of its own with a state tree of 500 fields, all set anew 20 times a second; no
machine is behind it. With --at it is a machine that runs: canductor demo --serve --ipc PATH.

With --print it is a machine that prints: `canductor demo --serve` and its virtual nodes are started anew for
every line of the table, so that the smallest leads are those of that load, and print the same for as long.
Loads take turns, round after round; each is compared with the quiet print of its round. Leads: how far the
commands still reached ahead of now when the motion worker's next ones were handed over, smallest after the
first second; and how long before it was due a command reached its node, smallest of all nodes.

Usage: python bench/ipc.py [--seconds S] [--stall-seconds S] [--at PATH]
       python bench/ipc.py --print [--rounds N] [--seconds S] [--stall-seconds S] [--gcode FILE]
"""

import argparse
import asyncio
import json
import multiprocessing
import os
import select
import shutil
import signal
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import msgpack

from coordinator.ipc.protocol.methods import Caller, Method, Registry, Scope
from coordinator.ipc.server.server import IpcServer
from coordinator.ipc.server.settings import IpcSettings
from coordinator.ipc.server.state import StateTree
from coordinator.support.values import Value

FIELDS = 500
ROOT = Path(__file__).resolve().parents[1]


async def serve(path: Path) -> None:
    state, registry = StateTree(), Registry()

    def status(_: Caller, __: dict[str, Any]) -> Value:
        names = ("state", "job", "progress", "x_mm", "y_mm")
        return {name: state.get(f"node.{i}") for i, name in enumerate(names)}

    registry.add(Method("machine.state", Scope.WATCH, "", status))
    server = IpcServer(registry, state, IpcSettings(unix_path=path))
    await server.start()
    turn = 0
    while True:
        turn += 1
        state.update("node", {str(i): turn + i / 7 for i in range(FIELDS)})
        await asyncio.sleep(0.05)


def run_server(path: Path) -> None:
    asyncio.run(serve(path))


def run_echo(path: Path) -> None:
    """Send everything back: what the computer itself takes, in the same traffic."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen()
    connection, _ = listener.accept()
    while data := connection.recv(1 << 18):
        connection.sendall(data)


class Peer:
    """A client that costs as little as it can: what is measured is the server."""

    def __init__(self, path: Path, kind: str) -> None:
        self.json = kind == "json"
        self.socket = socket.socket(socket.AF_UNIX)
        self.socket.connect(str(path))
        self.buffer = b""
        self.send({"id": 0, "method": "api.hello", "params": {"version": 1}})
        next(self.messages())

    def write(self, message: dict[str, Any]) -> bytes:
        """Return MESSAGE as bytes."""
        if self.json:
            return json.dumps(message).encode() + b"\n"
        body: bytes = msgpack.packb(message)
        return struct.pack(">I", len(body)) + body

    def send(self, message: dict[str, Any]) -> None:
        """Send MESSAGE."""
        self.socket.sendall(self.write(message))

    def messages(self) -> Iterator[dict[str, Any]]:
        """Yield messages of one read, at least one."""
        found = False
        while not found:
            self.buffer += self.socket.recv(1 << 18)
            while (message := self._next()) is not None:
                found = True
                yield message

    def _next(self) -> dict[str, Any] | None:
        if self.json:
            line, end, rest = self.buffer.partition(b"\n")
            if not end:
                return None
            self.buffer = rest
            return dict(json.loads(line))
        if len(self.buffer) < 4:
            return None
        end_at = 4 + struct.unpack_from(">I", self.buffer)[0]
        if len(self.buffer) < end_at:
            return None
        body, self.buffer = self.buffer[4:end_at], self.buffer[end_at:]
        return dict(msgpack.unpackb(body))


def at_rate(peer: Peer, rate_hz: float, seconds: float) -> list[float]:
    """Send requests at RATE_HZ whatever is answered; return the delays in s."""
    delays: list[float] = []
    sent: dict[int, float] = {}
    began, asked, total = time.perf_counter(), 0, int(rate_hz * seconds)
    while len(delays) < total:
        now, due = time.perf_counter(), began + asked / rate_hz
        if asked < total and now >= due:
            asked += 1
            sent[asked] = due  # not from when it was sent: no delay is left out
            peer.send({"id": asked, "method": "machine.state"})
            continue
        wait = 1.0 if asked == total else due - now
        if select.select([peer.socket], [], [], wait)[0]:
            delays += [time.perf_counter() - sent.pop(message["id"]) for message in peer.messages()]
    return delays


def flat_out(peer: Peer, seconds: float, method: str = "machine.state", window: int = 64) -> float:
    """Keep WINDOW requests under way; return answers a second."""
    began, answered, got, numbers = time.perf_counter(), 0, window, count(1)
    while time.perf_counter() - began < seconds:
        more = ({"id": next(numbers), "method": method} for _ in range(got))
        peer.socket.sendall(b"".join(map(peer.write, more)))
        got = sum(1 for _ in peer.messages())
        answered += got
    return answered / (time.perf_counter() - began)


def subscribers(path: Path, number: int, rate_hz: float, seconds: float) -> tuple[float, int]:
    """Watch everything NUMBER times; return updates a second of all, and how many were merged."""
    peers = {}
    for _ in range(number):
        peer = Peer(path, "msgpack")
        peer.send({"id": 1, "method": "api.watch", "params": {"rate_hz": rate_hz}})
        next(peer.messages())
        peers[peer.socket.fileno()] = peer
    poll = select.poll()
    for opened in peers:
        poll.register(opened, select.POLLIN)
    began, updates, skipped = time.perf_counter(), 0, 0
    while time.perf_counter() - began < seconds:
        for opened, _ in poll.poll(100):
            data = peers[opened].socket.recv(1 << 18)
            updates += data.count(b"\xa5event\xa5state")
            at = data.find(b"\xa7skipped")
            skipped += at >= 0 and data[at + 8] != 0
    spent = time.perf_counter() - began
    for peer in peers.values():
        peer.socket.close()
    return updates / spent, skipped


def memory_kib(pid: int) -> int:
    status = Path(f"/proc/{pid}/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1])


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / 100


def stolen_s() -> float:
    """Return how long the host of a virtual machine had processors run something else, all together."""
    return int(Path("/proc/stat").read_text().split()[8]) / 100


def stalled(path: Path, seconds: float) -> str:
    """Watch everything at 50 Hz, listen, and stop reading."""
    peer = Peer(path, "msgpack")
    peer.send({"id": 1, "method": "api.listen", "params": {"events": ["*"]}})
    peer.send({"id": 2, "method": "api.watch", "params": {"rate_hz": 50}})
    time.sleep(seconds)
    peer.socket.close()
    return ""


def start(target: Callable[[Path], None], name: str) -> tuple[Path, int]:
    """Run TARGET in a process of its own; return where it listens, and its pid."""
    path = Path(tempfile.mkdtemp()) / name
    process = multiprocessing.get_context("spawn").Process(target=target, args=(path,), daemon=True)
    process.start()
    assert process.pid is not None
    while not path.exists():
        time.sleep(0.05)
    return path, process.pid


# --------------------------------------------------------------------------------------------------- loads


def told(delays: list[float]) -> str:
    p50_ms, p99_ms, longest_ms = (sorted(delays)[int(len(delays) * q) - 1] * 1e3 for q in (0.5, 0.99, 1.0))
    return f"p50 {p50_ms:.2f} ms, p99 {p99_ms:.2f} ms, longest {longest_ms:.1f} ms"


def load_requests(path: Path, kind: str, seconds: float) -> str:
    return told(at_rate(Peer(path, kind), 2000, seconds))


def load_subscribers(path: Path, seconds: float) -> str:
    rate, merged = subscribers(path, 200, 10, seconds)
    return f"{rate:,.0f} updates/s, {merged} merged"


def load_echo(_: Path, seconds: float) -> str:
    echo = start(run_echo, "echo")[0]
    return told(at_rate(Peer(echo, "msgpack"), 2000, seconds))


def load_flat_out(path: Path, seconds: float) -> str:
    return f"{flat_out(Peer(path, 'msgpack'), seconds):,.0f} requests/s"


def load_dumps(path: Path, seconds: float) -> str:
    return f"{flat_out(Peer(path, 'msgpack'), seconds, 'motion.dump'):,.0f} requests/s, most refused: busy"


QUIET, STALL = "no clients", "a client that does not read"
LOADS: dict[str, Callable[[Path, float], str]] = {
    "2,000 requests/s, msgpack": lambda path, seconds: load_requests(path, "msgpack", seconds),
    "2,000 requests/s, JSON": lambda path, seconds: load_requests(path, "json", seconds),
    "2,000 messages/s to a bare echo beside it": load_echo,
    "200 subscribers of all fields at 10 Hz": load_subscribers,
    "as many requests as it takes": load_flat_out,
    "as many dumps of motion as it takes": load_dumps,
    STALL: stalled,
}


def run_load(name: str, path: str, seconds: str) -> None:
    """Be one load, in a process of its own."""
    print(LOADS[name](Path(path), float(seconds)))


# --------------------------------------------------------------------------------- with nothing to move


def measure(path: Path, pid: int, seconds: float, stall_s: float) -> None:
    print("a bare echo, for comparison: 2,000 messages/s:", load_echo(path, seconds))
    for kind in ("msgpack", "json"):
        before = cpu_s(pid)
        print(f"{kind}: 2,000 requests/s: {load_requests(path, kind, seconds)}")
        print(f"{kind}: with that, {(cpu_s(pid) - before) / seconds:.0%} of a processor, all in all")
        print(f"{kind}: flat out, 64 under way: {flat_out(Peer(path, kind), seconds):,.0f} requests/s")
    before = cpu_s(pid)
    line = load_subscribers(path, seconds)
    print(f"200 subscribers of all fields at 10 Hz: {line}, {(cpu_s(pid) - before) / seconds:.0%} CPU")
    begun_kib = memory_kib(pid)
    stalled(path, stall_s)
    grown_kib = memory_kib(pid) - begun_kib
    print(f"a client that stops reading for {stall_s:g} s: the server grew by {grown_kib:,} KiB")


# ------------------------------------------------------------------------------------- beside a print


@dataclass(frozen=True)
class Print:
    """What was seen of a print under one load."""

    lead_ms: float
    command_lead_ms: float
    cpu: float
    """Of one processor."""
    grown_kib: int
    said: str
    computer_load: float
    stolen: float
    """Share of the processors that a virtual machine's host gave to others: from 1 % on p99 tells of that."""


class Served:
    """`canductor demo --serve` in a process of its own, printing GCODE."""

    def __init__(self, gcode: Path) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="canductor-bench-"))
        self.path = self.folder / "bench.sock"
        command = [sys.executable, "-m", "coordinator.cli.main", "demo", "--serve", "--ipc", str(self.path)]
        self.process = subprocess.Popen(
            [*command, "--jobs", str(gcode.parent)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert self.process.stdout is not None
        while (line := self.process.stdout.readline()) != "ready\n":
            if not line:
                sys.exit("the demo did not start")
        self.operator = Peer(self.path, "msgpack")
        self.ask("job.start", {"file": gcode.name})
        while not self.ask("job.status", {})["line"]:
            time.sleep(0.1)

    def ask(self, method: str, params: dict[str, Any]) -> dict[str, Any]:
        """Return the result of METHOD."""
        self.operator.send({"id": 1, "method": method, "params": params})
        answer = next(self.operator.messages())
        if "error" in answer:
            sys.exit(f"{method}: {answer['error']['message']}")
        return dict(answer["result"])

    def close(self) -> None:
        """End it, print and all."""
        self.operator.socket.close()
        self.process.send_signal(signal.SIGTERM)
        self.process.communicate()
        shutil.rmtree(self.folder, ignore_errors=True)


def print_under(load: str, gcode: Path, seconds: float) -> Print:
    served = Served(gcode)
    try:
        pid = served.process.pid
        time.sleep(2)  # for the look-ahead to be full, and memory to be taken
        before_s, before_kib, stolen_before_s = cpu_s(pid), memory_kib(pid), stolen_s()
        said = ""
        if load == QUIET:
            time.sleep(seconds)
        else:
            command = [sys.executable, __file__, "--load", load, str(served.path), str(seconds)]
            said = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.strip()
        spent = cpu_s(pid) - before_s
        stolen = (stolen_s() - stolen_before_s) / seconds / (os.cpu_count() or 1)
        wanted = ["machine.lead_min_ms", "nodes.*.lead_min_ms", "job.state", "machine.cause"]
        fields = served.ask("state.get", {"fields": wanted})["values"]
        cause = fields.pop("machine.cause")
        if cause:
            sys.exit(f"the machine stopped under {load}: {cause}")
        if fields.pop("job.state") != "printing":
            sys.exit(f"{gcode} is printed in less than {seconds:g} s; give a longer file, or fewer --seconds")
        lead_ms = fields.pop("machine.lead_min_ms")
        command_lead_ms = min(value for value in fields.values() if value is not None)
        grown_kib = memory_kib(pid) - before_kib
        return Print(lead_ms, command_lead_ms, spent / seconds, grown_kib, said, os.getloadavg()[0], stolen)
    finally:
        served.close()


def compare(gcode: Path, rounds: int, seconds: float, stall_s: float) -> None:
    """Print under every load in turn, quietly first in each round, and tell the differences."""
    found: dict[str, list[Print]] = {name: [] for name in (QUIET, *LOADS)}
    for number in range(1, rounds + 1):
        print(f"round {number} of {rounds}: {gcode.name}, {seconds:g} s each", flush=True)
        for name, runs in found.items():
            run = print_under(name, gcode, stall_s if name == STALL else seconds)
            runs.append(run)
            print(
                f"  {name:42} lead {run.lead_ms:5.0f} ms, command {run.command_lead_ms:5.1f} ms, "
                f"CPU {run.cpu:4.0%}, memory {run.grown_kib:+6,} KiB, load {run.computer_load:.1f}, "
                f"stolen {run.stolen:5.2%}  "
                f"{run.said}",
                flush=True,
            )
    print(f"\nmedians of {rounds} rounds; what is lost of leads, against the quiet print of the same round")
    for name, runs in found.items():
        pairs = list(zip(runs, found[QUIET], strict=True))
        lost = statistics.median(1 - run.lead_ms / quiet.lead_ms for run, quiet in pairs)
        also = statistics.median(1 - run.command_lead_ms / quiet.command_lead_ms for run, quiet in pairs)
        print(f"  {name:42} lead {lost:+6.1%}, command {also:+6.1%}")


def pid_of(path: Path) -> int:
    """Return the process that listens at PATH."""
    with socket.socket(socket.AF_UNIX) as asked:
        asked.connect(str(path))
        return int(struct.unpack("3i", asked.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--stall-seconds", type=float)
    parser.add_argument("--at", type=Path)
    parser.add_argument("--print", action="store_true")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--gcode", type=Path, default=ROOT / "config/demo/part.gcode")
    parser.add_argument("--load", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.load is not None:
        run_load(*given.load)
    elif given.print:
        seconds = given.seconds or 30.0
        compare(given.gcode.resolve(), given.rounds, seconds, given.stall_seconds or seconds)
    else:
        path, pid = start(run_server, "bench") if given.at is None else (given.at, pid_of(given.at))
        measure(path, pid, given.seconds or 5.0, given.stall_seconds or 20.0)


if __name__ == "__main__":
    main()
