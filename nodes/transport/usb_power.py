"""The switch for the power of the USB ports, where the computer has one: Raspberry Pi computers 1 to 3."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from nodes.support.errors import CanductorError

PLATFORM: Final = Path("/sys/devices/platform")


def usb_power_switch(platform: Path = PLATFORM) -> Callable[[bool], None] | None:
    """Return what switches the power of all USB ports on (True) or off; None: there is no such switch.

    The function raises CanductorError when this user may not switch.
    """
    files = sorted(platform.glob("*/*.usb/buspower"))
    if not files:
        return None

    def switch(on: bool) -> None:
        for file in files:
            try:
                file.write_text("1" if on else "0")
            except OSError as error:
                raise CanductorError(
                    f"cannot switch the power of the USB ports by {file}: {error.strerror}; run as a user "
                    "who may write it, or set another restart_method"
                ) from None

    return switch
