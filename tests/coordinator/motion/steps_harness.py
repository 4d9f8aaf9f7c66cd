"""Runs a generator, executes what it emits on oracle nodes, and compares every step."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

from coordinator.motion.specs import NodeStreamSpec, StepperSpec
from coordinator.motion.steps.steps import StepGenerator
from tests.coordinator.motion.steps_oracle import Move, Node, Position, Step, step_times
from tests.stages.resting_step import resting_steps

ORIGIN: Position = (0.0, 0.0, 0.0, 0.0)
MAX_ERROR_S = 12.5e-6
# At a standstill a step's time is ill-conditioned: 1e-13 mm are worth some 5 ns.
NOISE_S = 5e-8


def node_spec(name: str = "main", freq: int = 168_000_000, move_count: int = 1024) -> NodeStreamSpec:
    return NodeStreamSpec(name, freq, move_count, 21, 200, -5)


def stepper(
    oid: int,
    weights: tuple[float, float, float, float],
    distance: float = 0.00625,
    *,
    node: int = 0,
    invert: bool = False,
    pulse_s: float = 2e-6,
) -> StepperSpec:
    return StepperSpec(f"s{oid}", node, oid, weights, distance, invert, pulse_s)


X = (1.0, 0.0, 0.0, 0.0)
Y = (0.0, 1.0, 0.0, 0.0)
Z = (0.0, 0.0, 1.0, 0.0)
E = (0.0, 0.0, 0.0, 1.0)
MACHINES = {
    "cartesian": [
        stepper(0, X),
        stepper(1, Y, 0.01, invert=True),
        stepper(2, Z, 0.0025, pulse_s=0.0),
        stepper(3, E, 0.001417, node=1),
    ],
    "corexy": [stepper(0, (1.0, 1.0, 0.0, 0.0)), stepper(1, (1.0, -1.0, 0.0, 0.0), node=1)],
}
NODES = [node_spec(), node_spec("tool", 64_000_000, 16)]


def rows(moves: Sequence[Move]) -> "np.ndarray[tuple[int, int], np.dtype[np.float64]]":
    return np.array([move.row() for move in moves])


class Run:
    """A generator and the nodes it feeds."""

    def __init__(
        self,
        steppers: Sequence[StepperSpec],
        nodes: Sequence[NodeStreamSpec] = NODES,
        *,
        start: Position = ORIGIN,
        max_error_s: float = MAX_ERROR_S,
        longest_s: float = 0.0,
    ) -> None:
        self.longest_s = longest_s
        self.steppers, self.specs, self.start, self.max_error_s = steppers, nodes, start, max_error_s
        self.gen = StepGenerator(steppers, nodes, start=start, max_error_s=max_error_s, longest_s=longest_s)
        self.nodes = [Node(spec, [s for s in steppers if s.node == i]) for i, spec in enumerate(nodes)]

    def collect(self, room: int = 4096) -> None:
        for i, node in enumerate(self.nodes):
            while batch := self.gen.take_batch(i, room):
                node.execute(batch)

    def play(self, moves: Sequence[Move], cuts: Sequence[tuple[float, bool]] = ()) -> None:
        assert self.gen.append(rows(moves), len(moves)) == len(moves)
        end = moves[-1].print_time + moves[-1].total_s
        for until, flush in [*sorted(cuts), (end, False), (end, True)]:
            while not self.gen.generate(until, flush=flush):
                self.collect()
            self.collect()

    def steps(self, index: int) -> list[tuple[int, int]]:
        s = self.steppers[index]
        return self.nodes[s.node].motors[s.oid].steps

    def check(self, moves: Sequence[Move], *, flushed: bool = False) -> None:
        for i, spec in enumerate(self.steppers):
            freq = self.specs[spec.node].clock_freq
            wanted = step_times(spec, freq, moves, self.start, self.max_error_s)
            done = self.steps(i)
            if not (flushed and len(done) != len(wanted)):
                compare(done, wanted, freq)
            position = sum(direction for _, direction in done)
            assert position == self.gen.position(i)
            assert position in resting_steps(spec, self.start, moves[-1].end)
            shortest = max(math.ceil(2 * spec.step_pulse_s * freq), 1)
            clocks = [clock for clock, _ in done]
            assert all(b - a >= shortest for a, b in itertools.pairwise(clocks))
        self.check_nodes()

    def check_nodes(self) -> None:
        stats = self.gen.stats()
        for node, counted in zip(self.nodes, stats.nodes, strict=True):
            assert node.check_slots() <= node.spec.move_count
            req = [record.req_clock for record in node.records]
            assert req == sorted(req)
            assert counted.framed_bytes == node.framed_bytes()
            assert counted.commands == len(node.records)
            assert counted.content_bytes == sum(record.size for record in node.records)
            steps = [record for record in node.records if record.name == "queue_step"]
            longest = (self.longest_s + 2 * self.max_error_s) * node.spec.clock_freq
            assert not self.longest_s or all(record.finish - record.first <= longest for record in steps)
            assert counted.late_slots == sum(record.min_clock > record.first for record in steps)
        for i, s in enumerate(stats.steppers):
            mine = [r for r in self.nodes[self.steppers[i].node].records if r.oid == self.steppers[i].oid]
            assert s.steps == len(self.steps(i))
            assert s.issued == sum(direction for _, direction in self.steps(i))
            assert s.queue_steps == sum(r.name == "queue_step" for r in mine)
            assert s.direction_changes == sum(r.name == "set_next_step_dir" for r in mine)
            assert s.commands == len(mine)
            assert s.content_bytes == sum(r.size for r in mine)


def compare(done: list[tuple[int, int]], wanted: list[Step], freq: float) -> None:
    assert [d for _, d in done] == [s.direction for s in wanted]
    for (clock, _), step in zip(done, wanted, strict=True):
        assert abs(clock / freq - step.time) <= step.band_s + NOISE_S
