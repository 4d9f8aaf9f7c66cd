"""Errors of a configuration: the place first, then what is wrong, then what to do."""

from dataclasses import dataclass

from nodes.support.errors import CanductorError


@dataclass(frozen=True, slots=True)
class Place:
    """A line of a configuration file; prints as ``printer.cfg:12``."""

    path: str
    """The file as the user would type it, not resolved."""
    line: int
    """Counted from 1; 0: the file as a whole."""

    def __str__(self) -> str:
        return f"{self.path}:{self.line}" if self.line else self.path


class ConfigError(CanductorError):
    """A configuration that cannot be used; the sentence begins with the file and line."""

    def __init__(self, place: Place, sentence: str) -> None:
        super().__init__(f"{place}: {sentence}")
        self.place = place
        """Where the mistake stands, for front ends that mark the line."""


class NotSupported(ConfigError):  # noqa: N818 (no mistake: the configuration is right)
    """What an option asks for is known, but nothing acts on it yet; its reader leaves it out and lists it."""

    def __init__(self, place: Place, reason: str) -> None:
        super().__init__(place, reason)
        self.reason = reason


class MissingSection(ConfigError):  # noqa: N818 (what is wrong, as the others)
    """There is no section NAME, without which nothing that follows can be read."""

    def __init__(self, path: str, name: str, why: str = "") -> None:
        super().__init__(Place(path, 0), f"there is no section [{name}]; add it{why and ': '}{why}")
        self.name = name
