"""[probe_eddy_current]: a coil whose frequency says how high it is above the metal of the bed.

A way down ends at the first reading above the threshold, which belongs to ``descend_z``; the height is then
measured at standstill. A scan measures at its travel height without any way down.
"""

import asyncio
import contextlib
import statistics
from collections.abc import AsyncIterator, Callable, Generator, Iterator, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Any, ClassVar, Final, Protocol

from coordinator.config.errors import ConfigError
from coordinator.config.options import ChoiceOption, FloatOption, IntOption, Option, SectionSpec, TextOption
from coordinator.config.pins import PinOption
from coordinator.config.sections.bounds import MAX_POSITION
from coordinator.config.sections.probe import DESCEND_Z, I2C_MCU, Z_OFFSET
from coordinator.gcode.builtins.state import go
from coordinator.gcode.commands import (
    AtStandstill,
    Call,
    ProgramAction,
    ProgramContext,
    Reading,
    Synchronized,
)
from coordinator.gcode.events import Done
from coordinator.gcode.parser import Command, WordError, quoted
from coordinator.kinematics.base import Point
from coordinator.modules.base import Build
from coordinator.modules.eddy_current.eddy_table import HEIGHTS, EddyTable, TableOption, table_of
from coordinator.modules.probes.manual_probe import ManualProbe
from coordinator.modules.probes.probe import (
    MEASURING_OPTIONS,
    Measured,
    Measuring,
    NotReadyError,
    Probe,
    lift,
)
from coordinator.modules.probes.probe_commands import ProbeCommands
from coordinator.modules.probes.reading_times import ReadingTimes
from coordinator.runtime.module_context import ModuleContext
from coordinator.runtime.moves.probing import place_by_steps
from coordinator.support.lazy_numpy import Numbers, np
from nodes.devices.bulk_sensor import SensorError, checked
from nodes.devices.endstop import EndstopState, SensorEndstop
from nodes.devices.ldc1612 import Ldc1612
from nodes.node.node import Node
from nodes.support.errors import CanductorError

READINGS: Final = 24
"""Of a height that is measured at standstill: two messages of the node."""
SETTLE_S: Final = 0.05
"""After a move, before that."""
CALIBRATE_LIFT_MM: Final = 5.0
TRAVEL_SPEED: Final = 50.0
"""mm/s, of a calibration's way from the nozzle to the coil."""
NEAR: Final = 2
"""Readings before and after a place that a scan in flight passes: with them its height is found."""
GAP_S: Final = 0.03
"""From a place to the nearest reading: one message may be lost."""
RANGE_HZ: Final = (100_000.0, 40_000_000.0)

SENSOR_TYPE: Final = ChoiceOption(name="sensor_type", help="the chip", choices=("ldc1612",))
FREQUENCY: Final = FloatOption(
    name="frequency",
    help="of the chip's reference clock",
    default=12_000_000.0,
    unit="Hz",
    minimum=1_000_000,
    maximum=RANGE_HZ[1],
)
MAX_SENSOR: Final = FloatOption(
    name="max_sensor_hz",
    help="what the coil's frequency may reach; the chip divides one above a quarter of its reference clock",
    default=5_000_000.0,
    unit="Hz",
    minimum=RANGE_HZ[0],
    maximum=RANGE_HZ[1],
)
INTB: Final = PinOption(
    name="intb_pin", help="input for the chip's INTB, of the same node; saves a transfer for each look"
)
ADDRESS: Final = IntOption(name="i2c_address", help="of the chip", default=42, minimum=1, maximum=127)
BUS: Final = TextOption(name="i2c_bus", help="bus of the node, by name; by default its first one", default="")
SPEED: Final = IntOption(
    name="i2c_speed", help="of the bus", default=400_000, unit="bit/s", minimum=10_000, maximum=1_000_000
)
DRIVE: Final = IntOption(
    name="reg_drive_current",
    help="drive current of the coil; LDC_CALIBRATE_DRIVE_CURRENT finds it",
    minimum=0,
    maximum=31,
)
CALIBRATE: Final = TableOption(
    name="calibrate", help="frequencies by height; PROBE_EDDY_CURRENT_CALIBRATE finds them"
)
OTHER_NAME: Final = FloatOption(
    name="z_offset",
    help="another name of descend_z",
    unit="mm",
    minimum=-MAX_POSITION,
    maximum=MAX_POSITION,
)
OPTIONS: Final[tuple[Option[Any], ...]] = (
    *(SENSOR_TYPE, FREQUENCY, MAX_SENSOR, INTB, I2C_MCU, BUS, ADDRESS, SPEED, DRIVE, CALIBRATE),
    *(DESCEND_Z, OTHER_NAME),
    *(option for option in MEASURING_OPTIONS if option is not Z_OFFSET),
)


class Compensation(Protocol):
    """Corrects frequencies of a coil for its temperature."""

    def to_calibrated(self, frequency_hz: float) -> float:
        """Return what a frequency of now would have been when the table was calibrated, Hz."""
        ...

    def from_calibrated(self, frequency_hz: float) -> float:
        """Return what a frequency of the table would be now, Hz."""
        ...

    def table_calibrated(self) -> None:
        """Note that the table has been calibrated just now."""


class EddyProbe(Probe):
    """The probe of [probe_eddy_current NAME]; for homing moves also the sensor in the place of an endstop."""

    NAMED = True
    TITLE = "[probe_eddy_current NAME]"
    SPEC = SectionSpec(
        "A coil above the metal of the bed, read by an LDC1612: measures heights, also in flight",
        OPTIONS,
        unsupported=("i2c_software_scl_pin", "i2c_software_sda_pin", "tap_threshold", "tap_z_offset"),
    )
    INPUT: ClassVar[PinOption | None] = None
    HAS_LINES = False

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        build.shared(ProbeCommands)
        self._manual = build.shared(ManualProbe)
        self._machine = build.machine
        self.instance = build.instance
        """Its name, which CHIP= of commands takes."""
        self.node_name = build.get(I2C_MCU)
        if self.node_name not in (node.name for node in build.machine.nodes):
            raise build.reader.bad(I2C_MCU, f"but there is no node of that name; add [mcu {self.node_name}]")
        build.get(SENSOR_TYPE)
        intb = build.find_pin(INTB)
        if intb is not None and intb.node != self.node_name:
            raise build.reader.bad(INTB, f"but it has to be one of node {self.node_name}, as the bus is")
        self.sensor = Ldc1612(
            f"[{build.name}]",
            bus=build.get(BUS),
            address=build.get(ADDRESS),
            rate=build.get(SPEED),
            clock_hz=build.get(FREQUENCY),
            max_sensor_hz=build.get(MAX_SENSOR),
            intb_pin="" if intb is None else intb.name,
        )
        self.sensor.drive = build.find(DRIVE)
        self._flight: _Flight | None = None
        self.table: EddyTable | None = build.find(CALIBRATE)
        self.compensation: Compensation | None = None
        """What corrects frequencies for the temperature of the coil; None: nothing does."""
        build.add_device(self.node_name, self.sensor, intb)
        for name, text, read in (
            (
                "LDC_CALIBRATE_DRIVE_CURRENT",
                "Find the drive current of the coil of CHIP=, some 20 mm above the bed",
                self._read_drive,
            ),
            (
                "PROBE_EDDY_CURRENT_CALIBRATE",
                "Find the frequencies of the coil of CHIP= by height; begins with a search by hand",
                self._read_calibrate,
            ),
        ):
            build.add_command(name, text, read)

    def trigger_height(self, build: Build) -> float:
        """Return descend_z, mm; raises ConfigError."""
        other = build.find(OTHER_NAME)
        if other is None:
            return build.get(DESCEND_Z)
        if build.reader.has(DESCEND_Z):
            raise ConfigError(build.place, "descend_z and z_offset mean the same; remove z_offset")
        if other <= 0:
            raise build.reader.bad(OTHER_NAME, "but the nozzle must not touch the bed; it must be above 0")
        return other

    async def connect(self, live: ModuleContext) -> None:
        """Check the chip, and become the endstop; raises CanductorError."""
        await super().connect(live)
        described = live.machine.description.probe
        if described is not None:
            endstop = live.machine.devices.endstops[described.rail.axis]
            assert isinstance(endstop, SensorEndstop)
            endstop.sensor = self
        with self.explained():
            await self.sensor.check(live.node(self.node_name))

    def end(self, cause: str) -> None:
        """End the readings of a scan that was cut short."""
        del cause
        if self._flight is not None:
            self._flight.end()

    @contextlib.contextmanager
    def explained(self) -> Iterator[None]:
        """Have errors of the sensor begin with the section's name."""
        try:
            yield
        except NotReadyError:
            raise
        except CanductorError as error:
            if self._live is not None and self._live.machine.stopped is not None:
                raise
            raise NotReadyError(f"[{self.name}]: {error}") from error

    @property
    def node(self) -> Node:
        """The node of the chip; raises CanductorError before ``connect``."""
        return self.live.node(self.node_name)

    def calibrated(self) -> EddyTable:
        """Return the calibration; raises NotReadyError when there is none."""
        if self.table is None:
            raise NotReadyError(
                f"[{self.name}] is not calibrated: calibrate with PROBE_EDDY_CURRENT_CALIBRATE"
                f" CHIP={self.instance}"
            )
        return self.table

    def check_offset(self, command: Command) -> None:
        """Raise WordError: a wrong height is one of the calibration."""
        raise WordError(
            f"{command.name} is for probes with a z_offset; the heights of [{self.name}] come from"
            " PROBE_EDDY_CURRENT_CALIBRATE: calibrate again"
        )

    # ------------------------------------------------------------------------------------- as an endstop

    @property
    def errors(self) -> Sequence[str]:
        """Why its node ends a way down."""
        return self.sensor.errors

    def begin_homing(self, node: Node, *, clock: int, rest_ticks: int, trsync_oid: int) -> None:
        """Trigger the stop group when the coil is at descend_z."""
        self.sensor.begin_homing(node, clock=clock, rest_ticks=rest_ticks, trsync_oid=trsync_oid)

    def end_homing(self, node: Node) -> None:
        """Stop comparing readings."""
        self.sensor.end_homing(node)

    async def state(self, node: Node) -> EndstopState:
        """Measure whether it is triggered; raises CanductorError."""
        with self.explained():
            threshold_hz = self.calibrated().frequency(self.offset[2])
            if self.compensation is not None:
                threshold_hz = self.compensation.from_calibrated(threshold_hz)
            self.sensor.threshold_hz = threshold_hz
            return await self.sensor.state(node)

    def touching(self, *, alone: bool) -> AbstractAsyncContextManager[None]:
        """Return what has the coil read while the head is lowered."""
        del alone
        return self.sampling()

    @asynccontextmanager
    async def sampling(self) -> AsyncIterator[None]:
        """Have the coil read meanwhile; raises NotReadyError where that cannot begin."""
        self.calibrated()
        async with contextlib.AsyncExitStack() as stack:
            with self.explained():
                await stack.enter_async_context(self.sensor.sampling(self.node))
            yield

    async def standing_mm(self) -> float:
        """Measure how high the nozzle is above the bed below the coil; raises NotReadyError."""
        frequency = await self.frequency()
        with self.explained():
            return self.height(frequency)

    def height(self, frequency_hz: float) -> float:
        """Return the height of the nozzle at a measured frequency, mm; raises CanductorError."""
        table = self.calibrated()
        if self.compensation is not None:
            frequency_hz = self.compensation.to_calibrated(frequency_hz)
        return table.height(frequency_hz)

    async def frequency(self) -> float:
        """Measure the frequency of the coil where the head stands, Hz; raises NotReadyError."""
        with self.explained():
            async with self.sensor.sampling(self.node):
                await asyncio.sleep(SETTLE_S)
                readings = await self.sensor.next_readings(self.node, READINGS)
        return statistics.fmean(reading.frequency_hz for reading in readings)

    # --------------------------------------------------------------------------------------------- scans

    @property
    def scans(self) -> bool:
        """Whether it measures at travel height."""
        return True

    def scan(
        self,
        job: ProgramContext,
        command: Command,
        how: Measuring,
        travels: "Sequence[Callable[[], Iterator[Reading]]]",
    ) -> Generator[Reading, None, list[Measured] | None]:
        """Measure where each of TRAVELS leads, standing there or in flight; None: it is only planned."""
        if how.method == "rapid_scan":
            return (yield from self._scan_in_flight(job, command, travels))
        found: list[Measured] = []
        for travel in travels:
            yield from travel()
            place = job.call(command).position

            async def measure(place: tuple[float, ...] = place) -> Done:
                async with self._failing(command):
                    height = await self.standing_mm()
                found.append(await self._scanned(place[0], place[1], height))
                return Done((self._told(found[-1]),))

            before = len(found)
            yield AtStandstill(measure)
            if len(found) == before:
                return None
        return found

    def _scan_in_flight(
        self,
        job: ProgramContext,
        command: Command,
        travels: "Sequence[Callable[[], Iterator[Reading]]]",
    ) -> Generator[Reading, None, list[Measured] | None]:
        """Have the coil read all the time, and note when each place is passed."""
        places: list[tuple[float, float]] = []
        passed: list[float] = []
        found: list[Measured] = []
        flight = self._flight = _Flight(self)

        async def evaluate() -> Done:
            async with self._failing(command):
                heights = await flight.heights(passed)
            for (x, y), height in zip(places, heights, strict=True):
                found.append(await self._scanned(x, y, height))
            return Done(tuple(map(self._told, found)))

        # The first place is where the head stands when the readings begin.
        yield from travels[0]()
        yield AtStandstill(self._beginning(command, flight))
        if not flight.began:
            return None
        try:
            for number, travel in enumerate(travels):
                if number:
                    yield from travel()
                x, y, _, _ = job.call(command).position
                places.append((x, y))
                yield Synchronized(passed.append)
            yield AtStandstill(evaluate)
        finally:  # also where the program is cancelled
            self.live.soon_on_loop(flight.end)
        return found or None

    def _beginning(self, command: Command, flight: "_Flight") -> "Callable[[], Any]":
        async def begin() -> Done:
            async with self._failing(command):
                await flight.begin()
            return Done()

        return begin

    @asynccontextmanager
    async def _failing(self, command: Command) -> AsyncIterator[None]:
        """Have what goes wrong at standstill say in which command, and where the head is."""
        try:
            yield
        except CanductorError as error:
            if self.live.machine.stopped is not None:
                raise
            raise CanductorError(f"{command.name} failed: {error}; {await self._place()}") from error

    async def _scanned(self, x: float, y: float, height_mm: float) -> Measured:
        """Return what is found at HEIGHT_MM above the bed, with the nozzle at X, Y."""
        place = await place_by_steps(self.live.machine)
        assert place is not None
        dx, dy, dz = self.offset
        trigger = place[2] - height_mm + dz
        trigger += sum(correction(x + dx, y + dy) for correction in self.corrections)
        return Measured((x, y, trigger), (x + dx, y + dy, trigger - dz))

    @staticmethod
    def _told(found: Measured) -> str:
        x, y, _ = found.bed
        return f"probe at {x:.3f},{y:.3f} is z={found.nozzle[2]:.6f}"

    # --------------------------------------------------------------------------------------- calibrating

    def _check_chip(self, call: Call, *known: str) -> dict[str, str]:
        given = call.parameters("CHIP", *known)
        chip = given.get("CHIP", self.instance)
        if chip not in (self.instance, self.name):
            raise WordError(f"CHIP of {call.command.name} is {quoted(chip)}; the chip is {self.instance}")
        return given

    def _read_drive(self, call: Call) -> Reading:
        self._check_chip(call)

        async def find() -> Done:
            with self.explained():
                drive = await self.sensor.find_drive(self.node)
            self.sensor.drive = drive
            self.live.save(self.name, DRIVE.name, str(drive))
            return Done((f"{self.name}: reg_drive_current: {drive}; SAVE_CONFIG writes it",))

        return AtStandstill(find)

    def _read_calibrate(self, call: Call) -> Reading:
        self._check_chip(call)
        self._manual.check_free(call)
        accepted = lambda job, place: self._calibrate(job, call.command, place)  # noqa: E731
        return self._manual.follow(call, accepted)

    def _calibrate(self, job: ProgramContext, command: Command, touched: Point) -> Iterator[Reading]:
        points = yield from self.measure_above(job, command, touched, HEIGHTS)
        if points:
            yield AtStandstill(lambda: self._keep_table(points))

    def measure_above(
        self,
        job: ProgramContext,
        command: Command,
        touched: Point,
        heights: Sequence[float],
        on_measured: Callable[[], None] = lambda: None,
    ) -> Generator[Reading, None, list[tuple[float, float]]]:
        """Measure frequencies at HEIGHTS (mm, rising) above the place where the nozzle TOUCHED the bed.

        Returns true heights and frequencies, the highest first; none: it is only planned. ON_MEASURED is
        called for each, on the control loop.
        """
        zero: list[float] = []
        points: list[tuple[float, float]] = []

        async def note_zero() -> Done:
            place = await place_by_steps(self.live.machine)
            assert place is not None
            zero.append(place[2])
            return Done()

        yield AtStandstill(note_zero)
        if not zero:
            return points
        x, y, z = touched
        speed = self.measuring.lift_speed
        yield from lift(job, z + CALIBRATE_LIFT_MM, speed)
        there = [x - self.offset[0], y - self.offset[1], *job.planner.toolhead_position[2:]]
        yield ProgramAction(lambda job: go(job, there, TRAVEL_SPEED))

        async def measure() -> Done:
            async with self._failing(command):
                frequency = await self.frequency()
            place = await place_by_steps(self.live.machine)
            assert place is not None
            points.append((place[2] - zero[0], frequency))
            on_measured()
            return Done()

        for height in reversed(heights):
            yield from lift(job, z + height, speed)
            yield AtStandstill(measure)
        yield from lift(job, z + CALIBRATE_LIFT_MM, speed)
        return points

    async def _keep_table(self, points: Sequence[tuple[float, float]]) -> Done:
        try:
            table = table_of(points)
        except ValueError as error:
            raise CanductorError(
                f"PROBE_EDDY_CURRENT_CALIBRATE failed: {error}; check that the coil is above metal"
            ) from error
        self.table = table
        if self.compensation is not None:
            self.compensation.table_calibrated()
        self.live.save(self.name, CALIBRATE.name, table.text())
        (low, highest_hz), (high, lowest_hz) = table.points[0], table.points[-1]
        found = f"{lowest_hz:.0f} to {highest_hz:.0f} Hz from {high:.2f} down to {low:.2f} mm"
        return Done((f"{self.name}: {found}; SAVE_CONFIG writes it",))


class _Flight:
    """The readings of a scan in flight by PROBE."""

    def __init__(self, probe: EddyProbe) -> None:
        self._probe = probe
        self._times: ReadingTimes | None = None

    @property
    def began(self) -> bool:
        """Whether there are readings."""
        return self._times is not None

    async def begin(self) -> None:
        """Begin to read; raises CanductorError."""
        probe = self._probe
        probe.calibrated()
        times = ReadingTimes(probe.live, probe.node_name, probe.sensor)
        with probe.explained():
            await probe.sensor.begin(probe.node)
        self._times = times
        times.begin()

    async def heights(self, passed: Sequence[float]) -> list[float]:
        """End it; return the heights at the print times PASSED, mm; raises CanductorError."""
        probe, times = self._probe, self._times
        assert times is not None
        try:
            with probe.explained():
                await times.count()
                await probe.sensor.next_readings(probe.node, READINGS)
                await times.count()
                readings = checked(list(probe.sensor.readings))
                at_s = times.middles(readings)
                heights = [probe.height(reading.frequency_hz) for reading in readings]
                found = [height_at(time_s - at_s, heights) for time_s in passed]
        finally:
            self.end()
        return found

    def end(self) -> None:
        """End the readings, unless they have ended; on the control loop."""
        if self._times is not None and self._times.end():
            self._probe.sensor.end(self._probe.node)


def height_at(after_s: Numbers, heights: Sequence[float]) -> float:
    """Return the height at a time by a straight line through the HEIGHTS (mm) nearest to it.

    AFTER_S: how long it is after each of them, which are in order. Raises SensorError when none is near.
    """
    middle = int(np.argmin(np.abs(after_s)))
    near = slice(max(0, middle - NEAR), middle + NEAR + 1)
    if abs(after_s[middle]) > GAP_S:
        raise SensorError("readings were lost on the way to the host: check the bus for errors and load")
    return float(np.polyfit(-after_s[near], heights[near], 1)[1])
