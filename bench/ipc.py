"""What the interface costs: rates, delays, subscribers, and the memory of a client that stalls.

The server runs in a process of its own with a state tree of 500 fields, all set anew 20 times a second; no
machine is behind it. With --at it is a machine that runs: canductor demo --serve --ipc PATH.

Usage: python bench/ipc.py [--seconds S] [--stall-seconds S] [--at PATH]
"""

import argparse
import asyncio
import json
import multiprocessing
import select
import socket
import statistics
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack

from coordinator.ipc.methods import Caller, Method, Registry, Scope, Value
from coordinator.ipc.server import IpcServer
from coordinator.ipc.settings import IpcSettings
from coordinator.ipc.state import StateTree

FIELDS = 500


async def serve(path: Path) -> None:
    state, registry = StateTree(), Registry()

    def status(_: Caller, __: dict[str, Any]) -> Value:
        names = ("state", "job", "progress", "x_mm", "y_mm")
        return {name: state.get(f"node.{i}") for i, name in enumerate(names)}

    registry.add(Method("machine.state", Scope.WATCH, "", status))
    server = IpcServer(registry, state, IpcSettings(unix_path=path))
    await server.start()
    count = 0
    while True:
        count += 1
        state.update("node", {str(i): count + i / 7 for i in range(FIELDS)})
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
        while True:
            self.buffer += self.socket.recv(1 << 18)
            found = False
            while (message := self._next()) is not None:
                found = True
                yield message
            if found:
                return

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
    began, count, total = time.perf_counter(), 0, int(rate_hz * seconds)
    while len(delays) < total:
        now = time.perf_counter()
        if count < total and now >= began + count / rate_hz:
            sent[count + 1] = began + count / rate_hz  # from when it was due: no delay is left out
            count += 1
            peer.send({"id": count, "method": "machine.state"})
            continue
        wait = 1.0 if count == total else max(0.0, began + count / rate_hz - now)
        if select.select([peer.socket], [], [], wait)[0]:
            delays += [time.perf_counter() - sent.pop(message["id"]) for message in peer.messages()]
    return delays


def flat_out(peer: Peer, seconds: float, window: int = 64) -> float:
    """Keep WINDOW requests under way; return answers a second."""
    began = time.perf_counter()
    numbered = 0
    for _ in range(window):
        numbered += 1
        peer.send({"id": numbered, "method": "machine.state"})
    answered = 0
    while time.perf_counter() - began < seconds:
        got = sum(1 for _ in peer.messages())
        answered += got
        batch = b""
        for _ in range(got):
            numbered += 1
            batch += peer.write({"id": numbered, "method": "machine.state"})
        peer.socket.sendall(batch)
    return answered / (time.perf_counter() - began)


def subscribers(path: Path, count: int, rate_hz: float, seconds: float) -> tuple[float, int]:
    """Watch everything COUNT times; return updates a second of all, and how many were merged."""
    peers = {}
    for _ in range(count):
        peer = Peer(path, "msgpack")
        peer.send({"id": 1, "method": "api.watch", "params": {"rate_hz": rate_hz}})
        next(peer.messages())
        peers[peer.socket.fileno()] = peer
    poll = select.poll()
    for number in peers:
        poll.register(number, select.POLLIN)
    began, updates, skipped = time.perf_counter(), 0, 0
    while time.perf_counter() - began < seconds:
        for number, _ in poll.poll(100):
            data = peers[number].socket.recv(1 << 18)
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


def stalled(path: Path, pid: int, seconds: float) -> int:
    """Watch everything at 50 Hz, listen, and stop reading; return by how much the server grew, in KiB."""
    before = memory_kib(pid)
    peer = Peer(path, "msgpack")
    peer.send({"id": 1, "method": "api.listen", "params": {"events": ["*"]}})
    peer.send({"id": 2, "method": "api.watch", "params": {"rate_hz": 50}})
    most, until = before, time.perf_counter() + seconds
    while time.perf_counter() < until:
        time.sleep(0.1)
        most = max(most, memory_kib(pid))
    peer.socket.close()
    return most - before


def start(target: Callable[[Path], None], name: str) -> tuple[Path, int]:
    """Run TARGET in a process of its own; return where it listens, and its pid."""
    path = Path(tempfile.mkdtemp()) / name
    process = multiprocessing.get_context("spawn").Process(target=target, args=(path,), daemon=True)
    process.start()
    assert process.pid is not None
    while not path.exists():
        time.sleep(0.05)
    return path, process.pid


def show_delays(kind: str, delays: list[float]) -> None:
    delays.sort()
    p99 = delays[int(len(delays) * 0.99)]
    print(
        f"{kind}: 2,000 requests/s: p50 {statistics.median(delays) * 1e3:.2f} ms, "
        f"p99 {p99 * 1e3:.2f} ms, longest {delays[-1] * 1e3:.1f} ms"
    )


def measure(path: Path, pid: int, seconds: float, stall_s: float) -> None:
    echo, _ = start(run_echo, "echo")
    show_delays("a bare echo, for comparison", at_rate(Peer(echo, "msgpack"), 2000, seconds))
    for kind in ("msgpack", "json"):
        before = cpu_s(pid)
        show_delays(kind, at_rate(Peer(path, kind), 2000, seconds))
        print(f"{kind}: with that, {(cpu_s(pid) - before) / seconds:.0%} of a processor, all in all")
        print(f"{kind}: flat out, 64 under way: {flat_out(Peer(path, kind), seconds):,.0f} requests/s")
    before = cpu_s(pid)
    rate, merged = subscribers(path, 200, 10, seconds)
    load = (cpu_s(pid) - before) / seconds
    print(f"200 subscribers of all fields at 10 Hz: {rate:,.0f} updates/s, {merged} merged, {load:.0%} CPU")
    print(
        f"a client that stops reading for {stall_s:g} s: "
        f"the server grew by {stalled(path, pid, stall_s):,} KiB"
    )


def pid_of(path: Path) -> int:
    """Return the process that listens at PATH."""
    with socket.socket(socket.AF_UNIX) as asked:
        asked.connect(str(path))
        return int(struct.unpack("3i", asked.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--stall-seconds", type=float, default=20.0)
    parser.add_argument("--at", type=Path)
    given = parser.parse_args()
    if given.at is not None:
        measure(given.at, pid_of(given.at), given.seconds, given.stall_seconds)
        return
    path, pid = start(run_server, "bench")
    measure(path, pid, given.seconds, given.stall_seconds)


if __name__ == "__main__":
    main()
