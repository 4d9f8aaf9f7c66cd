"""Bang-bang control of a heater."""


class Watermark:
    """Full power (MAX_POWER) until MAX_DELTA_K above the target, then none until as much below."""

    def __init__(self, *, max_power: float = 1.0, max_delta_k: float = 2.0) -> None:
        self._max_power = max_power
        self._max_delta_k = max_delta_k
        self._heating = False

    def power(self, _now_s: float, measured_c: float, target_c: float) -> float:
        """Return the power from now on."""
        if target_c <= 0 or measured_c >= target_c + self._max_delta_k:
            self._heating = False
        elif measured_c <= target_c - self._max_delta_k:
            self._heating = True
        return self._max_power if self._heating else 0.0

    def settled(self, measured_c: float, target_c: float) -> bool:
        """Return whether the target is reached."""
        return measured_c >= target_c - self._max_delta_k
