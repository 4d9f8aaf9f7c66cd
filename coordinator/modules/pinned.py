"""A device whose pins are known by file and line: what is wrong with them is told there."""

from collections.abc import Mapping
from typing import Final

from coordinator.config.options import FloatOption
from coordinator.config.pins import PinDescription
from coordinator.modules.base import Build, Device
from nodes.devices.pwm_out import SOFTWARE_FASTEST_S
from nodes.node.config import NodeConfig
from nodes.node.node import Node

AHEAD_S: Final = 0.4
"""How far ahead values are sent: late ones would stop the node, and hosts are sometimes slow."""


class Pinned:
    """DEVICE on PINS of its node."""

    def __init__(self, device: Device, *pins: PinDescription) -> None:
        self._device = device
        self._pins = pins

    def configure(self, config: NodeConfig) -> None:
        """Add it to what its node is configured as; ConfigError for a pin the node has not."""
        found = config.dictionary.enumerations.get("pin")
        numbers: Mapping[str, int] = found.values if found is not None else {}
        for pin in self._pins:
            pin.number(numbers)
        self._device.configure(config)

    def started(self, node: "Node") -> None:
        """Its node is ready."""
        self._device.started(node)


def pwm_cycle(build: Build, option: FloatOption, *, hardware: bool) -> float:
    """Return the cycle that OPTION asks for, s; in software no shorter than a node can make it."""
    asked = build.get(option)
    if hardware or asked >= SOFTWARE_FASTEST_S:
        return asked
    build.note(
        option,
        f"is {asked:g} s, too short for PWM in software: {SOFTWARE_FASTEST_S:g} s is used; hardware_pwm: True"
        " allows less, on pins that have it",
    )
    return SOFTWARE_FASTEST_S


def add_pinned(build: Build, device: Device, pin: PinDescription) -> None:
    """Have DEVICE on the node of PIN."""
    build.add_device(pin.node, Pinned(device, pin))
