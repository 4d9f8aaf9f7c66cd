"""A stepper motor on a node: its configuration and its position."""

import math
from typing import Final

from nodes.devices.device import Device
from nodes.node.config import NodeConfig, NodeConfigError
from nodes.node.node import Node

BOTH_EDGE_CONSTANTS: Final = ("STEPPER_BOTH_EDGE", "STEPPER_STEP_BOTH_EDGE")
COMMANDS: Final = (
    "config_stepper",
    "queue_step",
    "set_next_step_dir",
    "reset_step_clock",
    "stepper_get_position",
)
RESPONSES: Final = ("stepper_position oid=%c pos=%i",)


class Stepper(Device):
    """Stepper NAME, on the pins of its node.

    INVERT_STEP: a step is a falling edge. STEP_PULSE_S: least duration of a step pulse for the driver; 0: a
    driver that is set to step on both edges, which needs no pulses.
    """

    def __init__(
        self,
        name: str,
        *,
        step_pin: str,
        dir_pin: str,
        invert_step: bool = False,
        step_pulse_s: float = 2e-6,
    ) -> None:
        super().__init__(f"stepper {name}")
        self.name = name
        self.queue_step_id = self.set_next_step_dir_id = self.reset_step_clock_id = 0
        """Ids of the commands that move it, from its node's dictionary, for the step compressor."""
        self._step_pin = step_pin
        self._dir_pin = dir_pin
        self._invert_step = invert_step
        self._step_pulse_s = step_pulse_s

    @property
    def steps_on_both_edges(self) -> bool:
        """Return whether every change of the step pin is a step."""
        return self._step_pulse_s == 0

    def configure(self, config: NodeConfig) -> None:
        """Add the stepper to its node's CONFIG; NodeConfigError when firmware or pins do not allow it."""
        dictionary = config.dictionary
        config.require(self.name, COMMANDS, RESPONSES)
        able = any(dictionary.int_constant(name, 0) == 1 for name in BOTH_EDGE_CONSTANTS)
        if self.steps_on_both_edges and not able:
            raise NodeConfigError(
                f"{self.name}: the firmware of node {config.name} ({dictionary.version}) cannot step on both "
                "edges; set the driver to rising edges and give step_pulse_duration"
            )
        pulse_ticks = math.ceil(self._step_pulse_s * dictionary.clock_freq_hz)
        invert = -1 if self.steps_on_both_edges else int(self._invert_step)
        self.oid = config.create_oid()
        self.queue_step_id = dictionary.command("queue_step").message_id
        self.set_next_step_dir_id = dictionary.command("set_next_step_dir").message_id
        self.reset_step_clock_id = dictionary.command("reset_step_clock").message_id
        config.add_config(
            self.name,
            f"config_stepper oid={self.oid} step_pin={self._step_pin} dir_pin={self._dir_pin} "
            f"invert_step={invert} step_pulse_ticks={pulse_ticks}",
        )

    async def position(self, node: Node) -> int:
        """Query NODE for the stepper's position, in steps from where it began, as the node counts them."""
        answer = await node.query("stepper_get_position", "stepper_position", oid=self._oid)
        return answer.integer("pos")
