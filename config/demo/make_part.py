"""Write the demo part, the conductor's token, as a binary STL.

A toothed disc 28 mm wide with a baton laid across three waving staff lines. It is drawn to make a planner
work: 48 sharp corners on the rim, curves cut into short segments, lines two extrusions wide, holes down to
1.4 mm, islands that need travel and retraction, and three heights.

Usage: python3 make_part.py token.stl

All lengths are in millimetres. The part stands on z = 0, centred on x = y = 0.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Points: TypeAlias = npt.NDArray[np.float64]  # (n, 2) points of an edge, or (n, 3, 3) triangles

TEETH = 12
TIP_RADIUS_MM = 14.0
ROOT_RADIUS_MM = 12.4
RIM_INNER_RADIUS_MM = 10.6
# One tooth as (part of the pitch, radius): an arc at the root, a straight flank, an arc at the tip. The
# second flank leads to the next tooth.
TOOTH = (
    *((part, ROOT_RADIUS_MM) for part in (0.00, 0.17, 0.34)),
    *((part, TIP_RADIUS_MM) for part in (0.50, 0.67, 0.84)),
)
STAFF_WIDTH_MM = 0.9
BATON_ANGLE_RAD = np.radians(52.0)
# The tops of the solids, whole layers of 0.2 mm. The staff is the lowest, the baton crosses above it.
STAFF_TOP_MM = 0.4
RIM_TOP_MM = 0.6
NOTE_TOP_MM = 0.6
BATON_TOP_MM = 0.8


def band(left: Points, right: Points, top_mm: float, *, closed: bool) -> Points:
    """Return the triangles of an upright solid between two edges, from z = 0 to top_mm.

    The edges have the same number of points and run the same way; seen along them, `left` is on the left.
    A closed band is a ring (run counter-clockwise, `left` is the hole); an open band gets two end walls.
    """
    last = len(left) if closed else len(left) - 1
    here = np.arange(last)
    there = (here + 1) % len(left)

    def at(edge: Points, z_mm: float) -> Points:
        return np.column_stack((edge, np.full(len(edge), z_mm)))

    left_low, left_high = at(left, 0.0), at(left, top_mm)
    right_low, right_high = at(right, 0.0), at(right, top_mm)
    quads = [
        (right_high[here], right_high[there], left_high[there], left_high[here]),
        (left_low[here], left_low[there], right_low[there], right_low[here]),
        (right_low[here], right_low[there], right_high[there], right_high[here]),
        (left_high[here], left_high[there], left_low[there], left_low[here]),
    ]
    if not closed:
        start, end = slice(0, 1), slice(-1, None)
        quads.append((left_low[start], right_low[start], right_high[start], left_high[start]))
        quads.append((left_high[end], right_high[end], right_low[end], left_low[end]))
    halves = [half for a, b, c, d in quads for half in (np.stack((a, b, c), 1), np.stack((a, c, d), 1))]
    return np.concatenate(halves)


def ellipse(center: tuple[float, float], radii: tuple[float, float], tilt_rad: float, count: int) -> Points:
    """Return `count` points of an ellipse, counter-clockwise; equal radii make a circle."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    points = np.column_stack((radii[0] * np.cos(angle), radii[1] * np.sin(angle)))
    moved: Points = turn(points, tilt_rad) + np.array(center)
    return moved


def turn(points: Points, angle_rad: float) -> Points:
    """Turn points about the origin, counter-clockwise."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    turned: Points = points @ np.array([[cos, sin], [-sin, cos]])
    return turned


def rim() -> Points:
    """Return the toothed rim: four sharp corners a tooth outside, a fine circle inside."""
    pitch = 2.0 * np.pi / TEETH
    outer, inner = [], []
    for tooth in range(TEETH):
        for part, radius_mm in TOOTH:
            angle = (tooth + part) * pitch
            direction = np.array([np.cos(angle), np.sin(angle)])
            outer.append(radius_mm * direction)
            inner.append(RIM_INNER_RADIUS_MM * direction)
    return band(np.array(inner), np.array(outer), RIM_TOP_MM, closed=True)


def staff_line(y_mm: float) -> Points:
    """Return one waving line of the staff, its ends sunk into the rim."""
    reach = np.sqrt((RIM_INNER_RADIUS_MM + 0.8) ** 2 - y_mm**2)
    x = np.linspace(-reach, reach, 61)
    y = y_mm + 1.1 * np.sin(x * 0.6)
    slope = 1.1 * 0.6 * np.cos(x * 0.6)
    normal = np.column_stack((-slope, np.ones_like(x))) / np.sqrt(1.0 + slope**2)[:, None]
    middle = np.column_stack((x, y))
    aside = normal * STAFF_WIDTH_MM / 2
    return band(middle + aside, middle - aside, STAFF_TOP_MM, closed=False)


def note(x_mm: float, y_mm: float) -> Points:
    """Return a hollow note head, a tilted ellipse round a hole of 1.4 mm."""
    outer = ellipse((x_mm, y_mm), (2.1, 1.5), 0.4, 36)
    hole = ellipse((x_mm, y_mm), (0.7, 0.7), 0.4, 36)
    return band(hole, outer, NOTE_TOP_MM, closed=True)


def baton() -> list[Points]:
    """Return the baton: a round grip with a hole, and a blade that tapers to a single extrusion."""
    hole = ellipse((-6.6, 0.0), (0.9, 0.9), 0.0, 48)
    handle = ellipse((-6.6, 0.0), (2.6, 1.9), 0.0, 48)
    grip = band(hole, handle, BATON_TOP_MM, closed=True)
    length_mm = np.linspace(-4.6, 10.0, 15)
    half_width_mm = np.linspace(0.9, 0.25, 15)
    upper = np.column_stack((length_mm, half_width_mm))
    lower = np.column_stack((length_mm, -half_width_mm))
    blade = band(upper, lower, BATON_TOP_MM, closed=False)
    for solid in (grip, blade):
        solid[:, :, :2] = turn(solid[:, :, :2].reshape(-1, 2), BATON_ANGLE_RAD).reshape(-1, 3, 2)
    return [grip, blade]


def token() -> Points:
    """Return every triangle of the part. The solids overlap: a slicer prints their union."""
    staff = [staff_line(y_mm) for y_mm in (-4.6, 0.0, 4.6)]
    notes = [note(-4.9, 5.4), note(5.6, -3.9)]
    return np.concatenate([rim(), *staff, *notes, *baton()])


def binary_stl(triangles: Points) -> bytes:
    """Return triangles (n, 3, 3) as a binary STL, with unit normals by the right-hand rule."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    record = np.zeros(len(triangles), dtype=[("vectors", "<f4", (4, 3)), ("attributes", "<u2")])
    record["vectors"] = np.concatenate((normal[:, None], triangles), axis=1)
    header = b"conductor's token, millimetres".ljust(80, b"\0")
    return header + len(triangles).to_bytes(4, "little") + record.tobytes()


def main() -> int:
    """Write the STL named on the command line; return the exit status."""
    if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
        sys.stderr.write("usage: make_part.py FILE.stl\n")
        return 2
    try:
        Path(sys.argv[1]).write_bytes(binary_stl(token()))
    except OSError as error:
        sys.stderr.write(f"make_part.py: cannot write {sys.argv[1]}: {error.strerror}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
