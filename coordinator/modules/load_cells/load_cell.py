"""A load cell with an HX711 or HX717: what [load_cell NAME] and [load_cell_probe] have in common.

A force is (counts - tare) / counts_per_gram. The tare is where the scale is 0; reference_tare_counts is
that of the calibration, without any force.
"""

import asyncio
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, Final

from coordinator.config.errors import ConfigError, NotSupported
from coordinator.config.options import ChoiceOption, FloatOption, IntOption, Option
from coordinator.config.pins import PinOption
from coordinator.config.sections.probe import DOUT
from coordinator.modules.base import Build
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.values import Value
from nodes.devices.analog_trigger import Section
from nodes.devices.bulk_sensor import READINGS, SensorError
from nodes.devices.hx71x import CHIPS, FULL_SCALE, Chip, Hx71x
from nodes.node.node import Node

KEPT_S: Final = 12.0
"""So long readings are remembered: longer than LOAD_CELL_DIAGNOSTIC takes."""
SHOWN_S: Final = 1.0
"""Of the readings that the status shows."""
SILENT_S: Final = 1.0
"""A message that is so late is none: no force is shown then."""
LEAST_COUNTS: Final = 100
"""That a weight has to change readings by, for a calibration."""

ON_SPI: Final = ("ads1220", "ads131m02", "ads131m04")
SENSOR_TYPE: Final = ChoiceOption(
    name="sensor_type", help="the chip; those on SPI are not supported yet", choices=(*CHIPS, *ON_SPI)
)
SCLK: Final = PinOption(name="sclk_pin", help="output to the chip's clock input, of the node of dout_pin")
GAIN: Final = ChoiceOption(
    name="gain",
    help="channel and gain; the HX711 has A-128, A-64 and B-32, the HX717 A-128, A-64, B-64 and B-8",
    default="A-128",
    choices=("A-128", "A-64", "B-64", "B-32", "B-8"),
)
RATE: Final = IntOption(
    name="sample_rate",
    help="conversions per second, as the chip is wired: HX711 80 or 10, HX717 320, 80, 20 or 10; by default"
    " the first of these",
    unit="1/s",
    minimum=1,
)
COUNTS_PER_GRAM: Final = FloatOption(
    name="counts_per_gram", help="of the scale; LOAD_CELL_CALIBRATE finds it", above=0, maximum=FULL_SCALE
)
REFERENCE: Final = IntOption(
    name="reference_tare_counts",
    help="counts without any force; LOAD_CELL_CALIBRATE finds them",
    minimum=-FULL_SCALE,
    maximum=FULL_SCALE,
)
ORIENTATION: Final = ChoiceOption(
    name="sensor_orientation",
    help="whether a press of the nozzle against the bed raises readings (normal) or lowers them (inverted)",
    default="normal",
    choices=("normal", "inverted"),
)
CELL_OPTIONS: Final[tuple[Option[Any], ...]] = (
    *(SENSOR_TYPE, DOUT, SCLK, GAIN, RATE, COUNTS_PER_GRAM, REFERENCE, ORIENTATION),
)
UNSUPPORTED: Final = (
    *("cs_pin", "spi_speed", "spi_bus", "spi_software_sclk_pin", "spi_software_mosi_pin"),
    *("spi_software_miso_pin", "data_ready_pin", "pga_bypass", "input_mux", "vref", "adc_channel"),
    *("clock_freq", "pwm_clock", "enable_global_chop", "global_chop_delay", "channels"),
    "gloabl_chop_delay",  # written so in the reference page of Kalico
)
"""Options of chips on SPI."""


class LoadCell:
    """The scale of a section, which BUILD is of; with SECTIONS of a filter it may stand in for an endstop.

    KEPT_S: how long readings have to be remembered at least.
    """

    def __init__(
        self, build: Build, sections: Sequence[Section] | None = None, *, kept_s: float = 0.0
    ) -> None:
        self.name = build.name
        self.instance = build.instance
        """Its name, which LOAD_CELL= of commands takes."""
        chip = _chip(build)
        gain = build.get(GAIN)
        if gain not in chip.gains:
            raise build.reader.bad(GAIN, f"but this chip has {_any_of(tuple(chip.gains))}")
        dout, sclk = build.pin(DOUT), build.pin(SCLK)
        if dout.node != sclk.node:
            raise build.reader.bad(SCLK, f"but it has to be one of node {dout.node}, as dout_pin is")
        if dout.invert or sclk.invert:
            raise ConfigError(build.place, "dout_pin and sclk_pin cannot be inverted; remove the !")
        self.node_name = dout.node
        self.sensor = Hx71x(
            f"[{build.name}]",
            dout_pin=dout.name,
            sclk_pin=sclk.name,
            pulses=chip.gains[gain],
            rate=read_rate(build),
            sections=sections,
            kept_s=max(KEPT_S, kept_s),
        )
        build.add_device(dout.node, self.sensor, dout)
        self.counts_per_gram = build.find(COUNTS_PER_GRAM)
        self.reference = build.find(REFERENCE)
        self.sign = -1 if build.get(ORIENTATION) == "inverted" else 1
        self.tare_counts: float | None = self.reference
        self._live: ModuleContext | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    async def connect(self, live: ModuleContext) -> None:
        """Begin to measure; raises CanductorError."""
        self._live, self._loop = live, asyncio.get_running_loop()
        await self.sensor.begin(self.node)

    def end(self) -> None:
        """Measure no more."""
        if self._live is not None and self.sensor.is_sampling:
            self.sensor.end(self.node)

    @property
    def live(self) -> ModuleContext:
        """The running machine."""
        assert self._live is not None
        return self._live

    @property
    def node(self) -> Node:
        """The node of the chip."""
        return self.live.node(self.node_name)

    @property
    def is_calibrated(self) -> bool:
        """Whether forces are known."""
        return self.counts_per_gram is not None and self.reference is not None

    def scale(self) -> tuple[float, int]:
        """Return counts per gram, and the counts without any force; raises SensorError."""
        if self.counts_per_gram is None or self.reference is None:
            raise SensorError(
                f"it is not calibrated: calibrate with LOAD_CELL_CALIBRATE LOAD_CELL={self.instance}"
            )
        return self.counts_per_gram, self.reference

    def force_g(self, counts: float) -> float:
        """Return the force of a reading above the tare, g; raises SensorError."""
        per_gram, reference = self.scale()
        tare = reference if self.tare_counts is None else self.tare_counts
        return self.sign * (counts - tare) / per_gram

    async def mean_counts(self, seconds: float) -> float:
        """Return the mean of the readings of so many SECONDS from now on; raises SensorError."""
        size = max(4, round(seconds * self.sensor.rate_hz))
        readings = await self.sensor.next_readings(self.node, size)
        return statistics.fmean(reading.counts for reading in readings)

    def print_time_of_last_count(self) -> float:
        """Return when the node told last how many readings there were, s."""
        clock, _ = self.sensor.counts[-1]
        return self.live.print_time_of(self.node_name, clock)

    def calibrate(self, empty_counts: float, loaded_counts: float, grams: float) -> str:
        """Take a weight of so many GRAMS for the scale; return what was found. Raises SensorError."""
        change = loaded_counts - empty_counts
        if abs(change) < LEAST_COUNTS:
            raise SensorError(
                f"the weight changed readings by {abs(change):.0f} counts, and {LEAST_COUNTS} are needed:"
                " check the load cell's wiring, or take a heavier weight"
            )
        self.counts_per_gram, self.reference = abs(change) / grams, round(empty_counts)
        self.tare_counts = empty_counts
        self.live.save(self.name, COUNTS_PER_GRAM.name, f"{self.counts_per_gram:.5f}")
        self.live.save(self.name, REFERENCE.name, str(self.reference))
        room_g = (FULL_SCALE - abs(empty_counts)) / self.counts_per_gram
        return (
            f"{self.name}: counts_per_gram: {self.counts_per_gram:.5f}, reference_tare_counts:"
            f" {self.reference}; it can weigh {room_g:.0f} g; SAVE_CONFIG writes it"
        )

    @property
    def _is_heard(self) -> bool:
        """Whether readings came lately."""
        late_s = READINGS / self.sensor.rate_hz + SILENT_S
        return self._loop is not None and self._loop.time() - self.sensor.heard_s < late_s

    def status(self) -> Mapping[str, Value]:
        """Report the force of the last second, as the mean and its extremes."""
        size = round(SHOWN_S * self.sensor.rate_hz) if self._is_heard else 0
        recent = [one.counts for one in list(self.sensor.readings)[-size:] if size and not one.error]
        shown: dict[str, Value] = dict.fromkeys(("force_g", "min_force_g", "max_force_g"))
        if recent and self.is_calibrated:
            forces = [self.force_g(counts) for counts in recent]
            mean, low, high = statistics.fmean(forces), min(forces), max(forces)
            shown = {
                "force_g": round(mean, 1),
                "min_force_g": round(low, 1),
                "max_force_g": round(high, 1),
            }
        return {
            "is_calibrated": self.is_calibrated,
            "counts_per_gram": self.counts_per_gram,
            "reference_tare_counts": self.reference,
            "tare_counts": None if self.tare_counts is None else round(self.tare_counts),
            **shown,
            "errors": self.sensor.bad,
            "overflows": self.sensor.overflows,
            "sample_rate": self.sensor.rate_hz,
        }


def _chip(build: Build) -> Chip:
    """Return what the configured chip can do; raises ConfigError, for one on SPI NotSupported."""
    name = build.get(SENSOR_TYPE)
    if name in ON_SPI:
        raise NotSupported(
            build.reader.place_of(SENSOR_TYPE), f"its chip {name} is on SPI, which is not supported yet"
        )
    return CHIPS[name]


def read_rate(build: Build) -> int:
    """Return the conversions per second; raises ConfigError."""
    rates = _chip(build).rates
    rate = build.get_or(RATE, rates[0])
    if rate not in rates:
        raise build.reader.bad(RATE, f"but this chip can be wired for {_any_of(rates)}")
    return rate


def _any_of(choices: Sequence[object]) -> str:
    *others, last = map(str, choices)
    return f"{', '.join(others)} or {last}"
