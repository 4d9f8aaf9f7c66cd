"""How much filament is going to pass each hot end, and when: the planned moves know it before it happens.

Filament that was pulled back and comes again is hot already; only what goes farther than any before it takes
heat. Moves come from the thread that plans; heaters ask on the control loop, each about its own extruder.
"""

from array import array
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping
from threading import Lock
from typing import Any, Final

from coordinator.motion.history._history import ffi, lib

Chunk = tuple["array[float]", "array[float]"]
"""Print times, and how much new filament has passed by then, mm in all."""

KEPT_S: Final = 20.0
"""What is older than this before the newest move is forgotten."""
CHUNKS_MAX: Final = 4096
FILAMENT_AXIS: Final = 3
_DOUBLE_BYTES: Final = 8


class _Track:
    """What passes one hot end."""

    def __init__(self) -> None:
        self.chunks: deque[Chunk] = deque(maxlen=CHUNKS_MAX)
        self.place_mm = 0.0
        self.farthest_mm = 0.0


class FilamentForecast:
    """Asked with ``mm_per_s`` about extruders for which ``want`` was called; others cost nothing."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._tracks: dict[str, _Track] = {}
        self._active: tuple[str, ...] = ("extruder",)

    @property
    def is_wanted(self) -> bool:
        """Whether any heater uses the forecast."""
        return bool(self._tracks)

    def want(self, extruder: str) -> None:
        """Record what EXTRUDER moves from now on."""
        self._tracks.setdefault(extruder, _Track())

    def follow(self, weights: Mapping[str, tuple[float, float, float, float]]) -> None:
        """Record which steppers move filament in the next moves."""
        moved = {name: axes[FILAMENT_AXIS] != 0 for name, axes in weights.items()}
        others = [name for name in self._active if name not in moved]
        self._active = (*others, *(name for name, moves in moved.items() if moves))

    def see_moves(self, trapezoids: Any, count: int) -> None:
        """Record planned moves (``struct trapezoid *``)."""
        tracks = [self._tracks[name] for name in self._active if name in self._tracks]
        if not tracks or not count:
            return
        moves = ffi.cast("struct trapezoid *", trapezoids)
        for track in tracks:
            times, passed = (array("d", bytes(_DOUBLE_BYTES * 2 * count)) for _ in range(2))
            place, farthest = ffi.new("double *", track.place_mm), ffi.new("double *", track.farthest_mm)
            columns = (ffi.from_buffer("double[]", column) for column in (times, passed))
            lib.filament_passed(moves, count, place, farthest, *columns)
            track.place_mm, track.farthest_mm = place[0], farthest[0]
            self._add(track, times, passed)

    def _add(self, track: _Track, times: "array[float]", passed: "array[float]") -> None:
        with self._lock:
            track.chunks.append((times, passed))
            while track.chunks[0][0][-1] < times[-1] - KEPT_S:
                track.chunks.popleft()

    def mm_per_s(self, extruder: str, begin_s: float, end_s: float) -> float:
        """Return how fast new filament passes EXTRUDER between two print times, on average.

        What is not planned yet is taken to go on like what is.
        """
        track = self._tracks.get(extruder)
        if track is None:
            return 0.0
        with self._lock:
            chunks = list(track.chunks)
        if chunks:
            end_s = min(end_s, chunks[-1][0][-1])
        if not chunks or end_s <= begin_s:
            return 0.0
        return (_passed(chunks, end_s) - _passed(chunks, begin_s)) / (end_s - begin_s)


def _passed(chunks: list[Chunk], at_s: float) -> float:
    """Return how much had passed at AT_S; nothing more behind the last move that is known."""
    for times, passed in reversed(chunks):
        if at_s >= times[0]:
            after = bisect_right(times, at_s)
            if after == len(times):
                return passed[-1]
            begin_s, begin_mm = times[after - 1], passed[after - 1]
            share = (at_s - begin_s) / (times[after] - begin_s)
            return begin_mm + share * (passed[after] - begin_mm)
    return chunks[0][1][0]
