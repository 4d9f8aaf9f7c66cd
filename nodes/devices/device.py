"""Base of the devices that a node carries."""

from collections.abc import Callable

from nodes.dictionary.message_format import Message
from nodes.node.errors import NodeError
from nodes.node.node import Node


def ignore(_: object) -> None:
    """Do nothing: the callback of a device until its user sets one."""


class Device:
    """A device; messages call it DESCRIPTION, such as "the endstop of axis x"."""

    def __init__(self, description: str) -> None:
        self.description = description
        self.oid: int | None = None
        """Its object id; known when its node's configuration is built."""
        self._end_reports: Callable[[], None] | None = None

    def started(self, node: Node) -> None:
        """Begin to work, as NODE has become ready."""

    @property
    def _oid(self) -> int:
        if self.oid is None:
            raise NodeError(f"{self.description} is not configured on any node")
        return self.oid

    def _on_report(self, node: Node, response: str, callback: Callable[[Message], None]) -> None:
        """Call CALLBACK for each report RESPONSE of the device by NODE, and no callback set before."""
        if self._end_reports is not None:
            self._end_reports()
        self._end_reports = node.on(response, self._oid, callback)
