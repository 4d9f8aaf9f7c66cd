"""What a node needs of its bus: a link, and answers that only the bus has."""

from collections.abc import Callable
from typing import Protocol

from nodes.dictionary.dictionary import Dictionary
from nodes.link.interfaces import LinkInterface, OnLost, OnResponses
from nodes.node.config import NodeConfig


class Connector(Protocol):
    """How a node gets its link; the bus provides it."""

    async def connect(self, on_responses: OnResponses, on_lost: OnLost) -> LinkInterface:
        """Open a link, giving the node its id first where it needs one."""

    def wire_ns(self, content_bytes: int, bitrate: int, *, answer: bool) -> int:
        """Return how long a block is on the wire for certain; 0 where that is not known."""

    def forget(self) -> None:
        """Take note that the node was reset: what it knew of the bus is gone."""

    def why_silent(self) -> Exception | None:
        """Return a better explanation than "no answer" when a node never answered at all."""

    def check_identity(self, found: bytes) -> None:
        """Raise when a board that answers get_canbus_id with FOUND is not the node."""

    def suspect(self) -> None:
        """Find out whether a node that is silent restarted; the bus tells the node when it did."""


BuildConfig = Callable[[Dictionary], NodeConfig]
"""Makes a node's configuration when its dictionary is known; called again at every restart."""
