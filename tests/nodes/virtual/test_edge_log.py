"""The reader of edge logs, against a loop that looks at one record after the other."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nodes.support.errors import CanductorError
from nodes.virtual.edge_log import HEADER_SIZE, EdgeLog

Edge = tuple[int, int, int]
STEP, DIR, OTHER = 4, 0x7FFF, 7


def write_log(
    path: Path,
    edges: list[Edge],
    *,
    true_rate: float = 50_010_000.0,
    monotonic_ns: int = 10**15,
    clock: int = 0,
) -> Path:
    header = struct.pack("<8sddQQ", b"CNDEDGE1", 5e7, true_rate, monotonic_ns, clock).ljust(
        HEADER_SIZE, b"\0"
    )
    records = b"".join(struct.pack("<Q", clock << 16 | pin << 1 | level) for clock, pin, level in edges)
    path.write_bytes(header + records)
    return path


def slow_steps(edges: list[Edge], both_edges: bool, idle: int) -> list[tuple[int, int]]:
    steps, level_now, direction = [], idle, -1
    for clock, pin, level in edges:
        if pin == DIR:
            direction = 1 if level else -1
        if pin == STEP:
            if level != level_now and (both_edges or level != idle):
                steps.append((clock, direction))
            level_now = level
    return steps


@given(
    edges=st.lists(
        st.tuples(st.integers(0, 2**48 - 1), st.sampled_from([STEP, DIR, OTHER]), st.integers(0, 1)),
        max_size=60,
    ),
    both_edges=st.booleans(),
    idle=st.integers(0, 1),
    chunk=st.integers(1, 9),
)
def test_steps_are_those_a_slow_reader_finds(
    tmp_path_factory: pytest.TempPathFactory, edges: list[Edge], both_edges: bool, idle: int, chunk: int
) -> None:
    log = EdgeLog(write_log(tmp_path_factory.getbasetemp() / "edges", edges))
    found: list[tuple[int, int]] = []
    for clock, direction in log.steps(STEP, DIR, both_edges, step_idle_level=idle, chunk_records=chunk):
        assert clock.dtype == np.uint64
        assert direction.dtype == np.int8
        assert len(clock) <= chunk
        found += zip(clock.tolist(), direction.tolist(), strict=True)
    assert found == slow_steps(edges, both_edges, idle)


def test_header_and_true_time(tmp_path: Path) -> None:
    start = 2**32 - 1000
    log = EdgeLog(write_log(tmp_path / "log", [], clock=start, true_rate=5e7 * 1.0002))
    assert (log.clock_freq, log.start_clock, log.start_monotonic_ns) == (5e7, start, 10**15)
    assert log.ticks_to_monotonic_ns(start) == 10**15
    hour_ticks = round(3600 * 5e7 * 1.0002)  # over many rollovers of 32 bits
    clocks = np.array([start - 50_010, start + 50_010, start + hour_ticks], np.uint64)
    assert log.ticks_to_monotonic_ns(clocks).tolist() == [
        10**15 - 10**6,
        10**15 + 10**6,
        10**15 + 3600 * 10**9,
    ]


def test_true_time_where_48_bits_roll_over(tmp_path: Path) -> None:
    log = EdgeLog(write_log(tmp_path / "log", [], clock=2**48 - 10, true_rate=1e9))
    assert log.ticks_to_monotonic_ns(np.array([2**48 - 11, 5], np.uint64)).tolist() == [
        10**15 - 1,
        10**15 + 15,
    ]


def test_a_log_still_being_written(tmp_path: Path) -> None:
    path = write_log(tmp_path / "log", [(1, STEP, 1), (2, STEP, 0)])
    log = EdgeLog(path)
    with path.open("ab") as file:
        file.write(struct.pack("<Q", 3 << 16 | STEP << 1 | 1) + b"abc")  # and a part of the next
    assert log.record_count == 3
    assert [clock.tolist() for clock, _ in log.steps(STEP, DIR, both_edges=False)] == [[1, 3]]


@pytest.mark.parametrize("content", [b"", b"CNDEDGE1", b"x" * 64, b"CNDEDGE1".ljust(64, b"\0")])
def test_what_is_no_log_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "log").write_bytes(content)
    with pytest.raises(CanductorError, match=r"edge log .*(not an edge log|damaged)"):
        EdgeLog(tmp_path / "log")
    with pytest.raises(CanductorError, match="cannot be read"):
        EdgeLog(tmp_path / "none")
