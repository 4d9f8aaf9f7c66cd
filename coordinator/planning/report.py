"""What ``canductor plan`` reports: figures, warnings, and how they read."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from coordinator.motion.planner.values import Slowed
from coordinator.planning.figures import Peak


@dataclass(frozen=True, slots=True)
class AxisReport:
    """The most one axis is asked for: mm/s and mm/s² of X, Y, Z, or of filament for E."""

    name: str
    speed: Peak
    accel: Peak


@dataclass(frozen=True, slots=True)
class StepperReport:
    """What one stepper is asked to do."""

    name: str
    node: str
    steps: int
    queue_steps: int
    max_step_rate: float
    """Steps/s, the highest within any command sent."""
    max_step_rate_line: int
    worst_error_us: float


@dataclass(frozen=True, slots=True)
class NodeReport:
    """What one node is sent."""

    name: str
    bus: str
    commands: int
    bytes: int
    max_step_rate: float
    """Steps/s of all its steppers together, in the busiest bin of the timeline."""
    max_slots: int
    """Most slots of the move queue in use at once."""
    move_count: int
    """Slots it is taken to have."""
    late_slots: int
    """Commands whose slot is only free after they are due."""


@dataclass(frozen=True, slots=True)
class BusReport:
    """What one bus carries; its load over time stands in the timeline."""

    name: str
    kind: str
    """can or uart."""
    bitrate: int
    bits: int
    mean_load: float
    """Share of the bit rate over the whole plan."""
    peak_load: float
    """In the busiest bin."""
    peak_print_time_s: float
    peak_line: int
    over_ceiling_s: float
    """Print time in bins above the share of the bit rate that is given out."""


@dataclass(frozen=True, slots=True)
class Timeline:
    """Figures by bin of print time: bin i is from i·bin_s to (i + 1)·bin_s."""

    bin_s: float
    speed_mm_s: tuple[float, ...]
    """The highest along X Y Z."""
    flow_mm3_s: tuple[float, ...]
    """The highest while X, Y or Z moves."""
    bus_load: Mapping[str, tuple[float, ...]]
    """By bus: share of the bit rate."""


@dataclass(frozen=True, slots=True)
class PlanReport:
    """The figures of a plan; ``to_json`` gives them by these names."""

    gcode: str
    moves: int
    print_time_s: float
    steps: int
    queue_steps: int
    bytes_to_nodes: int
    """Framing included."""
    cpu_s: float
    """Of the whole process, start-up included."""
    peak_rss_mb: float
    path_speed: Peak
    """mm/s along X Y Z."""
    flow: Peak
    """mm³/s while X, Y or Z moves."""
    axes: tuple[AxisReport, ...]
    steppers: tuple[StepperReport, ...]
    nodes: tuple[NodeReport, ...]
    buses: tuple[BusReport, ...]
    slowed: tuple[Slowed, ...]
    """What the limits made slower than the program asks."""
    timeline: Timeline
    warnings: tuple[str, ...]
    """What would go wrong or be lost, with g-code file and line."""
    notices: tuple[str, ...]
    unsupported: tuple[str, ...]
    written: tuple[str, ...]
    """Files this plan wrote."""

    @property
    def ok(self) -> bool:
        """A plan that could not be finished is an error, not a report."""
        return True

    def to_json(self) -> Mapping[str, object]:
        """Return the figures by name."""
        return asdict(self)

    def to_text(self) -> str:
        """Return the figures for a reader."""
        return "\n".join(
            [
                *self.unsupported,
                *self.notices,
                (
                    f"{self.gcode}: {self.moves:,} moves in {_duration(self.print_time_s)}, "
                    f"{self.steps:,} steps in {self.queue_steps:,} queue_step commands, "
                    f"{self.bytes_to_nodes:,} bytes to the nodes"
                ),
                (
                    f"  at most {self.path_speed.value:,.1f} mm/s (line {self.path_speed.line:,}) and "
                    f"{self.flow.value:,.2f} mm³/s of filament (line {self.flow.line:,})"
                ),
                *map(_axis_text, self.axes),
                *map(_stepper_text, self.steppers),
                *map(_node_text, self.nodes),
                *map(_bus_text, self.buses),
                *(f"warning: {warning}" for warning in self.warnings),
                *(f"wrote {path}" for path in self.written),
                f"planned in {self.cpu_s:.2f} s of CPU time, {self.peak_rss_mb:.0f} MB of memory",
            ]
        )


def _axis_text(axis: AxisReport) -> str:
    return (
        f"  axis {axis.name}: at most {axis.speed.value:,.1f} mm/s (line {axis.speed.line:,}), "
        f"{axis.accel.value:,.0f} mm/s² (line {axis.accel.line:,})"
    )


def _stepper_text(s: StepperReport) -> str:
    return (
        f"  {s.name} on {s.node}: {s.steps:,} steps, {s.queue_steps:,} queue_steps, at most "
        f"{s.max_step_rate:,.0f} steps/s, timed within {s.worst_error_us:.1f} µs"
    )


def _node_text(n: NodeReport) -> str:
    return (
        f"  node {n.name}: {n.commands:,} commands, {n.bytes:,} bytes, at most "
        f"{n.max_step_rate:,.0f} steps/s, at most {n.max_slots:,} of {n.move_count:,} queue slots"
    )


def _bus_text(b: BusReport) -> str:
    return (
        f"  {b.kind} {b.name} at {b.bitrate:,} bit/s: {b.mean_load:.1%} loaded, at most {b.peak_load:.1%} "
        f"at {b.peak_print_time_s:,.0f} s (line {b.peak_line:,})"
    )


def _duration(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60)
    hours, minutes = divmod(int(minutes), 60)
    return f"{hours}:{minutes:02d}:{rest:04.1f} h" if hours else f"{int(minutes)}:{rest:04.1f} min"
