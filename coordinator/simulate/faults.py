"""The faults of a scenario, drawn from the seed, in true time."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Protocol

from coordinator.simulate.scenario import HOST, FaultSetting, Scenario
from coordinator.support.toml_values import Dice

NS: Final = 1_000_000_000
SILENCE_S: Final = 1.5
"""Maximum time from the last good frame to a stop that only a bad wire can have caused."""
ISOLATING: Final = ("cut", "power", "stall", "babble", "errors", "loss", "flood")
"""Faults that may keep a stop from reaching a node."""


@dataclass(frozen=True, slots=True)
class ScenarioFault:
    """One fault, from BEGIN_NS to END_NS of true time."""

    kind: str
    node: str
    bus: str
    begin_ns: int
    end_ns: int
    share: float
    can_id: int
    data: bytes = b""
    wrong_s: float = 0.0
    random_s: float = 0.0


class Actor(Protocol):
    """Carries out faults."""

    def act(self, fault: ScenarioFault) -> None:
        """Schedule FAULT, which lies in the future."""

    def call(self, at_ns: int, what: Callable[[], object]) -> None:
        """Call WHAT on the loop at a true time in the future."""

    def now_ns(self) -> int:
        """Return true time."""


class Faults:
    """The faults of SCENARIO, drawn with DICE and carried out by ACTOR. BUS_OF: each node's wire."""

    def __init__(self, scenario: Scenario, dice: Dice, actor: Actor, bus_of: Mapping[str, str]) -> None:
        self._scenario = scenario
        self._dice = dice
        self._actor = actor
        self._bus_of = bus_of
        self._begun: list[ScenarioFault] = []

    @property
    def begun(self) -> tuple[ScenarioFault, ...]:
        """All faults that are scheduled so far."""
        return tuple(self._begun)

    def begin(self, since: str, interrupt: Callable[[], object]) -> None:
        """Schedule the faults relative to SINCE, which is now; INTERRUPT is called for Ctrl-C."""
        now_ns = self._actor.now_ns()
        for number, setting in enumerate(self._scenario.faults):
            if setting.since == since:
                for fault in self._drawn(setting, f"faults.{number}", now_ns):
                    self._begun.append(fault)
                    if fault.kind == "interrupt":
                        self._actor.call(fault.begin_ns, interrupt)
                    else:
                        self._actor.act(fault)

    def add(
        self,
        kind: str,
        *,
        at_s: float,
        for_s: float,
        node: str = "",
        bus: str = "",
        share: float = 0.0,
        data: bytes = b"",
    ) -> ScenarioFault:
        """Schedule a fault that is not in the scenario, in AT_S from now; options as in a scenario file."""
        begin_ns = self._actor.now_ns() + round(at_s * NS)
        fault = ScenarioFault(kind, node, bus, begin_ns, begin_ns + round(for_s * NS), share, 0, data)
        self._begun.append(fault)
        self._actor.act(fault)
        return fault

    def _drawn(self, setting: FaultSetting, key: str, now_ns: int) -> list[ScenarioFault]:
        def draw(name: str) -> float:
            return self._dice.draw(getattr(setting, name), f"{key}.{name}")

        begin_s, every_s = draw("at_s"), draw("every_s")
        duration_ns = round(draw("for_s") * NS)
        faults = []
        for n in range(round(draw("times"))):
            begin_ns = now_ns + round((begin_s + n * every_s) * NS)
            end_ns = begin_ns + duration_ns
            node, bus = setting.node, setting.bus
            share, data = draw("share"), bytes.fromhex(setting.data)
            wrong = (draw("wrong_s"), draw("random_s"))
            faults.append(
                ScenarioFault(setting.kind, node, bus, begin_ns, end_ns, share, setting.id, data, *wrong)
            )
        return faults

    # ------------------------------------------------------------------------------------------ afterwards

    def happened(self) -> int:
        """Return how many faults have begun."""
        return sum(fault.begin_ns <= self._actor.now_ns() for fault in self._begun)

    def sound_until_ns(self, job_ns: int, stopped_ns: int) -> int:
        """Return the time up to which every due step must have been made; STOPPED_NS: when it stopped."""
        bad_wire = any(
            bus.loss.high or bus.corruption.high or bus.errors.high for bus in self._scenario.buses.values()
        )
        sound = stopped_ns - round(SILENCE_S * NS) if bad_wire else stopped_ns
        begins = [fault.begin_ns for fault in self._begun if fault.end_ns >= job_ns]
        return min([sound, *begins])

    def can_reach(self, node: str, from_ns: int, until_ns: int) -> bool:
        """Return whether nothing keeps the host from NODE between these times."""
        bus = self._bus_of[node]
        for fault in self._begun:
            there = fault.bus == bus or fault.node in (node, HOST)
            there |= fault.kind == "babble" and self._bus_of.get(fault.node) == bus
            if fault.kind in ISOLATING and there and fault.begin_ns <= until_ns and fault.end_ns >= from_ns:
                return False
        return True
