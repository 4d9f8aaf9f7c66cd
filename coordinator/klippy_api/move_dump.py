"""``motion_report/dump_trapq``: the executed moves, for programs that analyse motion; no I/O."""

from collections.abc import Mapping
from typing import Any, Final

from coordinator.motion.moves import Move
from coordinator.service.state.trace import MotionTrace

HEADER: Final = ("time", "duration", "start_velocity", "acceleration", "start_position", "direction")
"""Of each row: s of print time, s, mm/s, mm/s², mm, and a unit vector."""
TOOLHEAD: Final = "toolhead"
AXES: Final = 3


class MoveDump:
    """The moves of NAME, the toolhead or an extruder, that begin from print time SINCE_S on.

    Messages are made from TEMPLATE.
    """

    def __init__(self, name: str, template: Mapping[str, Any], since_s: float) -> None:
        self.template = template
        self._name = name
        self._extruder = name != TOOLHEAD
        self._until_s = since_s

    def take(self, trace: MotionTrace, now_s: float, active: object) -> list[list[Any]]:
        """Return the rows of moves that have begun by print time NOW_S and were not returned before.

        The extruder ACTIVE is the one that has moved.
        """
        rows: list[list[Any]] = []
        if not self._extruder or self._name == active:
            for move in trace.moves(self._until_s):
                if self._until_s <= move.print_time < now_s:
                    rows += self._rows(move)
        self._until_s = max(self._until_s, now_s)
        return rows

    def _rows(self, move: Move) -> list[list[Any]]:
        """Return a row for each part of MOVE at a constant acceleration; none if it moves other axes only."""
        place, ratio = list(move.start), list(move.ratio)
        if self._extruder:
            scale = abs(ratio[AXES])
            at, direction = [place[AXES], 0.0, 0.0], [1.0 if ratio[AXES] > 0 else -1.0, 0.0, 0.0]
        else:
            scale = 1.0 if any(ratio[:AXES]) else 0.0
            at, direction = place[:AXES], ratio[:AXES]
        if not scale:
            return []
        time_s, speed, accel = move.print_time, move.start_v, move.accel
        parts = ((move.accel_s, accel), (move.cruise_s, 0.0), (move.decel_s, -accel))
        rows: list[list[Any]] = []
        for duration_s, acceleration in parts:
            if duration_s <= 0:
                continue
            rows.append([time_s, duration_s, scale * speed, scale * acceleration, at, direction])
            way_mm = scale * (speed + acceleration * duration_s / 2) * duration_s
            at = [start + way_mm * share for start, share in zip(at, direction, strict=True)]
            time_s, speed = time_s + duration_s, speed + acceleration * duration_s
        return rows
