"""The words for how a machine that is served shows itself on the network."""

import argparse
from collections.abc import Callable
from ipaddress import ip_address
from typing import Any

from nodes.support.option_values import UsageError


def declare_network(add: Callable[..., Any]) -> None:
    """Add the options to a group."""
    add(
        "--announce",
        action=argparse.BooleanOptionalAction,
        help="let 'canductor discover' find the TCP port; run does it unless the port is on loopback",
    )
    add(
        "--metrics",
        metavar="[ADDRESS:]PORT",
        help="figures for Prometheus at http://ADDRESS:PORT/metrics; 127.0.0.1 if no address is given",
    )
    add("--metrics-open", action="store_true", help="let everybody read them who reaches the address")


def read_metrics(given: argparse.Namespace) -> tuple[str, int] | None:
    """Return address and port of the metrics; raises UsageError."""
    if given.metrics is None:
        if given.metrics_open:
            raise UsageError("--metrics-open goes with --metrics [ADDRESS:]PORT")
        return None
    host, _, port = str(given.metrics).rpartition(":")
    host = "127.0.0.1" if host in ("", "localhost") else host.removeprefix("[").removesuffix("]")
    number = int(port) if port.isascii() and port.isdecimal() and len(port) <= 5 else 0
    try:
        beyond = not ip_address(host).is_loopback
    except ValueError:
        number = 0
    if not 0 < number < 65536:
        raise UsageError(
            f"--metrics is '{given.metrics}', must be a port, or an IP address and one: 10.0.0.2:9100"
        )
    if beyond and not given.metrics_open:
        raise UsageError(
            f"--metrics at {host} needs --metrics-open: it asks nobody who he is (see docs/security.md)"
        )
    return host, number


def read_announce(given: argparse.Namespace, unless_said: bool | None) -> bool | None:
    """Return whether to announce the machine; None: as its port decides. Raises UsageError."""
    if given.announce and given.tcp is None:
        raise UsageError("--announce needs --tcp HOST:PORT: others cannot reach a Unix socket")
    return unless_said if given.announce is None else bool(given.announce)
