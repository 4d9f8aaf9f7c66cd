"""How much filament is going to pass each hot end, and when: the planned moves know it before it happens.

Filament that was pulled back and comes again is hot already; only what goes farther than any before it takes
heat. Moves come from the thread that plans; heaters ask on the control loop, each about its own extruder.
"""

from collections import deque
from collections.abc import Mapping
from threading import Lock
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from coordinator.motion.planner._planner import ffi
from coordinator.motion.trapezoid_array import TRAPEZOID

if TYPE_CHECKING:
    Chunk = tuple[NDArray[np.float64], NDArray[np.float64]]
    """Print times, and how much new filament has passed by then, mm in all."""

KEPT_S: Final = 20.0
"""What is older than this before the newest move is forgotten."""
CHUNKS_MAX: Final = 4096
FILAMENT_AXIS: Final = 3


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
        data: Any = ffi.buffer(trapezoids, count * TRAPEZOID.itemsize)
        moves = np.frombuffer(data, TRAPEZOID)
        up, cruise, down = moves["accel_s"], moves["cruise_s"], moves["decel_s"]
        way = moves["start_v"] * up + moves["accel"] * up**2 / 2 + moves["cruise_v"] * (cruise + down)
        way -= moves["accel"] * down**2 / 2
        pushed = moves["ratio"][:, FILAMENT_AXIS] * way
        begin = moves["print_time"]
        times = np.stack((begin, begin + up + cruise + down), axis=1).ravel()
        for track in tracks:
            places = track.place_mm + np.cumsum(pushed)
            farthest = np.maximum(np.maximum.accumulate(places), track.farthest_mm)
            before = np.concatenate(((track.farthest_mm,), farthest[:-1]))
            self._add(track, times, np.stack((before, farthest), axis=1).ravel())
            track.place_mm, track.farthest_mm = float(places[-1]), float(farthest[-1])

    def _add(self, track: _Track, times: "NDArray[np.float64]", passed: "NDArray[np.float64]") -> None:
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
            end_s = min(end_s, float(chunks[-1][0][-1]))
        if not chunks or end_s <= begin_s:
            return 0.0
        return (_passed(chunks, end_s) - _passed(chunks, begin_s)) / (end_s - begin_s)


def _passed(chunks: "list[Chunk]", at_s: float) -> float:
    """Return how much had passed at AT_S; nothing more behind the last move that is known."""
    for times, passed in reversed(chunks):
        if at_s >= times[0]:
            return float(np.interp(at_s, times, passed))
    return float(chunks[0][1][0])
