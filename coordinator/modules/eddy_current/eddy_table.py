"""The calibration of an eddy current probe: which frequency its coil has at which height (pure)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from coordinator.config.options import BadValue, Option, parse_decimal
from coordinator.support.lazy_numpy import np
from nodes.support.errors import CanductorError

HEIGHTS: Final = (0.05, *(round(0.1 * number, 1) for number in range(1, 41)))
"""Of a calibration, mm: between two of them the frequency is nearly straight."""
LEAST: Final = 4


class OutOfRangeError(CanductorError):
    """A frequency that the calibration does not have."""


@dataclass(frozen=True, slots=True)
class EddyTable:
    """Heights (mm, rising) with their frequencies (Hz, falling)."""

    points: tuple[tuple[float, float], ...]

    def height(self, frequency_hz: float) -> float:
        """Return the height at a frequency, mm; raises OutOfRangeError."""
        heights, frequencies = zip(*self.points, strict=True)
        if frequency_hz > frequencies[0]:
            raise OutOfRangeError(
                f"the coil has {frequency_hz:.0f} Hz, which is above its calibrated range: the nozzle is"
                f" less than {heights[0]:.2f} mm above the bed, or the coil has drifted; lift the head, or"
                " calibrate with PROBE_EDDY_CURRENT_CALIBRATE"
            )
        if frequency_hz < frequencies[-1]:
            raise OutOfRangeError(
                f"the coil has {frequency_hz:.0f} Hz, which is below its calibrated range: the nozzle is"
                f" more than {heights[-1]:.2f} mm above the bed, or the coil is not above the bed; go lower"
                " (horizontal_move_z of a scan), or calibrate with PROBE_EDDY_CURRENT_CALIBRATE"
            )
        return float(np.interp(frequency_hz, frequencies[::-1], heights[::-1]))

    def frequency(self, height_mm: float) -> float:
        """Return the frequency at a height, Hz."""
        heights, frequencies = zip(*self.points, strict=True)
        return float(np.interp(height_mm, heights, frequencies))

    def text(self) -> str:
        """Return it as it is saved."""
        rows = [
            ", ".join(f"{height:.6f}:{frequency:.3f}" for height, frequency in self.points[first : first + 4])
            for first in range(0, len(self.points), 4)
        ]
        return "\n" + ",\n".join(rows)


def table_of(points: Sequence[tuple[float, float]]) -> EddyTable:
    """Return the table of measured POINTS, in any order; raises ValueError where frequencies do not fall."""
    ordered = tuple(sorted(points))
    heights, frequencies = zip(*ordered, strict=True)
    if len(ordered) < LEAST or np.any(np.diff(heights) <= 0) or np.any(np.diff(frequencies) >= 0):
        raise ValueError("the frequency does not fall as the coil is lifted")
    return EddyTable(ordered)


@dataclass(frozen=True, slots=True, kw_only=True)
class TableOption(Option[EddyTable]):
    """A table as PROBE_EDDY_CURRENT_CALIBRATE saves it."""

    def parse(self, text: str) -> EddyTable:
        """Return it."""
        try:
            pairs = [word.split(":") for word in text.replace("\n", " ").split(",") if word.strip()]
            return table_of([(parse_decimal(mm), parse_decimal(hz)) for mm, hz in pairs])
        except ValueError:
            raise BadValue from None

    def rule(self) -> str:
        """Return what is allowed."""
        return f"{LEAST} or more of height:frequency with commas between them, as saved by a calibration"

    def stand_in(self) -> EddyTable:
        """Return any table."""
        return EddyTable(((0.0, 2.0), (1.0, 1.0)))

    def setting(self, text: str, value: EddyTable) -> object:
        """Return it as it is written."""
        del value
        return text
