"""[screws_tilt_adjust]: measures the bed above its screws and says how far each has to be turned."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from coordinator.config.options import ChoiceOption, Option, SectionSpec
from coordinator.gcode.commands import Call, Immediate, Phases, ProgramContext, Reading
from coordinator.gcode.parameters import bounded
from coordinator.gcode.parser import WordError, quoted
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.levelling.points import OPTIONS, ProbePoints, how_to_measure
from coordinator.modules.levelling.screw_turns import THREADS, Turn, screw_turns
from coordinator.modules.levelling.screws import SCREW, read_screws
from coordinator.modules.probes.probe import Measured, Probe
from coordinator.support.values import Value

THREAD: Final = ChoiceOption(
    name="screw_thread",
    help="thread of the screws, and how a knob is turned to raise the bed: clockwise (CW) or not (CCW)",
    default="CW-M3",
    choices=THREADS,
)
MAX_MM: Final = 1000.0
_OPTIONS: Final[tuple[Option[Any], ...]] = (THREAD, *OPTIONS)


class ScrewsTiltAdjust(Module):
    """The section."""

    SPEC = SectionSpec("Measures how far each screw of the bed has to be turned", _OPTIONS, family=SCREW)

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._screws = read_screws(build, own=(THREAD.name,), fine=False)
        self._thread = build.get(THREAD)
        self._points = ProbePoints(build, [screw.place for screw in self._screws])
        self._probe: Probe | None = None
        self._turns: tuple[Turn, ...] = ()
        self._limit: float | None = None
        self._failed = False
        build.add_command("SCREWS_TILT_CALCULATE", "Report how far each screw has to be turned", self._read)

    def link(self, modules: Modules) -> None:
        """Find the probe, without which the bed is probed by hand; raises NotSupported."""
        self._probe = self._points.find_probe(modules)

    def status(self) -> Mapping[str, Value]:
        """Report what was found last."""
        return {
            "error": self._failed,
            "max_deviation": self._limit,
            "results": {
                screw.key: {
                    "z": turn.height,
                    "sign": turn.direction,
                    "adjust": turn.adjust,
                    "is_base": turn.is_base,
                }
                for screw, turn in zip(self._screws, self._turns, strict=False)
            },
        }

    def _read(self, call: Call) -> Reading:
        given = call.parameters("DIRECTION", "MAX_DEVIATION")
        direction = given.get("DIRECTION", "").upper()
        if direction not in ("", "CW", "CCW"):
            raise WordError(
                f"DIRECTION of {call.command.name} is {quoted(given['DIRECTION'])}; give CW or CCW"
            )
        limit = bounded(call.command, given, "MAX_DEVIATION", None, low=0, high=MAX_MM)
        how = how_to_measure(call, self._probe)
        by = None if how is None or self._probe is None else (self._probe, how)
        self._points.check(call, None if by is None else by[0])

        def found(job: ProgramContext, measured: list[Measured]) -> Iterator[Reading]:
            del job
            yield from self._measured(call, measured, direction, limit)

        def run(job: ProgramContext) -> Iterator[Reading]:
            self._turns, self._limit, self._failed = (), limit, False
            yield from self._points.collect(job, call, by, found)

        return Phases(run)

    def _measured(
        self, call: Call, found: Sequence[Measured], direction: str, limit: float | None
    ) -> Iterator[Reading]:
        self._turns = screw_turns([one.nozzle[2] for one in found], self._thread, direction)
        yield Immediate(tuple(self._report(found)))
        worst_mm = max(abs(turn.rise_mm) for turn in self._turns)
        if limit is not None and worst_mm > limit:
            self._failed = True
            raise WordError(
                f"{call.command.name} failed: a screw is {worst_mm:.3f} mm off, more than MAX_DEVIATION"
                f" ({limit:g} mm); turn the screws and start again"
            )

    def _report(self, found: Sequence[Measured]) -> Iterator[str]:
        yield "01:20 means 1 full turn and 20 minutes, CW=clockwise, CCW=counter-clockwise"
        for screw, one, turn in zip(self._screws, found, self._turns, strict=True):
            x, y, z = one.nozzle
            base = " (base)" if turn.is_base else ""
            what = "" if turn.is_base else f" : adjust {turn.direction} {turn.adjust}"
            yield f"{screw.name}{base} : x={x:.1f}, y={y:.1f}, z={z:.5f}{what}"
