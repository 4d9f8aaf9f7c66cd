"""What has a node trigger a stop group by the readings of a sensor: a filter of them, and a comparison.

The node filters in whole numbers: a reading minus an offset, times a scale, through second-order sections.
"""

import math
from collections.abc import Sequence
from typing import Final

from nodes.devices.endstop import EndstopState
from nodes.devices.trsync import TriggerReason
from nodes.node.config import NodeConfig
from nodes.node.node import Node

COMMANDS: Final = (
    *("config_sos_filter", "sos_filter_set_offset_scale", "sos_filter_set_active", "sos_filter_set_section"),
    *("sos_filter_set_state", "config_trigger_analog", "trigger_analog_set_raw_range"),
    *("trigger_analog_set_trigger", "trigger_analog_home", "trigger_analog_query_state"),
)
RESPONSES: Final = ("trigger_analog_state oid=%c homing=%c homing_clock=%u",)
UNITS: Final = 1024
"""Of what is compared, in one of the quantity."""
COEFF_BITS: Final = 29
"""Coefficients are below 4."""
SCALE_BITS_MAX: Final = 31
SCALE_MAX: Final = 2**31 - 1
ABS_GE: Final = 0
"""Number of the comparison: at the value or further from 0."""
MONITOR_MAX: Final = 5
"""So many silent checks end homing, each as long as a reading takes."""

Section = tuple[float, float, float, float, float]
"""b0, b1, b2, a1, a2 of a second-order section, a0 being 1."""


class AnalogTrigger:
    """The trigger of the sensor that WHAT names, with a filter of at most so many SECTIONS."""

    def __init__(self, what: str, sections: Sequence[Section]) -> None:
        self._what = what
        self.sections = sections
        """Of its filter, in order."""
        self._filter_oid = self._oid = 0
        self._homing_rest_ticks = 0

    def configure(self, config: NodeConfig, attach: str, sensor_oid: int) -> None:
        """Add it to a node's CONFIG, by the command ATTACH to its sensor; raises NodeConfigError."""
        config.require(self._what, (*COMMANDS, attach), RESPONSES)
        self._filter_oid, self._oid = config.create_oid(), config.create_oid()
        for command in (
            f"config_sos_filter oid={self._filter_oid} max_sections={len(self.sections)}",
            f"config_trigger_analog oid={self._oid} sos_filter_oid={self._filter_oid}",
            f"{attach} oid={sensor_oid} trigger_analog_oid={self._oid}",
        ):
            config.add_config(self._what, command)

    def begin_homing(
        self,
        node: Node,
        *,
        clock: int,
        rest_ticks: int,
        trsync_oid: int,
        zero: int,
        per_count: float,
        raw_range: tuple[int, int],
        value: float,
        period_s: float,
    ) -> None:
        """Trigger when the filtered quantity is VALUE away from 0, from CLOCK on.

        The quantity is PER_COUNT for each count of a reading above ZERO. A reading outside RAW_RANGE, or none
        for some times PERIOD_S, ends homing as well.
        """
        self._homing_rest_ticks = rest_ticks
        low, high = raw_range
        scale, bits = fixed_point(UNITS * per_count)
        offset = {"offset": zero, "scale": scale, "scale_frac_bits": bits, "auto_offset": 0}
        node.send("sos_filter_set_offset_scale", oid=self._filter_oid, **offset)
        node.send(
            "sos_filter_set_active",
            oid=self._filter_oid,
            n_sections=len(self.sections),
            coeff_frac_bits=COEFF_BITS,
        )
        for index, section in enumerate(self.sections):
            words = {f"sos{number}": round(word * 2**COEFF_BITS) for number, word in enumerate(section)}
            node.send("sos_filter_set_section", oid=self._filter_oid, section_idx=index, **words)
            node.send("sos_filter_set_state", oid=self._filter_oid, section_idx=index, state0=0, state1=0)
        node.send("trigger_analog_set_raw_range", oid=self._oid, raw_min=low, raw_max=high)
        node.send(
            "trigger_analog_set_trigger",
            oid=self._oid,
            trigger_analog_type=ABS_GE,
            trigger_value=round(value * UNITS),
        )
        node.send(
            "trigger_analog_home",
            oid=self._oid,
            trsync_oid=trsync_oid,
            trigger_reason=int(TriggerReason.ENDSTOP),
            error_reason=int(TriggerReason.SENSOR_ERROR_0),
            clock=clock % 2**32,
            monitor_ticks=round(period_s * node.clock_freq_hz),
            monitor_max=MONITOR_MAX,
        )

    def end_homing(self, node: Node) -> None:
        """Compare no more."""
        names = ("trsync_oid", "trigger_reason", "error_reason", "clock", "monitor_ticks", "monitor_max")
        node.send("trigger_analog_home", oid=self._oid, **dict.fromkeys(names, 0))

    async def state(self, node: Node, *, pressed: bool) -> EndstopState:
        """Return its state where the sensor is PRESSED now, or not."""
        answer = await node.query("trigger_analog_query_state", "trigger_analog_state", oid=self._oid)
        next_clock = (answer.integer("homing_clock") + self._homing_rest_ticks) % 2**32
        return EndstopState(bool(answer.integer("homing")), next_clock, pressed)


def fixed_point(value: float) -> tuple[int, int]:
    """Return VALUE as a whole number of 32 bits and how many bits of it are a fraction.

    >>> fixed_point(10.25)
    (1375731712, 27)
    """
    bits = min(SCALE_BITS_MAX, int(math.log2(SCALE_MAX / abs(value)))) if value else 0
    return round(value * 2 ** max(0, bits)), max(0, bits)
