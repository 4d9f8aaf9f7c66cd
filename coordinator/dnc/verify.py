"""Files that are transferred twice and stored only if both copies are identical.

The block check of this protocol is one character, and its blocks have no numbers, so some damage cannot be
detected in one transfer. In two transfers the same damage would have to occur at the same place.
"""

from typing import IO

from coordinator.dnc.endpoint import Sink
from coordinator.dnc.files import FileRefused, Folder, Incoming, read_lines, stored_name
from coordinator.dnc.protocol.blocks import Header

_TEXT = "NOT THE SAME"


class FirstPass:
    """Writes FILE the first time; it gets its name only after the second time. A ``Sink``."""

    is_live = False
    ready = True

    def __init__(self, file: Incoming) -> None:
        self.file = file
        self.name = file.name
        self.size_bytes = 0
        self.came = False
        """Whether all of it was received."""

    def write(self, line: bytes) -> None:
        """See Sink."""
        self.file.write(line)
        self.size_bytes = self.file.size_bytes

    def keep(self) -> None:
        """See Sink."""
        self.came = True

    def drop(self, why: str = "") -> None:
        """See Sink."""
        if not self.came:
            self.file.drop(why)


class Compare:
    """Compares received lines with those of CONTENT, a file called NAME.

    A ``Sink``. KEEPS is stored if all lines are identical; DIFFERS is the advice if they are not.
    """

    is_live = False
    ready = True

    def __init__(
        self, name: str, content: IO[bytes], line_max: int, differs: str, keeps: Incoming | None = None
    ) -> None:
        self.name = name
        self.size_bytes = 0
        self._content = content
        self._lines = read_lines(content, line_max)
        self._count = 0
        self._differs = differs
        self._keeps = keeps

    def write(self, line: bytes) -> None:
        """See Sink."""
        self._count += 1
        self.size_bytes += len(line) + 1
        if next(self._lines, None) != line:
            self._refuse(self._count)

    def keep(self) -> None:
        """See Sink."""
        if next(self._lines, None) is not None:
            self._refuse(self._count + 1)
        self._content.close()
        if self._keeps is not None:
            self._keeps.keep()
            self._keeps = None

    def drop(self, why: str = "") -> None:
        """See Sink."""
        self._content.close()
        if self._keeps is not None:
            self._keeps.drop(why)

    def _refuse(self, line: int) -> None:
        raise FileRefused(
            f"line {line} of {self.name} differs between the two transfers: {self._differs}", _TEXT
        )


class TwoPassFolder:
    """Receives each file of FOLDER twice, one file at a time: another name discards the file before."""

    def __init__(self, folder: Folder, line_max: int) -> None:
        self._folder = folder
        self._line_max = line_max
        self._first: FirstPass | None = None

    def take(self, header: Header) -> Sink:
        """Return the sink for the file of HEADER; raises FileRefused."""
        first, self._first = self._first, None
        if first is not None and first.came and first.name == stored_name(header.code, header.name):
            return Compare(
                first.name,
                first.file.content(),
                self._line_max,
                "one was damaged; both were discarded; send the file twice again",
                keeps=first.file,
            )
        if first is not None:
            first.file.drop()
        self._first = FirstPass(self._folder.take(header.code, header.name))
        return self._first

    @property
    def waits_for(self) -> str | None:
        """Return the name of the file that was received once."""
        first = self._first
        return first.name if first is not None and first.came else None

    def close(self) -> None:
        """Discard a file that was received once."""
        if self._first is not None:
            self._first.file.drop()
            self._first = None
