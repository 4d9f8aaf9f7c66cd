"""How a mistake in a configuration is told: the place first, then what is wrong, then what to do."""

from collections.abc import Iterable

from nodes.support.errors import CanductorError
from nodes.support.records import record

_SHOWN_CHARS = 60
_SHOWN_PATH_CHARS = 300


@record
class Place:
    """A line of a configuration file; prints as ``printer.cfg:12``."""

    path: str
    """The file as the user would type it, not resolved."""
    line: int
    """Counted from 1; 0 speaks of the file as a whole."""

    def __str__(self) -> str:
        return f"{self.path}:{self.line}" if self.line else self.path


class ConfigError(CanductorError):
    """A configuration that cannot be used; the sentence begins with the file and line."""

    def __init__(self, place: Place, sentence: str) -> None:
        super().__init__(f"{place}: {sentence}")
        self.place = place
        """Where the mistake stands, for front ends that mark the line."""


class NotActing(ConfigError):  # noqa: N818 (no mistake: the configuration is right)
    """What an option asks for is known, but nothing acts on it yet; its reader leaves it out and lists it."""

    def __init__(self, place: Place, reason: str) -> None:
        super().__init__(place, reason)
        self.reason = reason


class MissingSection(ConfigError):  # noqa: N818 (what is wrong, as the others)
    """There is no section NAME, without which nothing that follows can be read."""

    def __init__(self, path: str, name: str, why: str = "") -> None:
        super().__init__(Place(path, 0), f"there is no section [{name}]; add it{why and ': '}{why}")
        self.name = name


def shown(text: str) -> str:
    """Quote what the user wrote so that it fits into a sentence: one line, printable, not long."""
    line = " ".join(text.split())
    if len(line) > _SHOWN_CHARS:
        line = line[: _SHOWN_CHARS - 1] + "…"
    return "'" + "".join(c if c.isprintable() else "?" for c in line) + "'"


def shown_path(path: str) -> str:
    """Quote a path; of a long one the end is what tells."""
    line = "".join(c if c.isprintable() else "?" for c in path)
    return f"'{line}'" if len(line) <= _SHOWN_PATH_CHARS else f"'…{line[-_SHOWN_PATH_CHARS:]}'"


def nearest(word: str, valid: Iterable[str], *, pattern: str = "{}") -> str:
    """Return "; did you mean …?" when one of the valid names looks like the word, else nothing."""
    if len(word) > _SHOWN_CHARS:
        return ""
    import difflib  # noqa: PLC0415 (start-up time)

    lower = {name.lower(): name for name in valid}
    found = difflib.get_close_matches(word.lower(), lower, n=1, cutoff=0.6)
    return f"; did you mean {pattern.format(lower[found[0]])}?" if found else ""
