"""Tables to 14 axes on 6 nodes of a simulated bus: how long it takes, and how well they act together.

The real host, links and firmware under virtual time with true bit timing: times are those of a real bus.

Bounds are of one broadcast: its bits, divided by the sender's share of the bit rate, or by what other traffic
leaves if that is less. Asking the nodes before and after, the rest until a broadcast has settled, repeats and
links come on top, and are told apart.
"""

import asyncio
import sys
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from nodes.clock.clock import HostTime
from nodes.mt.cost import RegisterCost
from nodes.mt.download import BUS_SHARE, DownloadReport, download
from nodes.mt.mt import transmission
from nodes.mt.table import Activation
from nodes.virtual.world import run
from tests.nodes.mt.machines import TableMachine, wavy

T = TypeVar("T")

FRAME_BITS_MAX = 135
"""Of 8 bytes: 111, and 24 stuff bits at most (ISO 11898-1)."""
POLL_DELAY_S = 0.002
"""T of an old drive that polls its register a thousand times a second."""
BUSY, LOSS = 0.7, 0.01
CASES = (("idle bus", 0.0, 0.0), ("70 % load", BUSY, 0.0), ("70 % load, 1 % loss", BUSY, LOSS))


def main() -> None:
    """Print all figures."""
    say(f"28 axles (14 axes, both directions) on 6 nodes, 1 Mbit/s; broadcasts with {BUS_SHARE:.0%} of it")
    for points in (32, 128, 256):
        words = len(transmission(wavy(points), [1]))
        bits = -(-words // 2) * FRAME_BITS_MAX
        say(f"{points} points: {words} words, at most {bits} bits, however they are stuffed")
        register = RegisterCost(points, words, 0, POLL_DELAY_S)
        say(f"  polled register: {register.text()}")
        for name, load, loss in CASES:
            one_table(points, name, load, loss)
    own_tables(64)
    skew()


def one_table(points: int, name: str, load: float, loss: float) -> None:
    """One table for all axles."""
    machine = TableMachine(1, capacity=points)

    async def act() -> list[DownloadReport]:
        return [await download(wavy(points), machine.places, now_ns=machine.now_ns)]

    reports = performed(machine, act, load, loss)
    told(f"  {name}: one table for all", reports)
    (cast,) = reports[0].casts
    say(f"    {cast.text()}")
    say(f"    asking {reports[0].asking_s * 1e3:.0f} ms, links {reports[0].links_s * 1e3:.0f} ms")


def own_tables(points: int) -> None:
    """Each axle its own."""
    machine = TableMachine(2, capacity=points)

    async def act() -> list[DownloadReport]:
        return [
            await download(wavy(points, number), [place], now_ns=machine.now_ns)
            for number, place in enumerate(machine.places)
        ]

    told(f"70 % load, 1 % loss: 28 tables of {points} points in turn", performed(machine, act, BUSY, LOSS))


def skew() -> None:
    """All use their tables from one moment on."""
    machine = TableMachine(3, ppm=30, capacity=32)

    async def act() -> tuple[float, float]:
        report = await download(wavy(32), machine.places, now_ns=machine.now_ns)
        await asyncio.sleep(10)
        at_ns = HostTime(machine.now_ns() + 200_000_000)
        for outcome in report.outcomes:
            place = outcome.place
            clock = int(machine.node(place).best_clock.ticks_at(at_ns))
            place.table.activate(place.node, clock=clock, generation=outcome.generation)
        await asyncio.sleep(0.3)
        moments, errors = [], []
        for outcome in report.outcomes:
            place, board = outcome.place, machine.board(outcome.place)
            found = await place.table.active(place.node)
            assert found.activation is Activation.DONE
            clock = board.clock - ((board.clock - found.clock32) & 0xFFFFFFFF)
            moments.append(float(board.true_ps(np.array([clock], np.uint64))[0]) * 1e-6)
            errors.append((machine.node(place).clock_error_s or 0.0) * 1e6)
        return max(moments) - min(moments), max(errors)

    between_us, error_us = performed(machine, act, BUSY, LOSS)
    say("activation on 6 nodes, clocks within 30 ppm, 70 % load, 1 % loss:")
    say(f"  {between_us:.2f} us between first and last; stated clock error {error_us:.2f} us")


def performed(machine: TableMachine, act: Callable[[], Awaitable[T]], load: float, loss: float) -> T:
    """Run ACT on MACHINE's bus, which carries LOAD besides and loses LOSS of its frames."""

    async def body() -> T:
        await machine.bus.start()
        machine.burden(load)
        machine.lose(loss)
        await asyncio.sleep(1)  # for the load to be known
        try:
            return await act()
        finally:
            await machine.bus.close()

    return run(machine.world, body(), limit_s=600)


def told(what: str, reports: Sequence[DownloadReport]) -> None:
    """Print what became of them."""
    outcomes = [outcome for report in reports for outcome in report.outcomes]
    elapsed_ms = sum(report.elapsed_s for report in reports) * 1e3
    broadcasts = max(outcome.broadcasts for outcome in outcomes)
    by_link = sum(outcome.by_link > 0 for outcome in outcomes)
    ok = sum(outcome.ok for outcome in outcomes)
    say(f"{what}: {ok} of {len(outcomes)} axles ok in {elapsed_ms:.0f} ms")
    say(f"    at most {broadcasts} broadcasts each, {by_link} axles through links")


def say(line: str) -> None:
    """Print LINE."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
