"""The inductance-to-digital converter LDC1612 on an I2C bus of a node, with a coil at its channel 0.

Its node reads it and sends the readings in bulk. While an axis homes with it, the node triggers a stop group
at the first reading above a threshold. Registers and their bits are those of the chip's data sheet.
"""

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Final

from nodes.devices.device import Device
from nodes.devices.endstop import EndstopState
from nodes.devices.trsync import TriggerReason
from nodes.dictionary.message_format import Message
from nodes.node.config import NodeConfig, NodeConfigError
from nodes.node.node import Node
from nodes.support.errors import CanductorError

COMMANDS: Final = (
    *("config_i2c", "i2c_set_bus", "i2c_transfer", "config_ldc1612", "query_ldc1612", "query_status_ldc1612"),
    *("ldc1612_setup_home", "query_ldc1612_home_state"),
)
RATE_HZ: Final = 250.0
"""Readings per second."""
LOOK_S: Final = 0.5 / RATE_HZ
"""Between two looks of the node at the chip."""
READINGS: Final = 12
"""In a full message."""
STATUS_S: Final = 0.1
"""Between two questions for the number of readings, which give their times."""
PATIENCE_S: Final = 1.0
"""For readings that are waited for."""
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


class SensorError(CanductorError):
    """The sensor does not measure; the sentence says why, without a full stop."""


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading."""

    number: int
    """From 0 on since the readings began."""
    frequency_hz: float
    """Of the coil; 0 where there is an error."""
    error: str = ""
    """What is wrong with it."""


class Ldc1612(Device):
    """The chip of NAME at ADDRESS of I2C BUS (empty: the node's first one), at RATE bit/s.

    CLOCK_HZ: of its reference; an internal one is not exact enough. MAX_SENSOR_HZ: what the coil may reach,
    which decides how its frequency is divided. INTB_PIN: wired to INTB; empty: it is not.
    """

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
        super().__init__(f"the LDC1612 of {name}")
        self.drive: int | None = None
        """Its drive current, 0 to 31; None: it is not known yet."""
        self.threshold_hz = math.inf
        """Above it homing is triggered."""
        self.readings: list[Reading] = []
        """Since they began."""
        self.counts: list[tuple[int, int]] = []
        """Clocks (32 bits) of the node, and how many readings there were."""
        self._bus, self._address, self._rate = bus, address, rate
        self._clock_hz, self._intb_pin = clock_hz, intb_pin
        self._divider = max(1, math.ceil(4 * max_sensor_hz / clock_hz))
        self._i2c_oid = 0
        self._users = 0
        self._listening = False
        self._sequence = 0
        self._came = asyncio.Event()
        self._rest_ticks = 1
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
        config.require(what, COMMANDS)
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

    def started(self, node: Node) -> None:
        """Listen to NODE, which has become ready."""
        self._on_report(node, "sensor_bulk_data", self._take)

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

    @asynccontextmanager
    async def sampling(self, node: Node) -> AsyncIterator[None]:
        """Have readings come meanwhile; raises SensorError."""
        await self.begin(node)
        try:
            yield
        finally:
            self.end(node)

    @property
    def is_sampling(self) -> bool:
        """Whether readings come."""
        return self._users > 0

    async def begin(self, node: Node) -> None:
        """Have readings come until ``end``, which is called as often as this; raises SensorError."""
        self._users += 1
        try:
            if self._users == 1:
                await self._start(node)
        except BaseException:
            self.end(node)
            raise

    def end(self, node: Node) -> None:
        """Have no more readings come, unless somebody else needs them."""
        self._users -= 1
        if not self._users and node.talks:
            node.send("query_ldc1612", oid=self._oid, rest_ticks=0)

    async def _start(self, node: Node) -> None:
        if self.drive is None:
            raise SensorError(
                "its drive current is not known: hold the head 20 mm above the bed and send"
                " LDC_CALIBRATE_DRIVE_CURRENT"
            )
        await self.set_up(node, drive=self.drive)
        self._listening = False
        node.send("query_ldc1612", oid=self._oid, rest_ticks=self._rest_ticks)
        # What comes from now on is no message that was on its way before.
        self._sequence, self.readings, self.counts = 0, [], []
        await self.count(node)
        self._listening = True

    def _take(self, message: Message) -> None:
        """Take a message of readings; others may have been lost before it."""
        if not self._listening:
            return  # of an earlier round
        data = message.data("data")
        self._sequence = self._whole(message.integer("sequence"))
        for at in range(0, len(data) - 3, 4):
            number = self._sequence * READINGS + at // 4
            self.readings.append(self._reading(number, int.from_bytes(data[at : at + 4], "big")))
        self._came.set()

    def _whole(self, sequence: int) -> int:
        """Return which number SEQUENCE (16 bits) stands for: the nearest one to the last."""
        return self._sequence + (sequence - self._sequence + (1 << 15)) % (1 << 16) - (1 << 15)

    def _reading(self, number: int, value: int) -> Reading:
        if value >= LOST:
            return Reading(number, 0.0, ERRORS[min(value - LOST, len(ERRORS) - 1)])
        if value >> 28:
            return Reading(number, 0.0, ERRORS[0])
        return Reading(number, value * self.hz_per_count)

    async def count(self, node: Node) -> int:
        """Return how many readings there were by now; raises SensorError when some were lost."""
        answer = await node.query("query_status_ldc1612", "sensor_bulk_status", oid=self._oid)
        if answer.integer("possible_overflows"):
            raise SensorError(
                "readings were lost, as the node could not send them: check the bus for errors and load"
            )
        count = self._whole(answer.integer("next_sequence")) * READINGS + answer.integer("buffered") // 4
        self.counts.append((answer.integer("clock"), count))
        return count

    async def next_readings(self, node: Node, size: int) -> list[Reading]:
        """Return SIZE readings that begin from now on; raises SensorError for a bad one or none.

        Messages may get lost on the way, so they need not follow each other.
        """
        first = await self.count(node) + 1  # the one that is being made may have begun before
        try:
            async with asyncio.timeout(PATIENCE_S + size / RATE_HZ):
                while len(found := [one for one in self.readings if one.number >= first]) < size:
                    self._came.clear()
                    await self._came.wait()
        except TimeoutError:
            node_failure = node.failure
            if node_failure is not None:
                raise node_failure.with_traceback(None) from None
            raise SensorError(ERRORS[3]) from None
        return checked(found[:size])

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
            error_reason=int(TriggerReason.SENSOR_BAD),
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


def checked(readings: list[Reading]) -> list[Reading]:
    """Return READINGS; raises SensorError where one is bad."""
    bad = next((reading.error for reading in readings if reading.error), "")
    if bad:
        raise SensorError(bad)
    return readings
