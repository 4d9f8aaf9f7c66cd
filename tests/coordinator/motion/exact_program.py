"""Plans a program for a machine as ``canductor plan`` does, and keeps all that a proof needs."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from coordinator.gcode.events import End, Full, PositionSet
from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program
from coordinator.machine.description import MachineDescription, load_machine
from coordinator.machine_devices import MachineDevices, stream_specs
from coordinator.motion.planner import Planner
from coordinator.motion.specs import NodeStreamSpec, StepperSpec
from coordinator.motion.steps import MAX_ERROR_S, StepGenerator, StepStats
from coordinator.pipeline import Pipeline, PlanRecord
from nodes.virtual.firmware import MAINBOARD, TOOLHEAD, firmware_dictionary
from tests.coordinator.motion.exact import Setting
from tests.coordinator.motion.exact_check import StepperProof, Verdict, check
from tests.coordinator.motion.exact_shapers import impulses
from tests.coordinator.motion.replay import Stream, replay_all

MOVE_COUNT = 1024


@dataclass
class Planned:
    """A planned program: what was intended, and what was emitted."""

    steppers: list[StepperSpec]
    nodes: list[NodeStreamSpec]
    record: PlanRecord
    setting: Setting
    stats: StepStats
    print_time_s: float
    batches: dict[int, bytearray] = field(default_factory=dict)

    def streams(self) -> dict[str, Stream]:
        """Return what the emitted commands make each stepper do."""
        return replay_all({i: bytes(b) for i, b in self.batches.items()}, self.nodes, self.steppers)

    def prove(self, windows: list[tuple[float, float]] | None = None) -> list[Verdict]:
        """Compare every stepper's steps with its exact motion, in WINDOWS of print time or everywhere."""
        epochs, streams = self.record.epochs(), self.streams()
        verdicts = []
        for spec in self.steppers:
            freq = self.nodes[spec.node].clock_freq
            proof = StepperProof(spec, epochs, self.setting)
            verdicts.append(check(proof, streams[spec.name], freq, MAX_ERROR_S, windows))
        return verdicts

    def left_out(self, name: str) -> int:
        """Return how many steps of a stepper were left out in pairs."""
        return next(s.cancelled for s in self.stats.steppers if s.name == name)


def plan_program(config: Path, gcode: Path) -> Planned:
    """Plan GCODE for CONFIG; nothing but the streams and the trapezoids is kept."""
    description = load_machine(str(config))
    devices = MachineDevices(description)
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
    setting = _shape(steps, description, steppers)
    batches = {i: bytearray() for i in range(len(nodes))}
    record = PlanRecord((0.0, 0.0, 0.0, 0.0))
    with Program.open(str(gcode)) as program:
        planner: Any = Planner(description.limits)
        if description.extruder and hasattr(Planner, "pressure_advance"):
            planner.pressure_advance = description.extruder.pressure_advance
        job = Job(program, planner, description.homed_position)
        pipeline = Pipeline(
            job, steps, lambda node, batch: batches[node].extend(batch), nodes=len(nodes), record=record
        )
        end = _run(pipeline)
    return Planned(steppers, nodes, record, setting, steps.stats(), end.print_time_s, batches)


def _shape(steps: Any, description: MachineDescription, steppers: Sequence[StepperSpec]) -> Setting:
    """Have STEPS shape as DESCRIPTION says, with impulses of our own; return what that is."""
    if not hasattr(steps, "set_shaper"):
        return Setting()
    shapers = {s.axis.upper(): impulses(s.kind, s.frequency_hz, s.damping_ratio) for s in description.shapers}
    for axis, found in shapers.items():
        steps.set_shaper("XYZ".index(axis), found)
    smooth_s = description.extruder.smooth_time_s if description.extruder else 0.0
    for index, spec in enumerate(steppers):
        if spec.weights[3]:
            steps.set_smooth_time(index, smooth_s)
    return Setting(shapers, smooth_s)


def _begin_late_enough(pipeline: Pipeline) -> None:
    """Let the next move begin so late that it does not act on what is generated."""
    if pipeline.steps.next_move_s > pipeline.planner.print_time_end_s:
        pipeline.planner.begin_at(pipeline.steps.next_move_s)


def _run(pipeline: Pipeline) -> End:
    _begin_late_enough(pipeline)
    while True:
        event = pipeline.job.step()
        match event:
            case Full():
                pipeline.run_through()
            case PositionSet():
                pipeline.finish()
                pipeline.declare(event.position)
                _begin_late_enough(pipeline)
            case End():
                pipeline.finish()
                return event
            case _:
                pass
