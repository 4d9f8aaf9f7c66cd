"""What all controllers of a heater have in common."""

from typing import Final, Protocol

NEAR_K: Final = 1.0
"""Waiting for a temperature ends this near to it …"""
SLOW_K_PER_S: Final = 0.1
"""… while it changes no faster than this."""


class Controller(Protocol):
    """Decides a heater's power each time its temperature is measured."""

    def power(self, now_s: float, measured_c: float, target_c: float, /) -> float:
        """Return the power from now on, 0..1; a target of 0 is off.

        Call it with rising times, for every measurement; a time that does not rise changes nothing.
        """
        ...

    def settled(self, measured_c: float, target_c: float, /) -> bool:
        """Return whether who waits for the target may go on."""
        ...


class Slope:
    """How fast a temperature changes: differences, smoothed over SMOOTH_S."""

    def __init__(self, smooth_s: float) -> None:
        self.k_per_s = 0.0
        self._smooth_s = smooth_s
        self._last: tuple[float, float] | None = None

    def update(self, now_s: float, celsius: float) -> float:
        """Take a measurement and return the s since the one before; 0 for the first or an old one."""
        if self._last is None:
            self._last = now_s, celsius
            return 0.0
        elapsed_s = now_s - self._last[0]
        if elapsed_s <= 0:
            return 0.0
        raw = (celsius - self._last[1]) / elapsed_s
        self.k_per_s += (raw - self.k_per_s) * min(1.0, elapsed_s / self._smooth_s)
        self._last = now_s, celsius
        return elapsed_s
