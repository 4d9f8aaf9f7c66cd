"""The folder of the transferred files: names are checked, and files appear only when complete."""

import contextlib
import errno
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from coordinator.dnc.protocol.blocks import BadText, is_text
from coordinator.support.atomic_file import claim, remove_unfinished
from nodes.support.errors import CanductorError

Check = Callable[[bytes, str], None]
"""Takes a file's content and name; raises CanductorError if the file is not valid."""

SUFFIXES: Final[Mapping[str, str]] = {
    "H": ".h",
    "D": ".nc",
    "L": ".p",
    "S": ".comp",
    "M": ".mp",
    "P": ".plc",
    "T": ".t",
}
"""Suffixes of file names by code, for names of the other side without a suffix."""
SIZE_MAX: Final = 2**30
CHECKED_MAX: Final = 2**24
"""Maximum size in bytes of a file that is validated before it is stored."""
FILES_MAX: Final = 10_000
NAME_MAX: Final = 100
_RESERVED: Final = re.compile(r"(con|prn|aux|nul|clock\$|com\d|lpt\d)(\..*)?", re.IGNORECASE)
_PLAIN: Final = re.compile(r"[^\x00-\x1f\x7f-\uffff/\\:;*?\"<>|]+")
_READ: Final = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_PREFIX: Final = ".dnc-"
_CREATE: Final = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC


class FileRefused(CanductorError):  # noqa: N818
    """A file cannot be received or sent; TEXT is the report for the control, at most 32 capital letters."""

    def __init__(self, sentence: str, text: str) -> None:
        super().__init__(sentence)
        self.text = text


@dataclass(frozen=True, slots=True)
class Entry:
    """A file of the folder."""

    name: str
    size_bytes: int

    @property
    def code(self) -> str:
        """Return the file code that its suffix stands for; D, a program, for any other."""
        suffix = os.path.splitext(self.name)[1].lower()  # noqa: PTH122 (a name, not a path)
        return next((code for code, known in SUFFIXES.items() if known == suffix), "D")


def check_name(name: str) -> str:
    """Return NAME if it is a valid file name; raises FileRefused."""
    if (
        not _PLAIN.fullmatch(name)
        or len(name) > NAME_MAX
        or name[0] in ".- "
        or name[-1] in ". "
        or _RESERVED.fullmatch(name)
    ):
        raise FileRefused(
            f"{name[:NAME_MAX]!a} is not a valid file name: 1 to {NAME_MAX} ASCII characters without"
            ' / \\ : * ? " < > |, not beginning with . or -, and no name that systems reserve',
            "BAD FILE NAME",
        )
    return name


def stored_name(code: str, name: str) -> str:
    """Return the local name of a file that is received as NAME with CODE; raises FileRefused."""
    suffix = SUFFIXES.get(code, "")
    return check_name(check_name(name) if "." in name else check_name(name) + suffix)


class Folder:
    """The files of PATH, without subfolders; links are not followed. PATH is opened once."""

    def __init__(
        self,
        path: Path,
        *,
        overwrite: bool = False,
        newline: bytes = b"\n",
        size_max: int = SIZE_MAX,
        check: Check | None = None,
        checked_codes: str = "S",
    ) -> None:
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise CanductorError(
                f"the folder {path} cannot be opened: {_why(error)}; create it, or use another folder"
            ) from None
        self.path = path
        self.overwrite = overwrite
        self.newline = newline
        self.size_max = size_max
        self._check = check
        self._checked_codes = checked_codes

    def close(self) -> None:
        """Close the folder."""
        os.close(self._fd)

    def files(self) -> list[Entry]:
        """Return the files by name, the first FILES_MAX found."""
        found = []
        with os.scandir(self._fd) as entries:
            for entry in entries:
                with contextlib.suppress(FileRefused, OSError):
                    if entry.is_file(follow_symlinks=False):
                        size = entry.stat(follow_symlinks=False).st_size
                        found.append(Entry(check_name(entry.name), size))
                if len(found) == FILES_MAX:
                    break
        return sorted(found, key=lambda entry: entry.name)

    @property
    def free_bytes(self) -> int:
        """Return the free space of the disk in bytes."""
        status = os.fstatvfs(self._fd)
        return status.f_bavail * status.f_frsize

    def open(self, code: str, name: str) -> tuple[str, IO[bytes]]:
        """Return name and content of the file that a header requests; raises FileRefused."""
        known = {entry.name for entry in self.files()}
        wanted = (name, name + SUFFIXES.get(code, ""))
        found = next((w for w in wanted if w in known), None)
        if found is None:
            found = next((k for k in sorted(known) if k.lower() in {w.lower() for w in wanted}), None)
        if found is None:
            raise FileRefused(f"there is no file {name!a} in {self.path}", "NO SUCH FILE")
        try:
            fd = os.open(found, _READ, dir_fd=self._fd)
        except OSError as error:
            raise FileRefused(
                f"{found} in {self.path} cannot be read: {_why(error)}", "FILE NOT READABLE"
            ) from None
        if not stat.S_ISREG(os.fstat(fd).st_mode):
            os.close(fd)
            raise FileRefused(f"{found} in {self.path} is not a file", "NO SUCH FILE")
        return found, os.fdopen(fd, "rb")

    def take(self, code: str, name: str) -> "Incoming":
        """Create a file that is received; raises FileRefused."""
        stored = stored_name(code, name)
        status = self._status(stored)
        if status is not None and not stat.S_ISREG(status.st_mode):
            raise FileRefused(f"{stored} in {self.path} exists and is not a file", "NAME IN USE")
        if status is not None and not self.overwrite:
            raise FileRefused(
                f"{stored} exists in {self.path} already; use another name, or give --overwrite",
                "FILE EXISTS",
            )
        check = self._check if code in self._checked_codes else None
        return Incoming(self, self._fd, stored, check)

    def _status(self, name: str) -> os.stat_result | None:
        try:
            return os.stat(name, dir_fd=self._fd, follow_symlinks=False)
        except FileNotFoundError:
            return None


class Incoming:
    """A file that is received: ``keep`` brings it to the disk and gives it its name."""

    is_live = False
    ready = True

    def __init__(self, folder: Folder, fd: int, name: str, check: Check | None) -> None:
        self.name = name
        self.size_bytes = 0
        self._folder = folder
        self._folder_fd = fd
        self._check = check
        remove_unfinished(folder.path, _PREFIX)
        self._partial = f"{_PREFIX}{secrets.token_hex(8)}.part"
        try:
            self._file = os.fdopen(os.open(self._partial, _CREATE, 0o644, dir_fd=fd), "wb")
            claim(self._file.fileno())
        except OSError as error:
            raise FileRefused(
                f"no file can be created in {folder.path}: {_why(error)}; use another folder", "DISK ERROR"
            ) from None

    def write(self, line: bytes) -> None:
        """Add a line; raises CanductorError."""
        data = line + self._folder.newline
        self.size_bytes += len(data)
        limit = CHECKED_MAX if self._check is not None else self._folder.size_max
        if self.size_bytes > limit:
            raise FileRefused(f"{self.name} is longer than {limit:,} bytes", "FILE TOO LONG")
        try:
            self._file.write(data)
        except OSError as error:
            raise self._disk_error(error) from None

    def content(self) -> IO[bytes]:
        """Return what was received so far; raises FileRefused."""
        try:
            self._file.flush()
            return os.fdopen(os.open(self._partial, _READ, dir_fd=self._folder_fd), "rb")
        except OSError as error:
            raise FileRefused(f"{self.name} cannot be read again: {_why(error)}", "DISK ERROR") from None

    def keep(self) -> None:
        """Check the file and give it its name; raises CanductorError, and then the file is removed."""
        try:
            self._file.flush()
            os.fsync(self._file.fileno())
            if self._check is not None:
                with self.content() as content:
                    self._check(content.read(CHECKED_MAX), self.name)
            self._file.close()
            self._show()
            os.fsync(self._folder_fd)
        except FileExistsError:
            self.drop()
            raise FileRefused(
                f"{self.name} was created in {self._folder.path} in the meantime; it was not overwritten",
                "FILE EXISTS",
            ) from None
        except OSError as error:
            self.drop()
            raise self._disk_error(error) from None
        except CanductorError:
            self.drop()
            raise

    def drop(self, why: str = "") -> None:  # noqa: ARG002 (other sinks report it)
        """Discard the file; without effect after ``keep``."""
        with contextlib.suppress(OSError):
            self._file.close()
        with contextlib.suppress(OSError):
            os.unlink(self._partial, dir_fd=self._folder_fd)

    def _disk_error(self, error: OSError) -> FileRefused:
        return FileRefused(
            f"{self.name} cannot be written: {_why(error)}; free some space, or use another folder",
            "DISK ERROR",
        )

    def _show(self) -> None:
        names = {"src_dir_fd": self._folder_fd, "dst_dir_fd": self._folder_fd}
        if self._folder.overwrite:
            os.rename(self._partial, self.name, **names)  # noqa: PTH104 (in an open folder)
            return
        try:
            os.link(self._partial, self.name, **names, follow_symlinks=False)
        except OSError as error:
            if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.EMLINK):
                raise
            # No hard links on this disk: an empty file reserves the name, which fails if it exists.
            os.close(os.open(self.name, _CREATE, 0o644, dir_fd=self._folder_fd))
            os.rename(self._partial, self.name, **names)  # noqa: PTH104 (likewise)
            return
        os.unlink(self._partial, dir_fd=self._folder_fd)


def read_lines(content: IO[bytes], line_max: int) -> Iterator[bytes]:
    """Yield lines without LF or CR LF; holds one at a time. Raises BadText, OSError."""
    number = 0
    while line := content.readline(line_max + 3):
        number += 1
        bare = line.removesuffix(b"\n").removesuffix(b"\r") if line.endswith(b"\n") else line
        if len(bare) > line_max:
            raise BadText(f"line {number} is longer than {line_max} characters, the limit of a block")
        yield bare


def check_lines(content: IO[bytes], name: str, line_max: int, data_bits: int) -> int:
    """Return how many lines CONTENT has if all can be sent, and go back to its start; raises BadText."""
    number = 0
    for number, line in enumerate(read_lines(content, line_max), 1):
        if b"\r" in line or not is_text(line, data_bits):
            odd = next(c for c in line if c < 0x20 or c == 0x7F or (data_bits == 7 and c > 0x7F))
            raise BadText(
                f"line {number} of {name} has the character {odd:02X} hex, which"
                f" {'does not fit into 7 bits; use the frame 8N1' if odd > 0x7F else 'no block can carry'}"
            )
    content.seek(0)
    return number


def _why(error: OSError) -> str:
    return (error.strerror or str(error)).lower()
