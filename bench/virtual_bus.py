"""The virtual CAN bus in figures: throughput, latency, and how true it is to its bit rate."""

import os
import socket
import statistics
import tempfile
import threading
import time
from pathlib import Path

from nodes.transport.frame import RECORD_SIZE, CanFrame
from nodes.virtual.hub import VirtualBus

RECORD = CanFrame(0x123, bytes(range(8))).to_record()


def connect(bus: VirtualBus) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    sock.connect(str(bus.path))
    return sock


def transfer(bus: VirtualBus, count: int, batch: int) -> float:
    """Seconds for COUNT frames from one client to another, written BATCH at a time."""
    with connect(bus) as sender, connect(bus) as receiver:
        data = RECORD * batch

        def send() -> None:
            for _ in range(count // batch):
                sender.sendall(data)

        thread = threading.Thread(target=send)
        begin_s = time.monotonic()
        thread.start()
        left = count * RECORD_SIZE
        while left:
            left -= len(receiver.recv(1 << 18))
        thread.join()
        return time.monotonic() - begin_s


def percentiles(values_ns: list[int]) -> str:
    values_ns.sort()
    points = {"min": 0.0, "p50": 0.5, "p90": 0.9, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
    return "  ".join(
        f"{name} {values_ns[round(at * (len(values_ns) - 1))] / 1000:.0f}" for name, at in points.items()
    )


def latencies(bus: VirtualBus, count: int) -> tuple[list[int], list[int]]:
    """One-way and round-trip times in ns; an echo process plays the other node."""
    with connect(bus) as near, connect(bus) as far:
        one_way, round_trip = [], []
        stamps = socket.socketpair()
        child = os.fork()
        if child == 0:
            near.close()
            for _ in range(count):
                record = far.recv(RECORD_SIZE, socket.MSG_WAITALL)
                stamps[1].sendall(time.monotonic_ns().to_bytes(8, "little"))
                far.sendall(record)
            os._exit(0)
        for _ in range(count):
            begin_ns = time.monotonic_ns()
            near.sendall(RECORD)
            near.recv(RECORD_SIZE, socket.MSG_WAITALL)
            round_trip.append(time.monotonic_ns() - begin_ns)
            one_way.append(int.from_bytes(stamps[0].recv(8, socket.MSG_WAITALL), "little") - begin_ns)
        os.waitpid(child, 0)
        for sock in stamps:
            sock.close()
        return one_way, round_trip


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bus"
        for batch in (1, 32):
            with VirtualBus(path, bitrate=None) as bus:
                count = 200_000 if batch > 1 else 50_000
                rate = count / transfer(bus, count, batch)
                print(f"no rate limit, {batch:2} frames a write: {rate:10,.0f} frames/s")
        for bitrate in (None, 1_000_000):
            with VirtualBus(path, bitrate=bitrate) as bus:
                one_way, round_trip = latencies(bus, 3000)
                frame_us = bus.stats.busy_ns / bus.stats.frames / 1000
                print(
                    f"latency at {bitrate or 'no'} bit/s, of which the frame itself {frame_us:.0f} us, in us:"
                )
                print(f"  one way     {percentiles(one_way)}")
                print(f"  round trip  {percentiles(round_trip)}")
        shares = []
        for _ in range(3):
            with VirtualBus(path) as bus:
                elapsed_s = transfer(bus, 8000, 8)
                shares.append(bus.stats.bits / elapsed_s / 1e6)
                late_us, realtime = bus.stats.late_ns_max / 1000, bus.stats.realtime
        share = statistics.median(shares)
        print(
            f"saturated at 1 Mbit/s: {share:.4%} of the nominal bit rate; woke at most {late_us:.0f} us late"
            f" (real-time priority: {'granted' if realtime else 'refused'})"
        )


if __name__ == "__main__":
    main()
