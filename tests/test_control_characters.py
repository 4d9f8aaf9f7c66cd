"""Control characters of files, clients and wires never reach a terminal, a log or the page."""

import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.cli.main import main
from coordinator.gcode.events import Notice, Reply
from coordinator.gcode.parser import parse
from coordinator.ipc.protocol.methods import ApiError, shown
from coordinator.klippy_api.wire import error_message
from coordinator.service.state.log_ring import LogRing
from coordinator.support import quoting
from coordinator.support.progress import Progress, ProgressDisplay
from coordinator.support.report import PlainReport
from nodes.support.errors import CanductorError
from nodes.support.svg_chart import escape
from nodes.support.terminal import printable, printable_lines, show
from tests.profiles import examples

ROOT: Final = Path(__file__).parent.parent
ODD: Final = "a\x1b[2J\x07\x9b31m\u202eb\x7f\r\udcff\u2028c"
"""Clears a screen, rings, colours, turns the direction, deletes, returns; half a character."""
WRITES: Final = re.compile(r"(?<![\w.])print\(|\b(stdout|stderr)\.(write|writelines)\(|\bprint_exc\(")
EXAMPLES: Final = {"canbus_tools/bus/bus_load.py", "coordinator/ipc/server/auth.py"}
"""Have calls in texts for people."""


def is_clean(text: str) -> bool:
    return all(c.isprintable() or c in "\n\t" for c in text)


def log_line(text: str) -> str:
    entries: list[str] = []
    LogRing(lambda entry: entries.append(str(entry["text"]))).add("notice", text)
    return entries[0]


def plain_progress(text: str) -> str:
    stream, now_s = io.StringIO(), iter((0.0, 100.0))
    display = ProgressDisplay(text, quiet=True, stderr=stream, clock_s=lambda: next(now_s))
    with display:
        display.update(Progress(done=1, total=2))
    return stream.getvalue()


def shown_text(text: str) -> str:
    stream = io.StringIO()
    show(text, stream)
    return stream.getvalue()


def display_text(text: str) -> str:
    command = parse(f"M117 {text}".encode(errors="surrogatepass"))
    assert command is not None
    return command.text


WAYS_OUT: Final[dict[str, Callable[[str], str]]] = {
    "error sentence": lambda text: str(CanductorError(text)),
    "answer to a client of ours": lambda text: ApiError("failed", text).sentence,
    "answer to Moonraker": lambda text: json.loads(error_message(1, text)[:-1])["error"]["message"],
    "log": log_line,
    "reply": lambda text: Reply(1, text).text,
    "notice": lambda text: Notice(1, text).text,
    "terminal": shown_text,
    "progress": plain_progress,
    "text of M117": display_text,
    "chart": escape,
    "quoted value": shown,
    "quoted word": quoting.shown,
    "quoted path": quoting.shown_path,
    "name": printable,
}


@pytest.mark.parametrize("way_out", WAYS_OUT)
def test_no_control_character_gets_out(way_out: str) -> None:
    """Failed before for the error sentence, both answers, log, reply, notice, terminal, progress and M117."""
    found = WAYS_OUT[way_out](ODD)
    assert is_clean(found), ascii(found)
    assert "a" in found
    assert found.encode(), "half a character would end the program"


@settings(max_examples=examples(50))
@given(st.text())
def test_what_is_printable_stays(text: str) -> None:
    for clean in (printable(text), printable_lines(text)):
        assert len(clean) == len(text)
        assert all(after in (before, "?") for before, after in zip(text, clean, strict=True))
        assert is_clean(clean)
    assert printable(text).isprintable()


@pytest.mark.parametrize("as_json", [False, True])
def test_the_command_line_shows_none(capsys: pytest.CaptureFixture[str], *, as_json: bool) -> None:
    """Failed before, and half a character was reported as a bug of ours."""

    def fail() -> PlainReport:
        raise CanductorError(f"there is no file {ODD}")

    for run in (fail, lambda: PlainReport({"file": ODD}, f"printed {ODD}")):
        main(["x", "--json"] if as_json else ["x"], lambda _, run=run: run)  # type: ignore[misc]
        written = capsys.readouterr()
        assert is_clean(written.out + written.err), ascii(written)
        assert "internal error" not in written.err


def test_one_file_writes_to_terminals() -> None:
    files = [
        path for name in ("coordinator", "nodes", "canbus_tools") for path in (ROOT / name).rglob("*.py")
    ]
    found = {str(path.relative_to(ROOT)) for path in files if WRITES.search(path.read_text())}
    assert found - EXAMPLES == set()


def test_the_page_takes_text_as_text() -> None:
    markup = re.compile(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(")
    scripts = list((ROOT / "coordinator/web").rglob("*.js"))
    assert scripts
    assert not [path.name for path in scripts if markup.search(path.read_text())]
