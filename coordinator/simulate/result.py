"""The result of one seed of a scenario, and of many."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from coordinator.simulate.checker import Violation

SHOWN_FAILURES = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """One run. Everything but the last two figures depends on scenario and seed alone."""

    scenario: str
    seed: int
    violations: tuple[Violation, ...] = ()
    cause: str | None = None
    """Why the machine stopped; None: the job completed."""
    steps: int = 0
    planned: int = 0
    virtual_s: float = 0.0
    """Simulated time."""
    ready_s: float = 0.0
    """Simulated time until every board was ready; 0: never."""
    faults: int = 0
    """That happened: those the scenario plans, and frames lost or damaged."""
    worst_primary_us: float = 0.0
    """Furthest that a step of the primary node was from its planned time, in truth."""
    worst_secondary_us: float = 0.0
    trace: str = ""
    """Hash of all that happened: equal for equal seeds."""
    events: int = 0
    """Of the simulated world."""
    cpu_s: float = field(default=0.0, compare=False)

    @property
    def ok(self) -> bool:
        """Whether all was as it has to be."""
        return not self.violations

    @property
    def replay(self) -> str:
        """The command that does the same again."""
        return f"canductor simulate {self.scenario} --seed {self.seed}"

    def to_json(self) -> Mapping[str, object]:
        """Return what JSON can hold."""
        return {
            "scenario": self.scenario,
            "seed": self.seed,
            "ok": self.ok,
            "violations": [{"rule": v.rule, "text": v.text} for v in self.violations],
            "cause": self.cause,
            "steps": self.steps,
            "steps_planned": self.planned,
            "virtual_s": round(self.virtual_s, 6),
            "ready_s": round(self.ready_s, 6),
            "faults": self.faults,
            "worst_primary_us": round(self.worst_primary_us, 3),
            "worst_secondary_us": round(self.worst_secondary_us, 3),
            "trace": self.trace,
            "events": self.events,
            "cpu_s": round(self.cpu_s, 3),
            "replay": self.replay,
        }

    def to_text(self) -> str:
        """Return it as lines for a reader."""
        died = any(violation.rule == "exception" for violation in self.violations)
        ended = "did not come to its end" if died else "completed"
        how = ended if self.cause is None else f"stopped: {self.cause}"
        lines = [
            f"{self.scenario}, seed {self.seed}: {how}",
            (
                f"  {self.steps:,} of {self.planned:,} steps in {self.virtual_s:.2f} s of simulated time "
                f"(ready after {self.ready_s:.2f}), "
                f"{self.faults:,} faults, at most {self.worst_primary_us:.1f} µs (primary) and "
                f"{self.worst_secondary_us:.1f} µs (others) off"
            ),
            f"  trace {self.trace}, {self.events:,} events, {self.cpu_s:.2f} s of CPU time",
        ]
        lines += [f"  FAILED {v.rule}: {v.text}" for v in self.violations]
        if not self.ok:
            lines.append(f"  replay: {self.replay}")
        return "\n".join(lines)


@dataclass(slots=True)
class _Tally:
    """The seeds of one scenario, added up."""

    seeds: int = 0
    completed: int = 0
    stopped: int = 0
    failed: int = 0
    faults: int = 0
    cpu_s: float = 0.0
    worst_primary_us: float = 0.0
    worst_secondary_us: float = 0.0

    def add(self, result: Result) -> None:
        self.seeds += 1
        self.failed += not result.ok
        self.completed += result.cause is None
        self.stopped += result.cause is not None
        self.faults += result.faults
        self.cpu_s += result.cpu_s
        self.worst_primary_us = max(self.worst_primary_us, result.worst_primary_us)
        self.worst_secondary_us = max(self.worst_secondary_us, result.worst_secondary_us)

    def to_json(self) -> Mapping[str, object]:
        return {
            "seeds": self.seeds,
            "completed": self.completed,
            "stopped": self.stopped,
            "failed": self.failed,
            "faults": self.faults,
            "cpu_s": round(self.cpu_s, 2),
            "worst_primary_us": round(self.worst_primary_us, 2),
            "worst_secondary_us": round(self.worst_secondary_us, 2),
        }


@dataclass(frozen=True, slots=True)
class SimulationReport:
    """All results of one command; in ascending order of scenario and seed."""

    results: Sequence[Result]
    wall_s: float

    @property
    def ok(self) -> bool:
        """Whether every seed was as it has to be."""
        return all(result.ok for result in self.results)

    @property
    def seeds_per_minute(self) -> float:
        """How fast it went."""
        return len(self.results) / self.wall_s * 60 if self.wall_s > 0 else 0.0

    def _tallies(self) -> dict[str, _Tally]:
        tallies: dict[str, _Tally] = {}
        for result in self.results:
            tallies.setdefault(result.scenario, _Tally()).add(result)
        return tallies

    def to_json(self) -> Mapping[str, object]:
        """Return the figures by name; results in full only when they are few, or failed."""
        few = len(self.results) <= SHOWN_FAILURES
        shown = [r for r in self.results if few or not r.ok][:SHOWN_FAILURES]
        return {
            "seeds": len(self.results),
            "completed": sum(r.cause is None for r in self.results),
            "stopped": sum(r.cause is not None for r in self.results),
            "failed": sum(not r.ok for r in self.results),
            "faults": sum(r.faults for r in self.results),
            "steps": sum(r.steps for r in self.results),
            "virtual_s": round(sum(r.virtual_s for r in self.results), 1),
            "wall_s": round(self.wall_s, 2),
            "cpu_s": round(sum(r.cpu_s for r in self.results), 2),
            "seeds_per_minute": round(self.seeds_per_minute, 1),
            "scenarios": {name: tally.to_json() for name, tally in self._tallies().items()},
            "results": [result.to_json() for result in shown],
        }

    def to_text(self) -> str:
        """Return a table of the scenarios, failures with the commands that replay them, and the sum."""
        if len(self.results) == 1:
            return self.results[0].to_text()
        head = ("scenario", "seeds", "completed", "stopped", "failed", "faults", "µs", "others µs", "CPU s")
        widths = (22, 5, 9, 7, 6, 8, 7, 9, 6)
        lines = [
            "  ".join(
                f"{h:{'<' if i == 0 else '>'}{w}}" for i, (h, w) in enumerate(zip(head, widths, strict=True))
            )
        ]
        for name, t in self._tallies().items():
            lines.append(
                f"{name:22}  {t.seeds:5}  {t.completed:9}  {t.stopped:7}  {t.failed:6}  {t.faults:8,}"
                f"  {t.worst_primary_us:7.1f}  {t.worst_secondary_us:9.1f}  {t.cpu_s / t.seeds:6.2f}"
            )
        failed = [result for result in self.results if not result.ok]
        lines += [result.to_text() for result in failed[:SHOWN_FAILURES]]
        if len(failed) > SHOWN_FAILURES:
            lines.append(
                f"… and {len(failed) - SHOWN_FAILURES} more; --json names the first {SHOWN_FAILURES}"
            )
        stopped = sum(r.cause is not None for r in self.results)
        lines.append(
            f"{len(self.results):,} seeds in {self.wall_s:.1f} s ({self.seeds_per_minute:,.0f} a minute): "
            f"{sum(r.faults for r in self.results):,} faults, {len(self.results) - stopped:,} completed, "
            f"{stopped:,} stopped with a cause, {len(failed):,} failed"
        )
        return "\n".join(lines)
