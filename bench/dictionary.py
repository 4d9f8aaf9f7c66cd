"""Messages per second through the dictionary: decoding, encoding from arguments and from text.

And how long reading a dictionary takes, which the control loop waits for: a small one, the largest valid one.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path

from nodes.dictionary.dictionary import MAX_INFLATED_BYTES, Dictionary
from nodes.dictionary.parts import MAX_ENUMERATION_NAMES, MAX_MESSAGES

ROUNDS = 100_000
READS = 20


def per_second(work: Callable[[], object]) -> float:
    best_s = float("inf")
    for _ in range(3):
        start_s = time.perf_counter()
        for _ in range(ROUNDS):
            work()
        best_s = min(best_s, time.perf_counter() - start_s)
    return ROUNDS / best_s


def largest() -> bytes:
    """Return a dictionary with as much in it as one may have."""
    words = "".join(f" p{number}=%u" for number in range(14))
    commands = {f"c{number}{words}": number for number in range(2, MAX_MESSAGES)}
    names = {"pin": {"P0": [0, MAX_ENUMERATION_NAMES]}}
    text = json.dumps({"commands": commands, "enumerations": names}).encode()
    return text + b" " * (MAX_INFLATED_BYTES - len(text))


def read_ms(text: bytes) -> float:
    """Return how long the dictionary TEXT is read at best."""
    taken_s = []
    for _ in range(READS):
        start_s = time.perf_counter()
        Dictionary.from_json(text)
        taken_s.append(time.perf_counter() - start_s)
    return min(taken_s) * 1e3


def main() -> None:
    text = (Path(__file__).parents[1] / "tests" / "data" / "dictionary.json").read_bytes()
    dictionary = Dictionary.from_json(text)
    clock = dictionary.responses["clock"].encode({"clock": 123456789})
    stats = dictionary.responses["stats"].encode({"count": 174, "sum": 123207, "sumsq": 1390393})
    pong = dictionary.responses["pong"].encode({"data": bytes(40)})
    step: dict[str, int] = {"oid": 7, "interval": 40562, "count": 14, "add": -80}
    words = "queue_step oid=7 interval=40562 count=14 add=-80"
    for name, work in (
        ("decode clock", lambda: dictionary.decode(clock)),
        ("decode stats", lambda: dictionary.decode(stats)),
        ("decode pong of 40 bytes", lambda: dictionary.decode(pong)),
        ("encode queue_step", lambda: dictionary.encode("queue_step", **step)),
        ("encode queue_step from text", lambda: dictionary.encode_text(words)),
    ):
        print(f"{name:<30}{per_second(work) / 1000:8.0f} thousand messages/s")
    print(f"{'a small dictionary is read':<30}{read_ms(text):8.1f} ms")
    print(f"{'the largest dictionary is read':<30}{read_ms(largest()):8.1f} ms")


if __name__ == "__main__":
    main()
