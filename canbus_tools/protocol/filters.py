"""Filters: which messages and frames a tool shows."""

import argparse
import re
from collections.abc import Iterable
from fnmatch import translate
from typing import Final

from canbus_tools.protocol.decoded import Decoded, Kind
from canbus_tools.protocol.protocol import Direction
from nodes.support.can_protocol import DATA_NODEID_MAX
from nodes.support.option_values import UsageError, integer, parse_int

ALL: Final = "all"
DEFAULT_KINDS: Final = frozenset(Kind) - {Kind.ACK}


class Filter:
    """Selects what to show. ``None``: everything; as KINDS, everything but acks."""

    def __init__(
        self,
        nodes: Iterable[int] | None = None,
        messages: Iterable[str] | None = None,
        direction: Direction | None = None,
        kinds: Iterable[Kind] | None = None,
    ) -> None:
        self._nodes = None if nodes is None else frozenset(nodes)
        patterns = None if messages is None else "|".join(map(translate, messages))
        self._wanted = None if patterns is None else re.compile(patterns).match
        self._direction = direction
        self._kinds = DEFAULT_KINDS if kinds is None else frozenset(kinds)

    def passes(self, said: Decoded) -> bool:
        """Return whether to show SAID."""
        return (
            said.kind in self._kinds
            and (self._nodes is None or said.nodeid in self._nodes)
            and (self._direction is None or said.direction is self._direction)
            and (self._wanted is None or self._wanted(said.name) is not None)
        )


def read_filter(text: str) -> Filter:
    """Read ``node=4,5 kind=nak dir=to get_* stats``; raises UsageError."""
    nodes: list[int] = []
    kinds: set[Kind] = set()
    messages: list[str] = []
    direction: Direction | None = None
    for word in text.split():
        key, equals, value = word.partition("=")
        if not equals:
            messages.append(word)
        elif key == "node":
            nodes += [parse_int(part, 1, DATA_NODEID_MAX, name="node") for part in value.split(",")]
        elif key == "kind":
            kinds |= _kinds(value)
        elif key in ("dir", "direction") and value in ("to", "from"):
            direction = Direction(value)
        else:
            raise UsageError(f"'{word}' is not a filter; write node=4 kind=nak dir=to (or from) get_*")
    return Filter(nodes or None, messages or None, direction, kinds or None)


def _kinds(value: str) -> set[Kind]:
    words = value.split(",")
    known = [*(kind.value for kind in Kind), ALL]
    if unknown := set(words).difference(known):
        raise UsageError(f"unknown kind '{unknown.pop()}'; the kinds are {', '.join(known)}")
    return set(Kind) if ALL in words else {Kind(word) for word in words}


def declare_filter(command: argparse.ArgumentParser) -> None:
    """Add the options that select what to show."""
    add = command.add_argument
    add(
        "--node",
        type=integer(1, DATA_NODEID_MAX),
        metavar="NODE",
        action="append",
        help="show only this node id; may be repeated",
    )
    add(
        "--message",
        metavar="NAME",
        action="append",
        help="show only messages and frames of this name; * matches any characters; may be repeated",
    )
    add("--direction", choices=("to", "from"), help="show only what is sent to nodes, or only what they send")
    add(
        "--kind",
        choices=(*(kind.value for kind in Kind), ALL),
        action="append",
        help="show only this kind; may be repeated (default: all but ack)",
    )


def given_filter(given: argparse.Namespace) -> str:
    """Return the options of ``declare_filter`` as the text that ``read_filter`` reads; raises UsageError."""
    for name in given.message or ():
        if not name or "=" in name or " " in name:
            raise UsageError(f"--message is '{name}', must be a message's name, such as get_clock or get_*")
    words = [f"node={','.join(map(str, given.node))}"] if given.node else []
    words += [f"kind={','.join(given.kind)}"] if given.kind else []
    words += [f"dir={given.direction}"] if given.direction else []
    return " ".join([*words, *(given.message or ())])
