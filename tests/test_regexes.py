"""Regular expressions that see texts of others take time in proportion to the text.

Two repeats side by side that match the same characters divide a text in every way before they fail: that
takes the square of its length. So does a repeat behind ``^`` that goes on over the ends of lines.
"""

import importlib
import pkgutil
import re
from collections.abc import Iterator
from re import _constants as op  # type: ignore[attr-defined]
from re import _parser as parser  # type: ignore[attr-defined]
from typing import Any, Final

import coordinator

ELSEWHERE: Final = {
    "coordinator.config.pins": "options of the owner",
    "coordinator.config.sections.kinematics.generic_cartesian": "options of the owner",
    "coordinator.planning.node_dictionaries": "options and comments of the owner",
}
REPEATS: Final = (op.MAX_REPEAT, op.MIN_REPEAT)
LONG: Final = 100
"""Repeats that end sooner cost a factor, not a power."""


def regexes() -> Iterator[tuple[str, "re.Pattern[Any]"]]:
    """Return the regular expressions of all modules, with their names."""
    for found in pkgutil.walk_packages(coordinator.__path__, "coordinator."):
        if found.name in ELSEWHERE or found.name.endswith("__main__"):
            continue
        for name, value in vars(importlib.import_module(found.name)).items():
            if isinstance(value, re.Pattern):
                yield f"{found.name}.{name}", value


def matches(item: Any, flags: int) -> frozenset[str]:
    """Return the ASCII characters that ITEM, one character of a pattern, matches."""
    one = re.compile("x", flags & ~re.UNICODE | re.ASCII)
    tree = parser.parse("x", one.flags)
    tree.data = [item]
    compiled = re._compiler.compile(tree, one.flags)  # type: ignore[attr-defined]
    return frozenset(c for c in map(chr, range(128)) if compiled.fullmatch(c))


def squares(items: Any, flags: int, before: frozenset[str] = frozenset()) -> tuple[bool, frozenset[str]]:
    """Return whether two repeats in ITEMS match the same, and what the open repeat at its end matches.

    BEFORE is what a repeat in front of ITEMS matches, with nothing needed in between.
    """
    for kind, value in items:
        if kind in REPEATS:
            low, high, inner = value
            if high >= LONG and len(inner) == 1 and inner[0][0] not in (op.SUBPATTERN, op.BRANCH):
                found = matches(inner[0], flags)
                if found & before:
                    return True, before
                before = found | (frozenset() if low else before)
                continue
            bad, after = squares(inner, flags, before)
            before = after if low else after | before
        elif kind is op.SUBPATTERN:
            bad, before = squares(value[-1], flags, before)
        elif kind is op.BRANCH:
            each = [squares(branch, flags, before) for branch in value[1]]
            bad, before = any(bad for bad, _ in each), frozenset().union(*(after for _, after in each))
        elif kind in (op.AT, op.ASSERT, op.ASSERT_NOT):
            continue
        else:
            bad, before = False, frozenset()
        if bad:
            return True, before
    return False, before


def crosses_lines(items: Any, flags: int) -> bool:
    """Return whether ITEMS begin at each line with a repeat that goes on in the next."""
    if not flags & re.MULTILINE or not items or items[0] != (op.AT, op.AT_BEGINNING):
        return False
    kind, value = items[1]
    return kind in REPEATS and len(value[2]) == 1 and "\n" in matches(value[2][0], flags)


def is_slow(pattern: "re.Pattern[Any]") -> bool:
    """Return whether PATTERN may take the square of a text's length."""
    text = pattern.pattern.decode("latin-1") if isinstance(pattern.pattern, bytes) else pattern.pattern
    flags = pattern.flags & ~re.UNICODE
    items = list(parser.parse(text, flags))
    return squares(items, flags)[0] or crosses_lines(items, flags)


def test_the_check_knows_both_kinds() -> None:
    for slow in (r"(?m)^\s*M112", r"\s*/?\s*N", r"(\d*\.?\d+|\d+\.)", r"a+(b?a+)c", r"(?i)\w+[0-9]*$"):
        assert is_slow(re.compile(slow)), slow
    for quick in (r"(?m)^[ \t]*M112", r"\s*(?:/\s*)?N", r"(\d+(?:\.\d*)?|\.\d+)", r"\s*0\s+B", r"\d{1,9}\d+"):
        assert not is_slow(re.compile(quick)), quick


def test_no_text_takes_the_square_of_its_length() -> None:
    """Failed before: M112 in scripts of the Klippy API, block numbers of DNC, shapers, tables."""
    found = dict(regexes())
    assert "coordinator.service.core.work._EMERGENCY_LINE" in found
    assert [name for name, pattern in found.items() if is_slow(pattern)] == []
