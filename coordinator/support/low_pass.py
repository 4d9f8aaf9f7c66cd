"""A low pass of the first order for values that come now and then."""


class LowPass:
    """Follows values with a time constant of TIME_S; 0: at once."""

    def __init__(self, time_s: float) -> None:
        self._time_s = time_s
        self._at_s = 0.0
        self.value: float | None = None
        """What it has come to; None: no value came yet."""

    def take(self, at_s: float, value: float) -> None:
        """Take the VALUE of a time AT_S."""
        if self.value is not None and at_s > self._at_s:
            past_s = at_s - self._at_s
            value = self.value + (value - self.value) * past_s / (past_s + self._time_s)
        self._at_s, self.value = at_s, value
