"""Bounded reading of configuration files: whatever a path names, memory and time stay small."""

import fnmatch
import os
from dataclasses import dataclass, field
from pathlib import Path

from coordinator.config.errors import ConfigError, Place
from coordinator.support.quoting import shown_path
from nodes.support.regular_file import read_regular

MAX_FILES = 200
MAX_BYTES = 2_000_000
MAX_DEPTH = 16
MAX_DIRECTORY_ENTRIES = 20_000
_WILDCARDS = "*?["


@dataclass(slots=True)
class ReadBudget:
    """What one configuration may still read; shared by a file and all it includes."""

    files: int = MAX_FILES
    bytes: int = MAX_BYTES
    directory_entries: int = MAX_DIRECTORY_ENTRIES
    open_files: list[tuple[int, int]] = field(default_factory=list)
    """Device and inode of the files that are being read now, outermost first: a repeat is a cycle."""


def read_lines(path: str, place: Place, budget: ReadBudget) -> list[str]:
    """Return the lines of a UTF-8 text file, without their ends.

    place: where the file was asked for, named in errors about the file itself. Raises ConfigError.
    """
    return split_lines(read_bytes(path, place, budget), path)


def split_lines(data: bytes, path: str) -> list[str]:
    """Return the lines of DATA, which the file PATH holds; raises ConfigError."""
    if (nul := data.find(b"\0")) >= 0:
        raise ConfigError(Place(path, data.count(b"\n", 0, nul) + 1), "a NUL byte: this is not a text file")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        where = Place(path, data.count(b"\n", 0, error.start) + 1)
        raise ConfigError(
            where, f"byte 0x{data[error.start]:02x} is not UTF-8 text; save the file as UTF-8"
        ) from None
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def read_bytes(path: str, place: Place, budget: ReadBudget) -> bytes:
    """Return what a regular file holds; raises ConfigError."""
    if budget.files < 1:
        raise ConfigError(place, f"more than {MAX_FILES} files are included")
    try:
        data = read_regular(path, budget.bytes + 1)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not a valid path"
        raise ConfigError(place, f"cannot read {shown_path(path)}: {reason}") from None
    take_bytes(data, place, budget)
    return data


def take_bytes(data: bytes, place: Place, budget: ReadBudget) -> None:
    """Count DATA as one more file that was read; raises ConfigError where all is too large then."""
    budget.files -= 1
    budget.bytes -= len(data)
    if budget.bytes < 0:
        raise ConfigError(place, f"the configuration is larger than {MAX_BYTES // 1_000_000} MB in all")


def enter_file(path: str, place: Place, budget: ReadBudget) -> None:
    """Note that a file is being read; raises ConfigError for a cycle or too deep a nesting."""
    try:
        status = Path(path).stat()
    except (OSError, ValueError):
        identity = (-1, -1)  # read_lines reports the reason
    else:
        identity = (status.st_dev, status.st_ino)
        if identity in budget.open_files:
            raise ConfigError(place, f"{shown_path(path)} includes itself")
    if len(budget.open_files) >= MAX_DEPTH:
        raise ConfigError(place, f"files are included more than {MAX_DEPTH} deep")
    budget.open_files.append(identity)


def included_paths(pattern: str, place: Place, budget: ReadBudget) -> list[str]:
    """Expand the pattern of an ``[include …]`` relative to the file it stands in, sorted by name.

    A pattern with wildcards may match nothing; a plain name must exist (reading it reports that).
    """
    base = str(Path(place.path).parent / pattern)
    if not any(c in pattern for c in _WILDCARDS):
        return [base]
    found = [Path(base).anchor]
    for part in Path(base).relative_to(found[0]).parts:
        found = [path for folder in found for path in _step(folder, part, place, budget)]
    return sorted(path for path in found if _is_file(path))


def _is_file(path: str) -> bool:
    try:
        return Path(path).is_file()
    except OSError:  # a name too long to exist
        return False


def _step(folder: str, part: str, place: Place, budget: ReadBudget) -> list[str]:
    """Return what one part of a pattern matches in one folder.

    Own code instead of glob, because a pattern over a large tree must end after a known number of entries.
    """
    if not any(c in part for c in _WILDCARDS):
        return [str(Path(folder) / part)]
    names = []
    try:
        with os.scandir(folder or ".") as entries:
            for entry in entries:
                budget.directory_entries -= 1
                if budget.directory_entries < 0:
                    raise ConfigError(
                        place, "the pattern searches too many files; name the files more closely"
                    )
                hidden = entry.name.startswith(".") and not part.startswith(".")
                if not hidden and fnmatch.fnmatchcase(entry.name, part):
                    names.append(str(Path(folder) / entry.name))
    except OSError:
        return []  # no such folder: nothing matches
    return names
