"""What one bound says about a normal distribution, by integration: the reference of the clock's filters."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(20)


class Product(NamedTuple):
    """A normal distribution times the likelihood of a bound."""

    mean: float
    variance: float
    log_density: float
    """Logarithm of the density of the bound, in units of the mean distance; -inf for a loose one."""


def normal_share(x: Array) -> Array:
    """Return the share of a normal distribution below X, from the definition of the error function."""
    return np.array([0.5 * math.erfc(-value / math.sqrt(2)) for value in x.tolist()])


def cut(mean: float, variance: float, bound: float, spread: float, noise: float, *, loose: bool) -> Product:
    """Return what remains of N(MEAN, VARIANCE) given that the value lies below BOUND.

    The distance to BOUND is exponential with mean SPREAD, or when LOOSE says nothing but that it is positive;
    BOUND is read with normal noise of standard deviation NOISE.
    """
    sd = math.sqrt(variance)
    centre = mean if loose else mean + variance / spread
    scales = [(centre, sd), (bound, noise), (bound, spread), (bound, sd)]
    edges = {at + x * by for at, by in scales for x in (-40, -12, -7, -4, -2, -1, 0, 1, 2, 4, 7, 12)}
    top = bound + 12 * noise
    cuts = np.array(sorted(edge for edge in edges if edge <= top))
    half = np.diff(cuts)[:, None] / 2
    u = (cuts[:-1, None] + half * (1 + _POINTS)).ravel()
    weight = (half * _WEIGHTS).ravel()
    distance = bound - u
    log_prior = -((u - mean) ** 2) / (2 * variance) - math.log(sd * math.sqrt(2 * math.pi))
    tilt = 0.0 if loose else 1 / spread
    likely = normal_share(distance / noise - noise * tilt)
    with np.errstate(divide="ignore"):
        log_all = log_prior + np.log(likely) + (noise * tilt) ** 2 / 2 - distance * tilt
    highest = float(log_all.max())
    mass = weight * np.exp(log_all - highest)
    whole = float(mass.sum())
    middle = float((mass * u).sum()) / whole
    variance = float((mass * (u - middle) ** 2).sum()) / whole
    return Product(middle, variance, -math.inf if loose else highest + math.log(whole))
