"""Results of the demo, as figures and as text."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from coordinator.service.jobs.outcome import Outcome
from coordinator.verification.hardware import Hardware
from coordinator.verification.heat_proof import HeatProof
from coordinator.verification.proof import ClockProof, StepperProof
from coordinator.verification.prover import Prover
from coordinator.verification.true_position import PlaceProof


@dataclass(frozen=True, slots=True)
class DemoReport:
    """The demo's outcome; ``ok`` only when every step was proved."""

    outcome: Outcome
    steppers: tuple[StepperProof, ...]
    places: tuple[PlaceProof, ...]
    """Of what was homed."""
    heat: tuple[HeatProof, ...]
    """Of every steady state of a heater."""
    clocks: tuple[ClockProof, ...]
    stray_edges: int
    """Level changes of pins that the configuration does not use."""
    dispatch_late_s: Mapping[str, float]
    """By node: the largest delay with which the host's kernel ran its timers."""
    frames: int
    frames_lost: int
    notices: tuple[str, ...]
    sensorless: frozenset[str] = frozenset()
    """Axes that are homed by the stall of a motor."""

    @property
    def ok(self) -> bool:
        """Whether every stepper did exactly what was planned, nothing else moved, and heat was held."""
        moved = all(s.holds for s in self.steppers) and all(p.holds for p in self.places)
        return moved and all(heat.holds for heat in self.heat) and self.stray_edges == 0

    def to_json(self) -> Mapping[str, object]:
        """Return the figures by name."""
        outcome = self.outcome
        links = {node.name: node.link for node in outcome.nodes}
        leads = [link.min_lead_s for link in links.values() if link.min_lead_s is not None]
        return {
            "nodes": list(links),
            "moves": outcome.moves,
            "print_time_s": round(outcome.print_time_s, 3),
            "steps": sum(s.steps_executed for s in self.steppers),
            "steps_planned": sum(s.steps_expected for s in self.steppers),
            "queue_steps": outcome.queue_steps,
            "bytes_to_nodes": sum(link.bytes_sent for link in links.values()),
            "position_error_steps": sum(s.position_error_steps for s in self.steppers),
            "worst_step_error_us": _us(max((s.worst_error_s for s in self.steppers), default=0.0)),
            "worst_band_error_us": _us(max((s.worst_band_error_s for s in self.steppers), default=0.0)),
            "place_error_um": {place.axis: round(place.error_mm * 1e3, 2) for place in self.places},
            "heat": [heat.to_json() for heat in self.heat],
            "clock_rms_us": {clock.node: _us(clock.rms_s) for clock in self.clocks},
            "clock_worst_us": {clock.node: _us(clock.worst_s) for clock in self.clocks},
            "retransmitted_bytes": sum(link.bytes_repeated for link in links.values()),
            "min_lead_ms": round(min(leads) * 1e3, 1) if leads else None,
            "frames": self.frames,
            "frames_lost": self.frames_lost,
            "stray_edges": self.stray_edges,
            "steppers": {
                s.stepper: {
                    "node": s.node,
                    "steps": s.steps_executed,
                    "steps_planned": s.steps_expected,
                    "position": s.position_executed,
                    "position_planned": s.position_expected,
                    "position_counted": s.position_counted,
                    "wrong_directions": s.wrong_directions,
                    "worst_step_error_us": _us(s.worst_error_s),
                    "worst_band_error_us": _us(s.worst_band_error_s),
                }
                for s in self.steppers
            },
            "dispatch_late_us": {name: _us(late_s) for name, late_s in self.dispatch_late_s.items()},
            "round_trip_us": {name: _us(link.srtt_s) for name, link in links.items()},
        }

    def to_text(self) -> str:
        """Return the proof for a reader."""
        outcome = self.outcome
        lines = [*self.notices, ""]
        lines += [
            f"{s.stepper} on {s.node}: {s.steps_executed:,} of {s.steps_expected:,} steps, at position "
            f"{s.position_executed:,} (plan {s.position_expected:,}, node's counter {s.position_counted:,}), "
            f"timed within {_us(s.worst_band_error_s)} µs of the plan, {_us(s.worst_error_s)} µs in truth"
            for s in self.steppers
        ]
        lines += [
            f"{p.axis}: homed, and at the end {abs(p.error_mm) * 1e3:.1f} µm from its believed position "
            f"(a step is {p.step_mm * 1e3:.1f} µm)"
            for p in self.places
        ]
        lines += [heat.to_text() for heat in self.heat]
        lines += [
            f"clock of {c.node}: {_us(c.rms_s)} µs rms from print time, {_us(c.worst_s)} µs at worst"
            for c in self.clocks
        ]
        lines += [node.to_text() for node in outcome.nodes]
        lines.append(
            f"{outcome.moves:,} moves in {outcome.print_time_s:.1f} s, {outcome.queue_steps:,} queue_step "
            f"commands; {self.frames:,} CAN frames, {self.frames_lost:,} of them lost on purpose"
        )
        lines.append(self.verdict())
        return "\n".join(lines)

    def verdict(self) -> str:
        """Return in a sentence whether all was proved, and what most likely is the cause if not."""
        if self.ok:
            return "PROVED: every stepper stands where the plan says; no step early, late or lost"
        return f"FAILED: {'; '.join(self.failures())}; {self._cure()}"

    def failures(self) -> list[str]:
        """Return everything that was not proved, a phrase each."""
        found = []
        if failed := [s.stepper for s in self.steppers if not s.holds]:
            found.append(f"{', '.join(failed)} did not do what was planned")
        if lost := self._lost():
            found.append(f"{', '.join(lost)} is not at the position that the machine believes")
        if cold := [heat.heater for heat in self.heat if not heat.holds]:
            found.append(f"{', '.join(dict.fromkeys(cold))} left the target in steady state")
        if self.stray_edges:
            found.append(f"{self.stray_edges} level changes of pins that the configuration does not use")
        return found

    def _lost(self) -> list[str]:
        return [place.axis for place in self.places if not place.holds]

    def _cure(self) -> str:
        """Return the likely cause first, where there is one that is not ours."""
        report = "please report this with the output above"
        without_switch = [axis for axis in self._lost() if axis in self.sensorless]
        if not without_switch:
            return report
        return (
            f"{', '.join(without_switch)} is homed without a switch, so most likely it stood at its end while"
            " another axis was homed along it: let one axis leave its end first (docs/tmc.md, Homing without"
            f" switches); if that is not it, {report}"
        )


def report_of(
    prover: Prover,
    hardware: Hardware,
    figures: Mapping[str, Mapping[str, Any]],
    outcome: Outcome,
    notices: Sequence[str],
    *,
    heat: Sequence[HeatProof] = (),
) -> DemoReport:
    """Return the report, with every stepper proved; FIGURES: statistics of the nodes, which have ended."""
    frames, frames_lost = hardware.frames()
    return DemoReport(
        outcome=outcome,
        steppers=tuple(prover.steppers()),
        places=tuple(prover.places(hardware)),
        heat=tuple(heat),
        clocks=tuple(prover.clocks()),
        stray_edges=prover.stray_edges(),
        dispatch_late_s={name: float(of_node["late_us_max"]) * 1e-6 for name, of_node in figures.items()},
        frames=frames,
        frames_lost=frames_lost,
        notices=tuple(notices),
        sensorless=prover.sensorless(),
    )


def _us(seconds: float) -> float:
    return round(seconds * 1e6, 2)
