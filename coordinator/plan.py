"""``canductor plan``: plans a program for a machine without its hardware, and tells what it would ask."""

import resource
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO

from coordinator.commands import PlanOptions
from coordinator.gcode.events import Emergency, End, Full, Notice, PositionSet, Progress
from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program
from coordinator.machine.description import MachineDescription, load_machine
from coordinator.machine_devices import MachineDevices, stream_specs
from coordinator.motion.planner import Planner
from coordinator.motion.steps import StepGenerator, StepStats
from coordinator.pipeline import Pipeline
from coordinator.progress import Progress as Shown
from coordinator.progress import ProgressDisplay
from nodes.dictionary import Dictionary
from nodes.errors import CanductorError
from nodes.virtual.firmware import MAINBOARD, TOOLHEAD, firmware_dictionary

ASSUMED_MOVE_COUNT = 1024
"""Queue slots of a node that is not there to be asked."""


@dataclass(frozen=True, slots=True)
class StepperReport:
    """What one stepper is asked to do."""

    name: str
    node: str
    steps: int
    queue_steps: int
    max_step_rate: float
    worst_error_us: float


@dataclass(frozen=True, slots=True)
class NodeReport:
    """What one node is sent."""

    name: str
    commands: int
    bytes: int
    max_slots: int


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
    steppers: tuple[StepperReport, ...]
    nodes: tuple[NodeReport, ...]
    notices: tuple[str, ...]
    not_yet_acting: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """A plan that could not be finished is an error, not a report."""
        return True

    def to_json(self) -> Mapping[str, object]:
        """Return the figures by name."""
        return asdict(self)

    def to_text(self) -> str:
        """Return the figures for a reader."""
        lines = [
            *self.not_yet_acting,
            *self.notices,
            (
                f"{self.gcode}: {self.moves:,} moves in {_duration(self.print_time_s)}, {self.steps:,} steps "
                f"in {self.queue_steps:,} queue_step commands, {self.bytes_to_nodes:,} bytes to the nodes"
            ),
        ]
        lines += [
            f"  {s.name} on {s.node}: {s.steps:,} steps, {s.queue_steps:,} queue_steps, "
            f"at most {s.max_step_rate:,.0f} steps/s, timed within {s.worst_error_us:.1f} µs"
            for s in self.steppers
        ]
        lines += [
            f"  node {n.name}: {n.commands:,} commands, {n.bytes:,} bytes, at most {n.max_slots} queue slots"
            for n in self.nodes
        ]
        lines.append(f"planned in {self.cpu_s:.2f} s of CPU time, {self.peak_rss_mb:.0f} MB of memory")
        return "\n".join(lines)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60)
    hours, minutes = divmod(int(minutes), 60)
    return f"{hours}:{minutes:02d}:{rest:04.1f} h" if hours else f"{minutes}:{rest:04.1f} min"


def plan_file(options: PlanOptions) -> PlanReport:
    """Plan OPTIONS.gcode for OPTIONS.config; raises CanductorError."""
    description = load_machine(str(options.config))
    devices = MachineDevices(description)
    dictionaries = _dictionaries(description, options)
    for node in description.nodes:
        devices.build_config(node.name, dictionaries[node.name])
    moving = devices.moving_nodes
    steps = StepGenerator(
        devices.stepper_specs(),
        stream_specs((name, dictionaries[name], ASSUMED_MOVE_COUNT) for name in moving),
    )
    with ExitStack() as stack:
        program = stack.enter_context(Program.open(options.gcode))
        files = [stack.enter_context(f) for f in _output_files(options, moving)]
        job = Job(program, Planner(description.limits), description.homed_position)
        pipeline = Pipeline(job, steps, lambda n, b: _keep(files, n, b), nodes=len(moving))
        display = stack.enter_context(ProgressDisplay(f"planning {program.name}", quiet=options.json))
        notices, end = _run(pipeline, display)
    return _report(description, pipeline, notices, end)


def _dictionaries(description: MachineDescription, options: PlanOptions) -> dict[str, Dictionary]:
    names = [node.name for node in description.nodes]
    for name in options.dictionaries:
        if name not in names:
            raise CanductorError(
                f"--dictionary {name}: the machine has no such node; it has {', '.join(names)}"
            )
    return {
        name: _read_dictionary(options.dictionaries[name])
        if name in options.dictionaries
        else firmware_dictionary(MAINBOARD if name == names[0] else TOOLHEAD)
        for name in names
    }


def _read_dictionary(path: Path) -> Dictionary:
    try:
        text = path.read_bytes()
    except OSError as error:
        raise CanductorError(f"cannot read the dictionary {path}: {error.strerror}; check the path") from None
    try:
        return Dictionary.from_json(text)
    except CanductorError as error:
        raise CanductorError(f"{path}: {error}") from None


def _output_files(options: PlanOptions, nodes: list[str]) -> list[BinaryIO]:
    if options.output is None:
        return []
    try:
        options.output.mkdir(parents=True, exist_ok=True)
        return [(options.output / f"{name}.batch").open("wb") for name in nodes]
    except OSError as error:
        raise CanductorError(
            f"cannot write to {options.output}: {error.strerror}; name another folder with -o"
        ) from None


def _keep(files: list[BinaryIO], node: int, batch: bytes) -> None:
    if files:
        files[node].write(batch)


def _run(pipeline: Pipeline, display: ProgressDisplay) -> tuple[list[str], End]:
    notices: list[str] = []
    began = time.monotonic()
    while True:
        event = pipeline.job.step()
        match event:
            case Full():
                pipeline.run_through()
            case PositionSet():
                pipeline.finish()
                pipeline.declare(event.position)
            case Progress():
                display.update(
                    Shown(
                        done=event.done_bytes,
                        total=event.size_bytes or 0,
                        print_time_s=pipeline.planner.print_time_end_s,
                        wall_time_s=time.monotonic() - began,
                    )
                )
            case Notice():
                notices.append(event.text)
            case Emergency():
                raise CanductorError(
                    f"{pipeline.job.program.name}:{event.line}: M112 stops the machine here; "
                    "remove it to plan what follows"
                )
            case End():
                pipeline.finish()
                return notices, event
            case _:
                pass  # waiting costs a plan nothing, and replies are for who asked


def _report(description: MachineDescription, pipeline: Pipeline, notices: list[str], end: End) -> PlanReport:
    stats: StepStats = pipeline.steps.stats()
    node_of = {stepper.name: stepper.node for stepper in description.steppers}
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return PlanReport(
        gcode=pipeline.job.program.name,
        moves=pipeline.moves,
        print_time_s=end.print_time_s,
        steps=sum(s.steps for s in stats.steppers),
        queue_steps=sum(s.queue_steps for s in stats.steppers),
        bytes_to_nodes=sum(n.framed_bytes for n in stats.nodes),
        cpu_s=usage.ru_utime + usage.ru_stime,
        peak_rss_mb=usage.ru_maxrss / 1024,
        steppers=tuple(
            StepperReport(
                s.name, node_of[s.name], s.steps, s.queue_steps, s.max_step_rate, s.worst_error_s * 1e6
            )
            for s in stats.steppers
        ),
        nodes=tuple(NodeReport(n.name, n.commands, n.framed_bytes, n.max_slots) for n in stats.nodes),
        notices=tuple(notices),
        not_yet_acting=tuple(str(entry) for entry in description.not_yet_acting),
    )
