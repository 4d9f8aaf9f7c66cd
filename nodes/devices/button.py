"""A switch on a node: pressed or not, each change told once, in order."""

from collections.abc import Callable
from typing import Final

from nodes.devices.ticks import start_clock, ticks_for
from nodes.dictionary.message_format import Message
from nodes.node.config import NodeConfig
from nodes.node.errors import NodeError
from nodes.node.node import Node

COMMANDS: Final = ("config_buttons", "buttons_add", "buttons_query", "buttons_ack")
REPEAT_SAMPLES: Final = 50
"""Samples after which the node tells again what the host has not acknowledged."""
_ACKS: Final = 256


def _ignore(_: bool) -> None:
    pass


class Button:
    """The switch for NAME on PIN, PULL 1 for a pull-up, -1 for a pull-down; INVERT: pressed is low.

    The node looks every POLL_S; two looks in a row have to agree. ``on_change`` is called with each change.
    """

    def __init__(
        self, name: str, *, pin: str, pull: int = 0, invert: bool = False, poll_s: float = 0.002
    ) -> None:
        self.name = name
        self.oid: int | None = None
        """Its object id; known when its node's configuration is built."""
        self.pressed = False
        """As the node told last; a node that begins tells only of a switch that is pressed."""
        self.on_change: Callable[[bool], None] = _ignore
        self._pin, self._pull, self._invert = pin, pull, invert
        self._poll_s = poll_s
        self._poll_ticks = 1
        self._acked = 0
        self._unlisten: Callable[[], None] | None = None

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pin do not allow it."""
        what = f"the switch of {self.name}"
        config.require(what, COMMANDS)
        self._poll_ticks = ticks_for(config, what, self._poll_s)
        self.oid = config.create_oid()
        config.add_config(what, f"config_buttons oid={self.oid} button_count=1")
        config.add_config(what, f"buttons_add oid={self.oid} pos=0 pin={self._pin} pull_up={self._pull}")

    def started(self, node: "Node") -> None:
        """Begin to look, as NODE has become ready."""
        if self.oid is None:
            raise NodeError(f"the switch of {self.name} is not configured on any node")
        if self._unlisten is not None:
            self._unlisten()
        oid = self.oid
        self._acked = 0
        self._unlisten = node.on("buttons_state", oid, lambda message: self._came(node, oid, message))
        node.send(
            "buttons_query",
            oid=oid,
            clock=start_clock(node) % (1 << 32),
            rest_ticks=self._poll_ticks,
            retransmit_count=REPEAT_SAMPLES,
            invert=int(self._invert),
        )
        self._change(False)  # the node begins with this

    def _came(self, node: "Node", oid: int, message: Message) -> None:
        """Take the events that are new: a report is repeated until it is acknowledged."""
        events = message.data("state")
        known = (self._acked - message.integer("ack_count")) % _ACKS
        fresh = events[known:] if known <= len(events) else b""
        if not fresh:
            return  # a report of before; the node has heard since
        self._acked = (self._acked + len(fresh)) % _ACKS
        node.send("buttons_ack", oid=oid, count=len(fresh))
        for state in fresh:
            self._change(bool(state & 1))

    def _change(self, pressed: bool) -> None:
        if pressed != self.pressed:
            self.pressed = pressed
            self.on_change(pressed)
