"""A switch on a node: pressed or not, each change reported once, in order."""

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Final

from nodes.devices.device import Device, ignore
from nodes.devices.ticks import start_clock, ticks_for
from nodes.dictionary.message_format import Message
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.support.errors import CanductorError

COMMANDS: Final = ("config_buttons", "buttons_add", "buttons_query", "buttons_ack")
RESPONSES: Final = ("buttons_state oid=%c ack_count=%c state=%*s",)
POLL_S: Final = 0.002
REPEAT_SAMPLES: Final = 50
"""Samples after which the node repeats a report that the host has not acknowledged."""
_ACKS: Final = 256


class Button(Device):
    """The switch for NAME on PIN, PULL 1 for a pull-up, -1 for a pull-down; INVERT: pressed is low.

    The node samples it every POLL_S; two consecutive samples have to agree. ``on_change`` is called with each
    change.
    """

    def __init__(self, name: str, *, pin: str, pull: int = 0, invert: bool = False) -> None:
        super().__init__(f"the switch of {name}")
        self.pressed = False
        """As the node last reported; a node that starts reports only a switch that is pressed."""
        self.on_change: Callable[[bool], None] = ignore
        self._pin, self._pull, self._invert = pin, pull, invert
        self._poll_ticks = 1
        self._acked = 0

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when firmware or pin do not allow it."""
        what = self.description
        config.require(what, COMMANDS, RESPONSES)
        self._poll_ticks = ticks_for(config, what, POLL_S)
        self.oid = config.create_oid()
        config.add_config(what, f"config_buttons oid={self.oid} button_count=1")
        config.add_config(what, f"buttons_add oid={self.oid} pos=0 pin={self._pin} pull_up={self._pull}")

    def started(self, node: Node) -> None:
        """Begin to sample, as NODE has become ready."""
        self._acked = 0
        self._on_report(node, "buttons_state", partial(self._received, node))
        node.send(
            "buttons_query",
            oid=self._oid,
            clock=start_clock(node) % (1 << 32),
            rest_ticks=self._poll_ticks,
            retransmit_count=REPEAT_SAMPLES,
            invert=int(self._invert),
        )
        self._change(False)  # the state in which the node begins

    def _received(self, node: Node, message: Message) -> None:
        """Process the events that are new: a report is repeated until it is acknowledged."""
        events = message.data("state")
        known = (self._acked - message.integer("ack_count")) % _ACKS
        new = events[known:] if known <= len(events) else b""
        if not new:
            return  # an old report; its acknowledgement has arrived since
        self._acked = (self._acked + len(new)) % _ACKS
        with contextlib.suppress(CanductorError):  # its node has failed since
            node.send("buttons_ack", oid=self._oid, count=len(new))
        for state in new:
            self._change(bool(state & 1))

    def _change(self, pressed: bool) -> None:
        if pressed != self.pressed:
            self.pressed = pressed
            self.on_change(pressed)
