"""The console's prompt: line editing, history and completion by prompt_toolkit."""

import asyncio
import signal
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from prompt_toolkit import PromptSession
from prompt_toolkit.auto_suggest import AutoSuggestFromHistory
from prompt_toolkit.completion import CompleteEvent, Completer, Completion
from prompt_toolkit.document import Document
from prompt_toolkit.history import FileHistory, History, InMemoryHistory
from prompt_toolkit.patch_stdout import patch_stdout
from prompt_toolkit.shortcuts import print_formatted_text

from canbus_tools.console.parser import complete
from canbus_tools.console.session import Quit, Session
from nodes.support.errors import CanductorError

HISTORY_BYTES_MAX: Final = 1 << 20
"""A longer history is moved to a second file, and a new one is started."""


class SessionCompleter(Completer):
    """Completes by the node's dictionary."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def get_completions(self, document: Document, complete_event: CompleteEvent) -> Iterable[Completion]:
        """Yield what can come next."""
        del complete_event
        line = document.text_before_cursor
        for found in complete(self._session.dictionary, self._session.known_names(), line):
            yield Completion(found.text, -found.replaces, display_meta=found.note)


async def prompt(session: Session, history_file: Path) -> None:
    """Read and carry out lines until /quit or Ctrl-D."""
    asked: PromptSession[str] = PromptSession(
        history=_history(history_file),
        completer=SessionCompleter(session),
        complete_while_typing=True,
        auto_suggest=AutoSuggestFromHistory(),
    )
    with patch_stdout():
        print_formatted_text(_banner(session))
        while True:
            try:
                line = await asked.prompt_async(f"{session.talk.nodeid or 'uart'}> ")
                await _run(session, line)
            except KeyboardInterrupt:
                continue  # drops the line, as a shell does
            except (EOFError, Quit):
                return
            except CanductorError as error:
                print_formatted_text(f"! {error}")


async def _run(session: Session, line: str) -> None:
    """Carry out a line; Ctrl-C ends it."""
    loop = asyncio.get_running_loop()
    task = loop.create_task(session.run(line))
    before = signal.getsignal(signal.SIGINT)
    loop.add_signal_handler(signal.SIGINT, task.cancel)
    try:
        await task
    except asyncio.CancelledError:
        if not task.cancelled():
            raise
        raise KeyboardInterrupt from None
    finally:
        loop.remove_signal_handler(signal.SIGINT)
        signal.signal(signal.SIGINT, before)


def _banner(session: Session) -> str:
    words = session.dictionary
    return (
        f"node {session.talk.name}: {words.constants.get('MCU', 'MCU unknown')}, firmware {words.version},"
        f" {len(words.commands)} commands\n"
        "Tab completes, /list shows what there is, /help helps, /quit ends"
    )


def _history(path: Path) -> History:
    """Return the lines of earlier sessions; none are kept where that is impossible."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and path.stat().st_size > HISTORY_BYTES_MAX:
            path.replace(path.with_suffix(".old"))
        path.touch(mode=0o600)
    except OSError:
        return InMemoryHistory()
    return FileHistory(path)
