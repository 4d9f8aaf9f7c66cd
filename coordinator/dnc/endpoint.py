"""Files of a transfer: received into a folder or a machine, sent from a folder, listed in the directory."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum, auto
from typing import IO, Final, Protocol

from coordinator.dnc.files import FileRefused, Folder, check_lines, read_lines
from coordinator.dnc.protocol import events
from coordinator.dnc.protocol.blocks import INPUT, Header
from coordinator.dnc.protocol.engine import Engine, State
from coordinator.dnc.protocol.listing import Listing, read_listing, write_listing
from nodes.support.errors import CanductorError


class Pause(Enum):
    """Result of a source that has no line yet."""

    NOT_YET = auto()


NOT_YET: Final = Pause.NOT_YET


class Source(Protocol):
    """Provides the lines to send."""

    def next_line(self) -> bytes | Pause | None:
        """Return a line, NOT_YET, or None at the end; raises CanductorError."""

    def close(self) -> None:
        """Release it."""


class Sink(Protocol):
    """Takes the lines that are received."""

    name: str
    size_bytes: int
    is_live: bool
    """Whether ``ready`` must be polled, also while no line arrives."""

    @property
    def ready(self) -> bool:
        """Whether there is room for another line; raises CanductorError when no more lines are accepted."""
        ...

    def write(self, line: bytes) -> None:
        """Take a line; raises CanductorError."""

    def keep(self) -> None:
        """Complete the file; raises CanductorError."""

    def drop(self, why: str = "") -> None:
        """Discard it, for the reason WHY; without effect after ``keep``."""


class FileSource:
    """The lines of an open file."""

    def __init__(self, content: IO[bytes], line_max: int) -> None:
        self._content = content
        self._lines: Iterator[bytes] = read_lines(content, line_max)

    def next_line(self) -> bytes | None:
        """See Source."""
        try:
            return next(self._lines, None)
        except OSError as error:
            raise CanductorError(f"reading the file failed: {error}") from None

    def close(self) -> None:
        """See Source."""
        self._content.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """The result of one transfer."""

    did: str
    """received, sent, listed, failed."""
    name: str = ""
    code: str = ""
    lines: int = 0
    size_bytes: int = 0
    sentence: str = ""
    """Why it failed."""
    confirmed: bool = False
    """Sent: the other side confirmed the whole file."""
    listing: Listing | None = None

    @property
    def ok(self) -> bool:
        """Whether it did not fail."""
        return self.did != "failed"


Take = Callable[[Header], Sink]
"""Returns the sink for the file of a header; raises FileRefused."""
Give = Callable[[Header], tuple[str, Source]]
"""Returns name and lines of the file that a header requests; raises CanductorError."""


class Endpoint:
    """Handles an engine's events. Without TAKE or GIVE, requests of the other side for it are refused."""

    def __init__(
        self,
        engine: Engine,
        *,
        take: Take | None = None,
        give: Give | None = None,
        folder: Folder | None = None,
    ) -> None:
        self._engine = engine
        self._take = take
        self._give = give
        self._folder = folder
        self._sink: Sink | None = None
        self._source: Source | None = None
        self._name = ""
        """Of the current transfer's file: the requested name, and the local name once the file is open."""
        self._why = ""
        self._waits_for_line = False
        """The source has no line yet."""

    @property
    def needs_polling(self) -> bool:
        """Whether ``go_on`` must be called periodically."""
        return self._waits_for_line or (self._sink is not None and self._sink.is_live)

    def begin(self, header: Header) -> None:
        """Control: fetch or send the file of HEADER; raises CanductorError."""
        if header.mode == INPUT:
            self._open_sink(header)
            self._engine.fetch(header.code, header.name)
        else:
            self._open_source(header)
            self._engine.send(header.code, header.name)

    def handle(self, event: events.Event) -> Outcome | None:
        """Handle EVENT; return the result of a transfer that it ended."""
        outcome = self._act(event)
        if outcome is not None:
            self._name = ""  # the next event does not belong to that file
        return outcome

    def _act(self, event: events.Event) -> Outcome | None:
        match event:
            case events.Asked(header=header):
                self._asked(header)
            case events.DirectoryAsked():
                self._send_directory()
            case events.LineWanted():
                self.go_on()
            case events.Line(text=text):
                self._line(text)
            case events.Ended():
                return self._ended()
            case events.Sent(confirmed=confirmed):
                return self._sent(confirmed=confirmed)
            case events.Directory(text=text):
                return self._listed(text)
            case events.Failed(sentence=sentence):
                return self._failed(sentence)
        return None

    def go_on(self) -> None:
        """Send the next line if there is one; accept the next line if there is room."""
        if self._sink is not None:
            self._check_room(self._sink)
            return
        if self._engine.state is not State.LINE_WANTED or self._source is None:
            self._waits_for_line = False
            return
        if self._engine.held:
            self._waits_for_line = True
            return
        try:
            line = self._source.next_line()
            self._waits_for_line = line is NOT_YET
            if line is None:
                self._engine.give_end()
            elif isinstance(line, bytes):
                self._engine.give_line(line)
        except CanductorError as error:
            self._end_with(error)

    def _check_room(self, sink: Sink) -> None:
        try:
            if sink.ready and self._engine.state is State.LINE_GIVEN:
                self._engine.line_taken()
        except CanductorError as error:
            if self._engine.state in (State.RECEIVING, State.LINE_GIVEN):
                self._end_with(error)

    def close(self, why: str = "") -> None:
        """Discard what is not complete, for the reason WHY."""
        if self._sink is not None:
            self._sink.drop(why)
        if self._source is not None:
            self._source.close()
        self._sink = self._source = None
        self._waits_for_line = False

    # --------------------------------------------------------------------------------------------- acts

    def _asked(self, header: Header) -> None:
        self.close()
        self._why = ""
        self._name = header.name
        try:
            if header.mode == INPUT:
                self._open_source(header)
            else:
                self._open_sink(header)
        except CanductorError as error:
            self._end_with(error)
        else:
            self._engine.accept()

    def _open_sink(self, header: Header) -> None:
        if self._take is None:
            raise FileRefused(
                "the other side wanted to send a file, but no files are accepted here", "NO INPUT"
            )
        self._sink = self._take(header)
        self._name = self._sink.name

    def _open_source(self, header: Header) -> None:
        if self._give is None:
            raise FileRefused("the other side asked for a file, but no files are provided here", "NO OUTPUT")
        self._name, self._source = self._give(header)

    def _line(self, text: bytes) -> None:
        assert self._sink is not None
        try:
            self._sink.write(text)
            ready = self._sink.ready
        except CanductorError as error:
            self._end_with(error)
        else:
            if ready:
                self._engine.line_taken()

    def _end_with(self, error: CanductorError) -> None:
        """End the transfer because of an error of this side."""
        self._why = str(error)
        if self._engine.is_peripheral:
            self._engine.refuse(error.text if isinstance(error, FileRefused) else "ERROR IN FILE")
        else:
            self._engine.fail(self._why)

    def _ended(self) -> Outcome | None:
        assert self._sink is not None
        sink = self._sink
        try:
            sink.keep()
        except CanductorError as error:
            self._engine.fail(str(error))
            return None
        self._sink = None
        lines = self._engine.lines
        self._engine.file_kept()
        return Outcome(
            did="received", name=sink.name, code=self._code, lines=lines, size_bytes=sink.size_bytes
        )

    def _sent(self, *, confirmed: bool) -> Outcome | None:
        if self._source is None:
            return None  # the directory
        self.close()
        return Outcome(
            did="sent", name=self._name, code=self._code, lines=self._engine.lines, confirmed=confirmed
        )

    def _listed(self, text: bytes) -> Outcome:
        try:
            return Outcome(did="listed", listing=read_listing(text))
        except CanductorError as error:
            return Outcome(did="failed", sentence=str(error))

    def _failed(self, sentence: str) -> Outcome:
        why, self._why = self._why or sentence, ""
        self.close(why)
        return Outcome(did="failed", name=self._name, code=self._code, lines=self._engine.lines, sentence=why)

    def _send_directory(self) -> None:
        self.close()
        self._name = self._why = ""
        if self._folder is None or self._give is None:
            self._end_with(
                FileRefused(
                    "the other side asked for the directory, but there is no directory here", "NO DIRECTORY"
                )
            )
        else:
            self._engine.give_directory(write_listing(self._folder.files(), self._folder.free_bytes))

    @property
    def _code(self) -> str:
        return "" if self._engine.header is None else self._engine.header.code


class Library:
    """Provides the files of a folder; a header without a name requests the next one of its code."""

    def __init__(self, folder: Folder, engine: Engine) -> None:
        self._folder = folder
        self._engine = engine
        self._next = 0

    def give(self, header: Header) -> tuple[str, Source]:
        """See Give."""
        options = self._engine.options
        name = header.name or self._next_name(header.code)
        if not name:
            return "", _Nothing()
        found, content = self._folder.open(header.code, name)
        line_max = options.block_max - 2
        try:
            check_lines(content, found, line_max, options.frame.data_bits)
        except BaseException:
            content.close()
            raise
        return found, FileSource(content, line_max)

    def _next_name(self, code: str) -> str:
        """Return the next file's name; after the last one, none, and then the first again."""
        names = [entry.name for entry in self._folder.files() if entry.code == code]
        at, self._next = self._next, self._next + 1
        if at >= len(names):
            self._next = 0
            return ""
        return names[at]


class _Nothing:
    """A source without lines, which follows the last file."""

    def next_line(self) -> None:
        """See Source."""

    def close(self) -> None:
        """See Source."""
