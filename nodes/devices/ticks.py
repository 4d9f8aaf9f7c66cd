"""Seconds to a node's ticks, bounded as the commands carry them."""

import asyncio
from typing import Final

from nodes.clock.clock import HostTime
from nodes.node.config import NodeConfig, NodeConfigError
from nodes.node.node import Node

LONGEST_TICKS: Final = (1 << 31) - 1
"""Clocks further apart than this cannot be told from the past."""
START_AHEAD_S: Final = 0.5
"""What begins when a node is ready begins so much later: commands may wait behind others on the bus."""


def ticks_for(config: NodeConfig, what: str, seconds: float) -> int:
    """Return SECONDS in ticks of the node, at least 1; NodeConfigError when its clock cannot count that."""
    ticks = max(1, round(seconds * config.dictionary.clock_freq_hz))
    if ticks > LONGEST_TICKS:
        longest_s = LONGEST_TICKS / config.dictionary.clock_freq_hz
        raise NodeConfigError(
            f"{what} on node {config.name}: {seconds:g} s is longer than the {longest_s:.0f} s its clock can "
            "count; choose a shorter time"
        )
    return ticks


def clock_after(node: "Node", seconds: float) -> int:
    """Return what NODE's clock (64 bits) shows so many seconds from now; on the control loop.

    Raises NodeError while that clock is not known.
    """
    at_s = asyncio.get_running_loop().time() + seconds
    return node.best_clock.ticks_at(HostTime(round(at_s * 1e9)))


def start_clock(node: "Node") -> int:
    """Return a clock (64 bits) for what begins on a NODE that has just become ready.

    It counts from now: a host that was kept busy may have the last answer to get_clock from long ago.
    """
    return clock_after(node, START_AHEAD_S)
