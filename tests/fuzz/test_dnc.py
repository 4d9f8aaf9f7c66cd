"""A short run of what fuzz_dnc.py does for long, without its coverage guidance.

DNC_FUZZ_SECONDS=600 runs it for so long, with a seed that is new each time.
"""

import os
import random
import time

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.dnc_target import PIECES, run_engine
from tests.profiles import examples

choices = st.integers(0, 2**31 - 1)
short = settings(max_examples=examples(150), suppress_health_check=list(HealthCheck))


@short
@given(st.binary(max_size=400), choices)
def test_any_bytes(data: bytes, choice: int) -> None:
    run_engine(data, choice)


@short
@given(st.lists(st.sampled_from(PIECES), max_size=30), choices)
def test_any_signs(pieces: list[bytes], choice: int) -> None:
    run_engine(b"".join(pieces), choice)


def mutated(chance: random.Random) -> bytes:
    data = bytearray(b"".join(chance.choices(PIECES, k=chance.randrange(1, 25))))
    for _ in range(chance.randrange(6)):
        at = chance.randrange(len(data) + 1)
        match chance.randrange(3):
            case 0:
                data[at : at + 1] = bytes([chance.randrange(256)])
            case 1:
                del data[at : at + chance.randrange(1, 9)]
            case _:
                data[at:at] = chance.randbytes(chance.randrange(1, 8))
    return bytes(data)


def test_mutated_talks() -> None:
    seconds = float(os.environ.get("DNC_FUZZ_SECONDS", "0"))
    seed = int(time.time()) if seconds else 1
    chance = random.Random(seed)
    until = time.monotonic() + seconds
    runs = 0
    while runs < 250 or time.monotonic() < until:
        data, choice = mutated(chance), chance.randrange(2**31)
        try:
            run_engine(data, choice)
        except Exception as error:
            raise AssertionError(f"run_engine({data!r}, {choice}) of seed {seed}: {error!r}") from error
        runs += 1
