"""Where the machine is, from the moves it was given; a numeric integral is the witness."""

import numpy as np
import pytest

from coordinator.assembly.load import load_machine
from coordinator.gcode.machine_state import MachineState
from coordinator.gcode.status import MotionStatus
from coordinator.motion.moves import read_moves
from coordinator.motion.planner.planner import Planner
from coordinator.service.state.trace import (
    BATCH_BYTES_MAX,
    BATCHES_KEEP_S,
    KEEP_S,
    MOVES_MAX,
    MotionTrace,
    Sent,
)
from coordinator.streaming.move_source import Planned
from coordinator.support.examples import DEMO_MACHINE


def at_rest(steps_sent: tuple[int, ...] = (), last_step_clocks: tuple[int, ...] = ()) -> Planned:
    planner = Planner(load_machine(str(DEMO_MACHINE)).limits)
    return Planned(MotionStatus.of(planner, MachineState()), 0.0, steps_sent, last_step_clocks)


def planned(lines: bytes) -> tuple[Planner, MotionTrace]:
    planner, trace = Planner(load_machine(str(DEMO_MACHINE)).limits), MotionTrace(1)
    planner.homed = "XYZ"
    planner.begin_at(100.0)
    planner.feed(lines, 0, len(lines), final=True)
    assert planner.flush()
    while (waiting := planner.take()).count:
        trace.see_moves(waiting.pointer, waiting.count)
        planner.release(waiting.count)
    return planner, trace


LINES = b"G1 X10 F6000\nG1 X10 Y20 E1 F3000\nG1 X30 Y20\nG1 E3\nG1 X0 Y0 Z5\n"


def test_position_follows_velocity_and_joins_the_moves() -> None:
    planner, trace = planned(LINES)
    times = np.linspace(100.0, planner.print_time_end_s, 20_001)
    moments = [trace.at(t) for t in times]
    assert all(moment is not None for moment in moments)
    way = np.array([m.position for m in moments if m is not None])
    steps = np.diff(way, axis=0)
    path = np.hypot(np.hypot(steps[:, 0], steps[:, 1]), steps[:, 2])
    path = np.where(path > 0, path, np.abs(steps[:, 3]))  # filament alone is its own path
    speed = np.array([m.velocity_mm_s for m in moments if m is not None])
    mean = (speed[1:] + speed[:-1]) / 2
    # A corner within an interval bends the way; elsewhere speed and way agree.
    assert np.median(np.abs(path / np.diff(times) - mean)) < 1e-3
    assert path.sum() == pytest.approx((mean * np.diff(times)).sum(), rel=1e-3)
    assert way[-1] == pytest.approx(planner.toolhead_position, abs=1e-9)
    lines = [m.line for m in moments if m is not None]
    assert lines == sorted(lines)
    assert set(lines) == {1, 2, 3, 4, 5}


def test_before_all_and_behind_all() -> None:
    planner, trace = planned(LINES)
    assert trace.at(99.9) is None
    after = trace.at(planner.print_time_end_s + 5)
    assert after is not None
    assert (after.moving, after.velocity_mm_s) == (False, 0.0)
    assert after.position == pytest.approx(planner.toolhead_position, abs=1e-9)


def test_memory_is_bounded_and_the_newest_stays() -> None:
    planner, trace = planned(
        b"".join(b"G1 X%d F6000\nG1 X0\n" % (i % 100 + 1) for i in range(MOVES_MAX // 20))
    )
    for _ in range(15):
        more = b"".join(b"G1 X%d F6000\nG1 X0\n" % (i % 100 + 1) for i in range(900))
        planner.feed(more, 0, len(more), final=True)
        planner.flush()
        while (waiting := planner.take()).count:
            trace.see_moves(waiting.pointer, waiting.count)
            planner.release(waiting.count)
        planner.flush()
    assert len(trace.moves(0.0)) <= MOVES_MAX
    trace.forget_before_s = planner.print_time_end_s
    planner.feed(b"G1 X5\n", 0, 6, final=True)
    planner.flush()
    trace.see_moves(planner.take().pointer, 1)
    assert len(trace.moves(0.0)) < MOVES_MAX / 4
    sent = at_rest(steps_sent=(7,), last_step_clocks=(99,))
    for number in range(100):
        trace.see_sent([(0, bytes([number]) * (BATCH_BYTES_MAX // 10))], sent)
    assert sum(map(len, trace.batches(0))) <= BATCH_BYTES_MAX
    assert trace.sent == Sent((7,), (99,))
    total, newest = trace.batches_after(0, 97)
    assert (total, [batch[0] for batch in newest]) == (100, [97, 98, 99])
    assert [batch[0] for batch in trace.batches_after(0, 0)[1]] == list(range(90, 100)), "what is kept"
    assert trace.batches_after(0, 100) == (100, ())


def test_commands_of_long_ago_are_forgotten() -> None:
    """Failed before: up to a megabyte of them was kept for each node."""
    trace = MotionTrace(2)
    for now_s in range(100):
        trace.forget_before_s = now_s - KEEP_S
        trace.see_sent([(0, bytes((now_s,)))], at_rest())
        if now_s == 0:
            trace.see_sent([(1, b"long ago")], at_rest())
    kept = [batch[0] for batch in trace.batches(0)]
    assert kept == list(range(99 - round(BATCHES_KEEP_S), 100))
    assert trace.batches_after(0, 98) == (100, (b"\x62", b"\x63"))
    assert trace.batches_after(0, 0)[1] == trace.batches(0)
    assert trace.batches(1) == (b"long ago",), "the last one stays: a node that rests is asked about, too"


def test_only_the_stretch_that_is_asked_for() -> None:
    planner, trace = planned(LINES)
    planner.begin_at(planner.print_time_end_s + 3.0)  # it stands meanwhile
    planner.feed(LINES, 0, len(LINES), final=True)
    assert planner.flush()
    trace.see_moves(planner.take().pointer, planner.take().count)
    everything = trace.moves(0.0)
    assert len(everything) == 10
    begins = [move.print_time for move in everything]
    ends = [sum(move[:4]) for move in everything]
    borders = np.array(begins + ends)
    times = [*np.linspace(99.0, ends[-1] + 1.0, 500), *(borders - 1e-6), *(borders + 1e-6), ends[4]]
    for since_s in times:
        assert trace.moves(since_s) == [m for m, end in zip(everything, ends, strict=True) if end > since_s]


def test_fresh_moves_are_taken_once() -> None:
    planner, trace = planned(LINES)
    fresh = trace.take_fresh()
    assert [*read_moves(fresh)] == trace.moves(0.0)
    assert trace.heights(0.0) == (0.0, 0.0)
    assert fresh
    assert len(trace.take_fresh()) == 0
    assert planner.homed == "XYZ"
