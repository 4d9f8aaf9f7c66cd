"""Detects that a bus cannot carry the motion planned on it, before a step is late."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from nodes.clock.clock import HostTime
from nodes.link import Forecast
from nodes.support.errors import CanductorError

PERSISTS_S: Final = 0.15
"""A forecast counts when it has stood so long: one of a moment of other traffic passes."""
URGENT_S: Final = 0.2
"""When the first late command is due so soon, it counts at once."""


class BusOverload(CanductorError):  # noqa: N818
    """A bus is asked for more than it can carry."""


LOSSY: Final = 0.15
"""With more blocks sent again than that it is losses that make motion late; a full bus alone causes a few."""
BLOCKED: Final = 0.72
"""With so much of a bus's time taken by what is received, that makes motion late, whatever is planned."""


@dataclass(slots=True)
class BusOverloadDetector:
    """Watches the forecasts of the bus called NAME."""

    name: str
    _late_since_ns: int | None = None

    def look(
        self,
        forecast: Forecast,
        now: HostTime,
        repeated: Callable[[], float],
        taken: Callable[[], float],
    ) -> bool:
        """Take the newest forecast; raises BusOverload when motion would be late for certain.

        Returns whether it may be: look again after PERSISTS_S, also if nothing more is sent.
        REPEATED returns the share of the blocks on this bus that had to be sent again, TAKEN the share of its
        time that received frames took lately, acknowledgements and those of low priority aside.
        """
        warning_s = forecast.warning_s
        if warning_s is None:
            self._late_since_ns = None
            return False
        if self._late_since_ns is None:
            self._late_since_ns = now
        if now - self._late_since_ns < PERSISTS_S * 1e9 and warning_s > URGENT_S:
            return True
        late = f"the first step commands would be late in {max(warning_s, 0):.1f} s"
        if (share := taken()) > BLOCKED:
            raise BusOverload(
                f"bus {self.name} is blocked: received frames take {share:.0%} of its time, and {late}; "
                "find the board that sends them, and take it off the bus"
            )
        if (share := repeated()) > LOSSY:
            raise BusOverload(
                f"bus {self.name} loses too much: {share:.0%} of the blocks on it had to be sent again, "
                f"and {late}; check its cable, its termination and the bit rate of all nodes"
            )
        raise BusOverload(
            f"bus {self.name} cannot carry what is planned: its motion needs {forecast.worst_ratio:.0%} of "
            f"the {forecast.motion_bits_per_s / 1000:.0f} kbit/s there are for it, and {late}; lower the "
            "speed or the microsteps, take other traffic off the bus, or raise its bit rate"
        )
