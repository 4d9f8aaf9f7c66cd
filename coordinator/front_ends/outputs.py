"""What a command prints while a machine moves: an output that is full, closed or unread does not stop it."""

import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from typing import TextIO

from coordinator.front_ends.console import Console
from nodes.support.terminal import OutputError, discard


class _ConsoleStream(io.TextIOBase):
    """Has a Console write to STREAM what is written to this one."""

    def __init__(self, stream: TextIO) -> None:
        self.console = Console(stream)
        self._stream = stream

    @property
    def encoding(self) -> str:  # type: ignore[override]  # a class written in C has it
        return self._stream.encoding

    def write(self, text: str, /) -> int:
        self.console.show_as_it_is(text)
        return len(text)

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()


@contextmanager
def outputs_in_threads() -> Iterator[None]:
    """Have threads write what the block prints on standard output and standard error.

    At the end of the block that is waited for; where the block raises, for a moment only. If standard output
    did not take all of it, BrokenPipeError or OutputError is raised then, as by ``show``.
    """
    output, errors = _ConsoleStream(sys.stdout), _ConsoleStream(sys.stderr)
    try:
        with redirect_stdout(output), redirect_stderr(errors):
            yield
    except BaseException:
        output.console.close()
        errors.console.close()
        raise
    output.console.close(None)
    errors.console.close(None)
    if (failure := output.console.failure) is not None:
        if isinstance(failure, BrokenPipeError):
            raise failure
        discard(sys.stdout)
        raise OutputError.of(failure)


def is_behind(stream: TextIO) -> bool:
    """Return whether something waits until what was written to STREAM before is read."""
    return isinstance(stream, _ConsoleStream) and stream.console.is_behind
