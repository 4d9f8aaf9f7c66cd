"""How well sync pulses hold the clocks of a bus's nodes together, with real firmware in a simulated world.

``bench/pulse.py [SEEDS]``: for every setting, over SEEDS seeds (2 unless told), three nodes on a CAN bus at
1 Mbit/s, whose receive interrupts come 0..1 µs after the frame, ramp their clocks apart by up to 10 ppm in
600 s from 60 s on. The error is that of the map by which steps are timed, made 1.8 s ahead and bent every
1.2 s as when a job streams: the true time at which the secondary reaches the mapped tick, less the one at
which the primary reaches the print time. "estimate" is the same of the fit itself, asked for the present.
Both from 10 s after the start, over all seeds and secondary nodes. "bound" is the median of the published
error bound, "held" how often the estimate was within it.
"""

import asyncio
import math
import random
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coordinator.runtime.timebase import ClockMap, TimeBase
from coordinator.simulate.boards import dictionary_blob
from coordinator.streaming.streamer import CYCLE_S, FULL_CYCLE_S
from coordinator.streaming.worker import MAKE_AHEAD_S
from nodes.bus.assign import Uuid
from nodes.bus.can_bus import CanBus
from nodes.clock.clock import HostTime, Ticks
from nodes.dictionary.dictionary import Dictionary
from nodes.link import LinkIO
from nodes.link.interfaces import LinkIoInterface, OnFrame, OnLost
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.virtual.world import CanPort, World, WorldNode, run

JITTER_S: Final = 1e-6
SCORED_AFTER_S: Final = 10.0
RAMP_FROM_S: Final = 60.0
RAMP_S: Final = 600.0
UNTIL_S: Final = 720.0
PPM: Final = (40.0, -60.0, 15.0)
RAMP_PPM: Final = (10.0, -10.0, 0.0)
START_CLOCKS: Final = ((1 << 32) - 168_000_000, (1 << 32) - 16_000_000 * 30, 7)
"""Two of them roll over early, the third when the firmware's 32 bits are through."""
CLOCK_FREQS: Final = (168_000_000, 16_000_000, 64_000_000)
LATE_S: Final = 30e-6
LOAD_ID: Final = 0x300
FRAME_BITS: Final = 130


@dataclass(frozen=True)
class Setting:
    """What is different from a quiet bus."""

    name: str
    loss: float = 0.0
    """Probability for each receiver to lose a frame."""
    late_share: float = 0.0
    """Share of time in which a node's receive interrupt may come up to LATE_S late."""
    late_for_s: float = CYCLE_S
    """For how long at a time."""
    load: float = 0.0
    """Share of the bus that other traffic takes."""


SETTINGS: Final = (
    Setting("quiet"),
    Setting("1 % of frames lost", loss=0.01),
    Setting("2 % late by up to 30 µs", late_share=0.02),
    Setting("… for 2 s at a time", late_share=0.02, late_for_s=2.0),
    Setting("70 % other traffic", load=0.7),
)


@dataclass
class Errors:
    """In seconds, of all seeds and secondary nodes of a setting."""

    estimate: list[float] = field(default_factory=list)
    mapped: list[float] = field(default_factory=list)
    bound: list[float] = field(default_factory=list)

    def row(self) -> str:
        """Return a line of the table."""
        figures = [
            rms_us(self.estimate),
            worst_us(self.estimate),
            rms_us(self.mapped),
            worst_us(self.mapped),
            1e6 * sorted(self.bound)[len(self.bound) // 2],
        ]
        held = sum(abs(e) <= b for e, b in zip(self.estimate, self.bound, strict=True)) / len(self.bound)
        return "".join(f"{x:9.2f}" for x in figures) + f"{held:10.3%}"


def rms_us(values: Sequence[float]) -> float:
    return 1e6 * math.sqrt(sum(x * x for x in values) / len(values))


def worst_us(values: Sequence[float]) -> float:
    return 1e6 * max(abs(x) for x in values)


class Machine:
    """Three nodes on a simulated bus."""

    def __init__(self, seed: int, setting: Setting) -> None:
        self.random = random.Random(seed)
        self.setting = setting
        self.world = World(seed)
        wire = self.world.add_can()
        self.port = self.world.add_can_port(wire)
        self.boards = [
            self.world.add_node(
                wire,
                f"00000000000{n}",
                start_clock=START_CLOCKS[n],
                clock_freq=CLOCK_FREQS[n],
                dictionary=dictionary_blob(CLOCK_FREQS[n], legacy=False),
            )
            for n in range(len(PPM))
        ]
        self.bus = CanBus("can0", self._start_io)
        self.nodes = [
            self.bus.add_node(f"n{n}", Uuid.parse(b.uuid), config) for n, b in enumerate(self.boards)
        ]
        self.port.controller.set_faults(loss=setting.loss)
        for board, ppm in zip(self.boards, PPM, strict=True):
            board.set_rate(ppm)
            assert board.controller is not None
            board.controller.set_faults(loss=setting.loss)
        self.sender = self.world.add_node(wire, "0000000000ff").controller if setting.load else None

    def _start_io(self, *, on_frame: OnFrame | None, on_closed: OnLost) -> LinkIoInterface:
        port: CanPort = self.port
        return LinkIO.driven_by(port.open(), on_frame=on_frame, on_closed=on_closed)

    def ramp(self, *, begins: bool) -> None:
        """Let the boards begin to warm up, or end it."""
        for board, ppm, change in zip(self.boards, PPM, RAMP_PPM, strict=True):
            board.set_rate(ppm if begins else ppm + change, change / RAMP_S if begins else 0.0)

    def disturb(self) -> None:
        """Be called every CYCLE_S: other traffic, and interrupts that are held off."""
        if self.sender is not None:
            for n in range(round(self.setting.load * CYCLE_S * 1e6 / FRAME_BITS)):
                self.sender.send(LOAD_ID + n % 16, bytes(8))
        if self.setting.late_share and self.random.random() < CYCLE_S / self.setting.late_for_s:
            for board in self.boards:
                late = self.random.random() < self.setting.late_share
                board.set_pace(irq_jitter_s=LATE_S if late else JITTER_S)


def config(dictionary: Dictionary) -> NodeConfig:
    return NodeConfig("board", dictionary)


def true_s(board: WorldNode, ticks: Sequence[float]) -> NDArray[np.float64]:
    """Return the true times of TICKS, between the whole ones as well."""
    whole = np.floor(np.array(ticks))
    found: NDArray[np.float64] = board.true_ps(whole.astype(np.uint64)) * 1e-12 + (
        np.array(ticks) - whole
    ) / board_hz(board)
    return found


def board_hz(board: WorldNode) -> int:
    return CLOCK_FREQS[int(board.uuid)]


class Follower:
    """One secondary node's map, steered as a job does, and what it was at each step."""

    def __init__(self, time_base: TimeBase, node: Node, print_time: float) -> None:
        self.node = node
        self._time_base = time_base
        self.map: ClockMap = time_base.secondary_map(node.best_clock, node.clock_freq_hz, print_time)
        self.print_times: list[float] = []
        self.mapped: list[float] = []

    def step(self, border: float) -> None:
        """Bend the map at BORDER, up to which steps are made."""
        last = self.map.last
        self.print_times.append((last.print_time + border) / 2)
        self.mapped.append(last.ticks + (self.print_times[-1] - last.print_time) * last.ticks_per_s)
        self._time_base.steer(self.node.name, self.map, self.node.best_clock, border)
        self.map.forget()


async def play(machine: Machine, errors: Errors) -> None:
    """Run one seed of a setting to its end."""
    await machine.bus.start()
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    primary = machine.nodes[0]
    time_base = TimeBase(primary.clock, primary.clock_freq_hz)
    begin = time_base.print_time_at(HostTime(machine.world.now_ns)) + MAKE_AHEAD_S
    followers = [Follower(time_base, node, begin) for node in machine.nodes[1:]]
    ramps = [(RAMP_FROM_S, True), (RAMP_FROM_S + RAMP_S, False)]
    made_s = 0.0
    while (passed_s := loop.time() - began_s) < UNTIL_S:
        if ramps and passed_s >= ramps[0][0]:
            machine.ramp(begins=ramps.pop(0)[1])
        machine.disturb()
        await asyncio.sleep(CYCLE_S)
        if passed_s < made_s + FULL_CYCLE_S:
            continue
        made_s = passed_s
        now_ns = HostTime(machine.world.now_ns)
        for follower, board in zip(followers, machine.boards[1:], strict=True):
            follower.step(time_base.print_time_at(now_ns) + MAKE_AHEAD_S)
            if passed_s >= SCORED_AFTER_S:
                look(machine, follower.node, board, errors)
    score(machine, followers, errors)
    await machine.bus.close()


def look(machine: Machine, node: Node, board: WorldNode, errors: Errors) -> None:
    """Compare the estimate with the truth of now: the primary's clock is what counts."""
    believed_ns = machine.nodes[0].clock.ns_at(Ticks(machine.boards[0].clock))
    off = (node.best_clock.ticks_at(believed_ns) - board.clock) / node.clock_freq_hz
    errors.estimate.append(off)
    errors.bound.append(node.clock_error_s or math.inf)


def score(machine: Machine, followers: Sequence[Follower], errors: Errors) -> None:
    skip = round((SCORED_AFTER_S + MAKE_AHEAD_S) / FULL_CYCLE_S)
    primary_hz = machine.nodes[0].clock_freq_hz
    for follower, board in zip(followers, machine.boards[1:], strict=True):
        due = true_s(machine.boards[0], [p * primary_hz for p in follower.print_times[skip:]])
        errors.mapped.extend(true_s(board, follower.mapped[skip:]) - due)


def main() -> None:
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 2
    print(f"{'':<26}{'estimate':>18}{'map':>18}")
    print(f"{'µs':<26}{'rms':>9}{'worst':>9}{'rms':>9}{'worst':>9}{'bound':>9}{'held':>9}")
    for setting in SETTINGS:
        errors, began = Errors(), time.monotonic()
        for seed in range(seeds):
            machine = Machine(seed, setting)
            run(machine.world, play(machine, errors), limit_s=UNTIL_S + 60)
        print(f"{setting.name:<26}{errors.row()}   ({time.monotonic() - began:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
