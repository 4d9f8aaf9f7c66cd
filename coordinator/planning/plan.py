"""``canductor plan``: plans a program without the machine, and reports what it would demand of each node."""

import time
from contextlib import ExitStack
from typing import BinaryIO

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription
from coordinator.gcode.events import (
    Emergency,
    End,
    Full,
    Notice,
    PositionSet,
    Progress,
    ShaperChange,
    SmoothTimeChange,
    SurfaceChange,
    WeightsChange,
)
from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program
from coordinator.modules.module_set import build_modules
from coordinator.motion.planner.planner import Planner
from coordinator.motion.steps.errors import StepError
from coordinator.motion.steps.steps import StepGenerator
from coordinator.planning.figures import PlanFigures
from coordinator.planning.node_dictionaries import node_dictionaries
from coordinator.planning.options import PlanOptions
from coordinator.planning.report import PlanReport
from coordinator.planning.summary import PlanResult, watched_nodes, write_files
from coordinator.runtime.devices import MachineDevices, stream_specs
from coordinator.streaming.compensation import Compensation, why_not_corrected
from coordinator.streaming.pipeline import Pipeline
from coordinator.streaming.program_machine import machine_state
from coordinator.support.progress import Progress as Shown
from coordinator.support.progress import ProgressDisplay
from coordinator.tables.axis_table import TableError
from coordinator.tables.files import read_table
from nodes.dictionary.cache import DictionaryCache
from nodes.support.errors import CanductorError

ASSUMED_MOVE_COUNT = 1024
"""Queue slots of a node that is not there to be asked."""


def plan_file(options: PlanOptions, *, cache: DictionaryCache | None = None) -> PlanReport:
    """Plan OPTIONS.gcode for OPTIONS.config; raises CanductorError.

    CACHE: of dictionaries; by default, the user's.
    """
    description = load_machine(str(options.config))
    modules = build_modules(description)
    devices = MachineDevices(description, modules.configure)
    known = node_dictionaries(description, options, cache if cache is not None else DictionaryCache.of_user())
    dictionaries = {name: node.dictionary for name, node in known.items()}
    for node in description.nodes:
        devices.build_config(node.name, dictionaries[node.name])
    streams = stream_specs((name, dictionaries[name], ASSUMED_MOVE_COUNT) for name in devices.moving_nodes)
    specs = devices.stepper_specs()
    figures = PlanFigures(watched_nodes(description, streams, options.can_bitrate))
    with ExitStack() as stack:
        program = stack.enter_context(Program.open(options.gcode))
        files = [stack.enter_context(f) for f in _output_files(options, devices.moving_nodes)]
        job = Job(
            program,
            Planner(description.limits),
            description.homed_position,
            machine_state(description, modules.vocabulary),
            modules.vocabulary,
        )
        pipeline = Pipeline(
            job,
            StepGenerator(specs, streams),
            lambda node, batch: _keep(figures, files, node, batch),
            nodes=len(streams),
            watch=figures.moves,
            compensation=_compensation(description, options) if options.tables else None,
        )
        display = stack.enter_context(ProgressDisplay(f"planning {program.name}", quiet=options.json))
        try:
            notices, end = _run(pipeline, display)
        except StepError as error:
            raise _with_line(error, program.name, figures) from None
    figures.finish()
    if figures.bad_records:
        raise CanductorError(
            f"{figures.bad_records} emitted commands make no sense; this is a bug of step generation"
        )
    chips = {name: node.chip for name, node in known.items()}
    notices = [*(node.notice for node in known.values() if node.notice), *notices]
    made = PlanResult(description, pipeline, figures, streams, specs, chips, notices, end.print_time_s)
    return write_files(options, made.report())


def _compensation(description: MachineDescription, options: PlanOptions) -> "Compensation":
    """Return what corrects the axes by the tables of OPTIONS; raises TableError."""
    compensation = Compensation(description.limits)
    for axis, path in options.tables.items():
        table = read_table(path, axis=axis)
        if why := why_not_corrected(description, table):
            raise TableError(why)
        compensation.want(axis, table)
    return compensation


def _with_line(error: StepError, program: str, figures: PlanFigures) -> CanductorError:
    if error.print_time_s is None:
        return error
    return CanductorError(f"{program}, near line {figures.line(error.print_time_s)}: {error}")


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


def _keep(figures: PlanFigures, files: list[BinaryIO], node: int, batch: bytes) -> None:
    figures.batch(node, batch)
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
            case PositionSet() | ShaperChange() | WeightsChange() | SmoothTimeChange() | SurfaceChange():
                pipeline.finish()
                pipeline.act(event)
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
                    f"{pipeline.job.name}:{event.line}: M112 stops the machine here; "
                    "remove it to plan what follows"
                )
            case End():
                pipeline.finish()
                return notices, event
            case _:
                pass  # waiting costs a plan nothing, and replies are for who asked
