"""Why a node cannot be used."""

from typing import Final

from nodes.support.errors import CanductorError


class NodeError(CanductorError):
    """A node cannot be used, and why."""


class NodeLost(NodeError):  # noqa: N818
    """A node is gone: it does not answer, or see NodeRestarted."""


class NodeRestarted(NodeLost):
    """A node restarted by itself: it has forgotten its configuration, and where its steppers stand."""


class NodeShutdown(NodeError):  # noqa: N818
    """A node stopped itself; what it reported is part of the sentence."""


_ADVICE: Final = {
    "Another CAN node assigned this ID": (
        "another board was given its node id, by another host on this bus or with a copy of its uuid; "
        "let only one host assign ids, and restart the board"
    ),
}
"""What to do about a shutdown whose own words do not tell."""


def shutdown_sentence(node: str, reason: str) -> str:
    """Return the sentence for a shutdown of NODE that it gave REASON for."""
    advice = _ADVICE.get(reason)
    return f"node {node} shut down: {reason}" + (f": {advice}" if advice else "")
