"""What a plan asks of machine and buses over print time: the skin of motion/plan_stats.h."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from coordinator.motion.stats._plan_stats import ffi, lib

BIN_S = 1.0
"""Length of a bin at the start; it doubles whenever the bins run out (68 minutes, and so on)."""


@dataclass(frozen=True, slots=True)
class WatchedNode:
    """A node whose stream is counted, and the bus it goes over."""

    name: str
    bus: str
    bitrate: int
    is_serial: bool
    clock_freq: int
    queue_step_id: int


@dataclass(frozen=True, slots=True)
class Peak:
    """The greatest of a quantity."""

    value: float
    print_time_s: float
    line: int
    """Of the program; 0: there was none."""


@dataclass(frozen=True, slots=True)
class Bus:
    """The load of one bus over print time."""

    name: str
    kind: str
    """can or uart."""
    bitrate: int
    bits: int
    load: tuple[float, ...]
    """By bin: share of the bit rate; above 1 the bus cannot carry it in time."""


class PlanFigures:
    """Counts moves and batches of one plan; one thread at a time. Times are print time in s."""

    def __init__(self, nodes: Sequence[WatchedNode]) -> None:
        self._nodes = tuple(nodes)
        self._stats: Any = ffi.new("struct plan_stats *")
        settings = [
            {
                "clock_freq": node.clock_freq,
                "queue_step_id": node.queue_step_id,
                "can_id": _can_id(index),
                "is_serial": node.is_serial,
            }
            for index, node in enumerate(nodes)
        ]
        if lib.plan_stats_init(self._stats, ffi.new("struct plan_node[]", settings), len(settings), BIN_S):
            raise ValueError(f"{len(settings)} nodes cannot be watched; at most {lib.PLAN_NODES} can")

    def moves(self, trapezoids: Any, count: int) -> None:
        """Count COUNT trapezoids at a cffi pointer of any module."""
        lib.plan_stats_moves(self._stats, ffi.cast("struct trapezoid *", trapezoids), count)

    def batch(self, node: int, batch: bytes) -> None:
        """Count a piece of NODE's stream."""
        lib.plan_stats_batch(self._stats, node, ffi.from_buffer("uint8_t[]", batch), len(batch))

    def finish(self) -> None:
        """Count the blocks that are not full; call it once, after the last batch."""
        lib.plan_stats_finish(self._stats)

    def line(self, print_time_s: float) -> int:
        """Return the first program line of the bin that holds PRINT_TIME_S, 0 when there was no move yet."""
        return int(lib.plan_stats_line(self._stats, print_time_s))

    @property
    def bin_s(self) -> float:
        """Length of a bin, s."""
        return float(self._stats.bin_s)

    @property
    def bad_records(self) -> int:
        """Records of the batches that made no sense; anything but 0 is a bug of step generation."""
        return sum(self._stats.nodes[i].bad_records for i in range(len(self._nodes)))

    def axis_speed(self, axis: int) -> Peak:
        """Return the highest speed of axis 0..3 (X Y Z E), mm/s."""
        return _peak(self._stats.axis_speed[axis])

    def axis_accel(self, axis: int) -> Peak:
        """Return the highest acceleration of axis 0..3 (X Y Z E), mm/s²."""
        return _peak(self._stats.axis_accel[axis])

    @property
    def path_speed(self) -> Peak:
        """The highest speed along X Y Z, mm/s."""
        return _peak(self._stats.path_speed)

    @property
    def flow(self) -> Peak:
        """The fastest filament while X, Y or Z moves, mm/s."""
        return _peak(self._stats.flow)

    def step_rate(self, node: int, oid: int) -> Peak:
        """Return the highest rate within any command of a stepper, steps/s."""
        peak = self._stats.step_rate[node][oid]
        return Peak(peak.value, peak.print_time, self.line(peak.print_time))

    def speeds(self) -> tuple[float, ...]:
        """Return the highest speed along X Y Z by bin, mm/s."""
        return tuple(self._stats.bin_speed[0 : self._stats.bins_used])

    def flows(self) -> tuple[float, ...]:
        """Return the fastest filament while X, Y or Z moves by bin, mm/s."""
        return tuple(self._stats.bin_flow[0 : self._stats.bins_used])

    def node_steps(self, node: int) -> tuple[float, ...]:
        """Return the steps of all of a node's steppers by bin, steps/s."""
        return tuple(n / self.bin_s for n in self._stats.bin_steps[node][0 : self._stats.bins_used])

    def buses(self) -> tuple[Bus, ...]:
        """Return every bus with its load, in the order of the nodes."""
        members: dict[str, list[int]] = {}
        for index, node in enumerate(self._nodes):
            members.setdefault(node.bus, []).append(index)
        return tuple(self._bus(name, indices) for name, indices in members.items())

    def _bus(self, name: str, indices: list[int]) -> Bus:
        first = self._nodes[indices[0]]
        used = self._stats.bins_used
        columns = [self._stats.bin_bits[i][0:used] for i in indices]
        capacity = first.bitrate * self.bin_s
        return Bus(
            name=name,
            kind="uart" if first.is_serial else "can",
            bitrate=first.bitrate,
            bits=sum(self._stats.nodes[i].bits for i in indices),
            load=tuple(sum(bits) / capacity for bits in zip(*columns, strict=True)),
        )


def _can_id(index: int) -> int:
    """Return an id such as nodes get: it only decides about a stuff bit or two."""
    return 0x100 + 2 * index


def _peak(peak: Any) -> Peak:
    return Peak(peak.value, peak.print_time, peak.line)
