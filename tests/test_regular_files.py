"""Files that others may have replaced: where one is expected, FIFOs, devices and folders hold nothing up."""

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from canbus_tools.protocol.dictionaries import read_dictionary
from coordinator.config.file import parse_config
from coordinator.front_ends.log_file import LogFile
from coordinator.ipc.server.auth import Tokens
from coordinator.modules.programs.save_variables import read_variables
from coordinator.planning import node_dictionaries
from coordinator.service.jobs.history import JobHistory
from coordinator.service.jobs.journal import Journal, read_journal
from coordinator.support.file_writer import FileWriter
from coordinator.tables.store import TableStore
from coordinator.web.session_file import read_sessions
from nodes.support.errors import CanductorError
from nodes.support.option_values import regular_file
from nodes.support.regular_file import open_regular
from nodes.support.secret_file import BYTES_MAX, read_secret

pytestmark = pytest.mark.timeout(60)


def read_history(path: Path) -> list[object]:
    """Return the jobs in the history at PATH."""
    history = JobHistory(pytest.fail, FileWriter())
    history.open(path)
    return [*history.jobs]


def load_tables(path: Path) -> list[str]:
    """Return what is wrong with the table at PATH, but for that it is one."""
    _, problems = TableStore(path.parent).load()
    return [problem for problem in problems if "no kept table" not in problem]


READERS: Final[dict[str, Callable[[Path], object]]] = {
    "journal": read_journal,
    "history": read_history,
    "sessions of the page": read_sessions,
    "tokens": Tokens.read,
    "variables": read_variables,
    "configuration": lambda path: parse_config(str(path)),
    "table": load_tables,
    "dictionary": read_dictionary,
    "dictionary of a plan": node_dictionaries._read_dictionary,
    "option": regular_file,
    "opener": open_regular,
}


@pytest.mark.parametrize("kind", ["fifo", "device", "folder"])
@pytest.mark.parametrize("reader", READERS)
def test_no_reader_waits(tmp_path: Path, reader: str, kind: str) -> None:
    """Those of a FIFO waited for ever, in the start of a service; those of a device filled the memory."""
    path = tmp_path / "x.table.json"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")
    if reader in ("journal", "history", "table"):
        assert not READERS[reader](path)
        return
    with pytest.raises((CanductorError, OSError)) as refused:
        READERS[reader](path)
    assert "regular file" in str(refused.value) or kind == "folder"


@pytest.mark.parametrize("spoiled", ["x" * 256, "file/x", "loop/x"])
@pytest.mark.parametrize("reader", READERS)
def test_a_path_that_cannot_be_looked_at_is_no_bug(tmp_path: Path, reader: str, spoiled: str) -> None:
    """Nor is a folder that may not be entered."""
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to("loop")
    read, path = READERS[reader], tmp_path / spoiled / "x.table.json"
    if reader == "table":
        assert "cannot be read" in str(read(path))
    elif reader in ("journal", "history") or (reader == "sessions of the page" and spoiled == "file/x"):
        assert not read(path)
    else:
        with pytest.raises(OSError if reader == "opener" else CanductorError):
            read(path)


def test_a_secret_is_not_read_without_end(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    with path.open("wb") as file:
        file.truncate(BYTES_MAX)
    path.chmod(0o600)
    assert len(read_secret(path, "the tokens' file")[0]) == BYTES_MAX
    os.truncate(path, 1 << 40)  # a hole: takes no room
    with pytest.raises(CanductorError, match="has more than 1000000 bytes"):
        read_secret(path, "the tokens' file")


@pytest.mark.parametrize("replaced", [False, True])
def test_a_log_file_that_is_a_fifo_is_reported(tmp_path: Path, *, replaced: bool) -> None:
    """Its thread waited for a reader, and the service for its thread."""
    path, failures = tmp_path / "canductor.log", list[str]()
    if replaced:
        before = LogFile(path, failures.append)
        before.add(lambda: "before")
        before.close(None)
        path.unlink()
    os.mkfifo(path)
    log = LogFile(path, failures.append)
    log.add(lambda: "a line")
    log.close(None)
    assert failures == [f"the log file {path} cannot be written: not a regular file"]


def test_a_disk_that_does_not_answer_does_not_keep_a_service_from_ending(tmp_path: Path) -> None:
    answers = threading.Event()

    def wait(_: str) -> None:
        answers.wait()

    log, journal = LogFile(tmp_path / "none" / "log", wait), Journal(tmp_path / "none" / "journal", wait)
    log.add(lambda: "a line")
    journal.begin("part.gcode", 1, 1)
    log.close()
    journal.close()
    answers.set()
