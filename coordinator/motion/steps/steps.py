"""Step generation: planned moves in, one stream of timed commands per node out (the manual is steps.h)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from coordinator.motion.specs import NodeStreamSpec, StepperSpec
from coordinator.motion.steps._steps import ffi, lib
from coordinator.motion.steps.errors import StepError
from coordinator.motion.steps.surface import Surface
from nodes.support.c_structs import from_struct

MAX_ERROR_S = 12.5e-6
"""How far a step may be from its true time by default."""
SHORT_S = 0.05
"""So long a command lasts at most on a machine: one that has begun goes on, even if the host is gone."""
SMOOTH_MIN_S = int(lib.STEP_SMOOTH_MIN_US) / 1e6
SMOOTH_MAX_S = int(lib.STEP_SMOOTH_MAX_US) / 1e6
"""Of a smooth time, but for 0."""
TABLE_POINTS_MAX = int(lib.STEP_TABLE_POINTS)
"""Points of one axis table that step generation has room for."""
Position = tuple[float, float, float, float]
_uncleared = ffi.new_allocator(should_clear_after_alloc=False)
"""For buffers of which only what was written is read."""


@dataclass(frozen=True, slots=True)
class StepperStats:
    """What one stepper's stream amounts to so far."""

    name: str
    position: int
    """Steps from the start, up to the generated time."""
    issued: int
    """Steps from the start that the commands in batches add up to."""
    issued_clock: int
    """The node's 64-bit clock at the last of them; 0: there is none."""
    steps: int
    queue_steps: int
    direction_changes: int
    commands: int
    content_bytes: int
    cancelled: int
    """Steps left out because their opposite followed too closely."""
    put_off: int
    """Steps delayed because their opposite, too close, had been flushed."""
    worst_error_ticks: float
    worst_error_s: float
    max_step_rate: float
    """Steps/s."""


class Issued(NamedTuple):
    """What the commands in batches amount to so far, for one stepper; see StepperStats."""

    name: str
    steps: int
    issued: int
    issued_clock: int


@dataclass(frozen=True, slots=True)
class AxisCorrection:
    """What is added to an axis's planned position, at the end of the last move that was appended."""

    points: int
    """Of its table; 0: it has none."""
    reverse: bool
    """Whether the table's side for travel to smaller positions is in use."""
    offset_mm: float
    """All that is added."""
    lag_mm: float
    """The part of it that the table does not want: it fades along the moves that follow."""


@dataclass(frozen=True, slots=True)
class NodeStats:
    """What one node's stream amounts to so far."""

    name: str
    commands: int
    content_bytes: int
    framed_bytes: int
    """Packed into full message blocks, with their headers and trailers."""
    max_slots: int
    """Most move-queue slots in use when any command is due."""
    late_slots: int
    """Commands whose slot becomes free only after they are due: the node's move_count is too small."""
    waiting_bytes: int
    """Bytes of the batch not yet taken."""


@dataclass(frozen=True, slots=True)
class StepStats:
    """Totals since construction."""

    steppers: tuple[StepperStats, ...]
    nodes: tuple[NodeStats, ...]


class StepGenerator:
    """Turns trapezoids into every node's queue_step stream; one thread at a time.

    START is where the axes X Y Z E stand (mm); steppers count their steps from there. MAX_ERROR_S bounds how
    far a step may be from its true time, LONGEST_S how long a command lasts, from its first step to its last
    (0: as long as it fits). Clocks begin as ticks = print time * clock_freq. After a StepError
    of append or generate the generator stays failed.
    """

    def __init__(
        self,
        steppers: Sequence[StepperSpec],
        nodes: Sequence[NodeStreamSpec],
        *,
        max_error_s: float = MAX_ERROR_S,
        start: Position = (0.0, 0.0, 0.0, 0.0),
        longest_s: float = 0.0,
    ) -> None:
        self._steppers, self._nodes = tuple(steppers), tuple(nodes)
        config = _config(self._steppers, self._nodes, max_error_s, start)
        config.struct.longest_s = longest_s
        size = lib.step_gen_size(config.struct)
        if not size:
            raise StepError(
                f"steppers {[s.name for s in steppers]} on nodes {[n.name for n in nodes]}: a value of the "
                "motion configuration is out of range; check step_distance, oid, step_pulse, clock "
                f"frequency, move_count and the step error of {max_error_s} s"
            )
        self._memory = ffi.new("char[]", size)
        self._gen = lib.step_gen_init(self._memory, config.struct)
        if self._gen == ffi.NULL:
            raise StepError(
                f"one of the steppers {[s.name for s in steppers]} has no position with the axes at {start}"
                " mm; correct the machine's geometry"
            )

    def append(self, trapezoids: Any, count: int) -> int:
        """Take over up to COUNT trapezoids; return how many had room.

        TRAPEZOIDS is a cffi pointer (of any module) or a buffer laid out as struct trapezoid. Take less than
        COUNT as "generate first". Raises StepError on a move that is illegal or out of order.
        """
        pointer = trapezoids
        if not isinstance(trapezoids, ffi.CData):
            pointer = ffi.from_buffer(trapezoids)
            count = min(count, len(pointer) // ffi.sizeof("struct trapezoid"))
        taken: int = lib.step_append(self._gen, ffi.cast("struct trapezoid *", pointer), count)
        if taken < 0:
            raise self._error()
        return taken

    def generate(self, until: float, *, flush: bool = False) -> bool:
        """Produce the commands for everything before print time UNTIL (s).

        Every move that begins before UNTIL must have been appended. Without FLUSH the last 0.1 s may be held
        back. Returns False when batches have to be taken first: take them and call again with the same
        arguments. Raises StepError.
        """
        status = lib.step_generate(self._gen, until, flush)
        if status not in {lib.STEP_OK, lib.STEP_FULL}:
            raise self._error()
        return bool(status == lib.STEP_OK)

    def take_batch(self, node: int, room: int = 1 << 16) -> bytes:
        """Remove and return up to ROOM bytes of NODE's batch (link/core/batch.h), whole records only."""
        self._check_node(node)
        out = _uncleared("uint8_t[]", room)
        taken = lib.step_take_batch(self._gen, node, out, room)
        return bytes(ffi.buffer(out, taken))

    @property
    def generated_until(self) -> float:
        """Print time (s) before which nothing can be changed any more."""
        return float(lib.step_generated_until(self._gen))

    @property
    def next_move_s(self) -> float:
        """Earliest print time (s) at which the next appended move may begin.

        After a flush, and after a change of a shaper or smoothing, the planner has to begin there or later.
        """
        return float(lib.step_next_move(self._gen))

    def set_clock_base(self, node: int, print_time: float, ticks: int, ticks_per_s: float) -> None:
        """Say what NODE's 64-bit clock is at PRINT_TIME and how fast it runs; only while no step waits."""
        self._check_node(node)
        status = lib.step_set_clock_base(self._gen, node, print_time, ticks, ticks_per_s)
        self._check_clock(node, status, ticks_per_s)

    def set_clock(self, node: int, ticks_per_s: float) -> None:
        """Change the rate of NODE's clock from the generated time on, without a jump there."""
        self._check_node(node)
        self._check_clock(node, lib.step_set_clock(self._gen, node, ticks_per_s), ticks_per_s)

    def clock_at(self, node: int, print_time: float) -> int:
        """Return NODE's 64-bit clock at PRINT_TIME, rounded down."""
        self._check_node(node)
        return int(lib.step_clock_at(self._gen, node, print_time))

    def position(self, stepper: int) -> int:
        """Return where STEPPER stands at the generated time, in steps from the start."""
        return self._stepper_stats(stepper).position

    def set_axis_position(self, position: Position) -> None:
        """Declare that the axes X Y Z E stand at POSITION (mm): no steps; the steps' count goes on.

        Raises StepError while appended moves are not yet generated.
        """
        if lib.step_set_axis_position(self._gen, ffi.new("double[4]", position)):
            raise StepError(f"the axes cannot be set to {position} mm while moves wait; generate them first")

    def set_table(
        self,
        axis: int,
        positions: Sequence[float],
        forward: Sequence[float],
        reverse: Sequence[float],
        *,
        take_up_mm_s: float,
    ) -> None:
        """Add to the planned positions of axis 0..2 (X Y Z) what a table says (mm); no points: nothing.

        Not a step is made now: what the correction jumps by is taken up along the moves that follow, at
        TAKE_UP_MM_S at the most. Only for axes of linear steppers. Raises StepError while appended moves are
        not yet generated.
        """
        status = lib.step_set_table(
            self._gen, axis, len(positions), list(positions), list(forward), list(reverse), take_up_mm_s
        )
        what = f"the table of axis {'XYZ'[axis]}"
        if status == lib.STEP_NOT_IDLE:
            raise StepError(f"{what} cannot change while moves wait; generate them first")
        if status:
            raise StepError(
                f"{what} is refused: give 2 to {TABLE_POINTS_MAX} ascending positions, and a take-up speed"
            )

    @property
    def corrections(self) -> tuple[AxisCorrection, ...]:
        """What is added to X, Y and Z."""
        found: Any = ffi.new("struct step_correction[3]")
        for axis in range(3):
            lib.step_get_correction(self._gen, axis, found + axis)
        return tuple(AxisCorrection(c.points, bool(c.reverse), c.offset, c.lag) for c in found)

    def set_corrections(self, corrections: Sequence[AxisCorrection]) -> None:
        """Declare that the motors of X, Y, Z stand ``offset_mm`` beyond their axes, on these sides: no steps.

        Raises StepError while appended moves are not yet generated.
        """
        offsets = [correction.offset_mm for correction in corrections]
        if lib.step_set_corrections(self._gen, offsets, [int(c.reverse) for c in corrections]):
            raise StepError(f"corrections cannot become {offsets} mm while moves wait; generate them first")

    def set_surface(self, surface: Surface | None) -> float:
        """Let Z follow the shape of a bed from now on (None: a plane at 0): no steps.

        Return the planned Z (mm) at which the axes stand from now on. Raises StepError unless the machine has
        been at rest for the lag of all shapers and smoothing.
        """
        z = ffi.new("double *")
        grid = ffi.new("struct step_surface *") if surface is None else surface.grid
        status = lib.step_set_surface(self._gen, grid, z)
        if status == lib.STEP_BAD_CONFIG:
            both = next(s.name for s in self._steppers if s.weights[2] and s.weights[3])
            raise StepError(f"the shape of the bed cannot be followed: {both} moves along both Z and E")
        self._check_settled(status, "the shape of the bed", "")
        self._surface = surface  # C reads its nodes
        return float(z[0])

    @property
    def look_ahead_s(self) -> float:
        """How far step times depend on later moves (s): so much more is held back without a flush."""
        return float(lib.step_look_ahead(self._gen))

    @property
    def lag_s(self) -> float:
        """How long (s) after the end of the last move steps may still come."""
        return float(lib.step_lag(self._gen))

    def set_shaper(self, axis: int, impulses: Sequence[tuple[float, float]]) -> None:
        """Shape axis 0..2 (X Y Z) by IMPULSES: (amplitude, time in s) each, centred; none: unshaped.

        Raises StepError unless the machine has been at rest for the lag of all shapers and smoothing.
        """
        amplitudes = [amplitude for amplitude, _ in impulses] or [1.0]
        times = [time_s for _, time_s in impulses] or [0.0]
        status = lib.step_set_shaper(self._gen, axis, len(times), amplitudes, times)
        self._check_settled(status, f"the shaper of axis {axis}", f"impulses {list(impulses)}")

    def set_weights(self, stepper: int, weights: Position) -> None:
        """Make STEPPER, which has no formula, follow other axes from now on.

        Raises StepError unless all has settled.
        """
        self._check_stepper(stepper)
        status = lib.step_set_weights(self._gen, stepper, weights)
        self._check_settled(status, f"what {self._steppers[stepper].name} follows", f"weights {weights}")

    def set_smooth_time(self, stepper: int, smooth_s: float) -> None:
        """Smooth STEPPER's E and its pressure advance by a triangle of full width SMOOTH_S; 0: neither.

        SMOOTH_S: 0, or from SMOOTH_MIN_S to SMOOTH_MAX_S. Raises StepError unless all has settled.
        """
        self._check_stepper(stepper)
        status = lib.step_set_smooth_time(self._gen, stepper, smooth_s)
        what = f"the smooth time of {self._steppers[stepper].name}"
        self._check_settled(status, what, f"a smooth time of {smooth_s} s")

    def index(self, name: str) -> int:
        """Return the number of the stepper called NAME; raises StepError when there is none."""
        for number, spec in enumerate(self._steppers):
            if spec.name == name:
                return number
        raise StepError(f"there is no stepper {name}; there is {', '.join(s.name for s in self._steppers)}")

    def _check_settled(self, status: int, what: str, value: str) -> None:
        if status == lib.STEP_NOT_IDLE:
            raise StepError(
                f"{what} cannot change while steps of earlier moves may come; "
                f"generate until {self.lag_s:.3f} s after the last move first"
            )
        if status:
            raise StepError(f"{what} is refused: {value} is out of range")

    def _check_stepper(self, index: int) -> None:
        if not 0 <= index < len(self._steppers):
            raise StepError(f"there is no stepper {index}; the generator has {len(self._steppers)}")

    def stats(self) -> StepStats:
        """Return the totals of every stepper and node."""
        return StepStats(self.stepper_stats(), tuple(self._node_stats(i) for i in range(len(self._nodes))))

    def stepper_stats(self) -> tuple[StepperStats, ...]:
        """Return the totals of every stepper."""
        return tuple(self._stepper_stats(i) for i in range(len(self._steppers)))

    def issued(self) -> list[Issued]:
        """Return what is issued, of every stepper: for each cycle of a print, where all totals cost more."""
        s: Any = ffi.new("struct step_stepper_stats *")
        found = []
        for index, stepper in enumerate(self._steppers):
            lib.step_stepper_stats(self._gen, index, s)
            found.append(Issued(stepper.name, s.steps, s.issued, s.issued_clock))
        return found

    def _stepper_stats(self, index: int) -> StepperStats:
        self._check_stepper(index)
        s = ffi.new("struct step_stepper_stats *")
        lib.step_stepper_stats(self._gen, index, s)
        return from_struct(StepperStats, s, name=self._steppers[index].name)

    def _node_stats(self, index: int) -> NodeStats:
        s = ffi.new("struct step_node_stats *")
        lib.step_node_stats(self._gen, index, s)
        return from_struct(NodeStats, s, name=self._nodes[index].name)

    def _check_node(self, node: int) -> None:
        if not 0 <= node < len(self._nodes):
            raise StepError(f"there is no node {node}; the generator has {len(self._nodes)}")

    def _check_clock(self, node: int, status: int, ticks_per_s: float) -> None:
        name = self._nodes[node].name
        if status == lib.STEP_NOT_IDLE:
            raise StepError(f"the clock of node {name} cannot be set while its steps wait; flush them first")
        if status:
            raise StepError(f"node {name}: {ticks_per_s} ticks/s is no possible clock")

    def _error(self) -> StepError:
        e: Any = ffi.new("struct step_error *")
        lib.step_last_error(self._gen, e)
        who = self._steppers[e.stepper].name if e.stepper >= 0 else "the plan"
        error = StepError(f"{who} at print time {e.print_time:.6f} s: {_REASONS[e.status].format(e.value)}")
        error.print_time_s = e.print_time
        return error


_REASONS = {
    lib.STEP_BAD_MOVE: "a planned move has impossible numbers; this is a bug of the planner",
    lib.STEP_BAD_ORDER: (
        "the time lies before {:.6f} s, up to which all is planned or generated; "
        "moves must follow each other in time"
    ),
    lib.STEP_JUMP: (
        "the move begins {:+.3f} steps from where the stepper stands; moves must join, or the position be set"
    ),
    lib.STEP_TOO_FAST: (
        "steps follow each other within {:.3g} s, closer than the step pulse allows; "
        "lower the speed or the microsteps, or shorten step_pulse_duration"
    ),
    lib.STEP_TOO_DENSE: (
        f"more than {lib.STEP_SEGMENTS} step commands at once; lower the speed or the microsteps"
    ),
    lib.STEP_NO_FIT: "a step has no legal clock; this is a bug of step compression",
    lib.STEP_BAD_CHECK: (
        "compressed steps do not replay to their times ({:.3g} s off); this is a bug of step compression"
    ),
}


class _Config:
    """A struct step_config with the arrays it points to kept alive."""

    def __init__(self, struct: Any, keep: tuple[Any, ...]) -> None:
        self.struct, self.keep = struct, keep


def _formula(stepper: StepperSpec) -> Any:
    """Return the C function of STEPPER's position; raises StepError when there is none of that name."""
    if stepper.formula is None:
        return ffi.NULL
    found = lib.step_find_formula(stepper.formula.encode())
    if not found:
        raise StepError(
            f"{stepper.name}: coordinator/kinematics/*.c have no formula '{stepper.formula}'; add it by"
            " STEP_FORMULA and compile again"
        )
    return found


def _config(
    steppers: Sequence[StepperSpec], nodes: Sequence[NodeStreamSpec], max_error_s: float, start: Position
) -> _Config:
    c_steppers = ffi.new("struct step_stepper_config[]", max(len(steppers), 1))
    c_nodes = ffi.new("struct step_node_config[]", max(len(nodes), 1))
    for c, s in zip(c_steppers, steppers, strict=False):
        c.node, c.oid, c.weights, c.step_distance = s.node, s.oid, s.weights, s.step_distance
        c.formula, c.params = _formula(s), s.params
        c.invert_dir, c.step_pulse_s = s.invert_dir, s.step_pulse_s
    for c, n in zip(c_nodes, nodes, strict=False):
        c.clock_freq, c.move_count, c.queue_step_id = n.clock_freq, n.move_count, n.queue_step_id
        c.set_next_step_dir_id, c.reset_step_clock_id = n.set_next_step_dir_id, n.reset_step_clock_id
    struct: Any = ffi.new("struct step_config *")
    struct.stepper_count, struct.node_count = len(steppers), len(nodes)
    struct.steppers, struct.nodes = c_steppers, c_nodes
    struct.max_error_s, struct.start = max_error_s, start
    return _Config(struct, (c_steppers, c_nodes))
