"""Timed commands hold a slot of their node's queue until they have finished, as steps do."""

import numpy as np
import pytest

from tests.coordinator.motion.steps_harness import ORIGIN, E, Run, X, Y, Z, node_spec, stepper
from tests.coordinator.motion.steps_oracle import Move, make_move

FREQ_HZ = 168e6
OTHER_COMMAND = 77
HOLDS_S = 0.3
"""From when a timed command is sent at the earliest to when it takes effect and frees its slot."""


class Outputs:
    """A node's timed commands beside its steps; NUMBER is what tells them apart."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self.finish: list[int] = []

    def add(self, req_s: float, finish_s: float) -> None:
        """Queue a command that is sent for REQ_S (print time) and holds its slot until FINISH_S."""
        req, finish = round(req_s * FREQ_HZ), round(finish_s * FREQ_HZ)
        self._run.gen.add_timed(0, req, finish, bytes([OTHER_COMMAND, len(self.finish)]))
        self.finish.append(finish)

    def most_slots(self) -> int:
        """Receive all as early as min_clock lets it come; return the most slots that were ever in use."""
        held: list[int] = []
        now = most = taken = 0
        for record in self._run.nodes[0].records:
            now = max(now, record.min_clock)
            if record.name == "other":
                assert record.values[0] == OTHER_COMMAND
                finish, taken = self.finish[record.values[1]], taken + 1
            elif record.name == "queue_step":
                finish = record.finish
            else:
                continue
            held = [other for other in held if other > now]
            held.append(finish)
            most = max(most, len(held))
        assert taken == len(self.finish)
        return most


def moves_of(seconds: float) -> list[Move]:
    """Return random moves from print time 1 s on."""
    moves, at, t = list[Move](), ORIGIN, 1.0
    rng = np.random.default_rng(3)
    while t < 1.0 + seconds:
        x, y, z, e = (float(v) for v in rng.uniform(-2, 2, 4))
        moves.append(make_move(t, at, (x, y, z, e), (0.0, 20.0, 0.0), 3000.0))
        t, at = t + moves[-1].total_s, (x, y, z, e)
    return moves


@pytest.mark.parametrize("move_count", [1, 3, 8])
def test_more_timed_commands_than_slots_wait_for_those_before_them(move_count: int) -> None:
    run = Run([stepper(0, X)], [node_spec(move_count=move_count)])
    outputs = Outputs(run)
    for k in range(4 * move_count):
        outputs.add(1.0 + 0.01 * k, 1.0 + 0.01 * k + HOLDS_S)
    run.play([make_move(3.0, ORIGIN, (1.0, 0.0, 0.0, 0.0), (0.0, 20.0, 0.0), 3000.0)])
    assert outputs.most_slots() == move_count
    assert run.gen.stats().nodes[0].max_slots >= move_count


@pytest.mark.parametrize("move_count", [2, 16])
def test_slots_never_overflow_with_steps_and_timed_commands_together(move_count: int) -> None:
    run = Run([stepper(i, w) for i, w in enumerate((X, Y, Z, E))], [node_spec(move_count=move_count)])
    moves = moves_of(0.25)
    outputs = Outputs(run)
    for k in range(50):
        outputs.add(1.0 + 0.005 * k, 1.0 + 0.005 * k + HOLDS_S)
    run.play(moves)
    run.check(moves)
    assert outputs.most_slots() == move_count


def test_a_command_that_finishes_late_is_not_passed_over_by_ones_that_finish_early() -> None:
    run = Run([stepper(0, X)], [node_spec(move_count=2)])
    outputs = Outputs(run)
    outputs.add(1.0, 9.0)
    for k in range(5):
        outputs.add(1.1 + 0.1 * k, 1.15 + 0.1 * k)
    run.play([make_move(10.0, ORIGIN, (1.0, 0.0, 0.0, 0.0), (0.0, 20.0, 0.0), 3000.0)])
    min_clocks = [record.min_clock for record in run.nodes[0].records if record.name == "other"]
    assert min_clocks == [0, 0, *outputs.finish[1:-1]], "one slot is free, again and again"
    assert outputs.most_slots() == 2
