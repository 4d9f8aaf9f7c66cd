"""Interfaces of the pipeline: a source of moves, and an observer of moves and commands."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from coordinator.gcode.events import Event, Notice, Reply
from coordinator.gcode.machine_state import MachineState
from coordinator.gcode.status import MotionStatus
from coordinator.motion.planner.planner import Planner, PlannerState

ProgramOutput = Reply | Notice


class MoveSource(Protocol):
    """Plans moves into ``planner`` and returns the events its driver has to act on (gcode/events.py).

    A ``Job`` is one that ends; the service's feeder is one that goes on from job to job.
    """

    @property
    def planner(self) -> Planner:
        """Where the moves go."""
        ...

    @property
    def machine(self) -> MachineState:
        """What the lines may change of the machine."""
        ...

    @property
    def name(self) -> str:
        """What is being read, for messages."""
        ...

    @property
    def line(self) -> int:
        """Number of the line that comes next."""
        ...

    def step(self) -> Event:
        """Work until there is an event; raises GCodeError."""
        ...

    def attend_others(self) -> Event | None:
        """Do what may be done while ``step`` must not be called, as the machine rests; nothing is planned.

        Returns the next event, None when there are no more.
        """
        ...


class Witness(Protocol):
    """Sees what is planned and what is sent."""

    def see_moves(self, trapezoids: Any, count: int) -> None:
        """Record moves (``struct trapezoid *``), in the worker's thread; they are gone afterwards."""

    def see_sent(self, batches: Sequence[tuple[int, bytes]], planned: "Planned") -> None:
        """Record commands for moving nodes, on the control loop; PLANNED counts their steps, too."""


@dataclass(frozen=True, slots=True)
class Planned:
    """Where the planner was after the latest visit."""

    status: MotionStatus
    stands_from_s: float | None
    """Print time from which nothing moves any more; None: there is more to plan."""
    steps_sent: tuple[int, ...] = ()
    """By stepper: where its node will count it when all commands in batches are executed."""
    last_step_clocks: tuple[int, ...] = ()
    """By stepper: its node's 64-bit clock at the last of those steps; 0: there is none."""

    @property
    def state(self) -> PlannerState:
        """The end of the last move read, and what holds for the next."""
        return self.status.state
