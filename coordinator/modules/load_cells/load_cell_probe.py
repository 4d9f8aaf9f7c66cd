"""[load_cell_probe]: the nozzle as probe, on a load cell that feels its force against the bed.

The head is lowered until the node sees trigger_force, filtered and above a tare that is taken just before.
Then the nozzle is lifted slowly, and where it leaves the bed is the height that is found (tap.py): how fast
the force was noticed, and how much the head gives way, do not matter.
"""

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from dataclasses import replace
from typing import Any, ClassVar, Final

from coordinator.config.options import (
    BadValue,
    FloatOption,
    IntOption,
    ListOption,
    Option,
    SectionSpec,
    parse_decimal,
)
from coordinator.config.pins import PinOption
from coordinator.config.sections.bounds import MAX_SPEED
from coordinator.config.sections.probe import LOAD_CELL, OFFSETS, Z_OFFSET
from coordinator.gcode.commands import AtStandstill, Call, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.parameters import bounded
from coordinator.modules.base import Build, Module
from coordinator.modules.load_cells.force_filters import high_pass, low_pass, notch
from coordinator.modules.load_cells.load_cell import CELL_OPTIONS, UNSUPPORTED, LoadCell, read_rate
from coordinator.modules.load_cells.load_cell_commands import LoadCellCommands, explained
from coordinator.modules.load_cells.tap import Tap, TapError, find_tap
from coordinator.modules.probes.probe import LINE_OPTIONS, MEASURING_OPTIONS, NotReadyError, Probe
from coordinator.modules.probes.probe_commands import ProbeCommands
from coordinator.modules.probes.reading_times import ReadingTimes
from coordinator.runtime.module_context import ModuleContext
from coordinator.runtime.moves.probing import Contact, SlowLift
from coordinator.support.values import Value
from nodes.devices.analog_trigger import Section
from nodes.devices.bulk_sensor import READINGS, SensorError, checked
from nodes.devices.endstop import EndstopState, SensorEndstop
from nodes.devices.hx71x import FULL_SCALE
from nodes.node.node import Node
from nodes.support.errors import CanductorError

SETTLE_S: Final = 0.1
"""Before the lift and after it: the force is measured at rest as well."""
WAITS_S: Final = 3.0
"""Beside the lift, readings have to be remembered for so long, and for two messages."""
MM_PER_READING: Final = 0.001
"""Of a lift, unless pullback_speed says otherwise."""
MAX_FORCE_G: Final = 1e5
NOTCHES_MAX: Final = 4
MAINS_PERIODS_S: Final = 4 / 60
"""A tare takes the mean of so long, in which the hum of 60 Hz (and nearly that of 50 Hz) comes to nothing."""
HEIGHT: Final = replace(
    Z_OFFSET,
    default=0.0,
    help="how high the nozzle is when it leaves the bed: 0, but for a bed whose print surface gives way",
)
TRIGGER_FORCE: Final = FloatOption(
    name="trigger_force",
    help="filtered force at which the way down ends",
    default=75.0,
    unit="g",
    minimum=10,
    maximum=2000,
)
SAFETY_LIMIT: Final = FloatOption(
    name="force_safety_limit",
    help="force at which homing is given up, also one that is there before it",
    default=2000.0,
    unit="g",
    minimum=100,
    maximum=MAX_FORCE_G,
)
TARE_TIME: Final = FloatOption(
    name="tare_time",
    help="how long the force is measured before each way down; that is its 0",
    default=MAINS_PERIODS_S,
    unit="s",
    minimum=0.01,
    maximum=2,
)


def _cutoff(name: str, of_what: str) -> FloatOption:
    return FloatOption(name=name, help=of_what, unit="Hz", above=0, maximum=1000)


def _order(name: str, of_what: str) -> IntOption:
    return IntOption(name=name, help=of_what, default=2, minimum=1, maximum=2)


DRIFT_HZ: Final = _cutoff(
    "drift_filter_cutoff_frequency",
    "of a filter that takes out what changes more slowly, such as the drag of a cable; by default none",
)
DRIFT_ORDER: Final = _order("drift_filter_delay", "order of that filter")
BUZZ_HZ: Final = _cutoff(
    "buzz_filter_cutoff_frequency",
    "of a filter that takes out what changes faster, such as the buzz of motors; by default none",
)
BUZZ_ORDER: Final = _order("buzz_filter_delay", "order of that filter")
NOTCHES: Final = ListOption(
    name="notch_filter_frequencies",
    help="frequencies that are taken out (Hz, four at most), such as 50, 60",
)
NOTCH_QUALITY: Final = FloatOption(
    name="notch_filter_quality",
    help="how narrow these filters are: frequency by width of what is taken out",
    default=2.0,
    minimum=0.5,
    maximum=10,
)
PULLBACK: Final = FloatOption(
    name="pullback_distance",
    help="how far the nozzle is lifted slowly, to find where it leaves the bed; 0: where it triggered counts",
    default=0.2,
    unit="mm",
    minimum=0,
    maximum=2,
)
PULLBACK_SPEED: Final = FloatOption(
    name="pullback_speed",
    help="of that lift; by default 1 µm per reading",
    unit="mm/s",
    minimum=0.01,
    maximum=MAX_SPEED,
)
OPTIONS: Final[tuple[Option[Any], ...]] = (
    *CELL_OPTIONS,
    *(TRIGGER_FORCE, SAFETY_LIMIT, TARE_TIME, DRIFT_HZ, DRIFT_ORDER, BUZZ_HZ, BUZZ_ORDER, NOTCHES),
    *(NOTCH_QUALITY, PULLBACK, PULLBACK_SPEED, HEIGHT),
    *(option for option in MEASURING_OPTIONS if option not in (*OFFSETS, Z_OFFSET)),
    *LINE_OPTIONS,
)


class LoadCellProbe(Probe):
    """The probe of [load_cell_probe]; for homing moves also the sensor in the place of an endstop."""

    SPEC = SectionSpec(
        "The nozzle as probe, by the force of its touch: a load cell with an HX711 or HX717",
        OPTIONS,
        unsupported=(
            *UNSUPPORTED,
            *("drift_safety_limit", "disable_pullback_move", "tap_classifier_module", "min_tap_quality"),
            *("decompression_angle", "max_approach_force", "max_departure_force", "max_baseline_force_delta"),
            "max_dwell_force_drop",
        ),
    )
    INPUT: ClassVar[PinOption | None] = None

    def __init__(self, build: Build) -> None:
        rate = read_rate(build)
        super().__init__(build)
        build.shared(ProbeCommands)
        self._pullback_mm = build.get(PULLBACK)
        self._pullback_speed = build.get_or(PULLBACK_SPEED, MM_PER_READING * rate)
        self._hums_hz = _hums(build, rate)
        kept_s = self._pullback_mm / self._pullback_speed + 2 * READINGS / rate + WAITS_S
        self.cell = LoadCell(build, _sections(build, rate, self._hums_hz), kept_s=kept_s)
        build.shared(LoadCellCommands).add(self.cell)
        build.shared(LoadCellProbeStatus).probe = self
        self._trigger_g, self._limit_g = build.get(TRIGGER_FORCE), build.get(SAFETY_LIMIT)
        if self._trigger_g >= self._limit_g:
            raise build.reader.bad(TRIGGER_FORCE, f"but it has to be below {SAFETY_LIMIT.name}")
        self._tare_s = build.get(TARE_TIME)
        self._tare: float | None = None
        self._lifted_mm = 0.0
        self._tap: Tap | None = None
        self._failed = False
        self._triggered_s = 0.0
        build.add_command(
            "LOAD_CELL_TEST_TAP",
            "Wait until the nozzle was tapped TAPS times, by hand, to see whether that triggers",
            self._read_test,
        )

    def side_offset(self, build: Build) -> tuple[float, float]:
        """Return 0: it is the nozzle."""
        del build
        return (0.0, 0.0)

    def trigger_height(self, build: Build) -> float:
        """Return z_offset, mm."""
        return build.get(HEIGHT)

    async def connect(self, live: ModuleContext) -> None:
        """Begin to measure, and become the endstop; raises CanductorError."""
        await super().connect(live)
        described = live.machine.description.probe
        if described is not None:
            endstop = live.machine.devices.endstops[described.rail.axis]
            assert isinstance(endstop, SensorEndstop)
            endstop.sensor = self
        await self.cell.connect(live)

    def end(self, cause: str) -> None:
        """Measure no more."""
        del cause
        self.cell.end()

    def force_status(self) -> Mapping[str, Value]:
        """Report what only this kind of probe has."""
        found = None if self._last is None else self._last.nozzle[2]
        return {
            **self.cell.status(),
            "endstop_tare_counts": None if self._tare is None else round(self._tare),
            "last_trigger_time": round(self._triggered_s, 4),
            "last_z_result": found,
            "is_last_tap_valid": self._tap is not None and not self._failed,
        }

    # ------------------------------------------------------------------------------------- as an endstop

    @property
    def errors(self) -> Sequence[str]:
        """Why its node ends a way down."""
        return self.cell.sensor.errors

    def touching(self, *, alone: bool) -> AbstractAsyncContextManager[None]:
        """Return what takes the tare before the head is lowered."""
        del alone
        return self._touching()

    @asynccontextmanager
    async def _touching(self) -> AsyncIterator[None]:
        await self._take_tare()
        yield

    async def _take_tare(self) -> None:
        """Take the present force as 0; raises NotReadyError where it is not safe."""
        try:
            per_gram, reference = self.cell.scale()
            self._tare = await self.cell.mean_counts(self._tare_s)
        except SensorError as error:
            raise NotReadyError(f"[{self.name}]: {error}") from error
        force_g = (self._tare - reference) / per_gram
        if abs(force_g) > self._limit_g:
            raise NotReadyError(
                f"[{self.name}]: the force at rest is {force_g:.0f} g, and force_safety_limit is"
                f" {self._limit_g:g} g: check that nothing presses against the nozzle, or calibrate again"
                " with LOAD_CELL_CALIBRATE"
            )

    def begin_homing(self, node: Node, *, clock: int, rest_ticks: int, trsync_oid: int) -> None:
        """Trigger the stop group at trigger_force."""
        per_gram, reference = self.cell.scale()
        room = self._limit_g * per_gram
        self.cell.sensor.begin_homing(
            node,
            clock=clock,
            rest_ticks=rest_ticks,
            trsync_oid=trsync_oid,
            zero=round(reference if self._tare is None else self._tare),
            grams_per_count=1 / per_gram,
            safe=(round(max(reference - room, -FULL_SCALE)), round(min(reference + room, FULL_SCALE))),
            grams=self._trigger_g,
        )

    def end_homing(self, node: Node) -> None:
        """Compare no more."""
        self.cell.sensor.end_homing(node)

    async def state(self, node: Node) -> EndstopState:
        """Measure whether it is triggered; raises CanductorError."""
        try:
            per_gram, reference = self.cell.scale()
            (reading,) = await self.cell.sensor.next_readings(node, 1)
        except SensorError as error:
            raise NotReadyError(f"[{self.name}]: {error}") from error
        tare = reference if self._tare is None else self._tare
        pressed = abs(reading.counts - tare) >= self._trigger_g * per_gram
        found = await self.cell.sensor.state(node, pressed=pressed)
        if pressed and not found.homing:
            self._triggered_s = self.live.print_time_of(self.cell.node_name, found.next_clock32)
        return found

    # ------------------------------------------------------------------------------------------ the tap

    async def standing_mm(self) -> float | None:
        """Lift the nozzle and return how high it is above where it left the bed, and z_offset of that.

        Raises NotReadyError. None: there is no lift, where it triggered counts.
        """
        if not self._pullback_mm:
            return None
        self._failed = True
        times = ReadingTimes(self.live, self.cell.node_name, self.cell.sensor)
        try:
            times.begin()
            move = SlowLift(self.live.machine, self._pullback_mm, self._pullback_speed)
            await asyncio.sleep(SETTLE_S)
            self._lifted_mm = await move.run()
            await self.cell.mean_counts(SETTLE_S)
            await times.count()
            all_readings = list(self.cell.sensor.readings)
            readings = [
                (float(at_s), reading)
                for at_s, reading in zip(times.middles(all_readings), all_readings, strict=True)
                if move.begin_s - SETTLE_S <= at_s <= move.end_s + SETTLE_S
            ]
            checked([reading for _, reading in readings])
        except SensorError as error:
            raise NotReadyError(f"[{self.name}]: {error}") from error
        finally:
            times.end()
        forces = [self.cell.force_g(reading.counts) for _, reading in readings]
        at = [at_s for at_s, _ in readings]
        try:
            self._tap = find_tap(at, [move.way_at(at_s) for at_s in at], forces, self._hums_hz)
        except TapError as error:
            raise NotReadyError(
                f"[{self.name}]: {error}; the nozzle was lifted by {self._pullback_mm:g} mm, check"
                " pullback_distance, pullback_speed and speed"
            ) from error
        self._failed = False
        return self._lifted_mm - self._tap.way_mm + self.offset[2]

    async def _measured(self, contact: Contact) -> Contact:
        """Return CONTACT with the height at which the nozzle left the bed, and where it stands now."""
        height_mm = await self.standing_mm()
        if height_mm is None:
            return contact
        x, y, z, e = contact.position
        now = z + self._lifted_mm
        return replace(contact, position=(x, y, now, e), trigger_z=now - height_mm + self.offset[2])

    # --------------------------------------------------------------------------------------------- test

    def _read_test(self, call: Call) -> Reading:
        given = call.parameters("TAPS", "TIMEOUT")
        taps = round(bounded(call.command, given, "TAPS", 3, low=1, high=10))
        timeout_s = bounded(call.command, given, "TIMEOUT", 30, low=1, high=300)

        async def wait() -> Done:
            await self._take_tare()
            self.live.say(f"tap the nozzle {taps} times, within {timeout_s:g} s each")
            for number in range(taps):
                try:
                    async with asyncio.timeout(timeout_s):
                        await self._wait_for_force(above=True)
                        await self._wait_for_force(above=False)
                except TimeoutError:
                    raise CanductorError(
                        f"[{self.name}]: tap {number + 1} of {taps} was not felt within {timeout_s:g} s;"
                        " check the wiring, counts_per_gram and trigger_force"
                    ) from None
                self.live.say(f"tap {number + 1} of {taps}")
            return Done(("all taps were felt: the nozzle is ready to probe",))

        return AtStandstill(wait)

    async def _wait_for_force(self, *, above: bool) -> None:
        """Wait until the force is above, or below, trigger_force; raises CanductorError."""
        assert self._tare is not None
        per_gram, _ = self.cell.scale()
        while True:
            with explained(self.cell):
                (reading,) = await self.cell.sensor.next_readings(self.cell.node, 1)
            if (abs(reading.counts - self._tare) >= self._trigger_g * per_gram) == above:
                return


class LoadCellProbeStatus(Module):
    """Shows the status that only this kind of probe has, beside that of every probe."""

    SPEC = SectionSpec("Status of the load cell of the probe", ())

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.name = LOAD_CELL
        self.probe: LoadCellProbe | None = None

    def status(self) -> Mapping[str, Value]:
        """Report the force, and the last tap."""
        return {} if self.probe is None else self.probe.force_status()


def _hums(build: Build, rate: int) -> tuple[float, ...]:
    """Return the frequencies that are taken out of readings, RATE per second; raises ConfigError."""
    found = []
    for word in build.get_or(NOTCHES, ()):
        try:
            found.append(parse_decimal(word))
        except BadValue:
            raise build.reader.bad(NOTCHES, "of which each must be a number of Hz") from None
        _check(build, NOTCHES, found[-1], rate)
    if len(found) > NOTCHES_MAX:
        raise build.reader.bad(NOTCHES, f"which are more than {NOTCHES_MAX}")
    return tuple(found)


def _sections(build: Build, rate: int, hums_hz: Sequence[float]) -> list[Section]:
    """Return the filter of readings, RATE per second; raises ConfigError."""
    found = []
    for option, order, make in ((DRIFT_HZ, DRIFT_ORDER, high_pass), (BUZZ_HZ, BUZZ_ORDER, low_pass)):
        cutoff_hz, given = build.find(option), build.get(order)
        if cutoff_hz is not None:
            _check(build, option, cutoff_hz, rate)
            found.append(make(cutoff_hz, rate, given))
    quality = build.get(NOTCH_QUALITY)
    return found + [notch(hum_hz, rate, quality) for hum_hz in hums_hz]


def _check(build: Build, option: Option[Any], frequency_hz: float, rate: int) -> None:
    if not 0 < frequency_hz < rate / 2:
        raise build.reader.bad(
            option, f"but with sample_rate {rate} a filter can only be for frequencies below {rate / 2:g} Hz"
        )
