"""A short run of what fuzz_interpreter.py does for long, without its coverage guidance."""

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.interpreter_target import SEEDS, TOKENS, run_program
from tests.profiles import examples

words = st.lists(st.sampled_from(TOKENS) | st.binary(max_size=4), max_size=6).map(b" ".join)
programs = st.lists(words, max_size=30).map(lambda lines: b"G28\n" + b"\n".join(lines))


@settings(max_examples=examples(120), suppress_health_check=[HealthCheck.too_slow])
@given(programs | st.binary(max_size=400))
def test_no_program_does_harm(text: bytes) -> None:
    run_program(text)


def test_beginnings_of_a_sound_program_are_sound() -> None:
    for seed in SEEDS:
        for end in range(0, len(seed) + 1, 3):
            run_program(seed[:end])
