"""PROBE, QUERY_PROBE, PROBE_ACCURACY, PROBE_CALIBRATE, Z_OFFSET_APPLY_PROBE: for whatever probe there is."""

import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from coordinator.config.options import SectionSpec
from coordinator.gcode.builtins.state import go
from coordinator.gcode.commands import (
    AtStandstill,
    Call,
    Immediate,
    Phases,
    ProgramAction,
    ProgramContext,
    Reading,
)
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import bounded
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.probes.manual_probe import SPEED, ManualProbe
from coordinator.modules.probes.probe import Measuring, Probe, lift
from coordinator.runtime.module_context import ModuleContext
from nodes.support.errors import CanductorError

ACCURACY_SAMPLES: Final = 10
CALIBRATE_LIFT_MM: Final = 5.0
"""How far the head is lifted before the nozzle goes to where the probe was."""
TRAVEL_SPEED: Final = 50.0
"""mm/s of that way."""


class ProbeCommands(Module):
    """The commands."""

    SPEC = SectionSpec("Commands of the probe", ())

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._machine = build.machine
        self._manual = build.shared(ManualProbe)
        self._probe: Probe | None = None
        self._live: ModuleContext | None = None
        reads: tuple[tuple[str, str, Callable[[Call], Reading]], ...] = (
            ("PROBE", "Lower the head until the probe triggers, and report where that is", self._read_probe),
            ("QUERY_PROBE", "Report whether the probe is triggered", self._read_query),
            ("PROBE_ACCURACY", "Measure one place SAMPLES times and report the spread", self._read_accuracy),
            ("PROBE_CALIBRATE", "Find z_offset of the probe by hand", self._read_calibrate),
            (
                "Z_OFFSET_APPLY_PROBE",
                "Make the offset of Z part of the z_offset of the probe",
                self._read_apply,
            ),
        )
        for name, text, read in reads:
            build.add_command(name, text, read)

    def link(self, modules: Modules) -> None:
        """Find the probe."""
        self._probe = next(modules.of(Probe), None)

    async def connect(self, live: ModuleContext) -> None:
        """Take over the machine."""
        self._live = live

    @property
    def probe(self) -> Probe:
        """The machine's probe: without one these commands do not exist."""
        assert self._probe is not None
        return self._probe

    # ------------------------------------------------------------------------------------------- measuring

    def _read_probe(self, call: Call) -> Reading:
        how = self.probe.how(call.command)
        self.probe.check(call)

        def run(job: ProgramContext) -> Iterator[Reading]:
            yield from self.probe.deploy(job, call.command)
            found = yield from self.probe.measure(job, call.command, how)
            yield from self.probe.stow(job, call.command)
            if found is not None:
                self.probe.keep(found)
                x, y, z = found.bed
                yield Immediate(
                    (f"Result is z={found.nozzle[2]:.6f}: the bed is at z={z:.6f} at {x:.3f},{y:.3f}",)
                )

        return Phases(run)

    def _read_accuracy(self, call: Call) -> Reading:
        how = self.probe.how(call.command)
        given = call.parameters("SAMPLES")
        count = round(bounded(call.command, given, "SAMPLES", ACCURACY_SAMPLES, low=1, high=10_000))
        self.probe.check(call)
        return Phases(lambda job: self._run_accuracy(job, call, how, count))

    def _run_accuracy(self, job: ProgramContext, call: Call, how: Measuring, count: int) -> Iterator[Reading]:
        x, y, z, _ = job.planner.toolhead_position
        begins = (
            f"PROBE_ACCURACY at X:{x:.3f} Y:{y:.3f} Z:{z:.3f} (samples={count} retract={how.retract_mm:.3f}"
            f" speed={how.speed:.1f} lift_speed={how.lift_speed:.1f})"
        )
        yield Immediate((begins,))
        heights: list[float] = []
        yield from self.probe.deploy(job, call.command)
        for _ in range(count):
            contact = yield from self.probe.touch(job, call.command, how)
            if contact is None:
                return
            heights.append(contact.trigger_z)
            x, y, _, _ = contact.position
            yield Immediate((f"probe at {x:.3f},{y:.3f} is z={contact.trigger_z:.6f}",))
            yield from lift(job, contact.position[2] + how.retract_mm, how.lift_speed)
        yield from self.probe.stow(job, call.command)
        yield Immediate((str(Accuracy(tuple(heights))),))

    def _read_query(self, call: Call) -> Reading:
        call.parameters()

        async def query() -> Done:
            self.probe.last_query = await self.probe.is_triggered()
            return Done((f"probe: {'TRIGGERED' if self.probe.last_query else 'open'}",))

        return AtStandstill(query)

    # ----------------------------------------------------------------------------------------- calibrating

    def _read_calibrate(self, call: Call) -> Reading:
        self.probe.check_offset(call.command)
        how = self.probe.how(call.command)
        speed = bounded(
            call.command,
            call.parameters("SPEED"),
            "SPEED",
            SPEED,
            low=1e-3,
            high=self._machine.limits.max_z_velocity,
        )
        self._manual.check_free(call)
        return Phases(lambda job: self._run_calibrate(job, call, how, speed))

    def _run_calibrate(
        self, job: ProgramContext, call: Call, how: Measuring, speed: float
    ) -> Iterator[Reading]:
        yield from self.probe.deploy(job, call.command)
        found = yield from self.probe.measure(job, call.command, how)
        yield from self.probe.stow(job, call.command)
        # A program that is only planned goes on as if the probe triggered at once.
        x, y, trigger_z = job.planner.toolhead_position[:3] if found is None else found.nozzle
        yield from lift(job, job.planner.toolhead_position[2] + CALIBRATE_LIFT_MM, how.lift_speed)
        z, e = job.planner.toolhead_position[2:]
        there = [x + self.probe.offset[0], y + self.probe.offset[1], z, e]
        yield ProgramAction(lambda job: go(job, there, TRAVEL_SPEED))
        yield self._manual.begin(
            job.call(call.command), lambda nozzle_z: self._keep(trigger_z - nozzle_z), speed
        )

    def _read_apply(self, call: Call) -> Reading:
        call.parameters()
        self.probe.check_offset(call.command)
        offset = call.figures()["gcode_move"]["homing_origin"].z  # type: ignore[attr-defined]

        async def apply() -> Done:
            return Done(self._keep(self.probe.offset[2] - offset) if offset else ("the offset of Z is 0",))

        return AtStandstill(apply)

    def _keep(self, z_offset: float) -> tuple[str, ...]:
        if self._live is None:
            raise CanductorError("the z_offset of the probe needs a machine that is connected")
        self._live.save(self.probe.name, "z_offset", f"{z_offset:.3f}")
        return (f"{self.probe.name}: z_offset: {z_offset:.3f}; SAVE_CONFIG writes it and restarts",)


@dataclass(frozen=True, slots=True)
class Accuracy:
    """What repeated measurements of one place say about a probe, mm."""

    heights: tuple[float, ...]

    def __str__(self) -> str:
        heights = self.heights
        return (
            f"probe accuracy results: maximum {max(heights):.6f}, minimum {min(heights):.6f}, range"
            f" {max(heights) - min(heights):.6f}, average {statistics.fmean(heights):.6f}, median"
            f" {statistics.median(heights):.6f}, standard deviation {statistics.pstdev(heights):.6f}"
        )
