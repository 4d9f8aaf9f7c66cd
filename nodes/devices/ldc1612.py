"""The inductance-to-digital converter LDC1612 on an I2C bus of a node, with a coil at its channel 0.

Its node reads it and sends the readings in bulk. While an axis homes with it, the node triggers a stop group
at the first reading above a threshold. Registers and their bits are those of the chip's data sheet.
"""

import asyncio
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

from nodes.devices import bulk_sensor
from nodes.devices.bulk_sensor import BulkSensor, SensorError
from nodes.devices.endstop import EndstopState
from nodes.devices.trsync import TriggerReason
from nodes.node.config import NodeConfig, NodeConfigError
from nodes.node.node import Node

COMMANDS: Final = (
    *("config_i2c", "i2c_set_bus", "i2c_transfer", "config_ldc1612", "query_ldc1612", "query_status_ldc1612"),
    *("ldc1612_setup_home", "query_ldc1612_home_state"),
)
RESPONSES: Final = (
    *bulk_sensor.RESPONSES,
    "i2c_response oid=%c i2c_bus_status=%c response=%*s",
    "ldc1612_home_state oid=%c homing=%c trigger_clock=%u",
)
RATE_HZ: Final = 250.0
"""Readings per second."""
LOOK_S: Final = 0.5 / RATE_HZ
"""Between two looks of the node at the chip."""
TRIES: Final = 3
"""Of a transfer whose answer was of another one."""
AUTO_S: Final = 0.1
"""The chip's own search for its drive current, several conversions."""
SCALE: Final = 1 << 28
LOST: Final = 0xFFFFFFF0
"""A reading that the node could not have, plus one of ERRORS."""
ERRORS: Final = (
    "the sensor flags its readings as bad: check its coil, and calibrate with LDC_CALIBRATE_DRIVE_CURRENT",
    "the sensor does not answer on its I2C bus: check its wiring",
    "the sensor does not answer on its I2C bus: check its wiring",
    "the sensor makes no readings: check its supply and its reference clock",
)
"""By the number that the node adds to the reason of a trigger."""

_MANUFACTURER, _DEVICE = (0x7E, 0x5449), (0x7F, 0x3055)
_RCOUNT, _SETTLE, _DIVIDERS, _ERROR_CONFIG, _CONFIG = 0x08, 0x10, 0x14, 0x19, 0x1A
_MUX, _RESET, _DRIVE = 0x1B, 0x1C, 0x1E
_SLEEP, _OVERRIDE, _AUTO_OFF, _EXTERNAL, _ONE = 1 << 13, 1 << 12, 1 << 10, 1 << 9, 1 << 0
_FLAGS_OUT: Final = 0xF801
"""Errors flag the readings, a reading lowers INTB."""
_MUX_VALUE: Final = 0x020F
"""One channel, the deglitch filter at 33 MHz."""
_SETTLE_COUNT: Final = 0x0400


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading."""

    number: int
    """From 0 on since the readings began."""
    frequency_hz: float
    """Of the coil; 0 where there is an error."""
    error: str = ""
    """What is wrong with it."""


class Ldc1612(BulkSensor[Reading]):
    """The chip of NAME at ADDRESS of I2C BUS (empty: the node's first one), at RATE bit/s.

    CLOCK_HZ: of its reference; an internal one is not exact enough. MAX_SENSOR_HZ: what the coil may reach,
    which decides how its frequency is divided. INTB_PIN: wired to INTB; empty: it is not.
    """

    QUERY = "query_ldc1612"
    STATUS = "query_status_ldc1612"
    SILENT = ERRORS[3]
    errors: ClassVar[Sequence[str]] = ERRORS
    """Why it ends homing, by the number that its node tells."""

    def __init__(
        self,
        name: str,
        *,
        bus: str,
        address: int,
        rate: int,
        clock_hz: float,
        max_sensor_hz: float,
        intb_pin: str = "",
    ) -> None:
        super().__init__(f"the LDC1612 of {name}", rate_hz=RATE_HZ)
        self.drive: int | None = None
        """Its drive current, 0 to 31; None: it is not known yet."""
        self.threshold_hz = math.inf
        """Above it homing is triggered."""
        self._bus, self._address, self._rate = bus, address, rate
        self._clock_hz, self._intb_pin = clock_hz, intb_pin
        self._divider = max(1, math.ceil(4 * max_sensor_hz / clock_hz))
        self._i2c_oid = 0
        self._homing_rest_ticks = 0

    @property
    def hz_per_count(self) -> float:
        """Return what a step of a reading is, Hz of the coil."""
        return self._clock_hz * self._divider / SCALE

    @property
    def period_s(self) -> float:
        """Return the time of a conversion, by the nominal clock."""
        return (self._rcount * 16 + 4) / self._clock_hz

    @property
    def _rcount(self) -> int:
        return min(0xFFFF, round(self._clock_hz / RATE_HZ / 16))

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware, bus or pin do not allow it."""
        what = self.description
        config.require(what, COMMANDS, RESPONSES)
        known = config.dictionary.enumerations.get("i2c_bus")
        names = list(known.values) if known is not None else []
        if not names or (self._bus and self._bus not in names):
            has = f"has {', '.join(names)}" if names else "has none"
            raise NodeConfigError(
                f"{what}: node {config.name} has no I2C bus {self._bus!r}; it {has}: correct i2c_bus"
            )
        self._rest_ticks = round(LOOK_S * config.dictionary.clock_freq_hz)
        self._i2c_oid, self.oid = config.create_oid(), config.create_oid()
        config.add_config(what, f"config_i2c oid={self._i2c_oid}")
        bus = self._bus or names[0]
        config.add_config(
            what, f"i2c_set_bus oid={self._i2c_oid} i2c_bus={bus} rate={self._rate} address={self._address}"
        )
        wired = f"_with_intb oid={self.oid} i2c_oid={self._i2c_oid} intb_pin={self._intb_pin}"
        plain = f" oid={self.oid} i2c_oid={self._i2c_oid}"
        config.add_config(what, "config_ldc1612" + (wired if self._intb_pin else plain))

    # ----------------------------------------------------------------------------------------- registers

    async def read(self, node: Node, register: int) -> int:
        """Return the value of a register; raises SensorError."""
        answer = await self._transfer(node, bytes((register,)), 2)
        return int.from_bytes(answer, "big")

    async def write(self, node: Node, register: int, value: int) -> None:
        """Set a register; raises SensorError."""
        await self._transfer(node, bytes((register, value >> 8, value & 0xFF)), 0)

    async def _transfer(self, node: Node, content: bytes, size: int) -> bytes:
        for _ in range(TRIES):
            answer = await node.query(
                "i2c_transfer", "i2c_response", oid=self._i2c_oid, write=content, read_len=size
            )
            if answer.integer("i2c_bus_status"):
                raise SensorError(ERRORS[1])
            # Another size is of an earlier transfer, whose answer was slow and was asked for again.
            if len(found := answer.data("response")) == size:
                return found
        raise SensorError(ERRORS[1])

    async def check(self, node: Node) -> None:
        """Raise SensorError where there is no LDC1612."""
        for register, wanted in (_MANUFACTURER, _DEVICE):
            found = [await self.read(node, register) for _ in range(TRIES)]
            if wanted not in found:
                raise SensorError("what answers at i2c_address is no LDC1612: check i2c_address")

    async def set_up(self, node: Node, *, drive: int | None) -> None:
        """Wake it, with DRIVE or a search for it; raises SensorError."""
        for register, value in (
            (_RESET, 1 << 15),
            (_RCOUNT, self._rcount),
            (_SETTLE, _SETTLE_COUNT),
            (_DIVIDERS, self._divider << 12 | 1),
            (_ERROR_CONFIG, _FLAGS_OUT),
            (_MUX, _MUX_VALUE),
            (_DRIVE, (drive or 0) << 11),
            (_CONFIG, _EXTERNAL | _ONE | (0 if drive is None else _OVERRIDE | _AUTO_OFF)),
        ):
            await self.write(node, register, value)

    async def find_drive(self, node: Node) -> int:
        """Have the chip find its drive current, and return it; raises SensorError."""
        await self.set_up(node, drive=None)
        await asyncio.sleep(AUTO_S)
        found = await self.read(node, _DRIVE) >> 6 & 0x1F
        await self.write(node, _CONFIG, _SLEEP | _ONE)
        return found

    # ------------------------------------------------------------------------------------------ readings

    async def wake(self, node: Node) -> None:
        """Set it up; raises SensorError."""
        if self.drive is None:
            raise SensorError(
                "its drive current is not known: hold the head 20 mm above the bed and send"
                " LDC_CALIBRATE_DRIVE_CURRENT"
            )
        await self.set_up(node, drive=self.drive)

    def reading(self, number: int, content: bytes) -> Reading:
        """Return the reading of that NUMBER."""
        value = int.from_bytes(content, "big")
        if value >= LOST:
            return Reading(number, 0.0, ERRORS[min(value - LOST, len(ERRORS) - 1)])
        if value >> 28:
            return Reading(number, 0.0, ERRORS[0])
        return Reading(number, value * self.hz_per_count)

    # -------------------------------------------------------------------------------------------- homing

    def begin_homing(self, node: Node, *, clock: int, rest_ticks: int, trsync_oid: int) -> None:
        """Trigger the stop group at the first reading above the threshold, from CLOCK on."""
        self._homing_rest_ticks = rest_ticks
        node.send(
            "ldc1612_setup_home",
            oid=self._oid,
            clock=clock % 2**32,
            threshold=round(self.threshold_hz / self.hz_per_count),
            trsync_oid=trsync_oid,
            trigger_reason=int(TriggerReason.ENDSTOP),
            error_reason=int(TriggerReason.SENSOR_ERROR_0),
        )

    def end_homing(self, node: Node) -> None:
        """Stop comparing its readings."""
        node.send(
            "ldc1612_setup_home",
            oid=self._oid,
            **dict.fromkeys(("clock", "threshold", "trsync_oid", "trigger_reason", "error_reason"), 0),
        )

    async def state(self, node: Node) -> EndstopState:
        """Measure whether it is triggered now; raises SensorError."""
        answer = await node.query("query_ldc1612_home_state", "ldc1612_home_state", oid=self._oid)
        async with self.sampling(node):
            (reading,) = await self.next_readings(node, 1)
        next_clock = (answer.integer("trigger_clock") + self._homing_rest_ticks) % 2**32
        return EndstopState(
            bool(answer.integer("homing")), next_clock, reading.frequency_hz > self.threshold_hz
        )
