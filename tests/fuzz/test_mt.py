"""A short run of what fuzz_mt.py does for long, without its coverage guidance."""

import random

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nodes.mt.mt import to_bytes, transmission
from tests.fuzz.mt_target import run_receivers
from tests.profiles import examples

short = settings(max_examples=examples(200), suppress_health_check=list(HealthCheck))


@short
@given(st.binary(max_size=400))
def test_any_bytes(data: bytes) -> None:
    run_receivers(data)


def test_damaged_transmissions() -> None:
    """Byte streams of a sound transmission with bytes changed, lost and doubled."""
    chance = random.Random(1)
    for _ in range(150):
        pairs = [(chance.randint(-5, 5), chance.randint(-5, 5)) for _ in range(chance.randrange(6))]
        stream = bytearray(to_bytes(transmission(pairs, [1 + chance.randrange(3)])))
        for _ in range(chance.randrange(4)):
            at = chance.randrange(len(stream))
            match chance.randrange(3):
                case 0:
                    stream[at] = chance.randrange(256)
                case 1:
                    del stream[at]
                case _:
                    stream[at:at] = stream[at : at + 4]
        records = b"".join(b"\0\x08" + stream[at : at + 8] for at in range(0, len(stream) - 8, 8))
        run_receivers(bytes((chance.randrange(3), chance.randrange(12))) + records)
