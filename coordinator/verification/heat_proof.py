"""How well the heaters held their targets: as they were measured, and as warm as they truly were.

A heater that is controlled by PID or by its model has to stay within NEAR_K of its target in steady state.
One that is switched on and off at its max_delta above and below leaves that range by its own option, and gets
farther still, by what comes after the switching: of it the mean of whole cycles has to be as near.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from coordinator.heat.controller import NEAR_K
from coordinator.heat.holding import SETTLING_S, Held
from coordinator.modules.heaters.heater import Heater
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.runtime.machine import Machine
from coordinator.virtual_machine.plant_heat import plant_word
from nodes.virtual.plant_log import PlantEvent

AROUND_NS: Final = 100_000_000
"""Extension of a steady state at both ends within which the log, written every 50 ms, is looked at."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HeatProof:
    """One heater in one steady state."""

    heater: str
    control: str
    max_delta_k: float
    """Of a heater that is switched on and off."""
    node: str
    body: str
    """What it heats, as the plant calls it."""
    held: Held
    span_ns: tuple[int, int]
    """When that was, in the host's time."""
    true_low_c: float = math.inf
    true_high_c: float = -math.inf

    @property
    def switched(self) -> bool:
        """Whether it is switched on and off at its max_delta."""
        return self.control == "watermark"

    @property
    def is_known(self) -> bool:
        """Whether the plant's log has its true temperature."""
        return self.true_low_c <= self.true_high_c

    @property
    def deviation_k(self) -> float:
        """How far from the target it was at most, by its sensor or in truth."""
        target = self.held.target_c
        return max(self.held.deviation_k, self.true_high_c - target, target - self.true_low_c)

    @property
    def holds(self) -> bool:
        """Whether it was as near to its target as its control has to keep it."""
        if not self.is_known:
            return False
        if not self.switched:
            return self.deviation_k <= NEAR_K
        return self.held.mean_c is None or abs(self.held.mean_c - self.held.target_c) <= NEAR_K

    def to_json(self) -> Mapping[str, object]:
        """Return the figures by name."""
        return {
            "heater": self.heater,
            "control": self.control,
            "target_c": self.held.target_c,
            "seconds": round(self.held.seconds, 1),
            "measured_c": [round(self.held.low_c, 2), round(self.held.high_c, 2)],
            "true_c": [round(self.true_low_c, 2), round(self.true_high_c, 2)] if self.is_known else None,
            "deviation_k": round(self.deviation_k, 2) if self.is_known else None,
            "cycles": self.held.cycles,
            "mean_c": None if self.held.mean_c is None else round(self.held.mean_c, 2),
            "holds": self.holds,
        }

    def to_text(self) -> str:
        """Return the statement for a reader."""
        held = self.held
        text = (
            f"{self.heater} ({self.control}): {held.target_c:g} °C in steady state for {held.seconds:.0f} s, "
            f"measured {held.low_c:.2f} to {held.high_c:.2f}, in truth {self.true_low_c:.2f} to "
            f"{self.true_high_c:.2f} °C: "
        )
        if not self.switched:
            return f"{text}{self.deviation_k:.2f} K off at most (allowed: {NEAR_K:g} K)"
        text += f"switched {self.max_delta_k:g} K above and below, as its max_delta says"
        if held.mean_c is None:
            return f"{text}; no whole cycle was seen"
        cycles = "1 cycle" if held.cycles == 1 else f"{held.cycles} cycles"
        return f"{text}; {held.mean_c:.2f} °C on average of {cycles}"


@dataclass(slots=True)
class HeatWatch:
    """Takes note of all steady states of a machine's heaters."""

    states: list[HeatProof] = field(default_factory=list)
    heaters: list[str] = field(default_factory=list)

    def attach(self, machine: "Machine") -> None:
        """Watch MACHINE, which has connected."""
        for heaters in machine.modules.of(HeaterRegistry):
            for unit in heaters.units.values():
                self._watch(machine, unit)

    def _watch(self, machine: "Machine", unit: "Heater") -> None:
        time_base = machine.time_base()

        def note(held: Held) -> None:
            self.states.append(
                HeatProof(
                    heater=unit.key,
                    control=unit.settings.kind,
                    max_delta_k=unit.settings.max_delta_k,
                    node=unit.node,
                    body=plant_word(unit.name),
                    held=held,
                    span_ns=(time_base.host_ns_at(held.since_s), time_base.host_ns_at(held.until_s)),
                )
            )

        self.heaters.append(unit.key)
        unit.on_held = note


def prove_heat(states: Iterable[HeatProof], node: str, log: Iterable[PlantEvent]) -> list[HeatProof]:
    """Return the STATES of NODE's heaters with how warm they truly were, by the LOG of its plant."""
    proofs = [state for state in states if state.node == node]
    bodies = {proof.body for proof in proofs}
    for event in log if proofs else ():
        if event.kind != "body" or event.name not in bodies:
            continue
        for index, proof in enumerate(proofs):
            begin_ns, end_ns = proof.span_ns[0] - AROUND_NS, proof.span_ns[1] + AROUND_NS
            if proof.body == event.name and begin_ns <= event.at_ns <= end_ns:
                low, high = min(proof.true_low_c, event.value), max(proof.true_high_c, event.value)
                proofs[index] = replace(proof, true_low_c=low, true_high_c=high)
    return proofs


def not_steady(heaters: Iterable[str], proofs: Iterable[HeatProof]) -> str | None:
    """Return a sentence about the HEATERS that have not been in steady state; None: all have."""
    missing = sorted(set(heaters) - {proof.heater for proof in proofs})
    if not missing:
        return None
    return (
        f"{', '.join(missing)}: nothing to compare: no target was held for longer than {SETTLING_S:g} s after"
        " it had been reached"
    )
