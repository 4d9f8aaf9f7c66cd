"""Pulse-width modulated outputs on a node: by its hardware, or by its software on any pin."""

from typing import Final

from nodes.devices.ticks import ticks_for
from nodes.devices.timed_output import TimedOutput
from nodes.node.config import NodeConfig, NodeConfigError
from nodes.node.node import Node

HARDWARE_COMMANDS: Final = ("config_pwm_out", "queue_pwm_out")
SOFTWARE_COMMANDS: Final = ("config_digital_out", "set_digital_out_pwm_cycle", "queue_digital_out")
SOFTWARE_FASTEST_S: Final = 0.001
"""A shorter cycle in software would keep the node from its steps."""


class PwmOut(TimedOutput):
    """The output for NAME on PIN; values are 0..1 of the time on, INVERT: on is low.

    It begins with START and has SHUTDOWN when its node shuts down; in software and with a safety net those
    are 0 or 1. See timed_output.py for MAX_DURATION_S.
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
        """The node's number for always on."""

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pin do not allow it."""
        config.require(f"the output of {self.name}", self._commands)
        self.oid = config.create_oid()
        config.timed_outputs += 1
        if self._hardware:
            self._configure_hardware(config)
        else:
            self._configure_software(config)

    @property
    def _commands(self) -> tuple[str, ...]:
        return HARDWARE_COMMANDS if self._hardware else SOFTWARE_COMMANDS

    def _configure_hardware(self, config: NodeConfig) -> None:
        self.command, self.value_parameter = "queue_pwm_out", "value"
        self._full = config.dictionary.int_constant("PWM_MAX")
        config.add_config(
            self.name,
            f"config_pwm_out oid={self.oid} pin={self._pin}"
            f" cycle_ticks={ticks_for(config, self.name, self._cycle_s)}"
            f" value={self._number(self._start)} default_value={self._number(self._shutdown)}"
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

    def set(self, node: "Node", clock: int, value: float) -> None:
        """Have VALUE, 0..1, from CLOCK on (64 bits, ahead of now by the way to the node)."""
        self._queue(node, clock, self._number(value))

    def _number(self, value: float) -> int:
        value = min(max(value, 0.0), 1.0)
        return round((1 - value if self._invert else value) * self._full)

    def _level(self, value: float) -> int:
        return int((value > 0) != self._invert)
