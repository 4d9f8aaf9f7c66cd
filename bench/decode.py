"""Messages per second of decoding a bus, with a recorded session of real firmware where it is at hand.

Single process, CPU time, best of three. Messages are commands and responses; acknowledgements, of which
there are as many again, are decoded and shown too but not counted.
"""

import contextlib
import io
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import pytest

from canbus_tools.protocol.decoded import Kind
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.dictionaries import DictionarySource
from canbus_tools.protocol.filters import Filter
from canbus_tools.protocol.frame import Frame
from canbus_tools.recordings.candump import candump_line
from canbus_tools.recordings.recordings import read_frames
from canbus_tools.tools.decode import Decoding
from nodes.dictionary.dictionary import Dictionary
from tests.canbus_tools import recorded
from tests.canbus_tools.talk_twin import DICTIONARY, Talk

FRAMES = 250_000


def session() -> tuple[str, list[Frame], dict[int, Dictionary]]:
    """Return a name, frames and dictionaries: the recorded session again and again."""
    try:
        once = recorded.frames(start_s=0.0)
    except pytest.skip.Exception:
        return made_up()
    length_s = once[-1].time_s - once[0].time_s + 1
    rounds = FRAMES // len(once)
    again = [f._replace(time_s=f.time_s + n * length_s, channel="can0") for n in range(rounds) for f in once]
    return "recorded session", again, {}


def streaming() -> tuple[str, list[Frame], dict[int, Dictionary]]:
    """Return a print: blocks full of queue_step, an acknowledgement each."""
    talk, rng = Talk(start_s=0.0, step_s=0.00013), random.Random(1)
    n = 0
    while len(talk.frames) < FRAMES:
        steps = (
            f"queue_step oid={rng.randint(0, 6)} interval={rng.randint(100, 90_000)}"
            f" count={rng.randint(1, 400)} add={rng.randint(-900, 900)}"
            for _ in range(6)
        )
        talk.command(n, *steps).ack(n + 1)
        n += 1
    return "streamed steps", talk.frames, {4: DICTIONARY}


def made_up() -> tuple[str, list[Frame], dict[int, Dictionary]]:
    talk = Talk(start_s=0.0)
    for n in range(FRAMES // 5):
        talk.command(n, "get_clock").response(n + 1, "clock", clock=n * 99_991 % 2**32).ack(n + 1)
    return "made-up queries", talk.frames, {4: DICTIONARY}


def cpu_s(work: Callable[[], object]) -> float:
    best_s = float("inf")
    for _ in range(3):
        start_s = time.process_time()
        work()
        best_s = min(best_s, time.process_time() - start_s)
    return best_s


def measure(name: str, frames: list[Frame], dictionaries: dict[int, Dictionary]) -> None:
    def decode() -> list[str]:
        decoder = BusDecoder(DictionarySource(dictionaries))
        return [said.kind.value for frame in frames for said in decoder.feed(frame)]

    messages = decode().count(Kind.MESSAGE.value)
    figures = [("frames in memory, decoded", cpu_s(decode))]
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "some.log"
        log.write_text("".join(map(candump_line, frames)))
        figures.append(("candump log, only read", cpu_s(lambda: sum(1 for _ in read_frames(log)))))

        def show() -> None:
            with contextlib.redirect_stdout(io.TextIOWrapper(io.BytesIO())):
                Decoding(filter_=Filter(kinds=Kind), dictionaries=dictionaries).run([log])

        figures.append(("candump log to text", cpu_s(show)))
    print(f"{name}: {len(frames)} frames, {messages} messages")
    for what, seconds in figures:
        print(
            f"  {what:<28}{messages / seconds / 1000:8.0f} thousand messages/s"
            f"{len(frames) / seconds / 1000:8.0f} thousand frames/s"
        )


def main() -> None:
    for make in (session, streaming):
        measure(*make())


if __name__ == "__main__":
    main()
