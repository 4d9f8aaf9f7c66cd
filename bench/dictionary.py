"""Messages per second through the dictionary: decoding, encoding from arguments and from text."""

import time
from collections.abc import Callable
from pathlib import Path

from nodes.dictionary.dictionary import Dictionary

ROUNDS = 100_000


def per_second(work: Callable[[], object]) -> float:
    best_s = float("inf")
    for _ in range(3):
        start_s = time.perf_counter()
        for _ in range(ROUNDS):
            work()
        best_s = min(best_s, time.perf_counter() - start_s)
    return ROUNDS / best_s


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


if __name__ == "__main__":
    main()
