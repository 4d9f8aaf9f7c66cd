"""Detection of a node that restarted or shut down although its one message about that was lost."""

import asyncio
from collections.abc import Sequence
from typing import Final

from nodes.dictionary.message_format import Message
from nodes.node.clock_keeper import UPTIME
from nodes.node.errors import NodeError, NodeRestarted, NodeShutdown, shutdown_sentence
from nodes.node.request_reply import (
    QUERY_TIMEOUT_S,
    QUERY_TRIES,
    Answer,
    Query,
    QueryTimeout,
    RequestReply,
)

QUERIES: Final = (UPTIME, Query("get_config", "config"))
"""What shows a restart or a shutdown."""
SHUTDOWN_GRACE_S: Final = 0.05
"""Time given to a node that is found shut down to report the reason."""


def restarted(node: str, how: str) -> NodeRestarted:
    """Return the failure of NODE, which restarted by itself; HOW: the evidence for that."""
    return NodeRestarted(f"node {node} restarted by itself ({how}); check its power supply")


async def get_config(talk: RequestReply, tries: int = QUERY_TRIES) -> Message:
    """Ask for the node's configuration state."""
    return (await talk.ask("get_config", "config", tries=tries, survives_shutdown=True)).message


class NodeWatchdog:
    """Watches node NAME from the time it took the configuration with CRC."""

    def __init__(self, name: str, crc: int) -> None:
        self._name = name
        self._crc = crc
        self._uptime_ticks = 0

    async def look(self, answers: Sequence[Answer | None]) -> NodeError | None:
        """Return the failure that the ANSWERS to QUERIES show, or None; QueryTimeout when one is missing.

        After a restart the configuration is gone and the uptime has run backwards. The uptime shows a restart
        even when another host has meanwhile configured the node identically.
        """
        name = self._name
        uptime, config = answers
        if config is None:
            raise QueryTimeout(f"node {name} did not answer get_config within {QUERY_TIMEOUT_S:g} s")
        found = config.message
        if not found.integer("is_config"):
            return restarted(name, "its configuration is gone")
        if found.integer("crc") != self._crc:
            return NodeRestarted(f"node {name} was given another configuration; let only one host drive it")
        if found.integer("is_shutdown"):
            await asyncio.sleep(SHUTDOWN_GRACE_S)
            return NodeShutdown(shutdown_sentence(name, "the message with the reason got lost"))
        if uptime is None:
            raise QueryTimeout(f"node {name} did not answer get_uptime within {QUERY_TIMEOUT_S:g} s")
        ticks = uptime.message.integer("high") << 32 | uptime.message.integer("clock")
        if ticks < self._uptime_ticks:
            return restarted(name, "its uptime ran backwards")
        self._uptime_ticks = ticks
        return None
