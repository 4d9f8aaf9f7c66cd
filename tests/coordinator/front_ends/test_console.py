"""Standard output of a service, where nobody reads it, or where it is closed."""

import asyncio
import os
import select
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import pytest

from coordinator.front_ends.console import Console, asyncio_reports_to
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


def test_a_report_of_a_bug_does_not_hold_the_loop(pipe: tuple[int, TextIO]) -> None:
    """asyncio would write it to standard error itself, and wait where nobody reads that."""
    reads, stream = pipe
    console, text = Console(stream), "x" * PIPE_BYTES_MAX

    async def main() -> None:
        loop = asyncio.get_running_loop()
        for _ in range(3):
            loop.call_soon(_fail, text)
            await asyncio.sleep(0)

    with asyncio_reports_to(console):
        asyncio.run(main())
    seen = b""
    while seen.count(b"ZeroDivisionError") < 3:
        seen += os.read(reads, 1 << 16)
    assert b"Exception in callback _fail(" in seen
    console.close()


def _fail(_: str) -> None:
    raise ZeroDivisionError
