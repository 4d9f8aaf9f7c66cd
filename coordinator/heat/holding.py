"""How well a heater holds its target: the band it keeps in steady state.

Steady state begins SETTLING_S after the target was reached, as M109 and M190 wait for it, and ends when the
target changes. Neither a fan that starts nor filament that passes ends it: to hold against them is the task.
"""

from dataclasses import dataclass
from typing import Final

SETTLING_S: Final = 10.0
"""How long a heater may swing after it has reached its target."""


@dataclass(frozen=True, slots=True)
class Held:
    """What was measured in steady state."""

    target_c: float
    since_s: float
    """Times are those of the measurements."""
    until_s: float
    low_c: float
    high_c: float
    measurements: int
    cycles: int
    """How often the heater was switched off and on again."""
    mean_c: float | None
    """Of whole such cycles; None where there was none."""

    @property
    def seconds(self) -> float:
        """How long it lasted, or lasts."""
        return self.until_s - self.since_s

    @property
    def deviation_k(self) -> float:
        """How far from the target it was at most."""
        return max(self.high_c - self.target_c, self.target_c - self.low_c)


@dataclass(slots=True)
class _Steady:
    """A target that is held: running sums, whatever the time."""

    target_c: float
    since_s: float
    until_s: float
    low_c: float
    high_c: float
    count: int = 0
    switched_on: int = 0
    in_cycles: tuple[float, int] = (0.0, 0)
    """Sum and number of measurements from the first switching on to the last."""
    sums: tuple[float, int] = (0.0, 0)
    """The same, to now."""

    def add(self, now_s: float, celsius: float, *, switches_on: bool) -> None:
        self.until_s, self.count = now_s, self.count + 1
        self.low_c, self.high_c = min(self.low_c, celsius), max(self.high_c, celsius)
        if switches_on:
            self.switched_on += 1
            self.in_cycles = self.sums
        if self.switched_on:
            self.sums = self.sums[0] + celsius, self.sums[1] + 1

    def held(self) -> Held:
        total, count = self.in_cycles
        return Held(
            self.target_c,
            self.since_s,
            self.until_s,
            self.low_c,
            self.high_c,
            self.count,
            max(self.switched_on - 1, 0),
            total / count if count else None,
        )


class Holding:
    """Watches one heater. Times rise; only their differences mean something."""

    def __init__(self, settling_s: float = SETTLING_S) -> None:
        self._settling_s = settling_s
        self._target_c = 0.0
        self._settled_s: float | None = None
        self._steady: _Steady | None = None
        self._on = False

    @property
    def held(self) -> Held | None:
        """The steady state that lasts; None: it is not in one."""
        return None if self._steady is None else self._steady.held()

    def measured(
        self, now_s: float, celsius: float, target_c: float, power: float, *, settled: bool
    ) -> Held | None:
        """Take a measurement, and the POWER that follows from it; return the steady state that has ended.

        SETTLED: whether who waits for the target may go on.
        """
        ended = None
        if target_c != self._target_c:
            ended = self.end()
            self._target_c = target_c
        switches_on, self._on = power > 0 and not self._on, power > 0
        if target_c <= 0:
            return ended
        if self._settled_s is None and settled:
            self._settled_s = now_s
        if self._settled_s is not None and now_s >= self._settled_s + self._settling_s:
            if self._steady is None:
                self._steady = _Steady(target_c, now_s, now_s, celsius, celsius)
            self._steady.add(now_s, celsius, switches_on=switches_on)
        return ended

    def end(self) -> Held | None:
        """End what lasts and return it; None: nothing did."""
        held, self._steady, self._settled_s, self._target_c = self.held, None, None, 0.0
        return held
