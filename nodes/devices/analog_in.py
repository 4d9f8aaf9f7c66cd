"""An analog input on a node: sampled periodically, reported, and monitored by the node itself."""

import math
import struct
from collections.abc import Callable
from typing import Final, NamedTuple

from nodes.devices.device import Device, ignore
from nodes.devices.ticks import start_clock, ticks_for
from nodes.dictionary.message_format import Message
from nodes.dictionary.vocabulary import carries
from nodes.node.config import NodeConfig
from nodes.node.node import Node

COMMANDS: Final = ("config_analog_in", "query_analog_in")
REPORT: Final = "analog_in_state oid=%c next_clock=%u values=%*s"
REPORT_OF_ONE: Final = "analog_in_state oid=%c next_clock=%u value=%hu"
"""That of older firmware."""
SAMPLES: Final = 8
SAMPLE_S: Final = 1e-3
REPORT_S: Final = 0.3
SUM_LIMIT: Final = 0xFFFF
"""Sums of samples have 16 bits on the wire."""
OUT_OF_RANGE: Final = "ADC out of range"
"""The reason with which a node shuts down then; it does not name the sensor."""
RANGE_CHECKS: Final = 4
"""Number of consecutive sums out of range after which the node shuts down."""


class AnalogValue(NamedTuple):
    """A measurement."""

    ratio: float
    """0 to 1 of the converter's reference."""
    clock32: int
    """The node's clock when its sampling began."""


class AnalogIn(Device):
    """The input for NAME (what it measures) on PIN, measured every REPORT_S.

    The node itself shuts down after RANGE_CHECKS consecutive measurements below LOW or above HIGH (ratios).
    """

    def __init__(self, name: str, *, pin: str, low: float = 0.0, high: float = 1.0) -> None:
        super().__init__(f"the sensor of {name}")
        self.on_value: Callable[[AnalogValue], None] = ignore
        """Called on the control loop with every measurement."""
        self.describe: Callable[[float], str] = self._percent
        """Returns a ratio that is out of range in the user's words."""
        self._name = name
        self._outside: float | None = None
        self._pin = pin
        self._low, self._high = low, high
        self._full = 1
        self._times: dict[str, int] = {}
        self._limits: dict[str, int] = {}

    def limit(self, low: float, high: float) -> None:
        """Change the limits, before its node is configured."""
        self._low, self._high = low, high

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pin do not allow it."""
        report = REPORT if carries(config.dictionary, REPORT) else REPORT_OF_ONE
        config.require(self.description, COMMANDS, (report,))
        adc_max = config.dictionary.int_constant("ADC_MAX")
        samples = max(1, min(SAMPLES, SUM_LIMIT // adc_max))
        self._full = adc_max * samples
        self._times = {
            "sample_ticks": ticks_for(config, self.description, SAMPLE_S),
            "sample_count": samples,
            "rest_ticks": ticks_for(config, self.description, REPORT_S),
        }
        self._limits = {
            "min_value": max(0, math.ceil(self._low * self._full)),
            "max_value": min(self._full, math.floor(self._high * self._full)),
            "range_check_count": RANGE_CHECKS,
        }
        if "bytes_per_report" in config.dictionary.command("query_analog_in").names:
            self._limits["bytes_per_report"] = 2
        self.oid = config.create_oid()
        config.add_config(self.description, f"config_analog_in oid={self.oid} pin={self._pin}")

    def started(self, node: Node) -> None:
        """Begin to measure, as NODE has become ready."""
        self._on_report(node, "analog_in_state", self._received)
        self._outside = None
        node.explain_shutdown(self._explain)
        period = self._times["rest_ticks"]  # all in step: reports that come together wake the host once
        clock = -(-start_clock(node) // period) * period % 2**32
        node.send("query_analog_in", oid=self._oid, clock=clock, **self._times, **self._limits)

    def stop(self, node: Node) -> None:
        """Stop measuring."""
        times = {**self._times, "sample_count": 0}
        node.send("query_analog_in", oid=self._oid, clock=0, **times, **self._limits)

    def _explain(self, reason: str) -> str:
        """Return that this is the sensor that was out of range, by its last measurement."""
        if reason != OUT_OF_RANGE or self._outside is None:
            return ""
        return f"{self._name}: {self.describe(self._outside)}"

    def _percent(self, ratio: float) -> str:
        return f"{ratio:.1%} of the converter's range, allowed are {self._low:.1%} to {self._high:.1%}"

    def _received(self, message: Message) -> None:
        if "values" in message.params:
            data = message.data("values")
            sums = struct.unpack_from(f"<{len(data) // 2}H", data)
        else:
            sums = (message.integer("value"),)
        next_clock = message.integer("next_clock")
        rest_ticks = self._times["rest_ticks"]
        for index, value in enumerate(sums):
            ratio = value / self._full
            self._outside = None if self._low <= ratio <= self._high else ratio
            began = next_clock - (len(sums) - index) * rest_ticks
            self.on_value(AnalogValue(min(value / self._full, 1.0), began % 2**32))
