"""Which of the things said on a bus a tool shows."""

import argparse
import re
from collections.abc import Iterable
from fnmatch import translate
from typing import Final

from canbus_tools.protocol.decoded import Decoded, Kind
from canbus_tools.protocol.protocol import Direction
from nodes.support.can_protocol import DATA_NODEID_MAX
from nodes.support.option_values import UsageError, integer

ALL: Final = "all"
DEFAULT_KINDS: Final = frozenset(Kind) - {Kind.ACK}


class Filter:
    """Says of each thing whether to show it. ``None`` stands for everything, but acks for KINDS."""

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
        """Tell whether to show it."""
        return (
            said.kind in self._kinds
            and (self._nodes is None or said.nodeid in self._nodes)
            and (self._direction is None or said.direction is self._direction)
            and (self._wanted is None or self._wanted(said.name) is not None)
        )


def declare_filter(command: argparse.ArgumentParser) -> None:
    """Add the options that say what to show."""
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


def given_filter(given: argparse.Namespace) -> Filter:
    """Return what ``declare_filter`` declared; raises UsageError."""
    if given.message and not all(given.message):
        raise UsageError("--message is empty; give a name as a dictionary has it, such as get_clock")
    kinds = given.kind and (set(Kind) if ALL in given.kind else {Kind(kind) for kind in given.kind})
    direction = Direction(given.direction) if given.direction else None
    return Filter(given.node, given.message, direction, kinds)
