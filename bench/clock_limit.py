"""How well two clocks can be known at all, five seconds after the first sample, whatever the estimator.

``bench/clock_limit.py [TRIALS]``: delays as in the recorded traces (a fixed way and an exponential
excess, by profile), their sample times, steady clocks that differ by up to 100 ppm. The exact posterior is
computed on a grid of rates: given a rate, the offset is uniform between the bounds that the exchanges leave.
Its mean is the best there is; printed is its root mean square error for the difference of two clocks
"""

import sys

import numpy as np

SAMPLES_S = np.array([0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.41, 1.4, 2.38, 3.37, 4.35])
EXCESS_S = {"A": 300e-6, "B": 30e-6, "C": 100e-6}
AT_S = 5.0
RATE = 100e-6
RATES = np.linspace(-RATE, RATE, 801)


def error(rng: np.random.Generator, excess_s: float) -> float:
    """Return the error at AT_S of the best estimate of one clock, whose offset and rate are drawn."""
    rate = rng.uniform(-RATE, RATE)
    truth = rate * SAMPLES_S
    low = truth - rng.exponential(excess_s, len(SAMPLES_S))
    high = truth + rng.exponential(excess_s, len(SAMPLES_S))
    way = RATES * SAMPLES_S[:, None]
    lowest, highest = (low[:, None] - way).max(0), (high[:, None] - way).min(0)
    weight = np.clip(highest - lowest, 0, None)
    estimate = ((lowest + highest) / 2 + AT_S * RATES) @ weight / weight.sum()
    return float(estimate - AT_S * rate)


def main() -> None:
    """Print a line for each profile."""
    trials = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    rng = np.random.default_rng(1)
    for profile, excess_s in EXCESS_S.items():
        errors = [error(rng, excess_s) for _ in range(trials)]
        rms_us = 1e6 * np.sqrt(2 * np.mean(np.square(errors)))
        print(f"{profile}: at best {rms_us:6.1f} µs rms between two clocks after {AT_S:g} s")


if __name__ == "__main__":
    main()
