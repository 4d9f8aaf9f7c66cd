"""Pulse-width modulated outputs on a node: in its hardware, or in its software on any pin."""

from typing import Final

from nodes.devices.ticks import ticks_for
from nodes.devices.timed_output import TimedOutput
from nodes.node.config import NodeConfig, NodeConfigError
from nodes.node.node import Node

HARDWARE_COMMANDS: Final = ("config_pwm_out", "queue_pwm_out")
SOFTWARE_COMMANDS: Final = ("config_digital_out", "set_digital_out_pwm_cycle", "queue_digital_out")
SOFTWARE_FASTEST_S: Final = 0.001
"""A shorter cycle in software would delay the node's steps."""


class PwmOut(TimedOutput):
    """The output for NAME on PIN; values are the ratio of the time on, 0..1; INVERT: on is low.

    It begins with START and has SHUTDOWN after a shutdown of its node; in software both must be 0 or 1.
    MAX_DURATION_S: see timed_output.py.
    """

    def __init__(
        self,
        name: str,
        *,
        pin: str,
        cycle_s: float = 0.1,
        hardware: bool = False,
        invert: bool = False,
        start: float = 0.0,
        shutdown: float = 0.0,
        max_duration_s: float = 0.0,
    ) -> None:
        super().__init__(name, max_duration_s=max_duration_s)
        self._pin = pin
        self._cycle_s = cycle_s
        self._hardware = hardware
        self._invert = invert
        self._start, self._shutdown = start, shutdown
        self._full = 1
        """The node's value for always on."""

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pin do not allow it."""
        self._add_to(config, HARDWARE_COMMANDS if self._hardware else SOFTWARE_COMMANDS)
        if self._hardware:
            self._configure_hardware(config)
        else:
            self._configure_software(config)

    def _configure_hardware(self, config: NodeConfig) -> None:
        self.command, self.value_parameter = "queue_pwm_out", "value"
        self._full = config.dictionary.int_constant("PWM_MAX")
        config.add_config(
            self.name,
            f"config_pwm_out oid={self.oid} pin={self._pin}"
            f" cycle_ticks={ticks_for(config, self.name, self._cycle_s)}"
            f" value={self._scaled(self._start)} default_value={self._scaled(self._shutdown)}"
            f" max_duration={self._duration_ticks(config)}",
        )

    def _configure_software(self, config: NodeConfig) -> None:
        self.command, self.value_parameter = "queue_digital_out", "on_ticks"
        if self._cycle_s < SOFTWARE_FASTEST_S:
            raise NodeConfigError(
                f"{self.name}: a cycle of {self._cycle_s:g} s is too short for software; set hardware_pwm, or"
                f" a cycle_time of at least {SOFTWARE_FASTEST_S:g} s"
            )
        if {self._start, self._shutdown} - {0.0, 1.0}:
            raise NodeConfigError(
                f"{self.name}: without hardware_pwm it can only start and shut down fully on or off"
            )
        self._full = ticks_for(config, self.name, self._cycle_s)
        config.add_config(
            self.name,
            f"config_digital_out oid={self.oid} pin={self._pin} value={self._level(self._start)}"
            f" default_value={self._level(self._shutdown)} max_duration={self._duration_ticks(config)}",
        )
        config.add_config(self.name, f"set_digital_out_pwm_cycle oid={self.oid} cycle_ticks={self._full}")

    def set(self, node: Node, clock: int, value: float) -> None:
        """Set VALUE, 0..1, at CLOCK (64 bits, later than now by the transit time to the node)."""
        self._queue(node, clock, self._scaled(value))

    def _start_value(self) -> int:
        return self._scaled(self._start)

    def _scaled(self, value: float) -> int:
        value = min(max(value, 0.0), 1.0)
        return round((1 - value if self._invert else value) * self._full)

    def _level(self, value: float) -> int:
        return int((value > 0) != self._invert)
