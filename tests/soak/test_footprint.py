"""Growth is seen, and what merely swings is none."""

import os

import pytest

from tests.soak.footprint import RSS_GROWTH_MAX_KIB, Footprint, growth, of_process, problems


def samples(rss_step: int = 0, descriptor_step: float = 0, thread_step: float = 0) -> list[Footprint]:
    return [
        Footprint(
            80_000 + (k % 3) * 100 + k * rss_step, 20 + int(k * descriptor_step), 5 + int(k * thread_step)
        )
        for k in range(60)
    ]


def test_this_process_has_a_footprint() -> None:
    before = of_process(os.getpid())
    assert before.rss_kib > 1000
    assert before.threads >= 1
    opened = os.open(os.devnull, os.O_RDONLY)
    try:
        assert of_process(os.getpid()).descriptors == before.descriptors + 1
    finally:
        os.close(opened)


def test_what_swings_does_not_grow() -> None:
    assert growth(samples()) == Footprint(0, 0, 0)
    assert problems("it", samples()) == []


def test_a_start_that_fills_caches_is_no_growth() -> None:
    filling = [Footprint(50_000 + 3000 * k, 10 + k // 2, 3) for k in range(12)]
    assert problems("it", filling + samples()[12:]) == []


@pytest.mark.parametrize(
    ("leaking", "sentence"),
    [
        (samples(rss_step=RSS_GROWTH_MAX_KIB // 30), "memory grew by"),
        (samples(descriptor_step=0.1), "more descriptors are open"),
        (samples(thread_step=0.1), "more threads run"),
    ],
)
def test_a_leak_is_a_problem(leaking: list[Footprint], sentence: str) -> None:
    (problem,) = problems("it", leaking)
    assert sentence in problem


def test_too_few_samples_are_no_proof() -> None:
    with pytest.raises(ValueError, match="too few"):
        growth(samples()[:8])
