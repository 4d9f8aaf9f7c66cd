"""Moves in bytes are what the planner and numpy see in the same memory."""

import numpy as np
import pytest

from coordinator.motion.moves import (
    MOVE_BYTES,
    Move,
    begin_heights_mm,
    begin_times_s,
    end_s,
    read_move,
    read_moves,
)
from coordinator.motion.trapezoid_array import TRAPEZOID


def some_moves(count: int) -> "np.ndarray[tuple[int], np.dtype[np.void]]":
    chance, moves = np.random.default_rng(1), np.zeros(count, TRAPEZOID)
    for name in TRAPEZOID.names or ():
        shape = moves[name].shape
        moves[name] = (
            chance.integers(-(2**40), 2**40, shape) if name == "line" else chance.normal(0, 9, shape)
        )
    return moves


def test_every_field_is_where_the_compiler_has_it() -> None:
    moves = some_moves(5)
    data = moves.tobytes()
    assert TRAPEZOID.itemsize == MOVE_BYTES
    assert Move._fields == TRAPEZOID.names
    for index, move in enumerate(read_moves(data)):
        for name in Move._fields:
            assert np.array_equal(getattr(move, name), moves[index][name])
        assert move == read_move(data, index)
        assert move.to_bytes() == data[index * MOVE_BYTES :][:MOVE_BYTES]


def test_times_and_heights() -> None:
    moves = some_moves(4)
    data, last = moves.tobytes(), moves[-1]
    assert begin_times_s(data).tolist() == moves["print_time"].tolist()
    phases = ("print_time", "accel_s", "cruise_s", "decel_s")
    assert end_s(data, -1) == pytest.approx(sum(last[name] for name in phases))
    assert begin_heights_mm(data).tolist() == moves["start"][:, 2].tolist()
