"""Dictionaries of real firmware, which lie outside the project: each one the tests use is named here."""

from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).parents[1] / ".." / "shared" / "data" / "dictionaries"
NAMES: Final = (
    "atmega2560",
    "linuxprocess",
    "rp2040-can2040",
    "stm32f072-can",
    "stm32f103-usb",
    "stm32f407-usart1",
    "stm32g0b1-can",
    "stm32h723-usbcanbridge",
)
PATHS: Final = [path for name in NAMES if (path := FOLDER / f"{name}.json").exists()]
"""Those that are there. A test without them skips with MISSING."""
MISSING: Final = "no dictionaries of real firmware in ../shared"
