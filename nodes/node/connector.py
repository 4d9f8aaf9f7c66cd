"""What a node needs of its bus: a link, and information that only the bus has."""

from collections.abc import Callable, Sequence
from typing import Protocol

from nodes.dictionary.dictionary import Dictionary
from nodes.link.interfaces import LinkInterface, OnLost, OnResponses
from nodes.node.board_reset import ResetMethod
from nodes.node.config import NodeConfig
from nodes.support.errors import CanductorError


class ClockConnector(Protocol):
    """What keeping a node's clock needs of its bus."""

    def wire_ns(self, content_bytes: int, bitrate: int, *, answer: bool) -> int:
        """Return the least time that a block takes on the wire; 0 where that is not known."""

    def suspect(self) -> None:
        """Check whether a silent node restarted; if it did, the bus notifies the node."""


class Connector(ClockConnector, Protocol):
    """Interface through which a node gets its link; the bus provides it."""

    async def connect(self, on_responses: OnResponses, on_lost: OnLost) -> LinkInterface:
        """Open a link: open the device again if it is closed, assign the node's id where it needs one."""

    def expect_reset(self) -> None:
        """Record that the node is about to reset itself, and that its bus may close then."""

    def forget(self) -> None:
        """Record that the node was reset: its id is gone, and on USB its device is about to disappear."""

    @property
    def reset_methods(self) -> Sequence[ResetMethod]:
        """How the node is reset, in the order to try."""

    async def reset(self, method: ResetMethod) -> bool:
        """Reset the node without its help; False when METHOD is not possible. Raises CanductorError."""

    def absence_s(self) -> float:
        """Return how long the node may be away now although nobody reset it."""

    def missing(self, error: CanductorError) -> str:
        """Return, as a clause, in which way the node is not back, for an attempt that failed with ERROR."""

    def why_silent(self) -> Exception | None:
        """Return a better explanation than "no answer" when a node never answered at all."""

    def check_identity(self, found: bytes) -> None:
        """Raise when a board that answers get_canbus_id with FOUND is not the node."""


BuildConfig = Callable[[Dictionary], NodeConfig]
"""Builds a node's configuration from its dictionary; called again at every restart."""
