"""A value that changes with the height of what is printed: a tower that shows which one is best.

With h = max(z - skip, 0), z being the height of the print:

    start + factor·h                                with ``factor``
    start + factor·(floor(h / band) + ½)·band       with ``factor`` and ``band``
    start + step·floor(h / step_height)             with ``step`` and ``step_height``

Source: the definition of TUNING_TOWER.
"""

import math
import re
from dataclasses import dataclass
from typing import Final

_LETTER_COMMAND: Final = re.compile(r"[A-Z]\d+(\.\d+)?", re.ASCII)
_ROUNDING: Final = 1e-9
"""Of a height in bands: 0.6 is the third band of 0.2 mm."""
LOWER_MM: Final = 2.0
"""What prints so far below the highest print so far belongs to another print: the tower ends."""


@dataclass(frozen=True, slots=True)
class TuningTower:
    """Which command gets which value at which height; heights in mm, in the machine's frame."""

    command: str
    """With parameters of its own, if any."""
    parameter: str
    """To which the value is given."""
    start: float
    factor: float = 0.0
    """Per mm."""
    band_mm: float = 0.0
    """0: there are none."""
    step: float = 0.0
    step_height_mm: float = 0.0
    """0: FACTOR holds."""
    skip_mm: float = 0.0
    written: str = ""
    """The parameters that it was begun with."""
    z_mm: float = -math.inf
    """Height of the print so far."""
    value: float | None = None
    """That was set last."""

    def value_at(self, z_mm: float) -> float:
        """Return the value that belongs to a height."""
        height = max(z_mm - self.skip_mm, 0.0)
        if self.step_height_mm:
            return self.start + self.step * _count(height, self.step_height_mm)
        if self.band_mm and z_mm >= self.skip_mm:
            return self.start + self.factor * (_count(height, self.band_mm) + 0.5) * self.band_mm
        return self.start + self.factor * height

    def ends_at(self, z_mm: float) -> bool:
        """Whether what prints at this height is another print."""
        return z_mm < self.z_mm - LOWER_MM

    def line(self, value: float) -> str:
        """Return the command with VALUE."""
        equals = "" if _LETTER_COMMAND.fullmatch(self.command.split()[0]) else "="
        return f"{self.command} {self.parameter}{equals}{value:.9f}"


def _count(height_mm: float, piece_mm: float) -> int:
    return math.floor(height_mm / piece_mm + _ROUNDING)
