"""Load of a node's processor."""

import math
from dataclasses import dataclass
from typing import Final

from nodes.dictionary.message_format import Message

STATS_INTERVAL_S: Final = 5.0
"""Interval of the firmware's reports."""


@dataclass(frozen=True, slots=True)
class NodeLoad:
    """Load of a node's processor, from its ``stats``."""

    awake: float
    """Share of the time since the last report spent in tasks, 0..1."""
    task_s: float
    """Mean duration of one round of all tasks."""
    task_spread_s: float
    """Standard deviation of that duration."""


def load_of(stats: Message, freq_hz: int, sumsq_base: int) -> NodeLoad:
    """Read a ``stats`` message (sum in ticks, sumsq in squared ticks over SUMSQ_BASE)."""
    count, total = max(1, stats.integer("count")), stats.integer("sum")
    variance = count * stats.integer("sumsq") * sumsq_base - total * total
    spread_s = math.sqrt(max(0, variance)) / (count * freq_hz)
    return NodeLoad(total / (freq_hz * STATS_INTERVAL_S), total / (count * freq_hz), spread_s)
