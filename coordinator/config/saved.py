"""Values that the machine calibrated, written into the marked block at the end of the user's file.

The file is replaced in one step or not at all, and what the user wrote stays as it is, byte for byte.
"""

import codecs
import errno
import re
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from coordinator.config.errors import ConfigError
from coordinator.config.file import SAVED_HEADER, SAVED_PREFIX, parse_saved, saved_header
from coordinator.config.text import split_lines
from coordinator.support.atomic_file import replace_content
from coordinator.support.quoting import shown, shown_path
from nodes.support.errors import CanductorError

NOTICE: Final = "DO NOT EDIT THIS BLOCK OR BELOW. The machine writes it; its values override those above."
_SAVED_SECTION = re.compile(re.escape(SAVED_PREFIX) + r" ?\[([^\[\]]+)\]\s*")
_ENDS = re.compile(rb"\r\n|\r|\n")
_WAYS_OUT: Final = {
    errno.ENOSPC: "free some space on its disk",
    errno.EDQUOT: "free some space: your quota of its disk is used up",
    errno.EIO: "check its disk",
}
"""What to do, by errno."""

Values = Mapping[str, Mapping[str, str]]
"""Options as text, by section."""


class SaveError(CanductorError):
    """What is to be saved cannot be written; the file is as it was."""


@dataclass(frozen=True, slots=True)
class ConfigSource:
    """A configuration file as it was read."""

    path: str
    data: bytes
    """All of it, without what it includes."""
    saved: Values
    """What its block says."""
    load: Callable[[str, bytes], object]
    """Loads the configuration as if the file, by its path, held other bytes; raises ConfigError."""


def checked(section: str, options: Mapping[str, str]) -> dict[str, str]:
    """Return OPTIONS as a file has them; raises SaveError for what no file can hold.

    It takes 10 ms for a text of 100,000 characters; in any thread.
    """
    found = {
        option.lower(): "\n".join(line.strip() for line in text.strip().split("\n"))
        for option, text in options.items()
    }
    _check({" ".join(section.split()): found})
    return found


class PendingConfig:
    """What modules want saved, until it is written."""

    def __init__(self, source: ConfigSource | None) -> None:
        self._source = source
        self._pending: dict[str, dict[str, str]] = {}
        self._removed: set[str] = set()

    @property
    def pending(self) -> Values:
        """What would be written, by section; nothing of a section that would be removed."""
        return self._pending | {section: {} for section in sorted(self._removed)}

    def put(self, section: str, option: str, text: str) -> None:
        """Keep a value until ``write``; raises SaveError for one that no file can hold."""
        self.put_checked(section, checked(section, {option: text}))

    def put_checked(self, section: str, options: Mapping[str, str]) -> None:
        """Keep what ``checked`` returned."""
        section = " ".join(section.split())
        self._pending.setdefault(section, {}).update(options)
        self._removed.discard(section)

    def remove(self, section: str) -> None:
        """Have SECTION left out of the block; raises SaveError where it does not come from the block."""
        section = " ".join(section.split())
        if self._source is not None and section in self._source.saved:
            self._removed.add(section)
        elif section not in self._pending:
            raise SaveError(f"[{section}] was not saved by the machine: remove it from the file by hand")
        self._pending.pop(section, None)

    def write(self) -> str:
        """Write all into the file and return its path. Not for the control loop: it loads the configuration.

        Nothing is pending afterwards, and what was written counts as read. Raises SaveError, also for values
        that the next start would refuse.
        """
        source = self._source
        if source is None:
            raise SaveError("nothing can be saved: this machine does not come from a file")
        merged = {section: dict(options) for section, options in source.saved.items()}
        for section in self._removed:
            del merged[section]
        for section, options in self._pending.items():
            merged.setdefault(section, {}).update(options)
        data = with_block(source.data, merged)
        _check_loads(source, data)
        replace_file(source.path, source.data, data)
        self._source = replace(source, data=data, saved=merged)
        self._pending = {}
        self._removed = set()
        return source.path


def _check_loads(source: ConfigSource, data: bytes) -> None:
    """Raise SaveError unless the machine of SOURCE can start with DATA as its file."""
    try:
        source.load(source.path, data)
    except CanductorError as error:
        raise SaveError(
            f"nothing was saved, because the machine could not start with it: {error}; then calibrate again,"
            " or drop what was calibrated with RESTART"
        ) from None


def with_block(data: bytes, values: Values) -> bytes:
    """Return the file DATA with VALUES as its block, instead of the one that it has; raises SaveError."""
    _check(values)
    own = _without_block(data)
    first = _ENDS.search(own)
    end = first[0] if first else b"\n"
    if own and not own.endswith((b"\r", b"\n")) and own != codecs.BOM_UTF8:
        own += end
    lines = block_lines(values, _written_sections(data))
    return own + b"".join(line.encode() + end for line in lines)


def block_lines(values: Values, written: Mapping[str, list[str]] | None = None) -> list[str]:
    """Return the block's lines, without their ends.

    WRITTEN: lines of sections as the block has them now; they stay as they are where they say the same.
    """
    lines = [SAVED_HEADER, f"{SAVED_PREFIX} {NOTICE}"]
    for section, options in values.items():
        lines.append(SAVED_PREFIX)
        before = (written or {}).get(section)
        if before is not None and _read({section: before}).get(section) == options:
            lines += before
            continue
        lines.append(f"{SAVED_PREFIX} [{section}]")
        for option, text in options.items():
            first, *rest = text.split("\n")
            lines.append(f"{SAVED_PREFIX} {option} = {first}".rstrip())
            lines += [f"{SAVED_PREFIX}   {line}".rstrip() for line in rest]
    return lines


def _read(sections: Mapping[str, list[str]]) -> Values:
    """Return what SECTIONS say, by their lines in a block; nothing if they cannot be read."""
    try:
        return parse_saved("", [SAVED_HEADER, *(line for lines in sections.values() for line in lines)])
    except ConfigError:
        return {}


def _written_sections(data: bytes) -> dict[str, list[str]]:
    """Return the lines of each section of the block of DATA, but for sections that it has in pieces."""
    lines = split_lines(data, "")
    found: dict[str, list[str]] = {}
    twice: set[str] = set()
    current: list[str] = []
    for line in lines[saved_header(lines) + 1 :]:
        header = _SAVED_SECTION.fullmatch(line)
        if header is not None:
            name = " ".join(header[1].split())
            twice |= {name} & found.keys()
            current = found[name] = [line]
        elif line.startswith(SAVED_PREFIX):
            current.append(line)
    for section in found.values():
        while section[-1].removeprefix(SAVED_PREFIX).strip() == "":
            del section[-1]
    return {name: section for name, section in found.items() if name not in twice}


def _without_block(data: bytes) -> bytes:
    """Return what stands before the block."""
    lines = split_lines(data, "")
    at = saved_header(lines)
    if at == len(lines):
        return data
    mark = len(codecs.BOM_UTF8) if data.startswith(codecs.BOM_UTF8) else 0  # belongs to no line
    ends = [mark, *(match.end() for match in _ENDS.finditer(data))]
    return data[: ends[at]]


def _check(values: Values) -> None:
    """Raise SaveError unless reading VALUES as they are written gives the same again."""
    for section, options in values.items():
        for option, text in options.items():
            one = {section: {option: text}}
            try:
                data = "\n".join(block_lines(one)).encode()
                found = parse_saved("", split_lines(data, ""))
            except (ConfigError, UnicodeEncodeError):
                found = {}
            if found != one:
                raise SaveError(
                    f"{shown(option)} of [{section}] cannot be saved as {shown(text)}: reading it again would"
                    " not give the same; the module that saves it has to write it otherwise"
                )


# ------------------------------------------------------------------------------------------------ the file


def replace_file(path: str, before: bytes, after: bytes) -> None:
    """Give the file PATH, which holds BEFORE, the content AFTER, in one step; raises SaveError.

    Its mode stays; of a symbolic link the file that it leads to is replaced.
    """
    try:
        file = Path(path)
        # AFTER: an earlier attempt failed when all but its last step was done.
        if not stat.S_ISREG(file.stat().st_mode) or file.read_bytes() not in (before, after):
            raise SaveError(
                f"{shown_path(path)} has changed since it was read, so nothing was saved; RESTART reads it"
                " again, then calibrate again"
            )
        replace_content(file, after)
    except OSError as error:
        way_out = _WAYS_OUT.get(error.errno or 0, "make the file and its folder writable")
        raise SaveError(f"cannot write {shown_path(path)}: {error.strerror or error}; {way_out}") from None
