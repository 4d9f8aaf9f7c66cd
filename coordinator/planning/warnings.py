"""What in a plan would go wrong on the machine, as sentences with the g-code line."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from coordinator.motion.planner.values import Slowed
from coordinator.planning.figures import Peak
from coordinator.planning.report import BusReport, NodeReport, StepperReport

CEILING = 0.9
"""Share of a bus's bit rate that its links give out; what is left carries everything unplanned."""
TICKS_PER_STEP = 100
"""Clock ticks per step that a 32-bit core has time for next to its other work, when it counts its own cycles.

A dictionary has the clock and the chip, but not what a step costs; with fewer it is asking for trouble.
"""
TICKS_PER_STEP_OF = {
    "atmega": 160,  # 8-bit: a step takes more instructions
    "at90": 160,
    "rp2040": 10,  # its clock is a timer of 12 MHz, its cores run ten times as fast
    "rp2350": 10,
}
"""Other chips, by how their name (constant MCU) begins."""


@dataclass(frozen=True, slots=True)
class NodeClock:
    """What a node's dictionary says of its speed."""

    name: str
    chip: str
    """Constant MCU, empty where there is none."""
    clock_freq: int
    """Ticks/s."""


def bus_warnings(program: str, buses: Sequence[BusReport]) -> Iterator[str]:
    """Name each bus that gets more than it can carry."""
    for bus in buses:
        if bus.over_ceiling_s > 0:
            yield (
                f"{program}:{bus.peak_line}: {bus.kind} {bus.name} would need {bus.peak_load:.0%} of its "
                f"{bus.bitrate:,} bit/s at print time {bus.peak_print_time_s:.0f} s, and more than "
                f"{CEILING:.0%} for {bus.over_ceiling_s:.0f} s in all; raise the bit rate, lower speed or "
                "microsteps, or spread the nodes over more buses"
            )


def queue_warnings(program: str, nodes: Sequence[NodeReport]) -> Iterator[str]:
    """Name each node whose move queue is too short for what comes at once."""
    for node in nodes:
        if node.late_slots:
            yield (
                f"{program}: node {node.name} gets {node.late_slots:,} commands before one of its "
                f"{node.move_count:,} queue slots is free for them; lower speed or microsteps"
            )


def slowed_warnings(program: str, slowed: Sequence[Slowed]) -> Iterator[str]:
    """Name each limit that makes moves slower than the program asks."""
    for s in slowed:
        many = f"from here on {s.moves:,} moves ask for more speed than {s.limit} allows, line {s.worst_line}"
        one = f"one move asks for more speed than {s.limit} allows,"
        yield (
            f"{program}:{s.first_line}: {many if s.moves > 1 else one} for {s.asked_mm_s:,.1f} mm/s where "
            f"{s.allowed_mm_s:,.1f} are made; lower F, or the print takes longer than its slicer thinks"
        )


def ticks_per_step(chip: str) -> int:
    """Return how many ticks a node on CHIP (constant MCU of its dictionary) should have for each step."""
    name = chip.lower()
    return next((t for start, t in TICKS_PER_STEP_OF.items() if name.startswith(start)), TICKS_PER_STEP)


def step_rate_warnings(
    program: str, node: NodeClock, together: Peak, steppers: Sequence[StepperReport]
) -> Iterator[str]:
    """Say when NODE has fewer clock ticks per step than its kind of micro-controller commonly needs.

    TOGETHER: of all its steppers in the busiest bin; STEPPERS: those of the node.
    """
    limit = node.clock_freq / ticks_per_step(node.chip)
    for stepper in steppers:
        if stepper.max_step_rate > limit:
            yield (
                f"{program}:{stepper.max_step_rate_line}: {stepper.name} is to make "
                f"{stepper.max_step_rate:,.0f} steps/s, {_too_fast(node, limit)}"
            )
    if together.value > limit:
        yield (
            f"{program}:{together.line}: the steppers of node {node.name} are to make "
            f"{together.value:,.0f} steps/s together, {_too_fast(node, limit)}"
        )


def _too_fast(node: NodeClock, limit: float) -> str:
    chip = f", {node.chip}," if node.chip else ""
    return (
        f"more than the {limit:,.0f} that node {node.name}{chip} with its clock of "
        f"{node.clock_freq / 1e6:g} MHz can be trusted with; lower speed or microsteps"
    )
