"""What outputs of modules have in common: when their values are sent, and how short a PWM cycle may be."""

from typing import Final

from coordinator.config.options import FloatOption
from coordinator.modules.base import Build
from nodes.devices.pwm_out import SOFTWARE_FASTEST_S

AHEAD_S: Final = 0.4
"""How far ahead values are sent: late ones would stop the node, and hosts are sometimes slow."""


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
