"""How far ahead of now the commands still reach when the next ones come: what more delay would have cost."""

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
        self._since_s = 0.0
        self._made_until_s: float | None = None

    def look(self, now_s: float, made_until_s: float, *, comes_to_rest: bool) -> None:
        """Record that commands up to MADE_UNTIL_S are handed over by NOW_S."""
        before_s, self._made_until_s = self._made_until_s, made_until_s
        if comes_to_rest:  # the lead shrinks, as it should
            self.now_s = self._made_until_s = None
            return
        if before_s is None:
            self._since_s = now_s
            return
        self.now_s = before_s - now_s  # what was left of it, whatever held up this look
        if now_s > self._since_s + SETTLED_S:
            self.least_s = self.now_s if self.least_s is None else min(self.least_s, self.now_s)
