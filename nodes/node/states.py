"""The life cycle of a node as a table: the only place that defines which state may follow which.

docs/node-states.md is generated from it (tests/nodes/state_pages.py).
"""

from enum import Enum
from typing import Final


class NodeState(Enum):
    """State of a node; the value is the phrase that messages use for it."""

    CONNECTING = "being connected"
    IDENTIFYING = "sending its dictionary"
    CONFIGURING = "being configured"
    READY = "ready"
    SHUTDOWN = "shut down"
    LOST = "lost"
    SLEEPING = "asleep"
    CLOSED = "closed"


class NodeEvent(Enum):
    """Event that moves a node from one state to another."""

    CONNECTED = "link open"
    IDENTIFIED = "dictionary read"
    CONFIGURED = "configuration finalized, clock known"
    RESET = "reset, to be started again"
    SHUTDOWN = "shutdown reported"
    LOST = "no answer"
    SILENT = "no answer yet, to be tried again"
    RESTARTED = "it restarted by itself"
    SLEEP = "put to sleep by the host"
    WAKE = "woken by the host"
    CLOSE = "closed by the host"


_S, _E = NodeState, NodeEvent
TRANSITIONS: Final = {
    (_S.CONNECTING, _E.CONNECTED): _S.IDENTIFYING,
    (_S.CONNECTING, _E.SILENT): _S.CONNECTING,
    (_S.CONNECTING, _E.LOST): _S.LOST,
    (_S.CONNECTING, _E.SLEEP): _S.SLEEPING,
    (_S.CONNECTING, _E.CLOSE): _S.CLOSED,
    (_S.IDENTIFYING, _E.IDENTIFIED): _S.CONFIGURING,
    (_S.IDENTIFYING, _E.SILENT): _S.CONNECTING,
    (_S.IDENTIFYING, _E.LOST): _S.LOST,
    (_S.IDENTIFYING, _E.RESTARTED): _S.LOST,
    (_S.IDENTIFYING, _E.SLEEP): _S.SLEEPING,
    (_S.IDENTIFYING, _E.CLOSE): _S.CLOSED,
    (_S.CONFIGURING, _E.CONFIGURED): _S.READY,
    (_S.CONFIGURING, _E.SILENT): _S.CONNECTING,
    (_S.CONFIGURING, _E.RESET): _S.CONNECTING,
    (_S.CONFIGURING, _E.SHUTDOWN): _S.SHUTDOWN,
    (_S.CONFIGURING, _E.LOST): _S.LOST,
    (_S.CONFIGURING, _E.RESTARTED): _S.LOST,
    (_S.CONFIGURING, _E.SLEEP): _S.SLEEPING,
    (_S.CONFIGURING, _E.CLOSE): _S.CLOSED,
    (_S.READY, _E.RESET): _S.CONNECTING,
    (_S.READY, _E.SHUTDOWN): _S.SHUTDOWN,
    (_S.READY, _E.LOST): _S.LOST,
    (_S.READY, _E.RESTARTED): _S.LOST,
    (_S.READY, _E.SLEEP): _S.SLEEPING,
    (_S.READY, _E.CLOSE): _S.CLOSED,
    (_S.SHUTDOWN, _E.RESET): _S.CONNECTING,
    (_S.SHUTDOWN, _E.LOST): _S.LOST,
    (_S.SHUTDOWN, _E.RESTARTED): _S.LOST,
    (_S.SHUTDOWN, _E.SLEEP): _S.SLEEPING,
    (_S.SHUTDOWN, _E.CLOSE): _S.CLOSED,
    (_S.LOST, _E.RESET): _S.CONNECTING,
    (_S.LOST, _E.SLEEP): _S.SLEEPING,
    (_S.LOST, _E.CLOSE): _S.CLOSED,
    (_S.SLEEPING, _E.WAKE): _S.CONNECTING,
    (_S.SLEEPING, _E.CLOSE): _S.CLOSED,
}


def following(state: NodeState, event: NodeEvent) -> NodeState | None:
    """Return the state after EVENT in STATE, or None when the event has no effect there."""
    return TRANSITIONS.get((state, event))
