"""Numbers that were written by people, programs or other computers: one reader for G-code, options and files.

Python's ``float`` and ``int`` also read digits of other scripts, ``1_000``, ``inf``, ``nan`` and any length.
"""

import re
from typing import Final

CHARS_MAX: Final = 40
MAGNITUDE_MAX: Final = 1e15
"""Beyond it a float does not hold every whole number, and nothing here is that large."""
MAGNITUDE_MIN: Final = 1e-12
"""Below it a number counts as 0, which checks for what must be above 0 refuse: nothing that is divided by the
other ones overflows."""
_DECIMAL: Final = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_WHOLE: Final = re.compile(r"[+-]?\d+", re.ASCII)
_HEX: Final = re.compile(r"0[xX][0-9a-fA-F]+", re.ASCII)


def read_decimal(text: str) -> float | None:
    """Return the decimal number in TEXT, from -MAGNITUDE_MAX to MAGNITUDE_MAX; None: there is none."""
    if (
        len(text) > CHARS_MAX
        or not _DECIMAL.fullmatch(text)
        or not abs(value := float(text)) <= MAGNITUDE_MAX
    ):
        return None
    return value if abs(value) >= MAGNITUDE_MIN else 0.0


def read_int(text: str, *, may_be_hex: bool = False) -> int | None:
    """Return the whole number that TEXT is; None: it is none. MAY_BE_HEX: also as in 0x1f."""
    if len(text) > CHARS_MAX:
        return None
    if may_be_hex and _HEX.fullmatch(text):
        return int(text, 16)
    return int(text) if _WHOLE.fullmatch(text) else None
