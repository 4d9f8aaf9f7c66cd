"""Output that nothing takes: a full disk, a reader that is gone."""

import os
from pathlib import Path

import pytest

from nodes.support.terminal import OutputError, show, show_error

FULL = Path("/dev/full")


def test_a_full_disk_is_reported_once_and_leaves_nothing_behind() -> None:
    with FULL.open("w") as stream:
        with pytest.raises(OutputError, match="cannot write the output: no space left on device"):
            show("a line", stream)
        show("another", stream)  # and closing the stream, as the interpreter does, raises nothing


def test_errors_are_for_who_reads_them() -> None:
    with FULL.open("w") as stream:
        show_error("a line", stream)
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stream:
        show_error("a line", stream)


def test_a_reader_that_is_gone_is_the_callers_matter() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    stream = os.fdopen(writer, "w")
    with pytest.raises(BrokenPipeError):
        show("a line", stream)
    with pytest.raises(BrokenPipeError):
        stream.close()
