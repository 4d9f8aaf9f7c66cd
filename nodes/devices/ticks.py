"""Conversion of seconds to a node's ticks, within the limits of the commands."""

import asyncio
from typing import Final

from nodes.clock.clock import HostTime
from nodes.node.config import NodeConfig, NodeConfigError
from nodes.node.node import Node

LONGEST_TICKS: Final = (1 << 31) - 1
"""Clocks further apart than this cannot be distinguished from past ones."""
START_AHEAD_S: Final = 0.5
"""Delay of what begins when a node is ready: commands may wait behind others on the bus."""


def ticks_for(config: NodeConfig, what: str, seconds: float) -> int:
    """Return SECONDS in ticks of the node, at least 1; NodeConfigError if that is too long for its clock."""
    ticks = max(1, round(seconds * config.dictionary.clock_freq_hz))
    if ticks > LONGEST_TICKS:
        longest_s = LONGEST_TICKS / config.dictionary.clock_freq_hz
        raise NodeConfigError(
            f"{what} on node {config.name}: {seconds:g} s is longer than the {longest_s:.0f} s that its "
            "clock can count; choose a shorter time"
        )
    return ticks


def clock_after(node: Node, seconds: float) -> int:
    """Return NODE's clock (64 bits) SECONDS from now; call it on the control loop.

    Raises NodeError while that clock is not known.
    """
    at_s = asyncio.get_running_loop().time() + seconds
    return node.best_clock.ticks_at(HostTime(round(at_s * 1e9)))


def start_clock(node: Node) -> int:
    """Return the clock (64 bits) at which to begin on a NODE that has just become ready.

    It is relative to now, since the last answer to get_clock may be old on a busy host.
    """
    return clock_after(node, START_AHEAD_S)
