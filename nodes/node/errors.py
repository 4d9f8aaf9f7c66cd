"""Errors of nodes that cannot be used."""

from typing import Final

from nodes.support.errors import CanductorError


class NodeError(CanductorError):
    """A node cannot be used; the sentence states the reason."""


class NodeLost(NodeError):  # noqa: N818
    """A node is lost: it does not answer, or it restarted (NodeRestarted)."""


class NodeRestarted(NodeLost):
    """A node restarted by itself: its configuration and the positions of its steppers are lost."""


class NodeShutdown(NodeError):  # noqa: N818
    """A node shut itself down; the sentence contains the reason that it reported."""


_ADVICE: Final = {
    "Another CAN node assigned this ID": (
        "another board was given its node id, by another host on this bus or with a copy of its uuid; "
        "let only one host assign ids, and restart the board"
    ),
    "Another host sends to this node": (
        "blocks of the same number and of different content reached it; "
        "let only one host use this wire, and restart the board"
    ),
}
"""Advice for shutdowns whose reason does not suggest one."""


def shutdown_sentence(node: str, reason: str) -> str:
    """Return the sentence for a shutdown of NODE with the REASON that it reported."""
    advice = _ADVICE.get(reason)
    return f"node {node} shut down: {reason}" + (f": {advice}" if advice else "")
