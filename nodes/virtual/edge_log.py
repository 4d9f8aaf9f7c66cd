"""Reads the log that a virtual node writes of its pins: each change of level, with the clock at that time.

Layout: a header of 64 bytes, then 8-byte records ``clock << 16 | pin << 1 | level`` (little-endian).
"""

import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from nodes.support.errors import CanductorError

MAGIC = b"CNDEDGE1"
HEADER_SIZE = 64
RECORD_SIZE = 8
CHUNK_RECORDS = 65_536
"""Records read at once: half a megabyte."""
CLOCK_BITS = 48
PIN_MAX = 0x7FFF

_HEADER = struct.Struct("<8sddQQ")
_CLOCK_MODULO = 1 << CLOCK_BITS

Clocks = npt.NDArray[np.uint64]
Directions = npt.NDArray[np.int8]


class EdgeLog:
    """The log at PATH; it may still grow: each call of steps() reads what it contains when the call begins.

    Memory is bounded for any length of the log. Clocks have 48 bits, enough for years.
    """

    def __init__(self, path: str | Path) -> None:
        """Read the header; raises CanductorError when PATH is not an edge log."""
        self.path = Path(path)
        try:
            with self.path.open("rb") as file:
                header = file.read(HEADER_SIZE)
        except OSError as error:
            raise CanductorError(f"edge log {path}: cannot be read: {error.strerror}") from error
        if len(header) < HEADER_SIZE or not header.startswith(MAGIC):
            raise CanductorError(f"edge log {path}: not an edge log of a virtual node; was the node started?")
        _, self.clock_freq, self.ticks_per_second, self.start_monotonic_ns, self.start_clock = (
            _HEADER.unpack_from(header)
        )
        if not (0 < self.clock_freq < 1e12 and 0 < self.ticks_per_second < 1e12):
            raise CanductorError(
                f"edge log {path}: its header is damaged: clock rate {self.ticks_per_second} Hz"
            )

    @property
    def record_count(self) -> int:
        """Number of complete records now in the file."""
        return max(0, self.path.stat().st_size - HEADER_SIZE) // RECORD_SIZE

    def ticks_to_monotonic_ns(self, clock: int | Clocks) -> npt.NDArray[np.int64]:
        """Return the true time (host's CLOCK_MONOTONIC, ns) at which the node's clock was CLOCK.

        CLOCK is one clock or an array, of which the lowest 48 bits count.
        """
        start = np.uint64(self.start_clock % _CLOCK_MODULO)
        ticks = (np.asarray(clock, np.uint64) - start) & np.uint64(_CLOCK_MODULO - 1)
        # Clocks before the start become negative.
        signed = (ticks << np.uint64(64 - CLOCK_BITS)).view(np.int64) >> np.int64(64 - CLOCK_BITS)
        elapsed_ns = np.rint(signed * (1e9 / self.ticks_per_second)).astype(np.int64)
        return np.asarray(elapsed_ns + np.int64(self.start_monotonic_ns))

    def edges(
        self, *pins: int, chunk_records: int = CHUNK_RECORDS
    ) -> Iterator[tuple[Clocks, npt.NDArray[np.uint16], npt.NDArray[np.uint8]]]:
        """Yield the changes of PINS in order: chunks of clock, pin and level."""
        left, offset = self.record_count, HEADER_SIZE
        while left > 0:
            records = np.fromfile(self.path, "<u8", min(left, chunk_records), offset=offset)
            left -= len(records)
            offset += records.nbytes
            pin = (records >> np.uint64(1)).astype(np.uint16) & np.uint16(PIN_MAX)
            chosen = np.isin(pin, pins)
            level = (records[chosen] & np.uint64(1)).astype(np.uint8)
            yield records[chosen] >> np.uint64(16), pin[chosen], level

    def steps(
        self,
        step_pin: int,
        dir_pin: int,
        both_edges: bool,
        *,
        step_idle_level: int = 0,
        chunk_records: int = CHUNK_RECORDS,
    ) -> Iterator[tuple[Clocks, Directions]]:
        """Yield the steps of one stepper: chunks of clock and direction (+1: the direction pin was high).

        A step is every change of the step pin if BOTH_EDGES, else every change away from STEP_IDLE_LEVEL.
        Before its first record, a pin is at its idle level (the direction pin: low); a record that repeats a
        level is not a change.
        """
        chunks = self.edges(step_pin, dir_pin, chunk_records=chunk_records)
        yield from steps_of(chunks, step_pin, both_edges=both_edges, step_idle_level=step_idle_level)


def steps_of(
    chunks: Iterable[tuple[Clocks, npt.NDArray[np.uint16], npt.NDArray[np.uint8]]],
    step_pin: int,
    *,
    both_edges: bool,
    step_idle_level: int = 0,
) -> Iterator[tuple[Clocks, Directions]]:
    """Yield the steps in CHUNKS of clock, pin and level of a step and a direction pin; see EdgeLog.steps."""
    step_level, dir_level = step_idle_level, 0
    for clock, pin, level in chunks:
        is_step_pin = pin == step_pin
        levels = level[is_step_pin]
        before = np.concatenate(([np.uint8(step_level)], levels[:-1]))
        stepped = levels != before
        if not both_edges:
            stepped &= levels != step_idle_level
        # The direction pin's level after each record.
        last_dir = np.maximum.accumulate(np.where(is_step_pin, -1, np.arange(len(pin))))
        directions = np.where(last_dir < 0, dir_level, level[last_dir])[is_step_pin][stepped]
        if len(levels):
            step_level = int(levels[-1])
        if len(pin) and last_dir[-1] >= 0:
            dir_level = int(level[last_dir[-1]])
        yield clock[is_step_pin][stepped], (directions.astype(np.int8) * 2 - 1).astype(np.int8)
