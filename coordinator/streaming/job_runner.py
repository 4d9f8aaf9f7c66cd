"""One job on one machine: connect, run, ask the nodes where they stand; shared by ``run`` and ``demo``."""

from collections.abc import Callable
from dataclasses import dataclass

from coordinator.config.model import MachineDescription
from coordinator.gcode.errors import GCodeError
from coordinator.gcode.events import Notice
from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program
from coordinator.modules.module_set import build_modules
from coordinator.motion.planner.planner import Planner
from coordinator.runtime.host import Host, LinuxHost
from coordinator.runtime.machine import Machine, MachineStopped, link_of
from coordinator.runtime.timebase import ClockMap
from coordinator.streaming.compensation import Compensation
from coordinator.streaming.move_source import JobState, ProgramOutput
from coordinator.streaming.pipeline import PlanRecord
from coordinator.streaming.program_machine import machine_state
from coordinator.streaming.streamer import Streamer
from coordinator.support.progress import NodeFigures, Progress
from nodes.dictionary.cache import DictionaryCache
from nodes.link import LinkStats
from nodes.node.states import NodeState
from nodes.support.errors import CanductorError

OnProgress = Callable[[Progress], None]


@dataclass(frozen=True, slots=True)
class NodeOutcome:
    """A node after a job."""

    name: str
    link: LinkStats
    clock_error_s: float
    """What the clock estimator promises."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a job was, told by the host and by the nodes' own counters."""

    moves: int
    print_time_s: float
    span: tuple[float, float]
    """Print times of begin and end."""
    steps: int
    queue_steps: int
    positions: dict[str, int]
    """By stepper: steps that the job moved it by, as its node counts them."""
    issued: dict[str, int]
    """By stepper: steps that the host's commands add up to."""
    maps: dict[str, ClockMap]
    """By moving node: print time to ticks."""
    nodes: tuple[NodeOutcome, ...]


async def run_job(
    description: MachineDescription,
    program: Program,
    on_progress: OnProgress,
    *,
    record: PlanRecord | None = None,
    on_told: Callable[[ProgramOutput], None],
    on_ready: Callable[[Machine], None] | None = None,
    host: Host | None = None,
    cache: DictionaryCache | None = None,
    compensation: "Compensation | None" = None,
) -> Outcome:
    """Connect to the machine, run PROGRAM on it and return what became of it.

    ON_TOLD gets what the program and the machine have to say; dictionaries are kept in CACHE.
    COMPENSATION corrects the axes.

    Raises CanductorError. Whatever ends the job before its end stops all nodes, but for a bad line of the
    program: what came before it is carried out, and the machine stands.
    """
    machine = Machine(
        description,
        host or LinuxHost(),
        build_modules(description),
        on_notice=lambda text: on_told(Notice(0, text)),
        cache=cache,
    )
    await machine.start()
    if on_ready is not None:
        on_ready(machine)
    try:
        return await _print(machine, program, on_progress, record, on_told=on_told, compensation=compensation)
    except GCodeError:
        raise
    except BaseException as error:
        machine.stop(f"{error or 'stopped by the user'}")
        confirmed = await machine.confirm_stop()
        if isinstance(error, CanductorError):
            raise MachineStopped(f"{machine.stopped}{_confirmation(confirmed)}") from None
        raise
    finally:
        await machine.close()


def _confirmation(confirmed_s: dict[str, float]) -> str:
    """Return the part of the sentence that tells how fast the other nodes stopped."""
    others = [f"{name} after {delay_s * 1e3:.0f} ms" for name, delay_s in confirmed_s.items()]
    return f" ({', '.join(others)})" if others else ""


async def _print(
    machine: Machine,
    program: Program,
    on_progress: OnProgress,
    record: PlanRecord | None,
    *,
    on_told: Callable[[ProgramOutput], None],
    compensation: "Compensation | None",
) -> Outcome:
    began_ns = machine.host.now()

    def show(state: JobState) -> None:
        on_progress(
            Progress(
                done=state.done_bytes,
                total=state.size_bytes or 0,
                print_time_s=state.print_time_s,
                wall_time_s=(machine.host.now() - began_ns) * 1e-9,
                nodes=tuple(_figures(machine, name) for name in machine.nodes),
            )
        )

    described = machine.description
    job = Job(
        program,
        Planner(described.limits),
        described.homed_position,
        machine_state(described),
        machine.modules.vocabulary,
    )
    streamer = Streamer(
        machine, job, record=record, compensation=compensation, on_told=on_told, on_state=show
    )
    streamer.worker.began_at = await machine.stepper_positions()
    await streamer.run()
    return await outcome_of(machine, streamer)


async def outcome_of(machine: Machine, streamer: Streamer) -> Outcome:
    """Return what became of STREAMER's job, which has ended."""
    ended_at = await machine.stepper_positions()
    stats = streamer.worker.steps.stats()
    return Outcome(
        moves=streamer.worker.pipeline.moves,
        print_time_s=streamer.ended_s - streamer.began_s,
        span=(streamer.began_s, streamer.ended_s),
        steps=sum(s.steps for s in stats.steppers),
        queue_steps=sum(s.queue_steps for s in stats.steppers),
        positions={name: ended_at[name] - began for name, began in streamer.worker.began_at.items()},
        issued={s.name: s.issued for s in stats.steppers},
        maps={node.name: m for node, m in zip(machine.moving, streamer.worker.maps, strict=True)},
        nodes=tuple(
            NodeOutcome(node.name, link_of(node).stats(), node.clock_error_s or 0.0)
            for node in machine.nodes.values()
            if node.state is NodeState.READY  # an optional one may be away
        ),
    )


def _figures(machine: Machine, name: str) -> NodeFigures:
    node = machine.nodes[name]
    try:
        stats = link_of(node).stats()
    except CanductorError:
        return NodeFigures(name=name)
    return NodeFigures(
        name=name,
        round_trip_ms=stats.srtt_s * 1e3,
        retransmitted_bytes=stats.bytes_repeated,
        queue_depth=stats.motion_commands,
        lead_ms=None if stats.min_lead_s is None else stats.min_lead_s * 1e3,
        clock_error_us=None if node.clock_error_s is None else node.clock_error_s * 1e6,
    )
