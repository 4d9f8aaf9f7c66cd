"""The sensors users call by name, computed from what their makers publish.

A thermistor's curve goes through three points of its data sheet, or follows from its B value where the sheet
gives no more; SOURCES says which.
"""

from dataclasses import dataclass
from typing import Final

from coordinator.heat.resistors import Platinum, SteinhartHart


@dataclass(frozen=True, slots=True)
class KnownThermistor:
    """A thermistor that is known by name."""

    curve: SteinhartHart
    source: str


def _points(source: str, *points: tuple[float, float]) -> KnownThermistor:
    return KnownThermistor(SteinhartHart.from_points(points), source)


THERMISTORS: Final[dict[str, KnownThermistor]] = {
    "EPCOS 100K B57560G104F": _points(
        "TDK (EPCOS) data sheet B57560G, R/T characteristic 8304",
        (25, 100_000),
        (150, 1641.9),
        (250, 226.15),
    ),
    "ATC Semitec 104GT-2": _points(
        "Semitec data sheet GT thermistor, 104GT-2", (20, 126_800), (150, 1360), (300, 80.65)
    ),
    "ATC Semitec 104NT-4-R025H42G": _points(
        "Semitec data sheet NT-4 thermistor, 104NT-4-R025H42G", (25, 100_000), (160, 1074), (300, 82.78)
    ),
    "Generic 3950": _points(
        "AMWEI data sheet AMF58-104G3950, as beads marked 100K 3950 are sold without one",
        (25, 100_000),
        (150, 1711),
        (250, 231),
    ),
    "Honeywell 100K 135-104LAG-J01": KnownThermistor(
        SteinhartHart.from_beta(25, 100_000, 3974), "Honeywell data sheet 135-104LAG-J01: B25/85 = 3974 K"
    ),
    "NTC 100K MGB18-104F39050L32": KnownThermistor(
        SteinhartHart.from_beta(25, 100_000, 4100),
        "B = 4100 K up to 250 °C, as this part is used; its name says B25/50 = 3950 K",
    ),
    "SliceEngineering 450": _points(
        "Slice Engineering, RT table of the 450 °C thermistor", (25, 500_000), (200, 3734), (400, 240)
    ),
    "TDK NTCG104LH104JT1": _points(
        "TDK data sheet NTCG104LH104JT1 (B25/85 = 4550 K)", (25, 100_000), (50, 31_230), (125, 2066)
    ),
}

PT1000: Final = Platinum(1000.0)
PT100: Final = Platinum(100.0)
PT100_BOARD_PULLUP_OHMS: Final = 4400.0
PT100_BOARD_GAIN: Final = 10.0
PT100_BOARD_SUPPLY_V: Final = 5.0
"""The amplifier board sold for PT100 sensors ("PT100 INA826"): two 2.2 kΩ to 5 V, INA826 with gain 10."""
