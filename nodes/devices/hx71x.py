"""The converters HX711 and HX717 of load cells, on two pins of a node.

Rates, gains and how they are chosen are those of the chips' data sheets.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

from nodes.devices.analog_trigger import AnalogTrigger, Section
from nodes.devices.bulk_sensor import RESPONSES, BulkSensor
from nodes.devices.endstop import EndstopState
from nodes.node.config import NodeConfig
from nodes.node.node import Node

COMMANDS: Final = ("config_hx71x", "query_hx71x", "query_hx71x_status")
LOOKS: Final = 8
"""At the chip in the time of a conversion."""
FULL_SCALE: Final = 2**23 - 1
LOST: Final = -(2**31)
"""A reading that the node could not have, plus one of ERRORS."""
ERRORS: Final = (
    "the force left its safe range: check that nothing presses against the nozzle, and the wiring",
    "the force is beyond what the node can filter: check counts_per_gram",
    "the sensor makes no readings: check its supply and its wiring",
    "the sensor lost count of its clock: check the wires of dout_pin and sclk_pin",
)
"""Why it ends homing, by the number that its node tells."""


@dataclass(frozen=True, slots=True)
class Chip:
    """What a chip can do."""

    gains: Mapping[str, int]
    """Channel and gain, with the pulses that choose it after the bits of a reading."""
    rates: tuple[int, ...]
    """Conversions per second, by a pin of the chip; the first one is the usual."""


CHIPS: Final[Mapping[str, Chip]] = {
    "hx711": Chip({"A-128": 1, "B-32": 2, "A-64": 3}, (80, 10)),
    "hx717": Chip({"A-128": 1, "B-64": 2, "A-64": 3, "B-8": 4}, (320, 80, 20, 10)),
}


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading."""

    number: int
    """From 0 on since the readings began."""
    counts: int
    """-2^23 to 2^23 - 1; 0 where there is an error."""
    error: str = ""
    """What is wrong with it."""


class Hx71x(BulkSensor[Reading]):
    """The chip of NAME at two pins of a node, wired for RATE conversions per second.

    PULSES choose channel and gain. Readings are remembered for KEPT_S. SECTIONS: of the filter with which it
    stands in for an endstop; None: it does not.
    """

    QUERY = "query_hx71x"
    STATUS = "query_hx71x_status"
    SILENT = ERRORS[2]
    errors: ClassVar[Sequence[str]] = ERRORS

    def __init__(
        self,
        name: str,
        *,
        dout_pin: str,
        sclk_pin: str,
        pulses: int,
        rate: int,
        kept_s: float,
        sections: Sequence[Section] | None = None,
    ) -> None:
        super().__init__(f"the load cell of {name}", rate_hz=rate, kept=round(kept_s * rate))
        self.bad = 0
        """Readings with an error, since it was connected."""
        self.trigger = None if sections is None else AnalogTrigger(self.description, sections)
        self._dout_pin, self._sclk_pin, self._pulses = dout_pin, sclk_pin, pulses

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pins do not allow it."""
        what = self.description
        config.require(what, COMMANDS, RESPONSES)
        self._rest_ticks = round(config.dictionary.clock_freq_hz / self.rate_hz / LOOKS)
        self.oid = config.create_oid()
        pins = f"dout_pin={self._dout_pin} sclk_pin={self._sclk_pin}"
        config.add_config(what, f"config_hx71x oid={self.oid} gain_channel={self._pulses} {pins}")
        if self.trigger is not None:
            self.trigger.configure(config, "hx71x_attach_trigger_analog", self.oid)

    async def wake(self, node: Node) -> None:
        """Do nothing: it converts all the time."""

    def reading(self, number: int, content: bytes) -> Reading:
        """Return the reading of that NUMBER."""
        counts = int.from_bytes(content, "big", signed=True)
        if not -FULL_SCALE - 1 <= counts <= FULL_SCALE:
            self.bad += 1
            return Reading(number, 0, ERRORS[3])
        if abs(counts) >= FULL_SCALE:
            self.bad += 1
            return Reading(number, counts, "the sensor is at its limit: check its wiring and gain")
        return Reading(number, counts)

    def begin_homing(
        self,
        node: Node,
        *,
        clock: int,
        rest_ticks: int,
        trsync_oid: int,
        zero: int,
        grams_per_count: float,
        safe: tuple[int, int],
        grams: float,
    ) -> None:
        """Trigger the stop group at a filtered force of GRAMS either way, from CLOCK on.

        ZERO: the counts without a force. SAFE: the counts that readings may have.
        """
        assert self.trigger is not None
        self.trigger.begin_homing(
            node,
            clock=clock,
            rest_ticks=rest_ticks,
            trsync_oid=trsync_oid,
            zero=zero,
            per_count=grams_per_count,
            raw_range=safe,
            value=grams,
            period_s=1 / self.rate_hz,
        )

    def end_homing(self, node: Node) -> None:
        """Compare no more."""
        assert self.trigger is not None
        self.trigger.end_homing(node)

    async def state(self, node: Node, *, pressed: bool) -> EndstopState:
        """Return its state where it is PRESSED now, or not."""
        assert self.trigger is not None
        return await self.trigger.state(node, pressed=pressed)
