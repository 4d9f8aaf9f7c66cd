"""The words for how a machine that is served shows itself on the network."""

import argparse
from collections.abc import Callable
from typing import Any

from nodes.option_values import UsageError


def declare_network(add: Callable[..., Any]) -> None:
    """Add the options to a group."""
    add(
        "--announce",
        action=argparse.BooleanOptionalAction,
        help="let 'canductor discover' find the TCP port; run does it unless the port is on loopback",
    )


def read_announce(given: argparse.Namespace, unless_said: bool | None) -> bool | None:
    """Return whether to announce the machine; None: as its port decides. Raises UsageError."""
    if given.announce and given.tcp is None:
        raise UsageError("--announce needs --tcp HOST:PORT: others cannot reach a Unix socket")
    return unless_said if given.announce is None else bool(given.announce)
