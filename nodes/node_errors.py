"""Why a node cannot be used."""

from nodes.errors import CanductorError


class NodeError(CanductorError):
    """A node cannot be used, and why."""


class NodeLost(NodeError):  # noqa: N818
    """A node is gone: it does not answer, or it restarted by itself."""


class NodeShutdown(NodeError):  # noqa: N818
    """A node stopped itself; what it reported is part of the sentence."""
