"""One change of one place in a source file."""

from dataclasses import dataclass
from pathlib import PurePath


@dataclass(frozen=True, slots=True, order=True)
class Mutation:
    """In FILE the bytes from START to END become REPLACEMENT; lines below keep their numbers."""

    file: str
    start: int
    end: int
    replacement: str
    original: str
    """The text that is replaced."""
    line: int
    """Counted from 1."""
    source_line: str
    """The text of this line, without the blanks around it."""
    above: str = ""
    """The text of the line above it, likewise."""
    occurrence: int = 1
    """Which of several equal texts in its line it replaces, counted from 1."""

    def applied(self, source: bytes) -> bytes:
        """Return SOURCE with the change made."""
        if source[self.start : self.end] != self.original.encode():
            raise ValueError(f"{self.file}:{self.line}: the source is not the one that was parsed")
        lost = self.original.count("\n") - self.replacement.count("\n")
        return source[: self.start] + self.replacement.encode() + b"\n" * lost + source[self.end :]

    @property
    def change(self) -> str:
        """Return the change as equivalent.toml names it: "< -> <=", with its number when not the first."""
        number = f" ({self.occurrence})" if self.occurrence > 1 else ""
        return f"{_short(self.original)} -> {_short(self.replacement) or 'nothing'}{number}"

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.change}    | {self.source_line}"

    @property
    def is_c(self) -> bool:
        """Whether FILE is written in C."""
        return PurePath(self.file).suffix in {".c", ".h"}


@dataclass(frozen=True, slots=True)
class Place:
    """A stretch of bytes and what may stand there instead."""

    start: int
    end: int
    replacements: tuple[str, ...]


def mutations(file: str, source: bytes, places: list[Place]) -> list[Mutation]:
    """Return the mutations that PLACES of SOURCE allow, in their order, none twice."""
    found: dict[tuple[int, int, str], Mutation] = {}
    for place in sorted(places, key=lambda p: (p.start, p.end)):
        original = source[place.start : place.end].decode()
        line_start = source.rfind(b"\n", 0, place.start) + 1
        line_end = source.find(b"\n", place.start)
        source_line = source[line_start : line_end if line_end >= 0 else len(source)].decode().strip()
        before = sum(
            p.end <= place.start and p.start >= line_start and _same(source, p, place) for p in places
        )
        for replacement in place.replacements:
            if replacement != original:
                found[place.start, place.end, replacement] = Mutation(
                    file,
                    place.start,
                    place.end,
                    replacement,
                    original,
                    source.count(b"\n", 0, place.start) + 1,
                    source_line,
                    source[:line_start].decode().rstrip("\n").rpartition("\n")[2].strip(),
                    before + 1,
                )
    return list(found.values())


def _same(source: bytes, one: Place, other: Place) -> bool:
    return source[one.start : one.end] == source[other.start : other.end]


def _short(text: str) -> str:
    return " ".join(text.split())
