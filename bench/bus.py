"""The scheduler under load: a virtual bus at 500 kbit/s with four nodes, offered 95 and 130 %.

Real threads in real time: what it prints are the counters that LinkIO.stats(), Link.stats() and
LinkIO.forecast() give while the bus runs.
"""

import asyncio
import struct
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

from nodes.link import Link, LinkIO, LinkSettings
from nodes.transport.virtual import VirtualTransport
from nodes.virtual.hub import VirtualBus

ROOT = Path(__file__).parent.parent
NODES = ROOT / "build" / "bench" / "load_nodes"
BITRATE = 500_000
LOOK_AHEAD_S = 0.5
SECONDS = 4.0
BITS_PER_CONTENT_BYTE = 19.0
"""In well filled blocks, acknowledgements included."""
SENSOR_BLOCK_BITS = 64 * 15.4
COMMAND = bytes([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12])


@dataclass
class Load:
    """Shares of the bit rate that are offered."""

    motion: float
    bulk: float
    sensors: float
    warned_s: list[float] = field(default_factory=list)


def build_nodes() -> None:
    NODES.parent.mkdir(parents=True, exist_ok=True)
    sources = ["bench/load_nodes.c", "firmware/wire/block.c", "firmware/wire/vlq.c"]
    subprocess.run(["gcc", "-O2", "-I.", "-Ifirmware", *sources, "-o", NODES], cwd=ROOT, check=True)


async def feed(io: LinkIO, links: list[Link], load: Load) -> None:
    """Queue motion as far ahead as a planner does, and bulk as it comes; watch the forecast."""
    for link in links:
        link.set_clock(1e9, 1, 1)  # a node whose ticks are the host's nanoseconds
    interval_ns = len(COMMAND) * BITS_PER_CONTENT_BYTE / (load.motion * BITRATE) * 1e9
    bulk_per_s = load.bulk * BITRATE / (59 * BITS_PER_CONTENT_BYTE)
    begin_ns = time.monotonic_ns()
    due_ns, count, bulk = begin_ns + LOOK_AHEAD_S * 1e9, 0, 0
    while (now_ns := time.monotonic_ns()) < begin_ns + SECONDS * 1e9:
        batches = dict.fromkeys(links, b"")
        while due_ns < now_ns + LOOK_AHEAD_S * 1e9:
            batches[links[count % 4]] += struct.pack("=QQB", 0, int(due_ns), len(COMMAND)) + COMMAND
            due_ns += interval_ns
            count += 1
        for link, batch in batches.items():
            if batch:
                link.send_batch(batch)
        while bulk < (now_ns - begin_ns) * 1e-9 * bulk_per_s and links[1].stats().bulk_bytes < 50_000:
            links[1].send(bytes(range(59)), bulk=True)
            bulk += 1
        forecast = io.forecast()
        if forecast.warning_s is not None:
            load.warned_s.append((forecast.now_ns - begin_ns) * 1e-9)
        await asyncio.sleep(0.01)


def report(io: LinkIO, links: list[Link], load: Load) -> None:
    bus = io.stats()
    shares = {
        name: f"{getattr(bus.load, name):.1%}" for name in ("motion", "acks", "data", "control", "bulk")
    }
    print(f"  last second: {bus.load.total:.1%} of the bit rate: {shares}")
    print(
        f"  kernel queue: at most {bus.queued_max} of {bus.queue_frames} frames, {bus.queue_waits} waits;"
        f" bulk held back for {bus.held_s:.2f} s; {bus.wakeups / SECONDS:.0f} wake-ups/s"
    )
    for link in links:
        stats = link.stats()
        lead = "none" if stats.min_lead_s is None else f"{stats.min_lead_s * 1e3:.1f} ms"
        print(
            f"  {link.name[-6:]}: motion {stats.motion.blocks} blocks, {stats.motion.frames} frames,"
            f" {stats.motion.bits} bits; bulk {stats.bulk.blocks} blocks; smallest lead {lead}, late"
            f" {stats.lead_histogram[0]}; repeats {stats.blocks_repeated},"
            f" round trip {stats.srtt_s * 1e3:.2f} ms"
        )
    first = f"{load.warned_s[0]:.2f} s after the start" if load.warned_s else "never"
    print(f"  the forecast warned: {first} (motion is due from {LOOK_AHEAD_S} s on)")


async def run(path: Path, load: Load) -> None:
    rate = load.sensors * BITRATE / SENSOR_BLOCK_BITS
    with VirtualBus(path, bitrate=BITRATE):
        process = await asyncio.create_subprocess_exec(NODES, path, str(rate))
        transport = VirtualTransport(path, bitrate=BITRATE)
        io = LinkIO(transport, asyncio.get_running_loop())
        links = [
            io.open_link(LinkSettings(nodeid, lost_after_s=10.0), on_responses=lambda _: None, on_lost=print)
            for nodeid in (4, 5, 6, 7)
        ]
        await feed(io, links, load)
        report(io, links, load)
        io.close()
        transport.close()
        process.terminate()
        await process.wait()


def main() -> None:
    build_nodes()
    with tempfile.TemporaryDirectory() as folder:
        for load in (Load(0.22, 0.10, 0.60), Load(0.60, 0.10, 0.60)):
            print(f"offered: motion {load.motion:.0%}, bulk {load.bulk:.0%}, sensor data {load.sensors:.0%}")
            asyncio.run(run(Path(folder) / "bus", load))


if __name__ == "__main__":
    main()
