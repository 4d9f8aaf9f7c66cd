"""An analog input on a node: sampled on and on, reported, and watched by the node itself."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from nodes.devices.ticks import start_clock, ticks_for
from nodes.dictionary.message_format import Message
from nodes.node.config import NodeConfig
from nodes.node.errors import NodeError
from nodes.node.node import Node

COMMANDS: Final = ("config_analog_in", "query_analog_in")
SAMPLES: Final = 8
SAMPLE_S: Final = 1e-3
SUM_LIMIT: Final = 0xFFFF
"""Sums of samples have 16 bits on the wire."""
OUT_OF_RANGE: Final = "ADC out of range"
"""The reason with which a node shuts down then; it does not name the sensor."""
RANGE_CHECKS: Final = 4
"""So many sums in a row have to be out of range: the node then shuts down."""


@dataclass(frozen=True, slots=True)
class AnalogValue:
    """A measurement."""

    ratio: float
    """0 to 1 of the converter's reference."""
    clock32: int
    """When its sampling began."""


def _ignore(_: AnalogValue) -> None:
    pass


class AnalogIn:
    """The input for NAME (what it measures) on PIN, measured every REPORT_S.

    The node itself shuts down when RANGE_CHECKS measurements in a row are below LOW or above HIGH (ratios).
    """

    def __init__(
        self,
        name: str,
        *,
        pin: str,
        low: float = 0.0,
        high: float = 1.0,
        report_s: float = 0.3,
        range_checks: int = RANGE_CHECKS,
    ) -> None:
        self.name = name
        self.oid: int | None = None
        """Its object id; known when its node's configuration is built."""
        self.on_value: Callable[[AnalogValue], None] = _ignore
        """Called on the control loop with every measurement."""
        self.report_s = report_s
        self.describe: Callable[[float], str] = self._percent
        """Returns a ratio that is out of range in the user's words."""
        self._outside: float | None = None
        self._pin = pin
        self._low, self._high = low, high
        self._range_checks = range_checks
        self._full = 1
        self._times: dict[str, int] = {}
        self._limits: dict[str, int] = {}
        self._unlisten: Callable[[], None] | None = None

    def limit(self, low: float, high: float) -> None:
        """Take other limits, before its node is configured."""
        self._low, self._high = low, high

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pin do not allow it."""
        what = f"the sensor of {self.name}"
        config.require(what, COMMANDS)
        adc_max = config.dictionary.int_constant("ADC_MAX")
        samples = max(1, min(SAMPLES, SUM_LIMIT // adc_max))
        self._full = adc_max * samples
        self._times = {
            "sample_ticks": ticks_for(config, what, SAMPLE_S),
            "sample_count": samples,
            "rest_ticks": ticks_for(config, what, self.report_s),
        }
        self._limits = {
            "min_value": max(0, math.ceil(self._low * self._full)),
            "max_value": min(self._full, math.floor(self._high * self._full)),
            "range_check_count": self._range_checks,
        }
        if "bytes_per_report" in config.dictionary.command("query_analog_in").names:
            self._limits["bytes_per_report"] = 2
        self.oid = config.create_oid()
        config.add_config(what, f"config_analog_in oid={self.oid} pin={self._pin}")

    def started(self, node: "Node") -> None:
        """Begin to measure, as NODE has become ready."""
        if self._unlisten is not None:
            self._unlisten()
        self._unlisten = node.on("analog_in_state", self._oid, self._came)
        self._outside = None
        node.explain_shutdown(self._explain)
        clock = start_clock(node) % 2**32
        node.send("query_analog_in", oid=self._oid, clock=clock, **self._times, **self._limits)

    def stop(self, node: "Node") -> None:
        """Measure no more."""
        times = {**self._times, "sample_count": 0}
        node.send("query_analog_in", oid=self._oid, clock=0, **times, **self._limits)

    def _explain(self, reason: str) -> str:
        """Return that this is the sensor that was out of range, by its last measurement."""
        if reason != OUT_OF_RANGE or self._outside is None:
            return ""
        return f"{self.name}: {self.describe(self._outside)}"

    def _percent(self, ratio: float) -> str:
        return f"{ratio:.1%} of the converter's range, allowed are {self._low:.1%} to {self._high:.1%}"

    def _came(self, message: Message) -> None:
        if "values" in message.params:
            data = message.data("values")
            sums = [int.from_bytes(data[at : at + 2], "little") for at in range(0, len(data) - 1, 2)]
        else:
            sums = [message.integer("value")]
        next_clock = message.integer("next_clock")
        rest_ticks = self._times["rest_ticks"]
        for index, value in enumerate(sums):
            ratio = value / self._full
            self._outside = None if self._low <= ratio <= self._high else ratio
            began = next_clock - (len(sums) - index) * rest_ticks
            self.on_value(AnalogValue(min(value / self._full, 1.0), began % 2**32))

    @property
    def _oid(self) -> int:
        if self.oid is None:
            raise NodeError(f"the sensor of {self.name} is not configured on any node")
        return self.oid
