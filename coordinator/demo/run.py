"""``canductor demo``: prints on virtual nodes in real time, then proves every step against the plan."""

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription, StepperDescription
from coordinator.demo.hardware import Hardware, NodeLog
from coordinator.demo.report import DemoReport, NodeReport
from coordinator.gcode.program import Program
from coordinator.motion.specs import StepperSpec
from coordinator.runtime.host import Computer, LinuxHost
from coordinator.runtime.machine import Machine
from coordinator.streaming.job_runner import OnProgress, Outcome, run_job
from coordinator.streaming.pipeline import PlanRecord
from coordinator.support.command_options import DEMO_GCODE, DemoOptions
from coordinator.support.interrupts import run_to_end
from coordinator.support.progress import ProgressDisplay
from coordinator.verification.exact_program import program_legs
from coordinator.verification.expected import ExpectedSteps, expected_steps
from coordinator.verification.expected_curved import expected_curved
from coordinator.verification.heat_proof import HeatProof, HeatWatch, not_steady, prove_heat
from coordinator.verification.proof import ClockProof, PrimaryClock, StepperProof, prove_clock, prove_stepper
from coordinator.verification.true_position import PlaceProof, prove_places
from coordinator.virtual_machine.stage import Stage
from nodes.virtual.firmware import firmware_dictionary

BEFORE_S = 1e-3
"""What moves a stepper so long before the plan begins does not belong to it: that was homing."""


def run_demo(options: DemoOptions) -> DemoReport:
    """Run the demo; raises CanductorError when it cannot be brought to its end."""
    description = load_machine(str(options.machine))
    with ExitStack() as stack:
        folder = stack.enter_context(_folder(options.keep))
        program = stack.enter_context(Program.open(options.gcode or DEMO_GCODE))
        stage = stack.enter_context(Stage(description, options, folder))
        display = stack.enter_context(ProgressDisplay(f"printing {program.name}", quiet=options.json))
        return print_and_prove(stage, program, LinuxHost(), display.update)


def print_and_prove(
    hardware: Hardware, program: Program, host: Computer, on_progress: OnProgress = lambda _: None
) -> DemoReport:
    """Print PROGRAM on HARDWARE, which HOST reaches, and prove every step; raises CanductorError."""
    description = hardware.description
    record = PlanRecord((0.0, 0.0, 0.0, 0.0))
    told: list[str] = []
    both_edges: dict[str, bool] = {}
    claimed: dict[str, list[str]] = {}
    warmth = HeatWatch()

    def ready(machine: Machine) -> None:
        claimed.update({name: machine.modules.pins.claimed(name) for name in machine.nodes})
        both_edges.update({name: s.steps_on_both_edges for name, s in machine.devices.steppers.items()})
        warmth.attach(machine)

    outcome = run_to_end(
        lambda: run_job(
            description,
            program,
            on_progress,
            record=record,
            on_told=lambda event: told.append(event.text),
            on_ready=ready,
            host=host,
        ),
        host.make_loop,
    )
    figures = hardware.stop_nodes()
    prover = Prover(description, hardware.edge_log, outcome, record, both_edges=both_edges, claimed=claimed)
    heat = [
        proof
        for node in description.nodes
        for proof in prove_heat(warmth.states, node.name, hardware.plant_log(node.name))
    ]
    notices = [*map(str, description.unsupported), *description.notes, *told]
    if (sentence := not_steady(warmth.heaters, heat)) is not None:
        notices.append(sentence)
    return report_of(prover, hardware, figures, outcome, notices, heat=heat)


@contextmanager
def _folder(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        yield keep
        return
    with tempfile.TemporaryDirectory(prefix="canductor-demo-") as folder:
        yield Path(folder)


class Prover:
    """Compares what the nodes' pins did with the plan."""

    def __init__(
        self,
        description: MachineDescription,
        edge_log: Callable[[str], NodeLog],
        outcome: Outcome,
        record: PlanRecord,
        *,
        both_edges: Mapping[str, bool],
        claimed: Mapping[str, Sequence[str]],
    ) -> None:
        self._description = description
        self._outcome = outcome
        self._record = record
        self._both_edges = both_edges
        self._claimed = claimed
        self._logs = {node.name: edge_log(node.name) for node in description.nodes}
        self._pins = firmware_dictionary("canductor-node-mainboard").enumerations["pin"].values
        primary = self._logs[description.nodes[0].name]
        self._primary = PrimaryClock(
            monotonic_ns=primary.start_monotonic_ns,
            ticks=primary.start_clock,
            true_ticks_per_s=primary.ticks_per_second,
            clock_freq=primary.clock_freq,
        )

    def steppers(self) -> list[StepperProof]:
        """Prove every stepper."""
        return [self._stepper(stepper) for stepper in self._description.steppers]

    def places(self, hardware: Hardware) -> list[PlaceProof]:
        """Prove where what was homed stands."""
        return prove_places(self._description, self._record, hardware.axes, hardware.motors())

    def clocks(self) -> list[ClockProof]:
        """Measure the clocks of the secondary nodes that step."""
        primary = self._description.nodes[0].name
        return [
            prove_clock(name, clock_map, self._logs[name], self._primary, self._outcome.span)
            for name, clock_map in self._outcome.maps.items()
            if name != primary
        ]

    def stray_edges(self) -> int:
        """Count level changes of pins that nothing of the configuration is on."""
        return sum(self._stray(node.name, log) for node, log in self._with_logs())

    def _with_logs(self) -> Iterator[tuple[Any, NodeLog]]:
        for node in self._description.nodes:
            yield node, self._logs[node.name]

    def _stray(self, node: str, log: NodeLog) -> int:
        owned = [self._pins[name] for name in self._claimed[node]]
        counted = sum(len(clock) for clock, _, _ in log.edges(*owned))
        return log.record_count - counted

    def _stepper(self, stepper: StepperDescription) -> StepperProof:
        log = self._logs[stepper.node]
        return prove_stepper(
            stepper.name,
            stepper.node,
            self._expected(stepper),
            self._executed(stepper, log),
            counted=self._outcome.positions[stepper.name],
            clock_map=self._outcome.maps[stepper.node],
            truth=log,
            primary=self._primary,
        )

    def _expected(self, stepper: StepperDescription) -> Iterator[ExpectedSteps]:
        legs = program_legs(self._spec(stepper), self._record.segments())
        if not all(leg.is_plain and leg.spec.weights == legs[0].spec.weights for leg in legs):
            yield from expected_curved(legs, self._outcome.maps[stepper.node].clock_freq)
            return
        weights = legs[0].spec.weights if legs else stepper.weights
        for position, moves in self._record.epochs():
            origin = float(np.dot(weights, position))
            yield from expected_steps(moves, weights, stepper.step_distance, origin)

    def _spec(self, stepper: StepperDescription) -> StepperSpec:
        function = stepper.function
        return StepperSpec(
            name=stepper.name,
            node=0,
            oid=0,
            weights=stepper.weights,
            step_distance=stepper.step_distance,
            invert_dir=stepper.dir_pin.invert,
            step_pulse_s=stepper.step_pulse_s,
            formula=function.formula,
            params=function.params,
        )

    def _executed(self, stepper: StepperDescription, log: NodeLog) -> Iterator[tuple[Any, Any]]:
        sign = np.int8(-1 if stepper.dir_pin.invert else 1)
        begin = self._outcome.maps[stepper.node].ticks(np.array([self._outcome.span[0] - BEFORE_S]))[0]
        for clock, direction in log.steps(
            self._pins[stepper.step_pin.name],
            self._pins[stepper.dir_pin.name],
            self._both_edges[stepper.name],
            step_idle_level=int(stepper.step_pin.invert),
        ):
            proved = clock >= begin
            yield clock[proved], direction[proved] * sign


def report_of(
    prover: Prover,
    hardware: Hardware,
    figures: Mapping[str, Mapping[str, Any]],
    outcome: Outcome,
    notices: Sequence[str],
    *,
    heat: Sequence[HeatProof] = (),
) -> DemoReport:
    """Return the report, with every stepper proved; the nodes have ended, with these FIGURES."""
    frames, frames_lost = hardware.frames()
    return DemoReport(
        moves=outcome.moves,
        print_time_s=outcome.print_time_s,
        queue_steps=outcome.queue_steps,
        steppers=tuple(prover.steppers()),
        places=tuple(prover.places(hardware)),
        heat=tuple(heat),
        clocks=tuple(prover.clocks()),
        stray_edges=prover.stray_edges(),
        nodes=tuple(
            NodeReport(
                name=node.name,
                bytes_sent=node.link.bytes_sent,
                retransmitted_bytes=node.link.bytes_repeated,
                min_lead_s=node.link.min_lead_s,
                round_trip_s=node.link.srtt_s,
                clock_error_bound_s=node.clock_error_s,
                dispatch_late_s=float(figures[node.name]["late_us_max"]) * 1e-6,
            )
            for node in outcome.nodes
        ),
        frames=frames,
        frames_lost=frames_lost,
        notices=tuple(notices),
    )
