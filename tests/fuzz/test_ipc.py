"""A short run of what fuzz_ipc.py does for long, without its coverage guidance.

IPC_FUZZ_SECONDS=600 runs it for so long, with a seed that is new each time, and watches memory.
"""

import os
import random
import resource
import time

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.ipc_target import REQUESTS, SEEDS, line, packed, run_session
from tests.profiles import examples

cuts = st.integers(0, 2**31 - 1)
plain = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary()
values = st.recursive(plain, lambda v: st.lists(v, max_size=4) | st.dictionaries(st.text(), v, max_size=4))
short = settings(max_examples=examples(120), suppress_health_check=list(HealthCheck))


@short
@given(st.binary(max_size=600), cuts)
def test_any_bytes(data: bytes, cut: int) -> None:
    run_session(data, cut)
    run_session(b"{" + data, cut)


@short
@given(st.lists(st.sampled_from(REQUESTS), max_size=40), st.booleans(), cuts)
def test_any_requests(requests: list[dict[str, object]], as_json: bool, cut: int) -> None:
    run_session(b"".join(map(line if as_json else packed, [REQUESTS[1], *requests])), cut)


@settings(short, max_examples=examples(50))
@given(st.dictionaries(st.sampled_from(["id", "method", "params", "x"]), values), cuts)
def test_any_values(message: dict[str, object], cut: int) -> None:
    run_session(packed(REQUESTS[1]) + packed({"method": "quick"} | message), cut)
    run_session(packed(REQUESTS[1]) + packed({"id": 1, "method": "quick", "params": message}), cut)


def mutated(chance: random.Random) -> bytes:
    data = bytearray(chance.choice(SEEDS))
    for _ in range(chance.randrange(1, 8)):
        at = chance.randrange(len(data) + 1)
        match chance.randrange(4):
            case 0:
                data[at : at + 1] = bytes([chance.randrange(256)])
            case 1:
                del data[at : at + chance.randrange(1, 20)]
            case 2:
                data[at:at] = data[chance.randrange(len(data) + 1) :][: chance.randrange(1, 40)]
            case _:
                data[at:at] = chance.randbytes(chance.randrange(1, 8))
    return bytes(data)


def test_mutated_sessions() -> None:
    seconds = float(os.environ.get("IPC_FUZZ_SECONDS", "0"))
    seed = int(time.time()) if seconds else 1
    chance = random.Random(seed)
    until = time.monotonic() + seconds
    runs, settled_kib = 0, 0
    while runs < 1500 or time.monotonic() < until:
        run_session(mutated(chance), chance.randrange(2**31))
        runs += 1
        if runs == 1500:
            settled_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    grown_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - settled_kib
    assert grown_kib < 4096, f"grew by {grown_kib} KiB in {runs} runs of seed {seed}"


def test_every_beginning_of_a_sound_session_is_sound() -> None:
    for data in SEEDS:
        for end in range(0, len(data) + 1, 7):
            run_session(data[:end])
