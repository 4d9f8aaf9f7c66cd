"""How far ahead of now the motion worker's commands reach: what delays could eat up before a node waits."""

from typing import Final

SETTLED_S: Final = 1.0
"""From a standstill until the look-ahead must be full."""


class MotionLead:
    """Watches the lead, looked at whenever commands were handed over; print times in s."""

    def __init__(self) -> None:
        self.now_s: float | None = None
        """At the last look; None: nothing more is to be made ready, the machine comes to rest or stands."""
        self.least_s: float | None = None
        """The smallest since the machine started, the first second after each standstill left out."""
        self._since_s: float | None = None

    def look(self, now_s: float, made_until_s: float, *, comes_to_rest: bool) -> None:
        """Take note that at NOW_S commands were made up to MADE_UNTIL_S."""
        if comes_to_rest:  # the lead shrinks, as it should
            self.now_s = self._since_s = None
            return
        lead_s = made_until_s - now_s
        self.now_s = lead_s
        if self._since_s is None:
            self._since_s = now_s
        elif now_s > self._since_s + SETTLED_S:
            self.least_s = lead_s if self.least_s is None else min(self.least_s, lead_s)
