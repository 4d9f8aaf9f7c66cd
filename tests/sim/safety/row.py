"""What is told of a case in which something goes wrong with the heaters on."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

MAX_DURATION_S: Final = 1.5
"""As it is without the option: within this a node ends its heat by itself."""


@dataclass(frozen=True, slots=True)
class Row:
    """A case and one heater."""

    case: str
    heater: str
    off_after_s: float
    """From the cause to when its pin went off for good."""
    bound_s: float
    steps: str
    """When the last step came, of when it may come."""
    ok: bool
    told: str


def table(rows: Sequence[Row]) -> str:
    """Return the rows as text."""
    lines = [
        f"{'case':27}  {'heater':11} {'off after':>9}  {'bound':>6}  {'last step, s':15}    what is told"
    ]
    for row in rows:
        verdict = "ok " if row.ok else "BAD"
        lines.append(
            f"{row.case:27}  {row.heater:11} {row.off_after_s:7.4f} s  {row.bound_s:4.2f} s"
            f"  {row.steps:15}{verdict} {row.told[:90]}"
        )
    return "\n".join(lines)
