"""Resets of a board: the methods, in the order in which a start tries them, and the pulses of DTR and RTS."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, Protocol


class ResetMethod(StrEnum):
    """How a board is reset; the words of ``restart_method``."""

    COMMAND = "command"
    """By the firmware's own ``config_reset`` or ``reset``."""
    ARDUINO = "arduino"
    """By a pulse of DTR, which a capacitor turns into a pulse of the reset pin."""
    CHEETAH = "cheetah"
    """By a pulse of DTR while RTS keeps the chip from entering its own boot loader."""
    RPI_USB = "rpi_usb"
    """By switching the power of the computer's USB ports off and on."""


def reset_methods(wanted: ResetMethod) -> tuple[ResetMethod, ...]:
    """Return the methods to be tried, in order, where WANTED is configured.

    Many boards on USB ignore DTR, and pseudo-terminals have none: where a method has no effect, the firmware
    is asked to reset itself.
    """
    return (wanted,) if wanted is ResetMethod.COMMAND else (wanted, ResetMethod.COMMAND)


@dataclass(frozen=True, slots=True)
class _Level:
    dtr: bool
    rts: bool
    hold_s: float


_PULSE_S: Final = 0.1
"""A capacitor of 100 nF and 10 kΩ makes a reset of about 1 ms of any edge; adapters may be slow to set it."""
_PULSES: Final = {
    ResetMethod.ARDUINO: (
        _Level(dtr=False, rts=True, hold_s=_PULSE_S),
        _Level(dtr=True, rts=True, hold_s=_PULSE_S),
    ),
    ResetMethod.CHEETAH: (
        _Level(dtr=False, rts=True, hold_s=_PULSE_S),
        _Level(dtr=True, rts=True, hold_s=_PULSE_S),
        _Level(dtr=False, rts=True, hold_s=_PULSE_S),
        _Level(dtr=False, rts=False, hold_s=_PULSE_S),
    ),
}
POWER_OFF_S: Final = 1.0
"""How long USB ports have no power: until the capacitors of the boards are empty."""

SetLines = Callable[[bool, bool], None]
"""Sets DTR and RTS; raises CanductorError when the device is gone."""
SetPower = Callable[[bool], None]
"""Switches the power of all USB ports; raises CanductorError."""


class SerialPort(Protocol):
    """The serial device of one node, as far as resets need it."""

    @property
    def set_lines(self) -> SetLines | None:
        """What sets DTR and RTS while the device is open; None: it has none, or is closed."""

    @property
    def set_power(self) -> SetPower | None:
        """What switches the power of the computer's USB ports; None: nothing does."""

    def close(self) -> None:
        """Close the device, after its I/O has ended."""


async def pulse(method: ResetMethod, set_lines: SetLines) -> None:
    """Pulse the lines as METHOD (arduino, cheetah) does; raises CanductorError when the device is gone."""
    for level in _PULSES[method]:
        set_lines(level.dtr, level.rts)
        await asyncio.sleep(level.hold_s)


async def power_cycle(set_power: SetPower) -> None:
    """Switch the power of the USB ports off and on; raises CanductorError. It never stays off."""
    try:
        set_power(False)
        await asyncio.sleep(POWER_OFF_S)
    finally:
        set_power(True)
