"""Plans a program for a machine as ``canductor plan`` does, and keeps all that a proof needs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from coordinator.assembly.load import load_machine
from coordinator.gcode.events import (
    End,
    Full,
    PositionSet,
    ShaperChange,
    SmoothTimeChange,
    SurfaceChange,
    WeightsChange,
)
from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program
from coordinator.modules.module_set import build_modules
from coordinator.motion.planner.planner import Planner
from coordinator.motion.specs import NodeStreamSpec, StepperSpec
from coordinator.motion.steps.steps import MAX_ERROR_S, StepGenerator, StepStats
from coordinator.runtime.devices import MachineDevices, stream_specs
from coordinator.streaming.compensation import Compensation
from coordinator.streaming.pipeline import Pipeline, PlanRecord
from coordinator.streaming.program_machine import machine_state
from coordinator.tables.axis_table import AxisTable
from coordinator.verification.exact_program import program_legs
from coordinator.verification.planned import segments
from nodes.virtual.firmware import MAINBOARD, TOOLHEAD, firmware_dictionary
from tests.coordinator.motion.exact_check import StepperProof, Verdict, check
from tests.coordinator.motion.replay import Stream, replay_all

MOVE_COUNT = 1024


@dataclass
class Planned:
    """A planned program: what was intended, and what was emitted."""

    steppers: list[StepperSpec]
    nodes: list[NodeStreamSpec]
    record: PlanRecord
    stats: StepStats
    print_time_s: float
    batches: dict[int, bytearray] = field(default_factory=dict)

    def streams(self) -> dict[str, Stream]:
        """Return what the emitted commands make each stepper do."""
        return replay_all({i: bytes(b) for i, b in self.batches.items()}, self.nodes, self.steppers)

    def prove(self, windows: list[tuple[float, float]] | None = None) -> list[Verdict]:
        """Compare every stepper's steps with its exact motion, in WINDOWS of print time or everywhere."""
        cut, streams = segments(self.record), self.streams()
        verdicts = []
        for spec in self.steppers:
            freq = self.nodes[spec.node].clock_freq
            proof = StepperProof(program_legs(spec, cut))
            verdicts.append(check(proof, streams[spec.name], freq, MAX_ERROR_S, windows))
        return verdicts

    def left_out(self, name: str) -> int:
        """Return how many steps of a stepper were left out in pairs."""
        return next(s.cancelled for s in self.stats.steppers if s.name == name)


def plan_program(
    config: Path, gcode: Path, tables: Mapping[str, AxisTable] | None = None, *, stage: bool = False
) -> Planned:
    """Plan GCODE for CONFIG; nothing but the streams and the trapezoids is kept.

    TABLES by axis correct it; with STAGE, corrections may act even without any.
    """
    description = load_machine(str(config))
    devices = MachineDevices(description, build_modules(description).configure)
    first = description.nodes[0].name
    dictionaries = {
        node.name: firmware_dictionary(MAINBOARD if node.name == first else TOOLHEAD)
        for node in description.nodes
    }
    for name, dictionary in dictionaries.items():
        devices.build_config(name, dictionary)
    nodes = stream_specs((name, dictionaries[name], MOVE_COUNT) for name in devices.moving_nodes)
    steppers = devices.stepper_specs()
    steps = StepGenerator(steppers, nodes)
    batches = {i: bytearray() for i in range(len(nodes))}
    record = PlanRecord((0.0, 0.0, 0.0, 0.0))
    with Program.open(str(gcode)) as program:
        state = machine_state(description)
        job = Job(program, Planner(description.limits), description.homed_position, state)
        compensation = Compensation(description.limits) if tables or stage else None
        for axis, table in (tables or {}).items():
            assert compensation is not None
            compensation.want(axis, table)
        pipeline = Pipeline(
            job,
            steps,
            lambda node, batch: batches[node].extend(batch),
            nodes=len(nodes),
            record=record,
            compensation=compensation,
        )
        end = _run(pipeline)
    return Planned(steppers, nodes, record, steps.stats(), end.print_time_s, batches)


def _run(pipeline: Pipeline) -> End:
    while True:
        event = pipeline.job.step()
        match event:
            case Full():
                pipeline.run_through()
            case PositionSet() | ShaperChange() | SmoothTimeChange() | WeightsChange() | SurfaceChange():
                pipeline.finish()
                pipeline.act(event)
            case End():
                pipeline.finish()
                return event
            case _:
                pass
