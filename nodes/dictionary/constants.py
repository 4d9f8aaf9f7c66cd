"""The constants of a dictionary that the host reads, with their ranges: whole numbers, checked together.

Afterwards they can be used without a check: a firmware that gives another value is refused when its
dictionary is read, and affects no other node.
"""

from collections.abc import Mapping
from typing import Final

_BYTE: Final = (0, (1 << 8) - 1)
_WORD: Final = (1, (1 << 16) - 1)
_LONG: Final = (1, (1 << 32) - 1)

CONSTANTS: Final[Mapping[str, tuple[int, int]]] = {
    "CLOCK_FREQ": _LONG,
    "RECEIVE_WINDOW": (64, (1 << 20) - 1),  # a block at least
    "STATS_SUMSQ_BASE": _LONG,
    "CANBUS_FREQUENCY": (10_000, 1_000_000),  # the rates of CAN
    "ADC_MAX": _WORD,  # sums of samples and values of outputs have 16 bits on the wire
    "PWM_MAX": _WORD,
    "STEPPER_BOTH_EDGE": _BYTE,
    "STEPPER_STEP_BOTH_EDGE": _BYTE,
    "CAN_BUS_STOP": _BYTE,
    "CAN_SYNC_PULSE": _BYTE,
    "CAN_TRIGGER_GROUPS": _BYTE,
    "MT_AXLES": _BYTE,
}
"""Lowest and highest value of each."""
