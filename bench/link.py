"""Link figures, against an acking process: six-byte commands per second, and a query's round trip."""

import asyncio
import json
import os
import pty
import resource
import socket
import statistics
import struct
import subprocess
import time
import tty
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nodes.link import Link, LinkIO, LinkSettings, Response, TransportKind

ROOT = Path(__file__).parent.parent
ACKER = ROOT / "build" / "bench" / "acker"
COMMANDS = 300_000
BATCH = 30_000
QUERIES = 5_000
RECORD = struct.pack("=QQB", 0, 0, 6) + bytes([1, 2, 3, 4, 5, 6])


@dataclass
class FdTransport:
    """A transport that is a bare file descriptor."""

    name: str
    kind: TransportKind
    fd: int

    def fileno(self) -> int:
        """Return it."""
        return self.fd

    def close(self) -> None:
        """Close it."""
        os.close(self.fd)


def build_acker() -> None:
    ACKER.parent.mkdir(parents=True, exist_ok=True)
    sources = ["bench/acker.c", "firmware/wire/block.c", "firmware/wire/vlq.c"]
    subprocess.run(["gcc", "-O2", "-I.", "-Ifirmware", *sources, "-o", ACKER], cwd=ROOT, check=True)


def connect(line: str) -> tuple[FdTransport, "subprocess.Popen[bytes]"]:
    if line == "pty":
        ours, theirs = pty.openpty()
        tty.setraw(theirs)
        kind, word = TransportKind.BYTES, "bytes"
    else:
        pair = socket.socketpair()
        ours, theirs = pair[0].detach(), pair[1].detach()
        kind = TransportKind.CAN_STREAM if line == "can" else TransportKind.BYTES
        word = "can" if line == "can" else "bytes"
    process = subprocess.Popen([ACKER, str(theirs), word], pass_fds=[theirs])
    os.close(theirs)
    return FdTransport(line, kind, ours), process


async def throughput(link: Link) -> dict[str, float]:
    """Stream COMMANDS, keeping the motion queue filled but not over its bound."""
    batch = RECORD * BATCH
    before = resource.getrusage(resource.RUSAGE_SELF)
    start_s = time.monotonic()
    for _ in range(COMMANDS // BATCH):
        link.send_batch(batch)
        await link.drained()
    elapsed_s = time.monotonic() - start_s
    after = resource.getrusage(resource.RUSAGE_SELF)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        "commands_per_s": round(COMMANDS / elapsed_s),
        "host_cpu_us_per_command": round(cpu_s / COMMANDS * 1e6, 3),
    }


async def round_trips(link: Link, inbox: "asyncio.Queue[Response]") -> dict[str, float]:
    total_us, inner_us = [], []
    for _ in range(QUERIES):
        start_ns = time.monotonic_ns()
        link.send(b"\x02\x07")
        response = await inbox.get()
        total_us.append((time.monotonic_ns() - start_ns) / 1e3)
        if response.sent_ns:
            inner_us.append((response.received_ns - response.sent_ns) / 1e3)
    figures = {}
    for name, values in (("python", total_us), ("c", inner_us)):
        cuts = statistics.quantiles(values, n=100)
        figures |= {f"{name}_p50_us": round(cuts[49], 1), f"{name}_p99_us": round(cuts[98], 1)}
    return figures


async def measure(line: str, window: int) -> dict[str, float]:
    transport, process = connect(line)
    inbox: asyncio.Queue[Response] = asyncio.Queue()

    def on_responses(responses: Sequence[Response]) -> None:
        for response in responses:
            inbox.put_nowait(response)

    io = LinkIO(transport, asyncio.get_running_loop())
    settings = LinkSettings(4 if transport.kind == TransportKind.CAN_STREAM else None, window)
    link = io.open_link(settings, on_responses=on_responses, on_lost=print)
    figures = await round_trips(link, inbox) | await throughput(link)
    stats = link.stats()
    figures["blocks_repeated"] = stats.blocks_repeated
    io.close()
    transport.close()
    process.wait(timeout=10)
    return figures


def main() -> None:
    build_acker()
    results = {}
    for line, window in (("pty", 192), ("pty", 960), ("bytes", 192), ("can", 192), ("can", 960)):
        results[f"{line} window {window}"] = figures = asyncio.run(measure(line, window))
        print(f"{line:5} window {window}: " + ", ".join(f"{name} {value}" for name, value in figures.items()))
    print(json.dumps(results))


if __name__ == "__main__":
    main()
