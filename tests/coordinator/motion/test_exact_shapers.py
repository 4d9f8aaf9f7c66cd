"""The shapers do what they are for: a vibration at their frequency is left small or not at all."""

import cmath
import itertools
import math

import pytest

from coordinator.motion.steps.shapers import shaper_impulses
from coordinator.verification.exact_shapers import KINDS, TOLERANCE, impulses
from nodes.support.errors import CanductorError

LEFT = {"zv": 0.0, "mzv": 0.0, "zvd": 0.0, "ei": TOLERANCE, "2hump_ei": 0.0, "3hump_ei": TOLERANCE}


def vibration_left(kind: str, designed_hz: float, actual_hz: float, damping: float) -> float:
    """Return the vibration after the last impulse as a share of that after a single impulse there."""
    shaped = impulses(kind, designed_hz, damping)
    w = 2 * math.pi * actual_hz
    pole = complex(-damping * w, w * math.sqrt(1 - damping**2))
    end = shaped[-1][1]
    # Of a single impulse at the begin as much is left as has not decayed meanwhile.
    total = sum(a * cmath.exp(pole * (end - t)) for a, t in shaped)
    return abs(total) / math.exp(pole.real * (end - shaped[0][1]))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("frequency", [25.0, 50.0, 90.0])
def test_the_vibration_at_the_shapers_frequency_is_gone(kind: str, frequency: float) -> None:
    shaped = impulses(kind, frequency, 0.0)
    assert sum(a for a, _ in shaped) == pytest.approx(1)
    assert sum(a * t for a, t in shaped) == pytest.approx(0, abs=1e-15)
    assert all(a > 0 for a, _ in shaped)
    assert vibration_left(kind, frequency, frequency, 0.0) == pytest.approx(LEFT[kind], abs=2e-3)
    damped = vibration_left(kind, frequency, frequency, 0.1)
    assert damped <= (1e-9 if kind in {"zv", "mzv", "zvd"} else 2 * TOLERANCE)


def forgiven_hz(kind: str) -> float:
    """Return how far the frequency may rise above 50 Hz before more than the tolerance is left."""
    rise = 0.0
    while vibration_left(kind, 50.0, 50.0 + rise, 0.0) <= TOLERANCE + 2e-3:
        rise += 0.1
    return rise


def test_more_impulses_forgive_a_wrong_frequency() -> None:
    rises = [forgiven_hz(kind) for kind in KINDS]
    assert rises == sorted(rises), dict(zip(KINDS, rises, strict=True))
    assert len(set(rises)) == len(KINDS)


@pytest.mark.parametrize("kind", ["ei", "2hump_ei", "3hump_ei"])
@pytest.mark.parametrize("tolerance", [0.02, 0.15])
def test_a_shaper_lets_through_what_it_is_asked_to(kind: str, tolerance: float) -> None:
    """The engine's impulses, by the oracle's figure; with two humps the tolerance is not in the middle."""
    written = f"{kind}(v_tol={tolerance:g})"
    ours = shaper_impulses(written, 50.0, 0.1)
    for mine, other in zip(ours, impulses(written, 50.0, 0.1), strict=True):
        assert mine == pytest.approx(other)
    left = [vibration_left(written, 50.0, 50.0 + rise / 10, 0.0) for rise in range(250)]
    hump = next(here for here, beyond in itertools.pairwise(left) if beyond < here)
    assert hump == pytest.approx(tolerance, rel=0.1)
    assert shaper_impulses(f"{kind}(v_tol=0.05)", 50.0, 0.1) == shaper_impulses(kind, 50.0, 0.1)


@pytest.mark.parametrize(
    "written", ["ei(v_tol=0)", "ei(v_tol=0.6)", "zv(v_tol=0.1)", "ei(x=1)", "ei(", "who"]
)
def test_what_is_no_shaper_is_refused(written: str) -> None:
    with pytest.raises(CanductorError):
        shaper_impulses(written, 50.0, 0.1)
