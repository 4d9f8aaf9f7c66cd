"""``canductor can load``: the load of a bus and its causes, live or from a recording."""

import argparse
import contextlib
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from canbus_tools.bus import load_plot
from canbus_tools.bus.bus_load import (
    EXTENDED,
    OTHER_IDS,
    WINDOW_S,
    WINDOW_S_MAX,
    WINDOW_S_MIN,
    BusLoad,
    LoadMeter,
    TrafficClass,
)
from canbus_tools.bus.computer import Computer, now_s
from canbus_tools.bus.link_facts import read_link
from canbus_tools.bus.open_bus import BusOptions, bus_options, declare_bus
from canbus_tools.protocol.protocol import Direction, frame_format, owner_of
from canbus_tools.recordings.recordings import read_frames
from canbus_tools.support.text_table import count, paragraph, table
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, decimal, parse_path
from nodes.support.terminal import show

DURATION_S: Final = 10.0
DURATION_S_MAX: Final = 86_400.0
REFRESH_S: Final = 1.0
SHOWN_IDS: Final = 10
BAR: Final = 40


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options."""
    add = command.add_argument
    add("recording", nargs="?", type=Path, metavar="FILE", help="measure a recording instead of a live bus")
    declare_bus(command)
    add(
        "--duration",
        type=decimal(0.1, DURATION_S_MAX, "s"),
        metavar="S",
        help=f"how long to measure, in seconds (default: {DURATION_S:g})",
    )
    add("--watch", action="store_true", help="show the load continuously, until Ctrl-C")
    add(
        "--window",
        type=decimal(WINDOW_S_MIN, WINDOW_S_MAX, "s"),
        default=WINDOW_S,
        metavar="S",
        help="averaging window of peak and plot, in seconds",
    )
    add(
        "--plot",
        type=lambda text: parse_path(text, ".svg", ".png"),
        metavar="FILE",
        help="draw the load over time: .svg, or .png (uses rsvg-convert)",
    )


def make_job(given: argparse.Namespace) -> Callable[[Computer], "LoadReport"]:
    """Check what was given; raises UsageError."""
    window_s: float = given.window
    if given.recording is not None:
        if given.watch or given.duration is not None or given.channel is not None:
            raise UsageError(
                "a recording is measured from start to end: --watch, --duration and --channel do not apply"
            )
        if given.bitrate is None:
            raise UsageError("--bitrate is missing: a recording does not contain the bit rate of its bus")
        bitrate: int = given.bitrate
        recording: Path = given.recording
        return lambda _: _finish(measure_recording(recording, bitrate, window_s), str(recording), given.plot)
    duration_s = given.duration or (None if given.watch else DURATION_S)
    options = bus_options(given)
    shown = _Screen() if given.watch and not given.json else None
    return lambda computer: _finish(
        measure(computer, options, duration_s, window_s, shown), options.name, given.plot
    )


def find_bitrate(options: BusOptions) -> int:
    """Return the bit rate as given, or as the interface is set; raises CanductorError."""
    if options.bitrate is not None:
        return options.bitrate
    if options.is_socketcan:
        link = read_link(options.channel)
        if link.bitrate is not None:
            return link.bitrate
        raise CanductorError(
            f"CAN bus {options.name}: a {link.kind or 'network'} interface has no bit rate; give one to"
            " calculate with, such as --bitrate 1000000"
        )
    raise CanductorError(
        f"CAN bus {options.name}: python-can does not report the bit rate; give it, such as --bitrate 1000000"
    )


def measure_recording(path: Path, bitrate: int, window_s: float = WINDOW_S) -> LoadMeter:
    """Measure a recording; raises CanductorError, also if it has frames of several buses."""
    meter = LoadMeter(bitrate, window_s=window_s)
    channel: str | None = None
    for frame in read_frames(path):
        if channel not in (None, frame.channel):
            raise CanductorError(
                f"{path} has frames of several buses ({channel}, {frame.channel}); separate them first, for "
                "example by 'grep' on a candump log"
            )
        channel = frame.channel
        meter.feed(frame)
    return meter


def measure(
    computer: Computer,
    options: BusOptions,
    duration_s: float | None,
    window_s: float,
    screen: "_Screen | None" = None,
) -> LoadMeter:
    """Measure a live bus for DURATION_S, or until Ctrl-C; raises CanductorError."""
    bitrate = find_bitrate(options)
    meter = LoadMeter(bitrate, window_s=window_s)
    with computer.listen(options.without_bitrate()) as bus, contextlib.suppress(KeyboardInterrupt):
        stamps = _Stamps(computer)
        end_s = None if duration_s is None else stamps.started_s + duration_s
        meter.begin(stamps.started_s)
        while (left_s := REFRESH_S if end_s is None else end_s - now_s(computer)) > 0:
            for frame in bus.take(min(REFRESH_S, left_s)):
                meter.feed(frame._replace(time_s=stamps.of(frame.time_s)))
            meter.advance(now_s(computer))
            if screen is not None and screen.is_due(now_s(computer)):
                screen.show(LoadReport(meter.load(), options.name))
    return meter


class _Stamps:
    """Converts times of frames to monotonic times.

    For backends that do not use Unix time, the first frame sets the offset.
    """

    def __init__(self, computer: Computer) -> None:
        self.started_s = now_s(computer)
        self._computer = computer
        self._offset_s = computer.unix_s() - self.started_s
        self._first = True

    def of(self, stamp_s: float) -> float:
        """Return the time of a frame, which is not before the start nor in the future."""
        at_s = now_s(self._computer)
        if self._first and abs(stamp_s - self._offset_s - at_s) > 2 * REFRESH_S:
            self._offset_s = stamp_s - at_s
        self._first = False
        return min(max(stamp_s - self._offset_s, self.started_s), at_s)


def _finish(meter: LoadMeter, name: str, plot: Path | None) -> "LoadReport":
    report = LoadReport(meter.load(), name, None if plot is None else str(plot))
    if plot is not None:
        _draw(plot, load_plot.draw(f"load of {name} at {meter.bitrate} bit/s", report.load))
    return report


def _draw(path: Path, picture: str) -> None:
    try:
        if path.suffix.lower() == ".svg":
            path.write_text(picture, encoding="utf-8")
            return
        converter = shutil.which("rsvg-convert")
        if converter is None:
            raise CanductorError(
                f"'{path}': a PNG needs rsvg-convert, which is missing; install librsvg2-bin, or give a name "
                "that ends in .svg"
            )
        subprocess.run([converter, "-o", path], input=picture.encode(), capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise CanductorError(f"'{path}': the plot cannot be written there: {error}") from None


# ----------------------------------------------------------------------------------------------------- report


@dataclass(frozen=True, slots=True)
class LoadReport:
    """Result of a measurement."""

    load: BusLoad
    bus: str
    plot: str | None = None
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return all figures; shares are of 1."""
        load = self.load
        return {
            "bus": self.bus,
            "bitrate": load.bitrate,
            "duration_s": round(load.duration_s, 6),
            "frames": load.frames,
            "bits": load.bits,
            "frames_per_s": round(load.frames_per_s, 3),
            "mean": round(load.mean, 6),
            "peak": {
                "load": round(load.peak, 6),
                "at_s": round(load.peak_at_s, 6),
                "window_s": load.window_s,
            },
            "classes": {kind.value: _part(part) for kind, part in load.classes.items()},
            "ids": {id_name(number): _part(part) for number, part in load.ids.items()},
            "windows": [
                {
                    "start_s": round(window.start_s, 6),
                    "length_s": round(window.length_s, 6),
                    "frames": window.frames,
                    "load": round(window.load, 6),
                    "bits": {kind.value: bits for kind, bits in window.bits.items()},
                }
                for window in load.windows
            ],
            "error_reports": load.error_reports,
            "errors_estimated": load.error_reports > 0,
            "unmeasured_fd_frames": load.unmeasured,
            "plot": self.plot,
        }

    def to_text(self) -> str:
        """Return it as tables."""
        load = self.load
        if not load.frames and not load.error_reports:
            return f"{self.bus}: no frame in {load.duration_s:.1f} s"
        lines = [
            f"{self.bus}: {load.mean:.1%} of {load.bitrate} bit/s in {load.duration_s:.1f} s",
            f"busiest {load.window_s:g} s: {load.peak:.1%}, starting at {load.peak_at_s:g} s",
            f"{load.frames_per_s:,.0f} frames/s",
            _bar(load.mean, load.peak),
            "",
            *table(
                ("what", "load", "frames", "frames/s", ""),
                [(kind.value, *self._figures(part)) for kind, part in load.classes.items()],
            ),
            "",
            *table(
                ("id", "what", "load", "frames", "frames/s"),
                [
                    (id_name(number), what_is(number), *self._figures(part)[:3])
                    for number, part in list(load.ids.items())[:SHOWN_IDS]
                ],
            ),
        ]
        if len(load.ids) > SHOWN_IDS:
            lines.append(f"  … and {count(len(load.ids) - SHOWN_IDS, 'more id')} (all of them: --json)")
        lines += self._remarks()
        return "\n".join(lines)

    def _figures(self, part: Any) -> tuple[str, str, str, str]:
        per_s = part.frames / self.load.duration_s if self.load.duration_s > 0 else 0.0
        return (f"{part.share:7.2%}", f"{part.frames:8}", f"{per_s:8,.0f}", _bar(part.share, part.share, 20))

    def _remarks(self) -> list[str]:
        lines: list[str] = []
        if self.load.error_reports:
            lines += paragraph(
                f"{count(self.load.error_reports, 'error report')}: the cost of errors is estimated"
            )
        if self.load.unmeasured:
            lines += paragraph(f"{count(self.load.unmeasured, 'CAN FD frame')} counted, but not measured")
        if self.plot is not None:
            lines.append(f"plot: {self.plot}")
        return ["", *lines] if lines else []


def _part(part: Any) -> dict[str, object]:
    return {"frames": part.frames, "bits": part.bits, "load": round(part.share, 6)}


def id_name(key: int) -> str:
    """Return an id of BusLoad.ids as text."""
    if key == OTHER_IDS:
        return "other"
    return f"{key & (EXTENDED - 1):08x}" if key & EXTENDED else f"{key:03x}"


def what_is(key: int) -> str:
    """Return the purpose of an id."""
    if key == OTHER_IDS or key & EXTENDED:
        return TrafficClass.OTHER.value
    owner = owner_of(key)
    if owner is not None:
        return f"{'to' if owner[1] is Direction.TO_NODE else 'from'} node {owner[0]}"
    known = frame_format(key, bytes(8))
    if known is not None and known.command is None:
        return known.name
    return {0x3F0: "admin, host", 0x3F1: "admin, nodes", 0x3F2: "tables"}.get(key, TrafficClass.OTHER.value)


def _bar(mean: float, peak: float, width: int = BAR) -> str:
    filled, reached = (min(width, round(share * width)) for share in (mean, peak))
    return "█" * filled + "░" * max(0, reached - filled) + "·" * (width - max(filled, reached))


class _Screen:
    """Shows changing reports: in place on a terminal, else one line each."""

    def __init__(self) -> None:
        self._in_place = sys.stdout.isatty()
        self._next_s = 0.0
        self._lines = 0

    def is_due(self, at_s: float) -> bool:
        if at_s < self._next_s:
            return False
        self._next_s = at_s + REFRESH_S
        return True

    def show(self, report: LoadReport) -> None:
        if self._in_place:
            text = report.to_text()
            up = f"\x1b[{self._lines}F" if self._lines else ""
            show(text, before=f"{up}\x1b[J")
            self._lines = text.count("\n") + 1
        else:
            load = report.load
            now = load.windows[-2].load if len(load.windows) > 1 else load.mean
            show(f"{load.duration_s:.0f} s: {now:.1%} now, {load.mean:.1%} mean, {load.peak:.1%} peak")
