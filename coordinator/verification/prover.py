"""Compares what the nodes' pins did with the plan: every step, every place, every clock."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from coordinator.config.model import MachineDescription, StepperDescription
from coordinator.motion.specs import StepperSpec
from coordinator.service.jobs.outcome import Outcome
from coordinator.streaming.pipeline import PlanRecord
from coordinator.verification.exact_program import program_legs
from coordinator.verification.expected import ExpectedSteps, expected_steps
from coordinator.verification.expected_curved import expected_curved
from coordinator.verification.hardware import Hardware, NodeLog
from coordinator.verification.planned import epochs, segments, ticks_at
from coordinator.verification.proof import ClockProof, PrimaryClock, StepperProof, prove_clock, prove_stepper
from coordinator.verification.true_position import PlaceProof, prove_places
from nodes.virtual.firmware import firmware_dictionary

BEFORE_S: Final = 1e-3
"""Steps that come longer before the start of the plan do not belong to it: they are of homing."""


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

    def sensorless(self) -> frozenset[str]:
        """Return the axes that are homed by the stall of a motor."""
        return frozenset(rail.axis for rail in self._description.stops if rail.homing.is_sensorless)

    def clocks(self) -> list[ClockProof]:
        """Measure the clocks of the secondary nodes that step."""
        primary = self._description.nodes[0].name
        return [
            prove_clock(
                name, clock_map, self._logs[name].ticks_to_monotonic_ns, self._primary, self._outcome.span
            )
            for name, clock_map in self._outcome.maps.items()
            if name != primary
        ]

    def stray_edges(self) -> int:
        """Count level changes of pins that nothing of the configuration is on."""
        return sum(self._stray(node, log) for node, log in self._logs.items())

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
            truth=log.ticks_to_monotonic_ns,
            primary=self._primary,
        )

    def _expected(self, stepper: StepperDescription) -> Iterator[ExpectedSteps]:
        legs = program_legs(self._spec(stepper), segments(self._record))
        if not all(leg.is_plain and leg.spec.weights == legs[0].spec.weights for leg in legs):
            yield from expected_curved(legs, self._outcome.maps[stepper.node].clock_freq)
            return
        weights = legs[0].spec.weights if legs else stepper.weights
        for position, moves in epochs(self._record):
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
        begin = ticks_at(self._outcome.maps[stepper.node], np.array([self._outcome.span[0] - BEFORE_S]))[0]
        for clock, direction in log.steps(
            self._pins[stepper.step_pin.name],
            self._pins[stepper.dir_pin.name],
            self._both_edges[stepper.name],
            step_idle_level=int(stepper.step_pin.invert),
        ):
            proved = clock >= begin
            yield clock[proved], direction[proved] * sign
