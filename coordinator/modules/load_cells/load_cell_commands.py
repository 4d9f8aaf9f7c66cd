"""[load_cell NAME]: a scale; LOAD_CELL_READ, LOAD_CELL_TARE and the like, for all load cells.

A calibration is a dialogue: TARE without a weight, CALIBRATE GRAMS= with one, then ACCEPT or ABORT.
"""

import contextlib
import statistics
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from coordinator.config.options import SectionSpec
from coordinator.gcode.commands import AtStandstill, Call, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import bounded
from coordinator.gcode.parser import WordError, quoted
from coordinator.modules.base import Build, Module
from coordinator.modules.load_cells.load_cell import CELL_OPTIONS, UNSUPPORTED, LoadCell
from coordinator.modules.probes.manual_probe import ManualProbe
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

READ_S: Final = 1.0
"""Of readings that LOAD_CELL_READ, LOAD_CELL_TARE and a calibration take the mean of."""
DIAGNOSTIC_S: Final = 10.0
HEAVIEST_G: Final = 1e6
_BEGUN: Final = (
    "take everything off the load cell and send TARE; put a known weight on it and send CALIBRATE GRAMS=; end"
    " with ACCEPT or ABORT"
)


class LoadCellModule(Module):
    """The section."""

    NAMED = True
    NAMELESS = True
    SPEC = SectionSpec("A scale: a load cell with an HX711 or HX717", CELL_OPTIONS, unsupported=UNSUPPORTED)

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.cell = LoadCell(build)
        build.shared(LoadCellCommands).add(self.cell)

    async def connect(self, live: ModuleContext) -> None:
        """Begin to measure."""
        await super().connect(live)
        await self.cell.connect(live)

    def end(self, cause: str) -> None:
        """Measure no more."""
        del cause
        self.cell.end()

    def status(self) -> Mapping[str, Value]:
        """Report the force."""
        return self.cell.status()


@dataclass(slots=True)
class _Calibration:
    """One that is going on."""

    cell: LoadCell
    empty_counts: float | None = None
    loaded: tuple[float, float] | None = None
    """Counts, and grams."""


class LoadCellCommands(Module):
    """The commands."""

    SPEC = SectionSpec("Commands of load cells", ())

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._cells: dict[str, LoadCell] = {}
        self._calibration: _Calibration | None = None
        self._manual = build.shared(ManualProbe)
        self._manual.others.append(self)
        reads: tuple[tuple[str, str, Callable[[Call], Reading]], ...] = (
            ("LOAD_CELL_READ", "Report the force on a load cell, LOAD_CELL=", self._read_read),
            ("LOAD_CELL_TARE", "Make the present force on a load cell, LOAD_CELL=, its 0", self._read_tare),
            (
                "LOAD_CELL_DIAGNOSTIC",
                "Report how a load cell, LOAD_CELL=, measures",
                self._read_diagnostic,
            ),
            ("LOAD_CELL_CALIBRATE", "Begin to calibrate a load cell, LOAD_CELL=", self._read_begin),
            ("TARE", "In a calibration of a load cell: nothing is on it", self._read_empty),
            ("CALIBRATE", "In a calibration of a load cell: GRAMS= are on it", self._read_loaded),
        )
        for name, text, read in reads:
            build.add_command(name, text, read)

    def add(self, cell: LoadCell) -> None:
        """Add a load cell."""
        self._cells[cell.instance] = cell

    def _cell(self, call: Call) -> LoadCell:
        """Return the load cell that CALL is for; raises WordError."""
        name = call.parameters("LOAD_CELL").get("LOAD_CELL")
        known = ", ".join(self._cells)
        if name is None and len(self._cells) == 1:
            return next(iter(self._cells.values()))
        if name is None:
            raise WordError(f"{call.command.name} needs LOAD_CELL=; there are {known}")
        found = self._cells.get(name) or next((c for c in self._cells.values() if c.name == name), None)
        if found is None:
            raise WordError(f"LOAD_CELL of {call.command.name} is {quoted(name)}; there is {known}")
        return found

    # ------------------------------------------------------------------------------------------- measuring

    def _read_read(self, call: Call) -> Reading:
        cell = self._cell(call)

        async def read() -> Done:
            with explained(cell):
                counts = await cell.mean_counts(READ_S)
            force = f"{cell.force_g(counts):.1f} g" if cell.is_calibrated else "not calibrated"
            return Done((f"{cell.name}: {force}; {counts:.0f} counts",))

        return AtStandstill(read)

    def _read_tare(self, call: Call) -> Reading:
        cell = self._cell(call)

        async def tare() -> Done:
            with explained(cell):
                cell.tare_counts = await cell.mean_counts(READ_S)
            return Done((f"{cell.name}: tare at {cell.tare_counts:.0f} counts",))

        return AtStandstill(tare)

    def _read_diagnostic(self, call: Call) -> Reading:
        cell = self._cell(call)

        async def measure() -> Done:
            sensor = cell.sensor
            with explained(cell):
                first = await sensor.count(cell.node)
                begin_s = cell.print_time_of_last_count()
                await cell.mean_counts(DIAGNOSTIC_S)
                last = await sensor.count(cell.node)
                seconds = cell.print_time_of_last_count() - begin_s
            counts = [one.counts for one in sensor.readings if first <= one.number < last and not one.error]
            spread = statistics.pstdev(counts)
            mean = statistics.fmean(counts)
            rate = f"{(last - first) / seconds:.1f} per second (sample_rate {sensor.rate_hz:g})"
            lines = [
                f"{cell.name}: {len(counts)} readings, {rate}; errors since the start: {sensor.bad}",
                f"counts: {min(counts)} to {max(counts)}, mean {mean:.1f}, standard deviation {spread:.1f}",
            ]
            if cell.is_calibrated:
                per_gram, _ = cell.scale()
                lines.append(
                    f"force: {cell.force_g(mean):.1f} g, standard deviation {spread / per_gram:.2f} g"
                )
            return Done(tuple(lines))

        return AtStandstill(measure)

    # ----------------------------------------------------------------------------------------- calibrating

    @property
    def is_active(self) -> bool:
        """Whether a calibration waits for an answer."""
        return self._calibration is not None

    def _read_begin(self, call: Call) -> Reading:
        cell = self._cell(call)
        self._manual.check_no_dialogue(call)

        async def begin() -> Done:
            self._calibration = _Calibration(cell)
            return Done((f"{cell.name}: {_BEGUN}",))

        return AtStandstill(begin)

    def _going_on(self, call: Call) -> _Calibration:
        if self._calibration is None:
            raise WordError(f"{call.command.name} is for a calibration; begin with LOAD_CELL_CALIBRATE")
        return self._calibration

    def _read_empty(self, call: Call) -> Reading:
        call.parameters()
        going_on = self._going_on(call)

        async def tare() -> Done:
            with explained(going_on.cell):
                going_on.empty_counts = await going_on.cell.mean_counts(READ_S)
            return Done((f"empty: {going_on.empty_counts:.0f} counts; now CALIBRATE GRAMS= with a weight",))

        return AtStandstill(tare)

    def _read_loaded(self, call: Call) -> Reading:
        going_on = self._going_on(call)
        given = call.parameters("GRAMS")
        if "GRAMS" not in given:
            raise WordError("CALIBRATE needs GRAMS=, the weight on the load cell")
        grams = bounded(call.command, given, "GRAMS", 0, low=1, high=HEAVIEST_G)

        async def load() -> Done:
            if going_on.empty_counts is None:
                raise CanductorError("CALIBRATE comes after TARE: take everything off the load cell first")
            with explained(going_on.cell):
                counts = await going_on.cell.mean_counts(READ_S)
            going_on.loaded = counts, grams
            per_gram = (counts - going_on.empty_counts) / grams
            return Done((f"{grams:g} g: {counts:.0f} counts, {per_gram:.3f} per gram; ACCEPT keeps that",))

        return AtStandstill(load)

    def read_accept(self, call: Call) -> Reading:
        """Keep the calibration."""
        going_on = self._going_on(call)

        async def keep() -> Done:
            if going_on.empty_counts is None or going_on.loaded is None:
                raise CanductorError(
                    "ACCEPT comes after TARE and CALIBRATE GRAMS=; ABORT ends without a result"
                )
            counts, grams = going_on.loaded
            with explained(going_on.cell):
                told = going_on.cell.calibrate(going_on.empty_counts, counts, grams)
            self._calibration = None
            return Done((told,))

        return AtStandstill(keep)

    def read_abort(self, call: Call) -> Reading:
        """End it."""
        del call

        async def end() -> Done:
            self._calibration = None
            return Done(("the calibration of the load cell was aborted; nothing is kept",))

        return AtStandstill(end)


@contextlib.contextmanager
def explained(cell: LoadCell) -> Iterator[None]:
    """Have errors of the sensor begin with its section's name."""
    try:
        yield
    except CanductorError as error:
        if cell.live.machine.stopped is not None:
            raise
        raise CanductorError(f"[{cell.name}]: {error}") from error
