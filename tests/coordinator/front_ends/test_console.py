"""Standard output of a service, where nobody reads it, or where it is closed."""

import os
import select
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import pytest

from coordinator.front_ends.console import Console
from coordinator.front_ends.writing_thread import WAITING_MAX

PIPE_BYTES_MAX = 1 << 20
LINE = "x" * 500


@pytest.fixture
def pipe() -> Iterator[tuple[int, TextIO]]:
    """Yield the end of a pipe that reads, and a stream that writes to the other one."""
    reads, writes = os.pipe()
    with os.fdopen(writes, "w", encoding="ascii") as stream:
        yield reads, stream
    os.close(reads)


def test_who_says_something_does_not_wait_for_who_reads(pipe: tuple[int, TextIO]) -> None:
    reads, stream = pipe
    console = Console(stream)
    said = 3 * WAITING_MAX + PIPE_BYTES_MAX // len(LINE)
    for number in range(said):
        console.show(f"{number}\x1b[2J \u00fc {LINE}")
    numbers, left_out, rest = list[int](), 0, b""
    while len(numbers) + left_out < said:
        *lines, rest = (rest + os.read(reads, 1 << 16)).split(b"\n")
        for line in map(bytes.decode, lines):
            if line.endswith(f"?[2J ? {LINE}"):
                numbers.append(int(line.partition("?")[0]))
            else:
                left_out += int(line.removesuffix(" entries were left out here: nobody read them"))
    assert numbers == sorted(set(numbers))
    assert left_out > 0
    console.close()


def test_its_end_does_not_wait_for_who_reads(pipe: tuple[int, TextIO]) -> None:
    reads, stream = pipe
    console = Console(stream)
    for _ in range(PIPE_BYTES_MAX // len(LINE)):
        console.show(LINE)
    select.select([reads], [], [])
    console.close(wait_s=0.0)
    for _ in range(PIPE_BYTES_MAX // len(LINE)):
        print(LINE, file=stream, flush=True)  # as the report of a command, after its service
    assert os.read(reads, 1 << 16).decode("ascii").startswith(LINE)


def test_a_closed_output_is_no_mistake(tmp_path: Path) -> None:
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes, "w", encoding="utf-8") as stream:
        console = Console(stream)
        console.show("nobody reads this")
        console.close()
    with (tmp_path / "output").open("w", encoding="utf-8") as stream:
        console = Console(stream)
        console.show("somebody\nreads\tthis")
        console.close()
    assert (tmp_path / "output").read_text(encoding="utf-8") == "somebody\nreads\tthis\n"
    console = Console(None)
    console.show("there is none")
    console.close()
