"""Commands of a stepper as rows: every step at the clock at which the firmware makes it."""

import asyncio
import itertools
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

import nodes.virtual
from coordinator.klippy_api.step_dump import StepReader
from nodes.dictionary.dictionary import Dictionary

FOLDER: Final = Path(nodes.virtual.__file__).parent / "bin"
DICTIONARY: Final = Dictionary.from_json((FOLDER / "canductor-node-uart.json").read_bytes())
OID: Final = 3
ROLLOVER: Final = 1 << 32


def batch(*commands: str, due: int) -> bytes:
    encoded = (DICTIONARY.encode_text(command) for command in commands)
    return b"".join(struct.pack("=QQB", 0, due, len(content)) + content for content in encoded)


def queue(interval: int, count: int, add: int, oid: int = OID) -> str:
    return f"queue_step oid={oid} interval={interval} count={count} add={add}"


def direction(*, pin: bool) -> str:
    return f"set_next_step_dir oid={OID} dir={int(pin)}"


def read(reader: StepReader, content: bytes, steps: int) -> list[list[int]]:
    return asyncio.run(reader.read([content], steps))


def clocks(begin: int, rows: list[list[int]]) -> Iterator[tuple[int, int]]:
    """Yield clock and direction of every step of ROWS."""
    for interval, count, add in rows:
        for step in range(abs(count)):
            begin += interval + add * step
            yield begin, 1 if count > 0 else -1


@pytest.mark.parametrize("inverted", [False, True])
def test_steps_over_rests_turns_and_the_rollover_of_the_clock(inverted: bool) -> None:
    reader = StepReader(DICTIONARY, OID, inverted=inverted)
    start = 7 * ROLLOVER - 500
    content = batch(
        f"reset_step_clock oid={OID} clock={start % ROLLOVER}",
        direction(pin=not inverted),
        queue(300, 4, 50),
        queue(9, 9, 9, oid=OID + 1),
        direction(pin=inverted),
        queue(1000, 2, -10),
        due=start + 100,
    )
    rows = read(reader, content, 2)
    forth = [start + 300, start + 650, start + 1050, start + 1500]
    back = [forth[-1] + 1000, forth[-1] + 1990]
    assert list(clocks(0, rows)) == [(at, 1) for at in forth] + [(at, -1) for at in back]
    assert reader.clock == back[-1]
    again = read(reader, batch(queue(5, 1, 70), queue(6, 2, 0), due=back[-1]), -3)
    assert list(clocks(back[-1], again)) == [(back[-1] + 5, -1), (back[-1] + 11, -1), (back[-1] + 17, -1)]


@pytest.mark.parametrize(("steps", "signs"), [(3, [1, -1]), (-7, [-1, -1])])
def test_a_direction_set_before_follows_from_where_the_steps_lead(steps: int, signs: list[int]) -> None:
    reader = StepReader(DICTIONARY, OID, inverted=False)
    reader.begin(1_000_000)
    rows = read(reader, batch(queue(100, 5, 0), direction(pin=False), queue(100, 2, 0), due=1_000_000), steps)
    assert [row[1] for row in rows] == [5 * signs[0], 2 * signs[1]]
    assert reader.clock == 1_000_700


def test_a_direction_once_found_holds() -> None:
    reader = StepReader(DICTIONARY, OID, inverted=False)
    found = [read(reader, batch(queue(100, 5, 0), due=0), steps) for steps in (-5, 99)]
    assert [row[1] for row in itertools.chain(*found)] == [-5, -5]
