"""Load of a CAN bus: the library of ``canductor can load``, for any user of python-can.

    meter = LoadMeter(bitrate=1_000_000)
    for message in bus:                 # can.Message, or canbus_tools.protocol.frame.Frame
        meter.feed(message)
    print(f"{meter.load().mean:.1%}")   # of all the bus could carry

A frame counts with its bits on the wire: all fields, the stuff bits of its content, and the interframe space
of three bits. The cost of an error is not reported by any adapter: it is estimated and shown separately. CAN
FD frames are counted but not measured.

Times are seconds of the clock that stamps the frames; a frame belongs to the window in which it was
received. Memory is bounded: WINDOWS_MAX windows, which become longer if the time does not fit; IDS_MAX ids,
and one entry for the frames of all further ids.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple

import can

from canbus_tools.bus.open_bus import BITRATE_MAX, BITRATE_MIN
from canbus_tools.protocol.frame import Frame, FrameKind
from canbus_tools.protocol.protocol import SIGNAL_FRAMES, Direction, owner_of
from nodes.support._can_bits import ffi, lib
from nodes.support.can_protocol import ADMIN_ID, ADMIN_RESPONSE_ID
from nodes.support.errors import CanductorError

WINDOW_S: Final = 1.0
WINDOW_S_MIN, WINDOW_S_MAX = 0.01, 3600.0
WINDOWS_MAX: Final = 1024
IDS_MAX: Final = 4096
"""All 11-bit ids, and as many others."""
OTHER_IDS: Final = -1
"""Key of all ids beyond IDS_MAX."""
EXTENDED: Final = 1 << 29
"""Added to a 29-bit id, to distinguish it from an 11-bit id."""
DATA_MAX: Final = 8
ERROR_BITS: Final = 80
"""Estimated bits of one error: flag and echo of 6 to 12 bits, delimiter of 8, interframe space of 3, and the
destroyed part of a frame, which is unknown: half of a full frame."""
_WIRE_ERRORS: Final = 0x008 | 0x020 | 0x080
"""linux/can/error.h: protocol violation, missing acknowledgement, bus error. The others take no time."""


class TrafficClass(Enum):
    """Purpose of a frame."""

    ADMIN = "admin"
    """Queries about nodes and ids, and their answers; clock pulses."""
    SIGNAL = "signals"
    """Bus stop and triggers, which have the highest priority."""
    TO_NODES = "to nodes"
    FROM_NODES = "from nodes"
    OTHER = "other"
    """Frames of another protocol."""
    ERROR = "errors"
    """Estimated."""


_SIGNAL_IDS: Final = frozenset(i for f in SIGNAL_FRAMES for i in range(f.can_id, f.can_id + f.ids))


def classify(frame: Frame) -> TrafficClass:
    """Return the class of a frame by its id."""
    if frame.kind is FrameKind.ERROR:
        return TrafficClass.ERROR
    if frame.kind is not FrameKind.DATA:
        return TrafficClass.OTHER
    if frame.can_id in (ADMIN_ID, ADMIN_RESPONSE_ID):
        return TrafficClass.ADMIN
    if frame.can_id in _SIGNAL_IDS:
        return TrafficClass.SIGNAL
    owner = owner_of(frame.can_id)
    if owner is None:
        return TrafficClass.OTHER
    return TrafficClass.TO_NODES if owner[1] is Direction.TO_NODE else TrafficClass.FROM_NODES


def frame_bits(frame: Frame, length: int | None = None) -> int:
    """Return the bit times of FRAME on the bus; 0 if unknown (CAN FD, some error reports).

    LENGTH: length in a remote frame, which has no data; it affects the number of stuff bits.
    """
    if frame.kind is FrameKind.ERROR:
        return ERROR_BITS if frame.can_id & _WIRE_ERRORS else 0
    if frame.kind is FrameKind.FD or len(frame.data) > DATA_MAX:
        return 0
    kind = 0
    if frame.kind is FrameKind.EXTENDED or frame.can_id > 0x7FF:
        kind |= lib.CAN_BITS_EXTENDED
    if frame.kind is FrameKind.REMOTE:
        kind |= lib.CAN_BITS_REMOTE
    size = len(frame.data) if length is None else min(length, DATA_MAX)
    bits: int = lib.can_any_frame_bits(frame.can_id & 0x1FFFFFFF, kind, size, ffi.from_buffer(frame.data))
    return bits


class Part(NamedTuple):
    """A part of the traffic."""

    frames: int
    bits: int
    share: float
    """Share of the bus's capacity in the time, 0..1."""


@dataclass(frozen=True, slots=True)
class Window:
    """One window of time."""

    start_s: float
    """Since the measurement began."""
    length_s: float
    """Shorter in the last window."""
    frames: int
    bits: Mapping[TrafficClass, int]
    load: float
    """0..1; slightly more is possible, from a frame that began before the window."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BusLoad:
    """Result of a LoadMeter."""

    bitrate: int
    duration_s: float
    frames: int
    """Without error reports."""
    bits: int
    mean: float
    """Share of the time that the bus was busy, 0..1."""
    peak: float
    """Load of the busiest window."""
    peak_at_s: float
    """Start of that window since the start of the measurement."""
    window_s: float
    """Length of that window."""
    frames_per_s: float
    classes: Mapping[TrafficClass, Part]
    ids: Mapping[int, Part]
    """Busiest first; 29-bit ids with EXTENDED added; OTHER_IDS: all that did not fit."""
    windows: tuple[Window, ...]
    error_reports: int
    unmeasured: int
    """CAN FD frames."""


class LoadMeter:
    """Measures one bus of BITRATE bit/s; for one thread. Raises CanductorError for arguments out of range."""

    def __init__(self, bitrate: int, window_s: float = WINDOW_S) -> None:
        if not BITRATE_MIN <= bitrate <= BITRATE_MAX:
            raise CanductorError(f"bit rate {bitrate} is not between {BITRATE_MIN} and {BITRATE_MAX} bit/s")
        if not WINDOW_S_MIN <= window_s <= WINDOW_S_MAX:
            raise CanductorError(f"window {window_s} s is not between {WINDOW_S_MIN} and {WINDOW_S_MAX:g} s")
        self.bitrate = bitrate
        self._window_s = window_s
        self._classes = {kind: [0, 0] for kind in TrafficClass}
        self._ids: dict[int, list[int]] = {}
        self._start_s: float | None = None
        self._end_s = -math.inf
        self._bins: dict[int, list[int]] = {}
        self._bin_s = window_s
        self._current = 0
        self._current_bits = 0
        self._peak = (0, 0)
        self._unmeasured = 0

    def begin(self, now_s: float) -> None:
        """Start the time before the first frame, on a live bus; else the first frame starts it."""
        if self._start_s is None:
            self._start_s = self._end_s = now_s

    def advance(self, now_s: float) -> None:
        """Let time pass without a frame."""
        self.begin(now_s)
        self._end_s = max(self._end_s, now_s)

    def feed(self, frame: Frame | can.Message) -> int:
        """Count a frame and return its bits on the wire."""
        length = None
        if isinstance(frame, can.Message):
            length = frame.dlc if frame.is_remote_frame else None
            frame = Frame.from_message(frame)
        bits = frame_bits(frame, length)
        kind = classify(frame)
        self._unmeasured += frame.kind is FrameKind.FD
        for tally in (self._classes[kind], self._id_tally(frame)):
            tally[0] += 1
            tally[1] += bits
        self._feed_time(frame.time_s, bits, kind)
        return bits

    def load(self) -> BusLoad:
        """Return the result until now."""
        duration_s = 0.0 if self._start_s is None else self._end_s - self._start_s
        carried = duration_s * self.bitrate
        frames = sum(tally[0] for kind, tally in self._classes.items() if kind is not TrafficClass.ERROR)
        bits = sum(tally[1] for tally in self._classes.values())
        peak_bits, peak_window = max(self._peak, (self._current_bits, self._current), key=lambda p: p[0])

        def part(tally: list[int]) -> Part:
            return Part(tally[0], tally[1], tally[1] / carried if carried > 0 else 0.0)

        # In a measurement shorter than a window the mean is the peak; a short last window may show less.
        peak_s = min(self._window_s, duration_s)
        mean = bits / carried if carried > 0 else 0.0
        return BusLoad(
            bitrate=self.bitrate,
            duration_s=duration_s,
            frames=frames,
            bits=bits,
            mean=mean,
            peak=max(mean, peak_bits / (peak_s * self.bitrate)) if peak_s > 0 else 0.0,
            peak_at_s=peak_window * self._window_s,
            window_s=self._window_s,
            frames_per_s=frames / duration_s if duration_s > 0 else 0.0,
            classes={kind: part(tally) for kind, tally in self._classes.items() if tally[0]},
            ids={i: part(t) for i, t in sorted(self._ids.items(), key=lambda item: -item[1][1])},
            windows=self._windows(duration_s),
            error_reports=self._classes[TrafficClass.ERROR][0],
            unmeasured=self._unmeasured,
        )

    # ----------------------------------------------------------------------------------------------- inside

    def _id_tally(self, frame: Frame) -> list[int]:
        if frame.kind is FrameKind.ERROR:
            return [0, 0]  # its "id" is the kind of error
        extended = frame.kind is FrameKind.EXTENDED or frame.can_id > 0x7FF
        key = frame.can_id | EXTENDED if extended else frame.can_id
        if key not in self._ids and len(self._ids) >= IDS_MAX:
            key = OTHER_IDS
        return self._ids.setdefault(key, [0, 0])

    def _feed_time(self, time_s: float, bits: int, kind: TrafficClass) -> None:
        if self._start_s is None:
            # The time starts at the beginning of the first frame.
            self._start_s = self._end_s = time_s - bits / self.bitrate
        self._end_s = max(self._end_s, time_s)
        since_s = max(0.0, time_s - self._start_s)
        window = int(since_s / self._window_s)
        if window > self._current:
            self._peak = max(self._peak, (self._current_bits, self._current), key=lambda p: p[0])
            self._current, self._current_bits = window, 0
        self._current_bits += bits  # late frames count now: recordings may be slightly out of order
        while since_s / self._bin_s >= WINDOWS_MAX:
            self._merge_bins()
        tallies = self._bins.setdefault(int(since_s / self._bin_s), [0] * (len(TrafficClass) + 1))
        tallies[0] += kind is not TrafficClass.ERROR
        tallies[_COLUMN[kind]] += bits

    def _merge_bins(self) -> None:
        """Double the length of the windows."""
        old, self._bins = self._bins, {}
        self._bin_s *= 2
        for number, tallies in old.items():
            into = self._bins.setdefault(number // 2, [0] * len(tallies))
            into[:] = [a + b for a, b in zip(into, tallies, strict=True)]

    def _windows(self, duration_s: float) -> tuple[Window, ...]:
        found = []
        while duration_s / self._bin_s > WINDOWS_MAX:
            self._merge_bins()
        last = min(WINDOWS_MAX, max(math.ceil(duration_s / self._bin_s), max(self._bins, default=-1) + 1))
        for number in range(last):
            start_s = number * self._bin_s
            length_s = min(self._bin_s, duration_s - start_s)
            tallies = self._bins.get(number, [0] * (len(TrafficClass) + 1))
            # A frame just after the start of the last window must not look like a high load.
            of_bits = max(length_s, self._bin_s / 10) * self.bitrate
            bits = {kind: tallies[column] for kind, column in _COLUMN.items() if tallies[column]}
            found.append(Window(start_s, length_s, tallies[0], bits, sum(bits.values()) / of_bits))
        return tuple(found)


_COLUMN: Final = {kind: column for column, kind in enumerate(TrafficClass, 1)}
