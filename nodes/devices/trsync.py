"""Stop groups on a node (trsync): what has to stop when something triggers, anywhere on the machine."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from nodes.dictionary.message_format import Message
from nodes.node.config import NodeConfig
from nodes.node.errors import NodeError
from nodes.node.node import Node

COMMANDS: Final = ("config_trsync", "trsync_start", "trsync_set_timeout", "trsync_trigger")
GROUPS_CONSTANT: Final = "CAN_TRIGGER_GROUPS"
"""Of the dictionary: how many trigger groups the firmware knows; 0 on others' firmware."""
NO_GROUP: Final = 255


class TriggerReason(IntEnum):
    """Why a stop group triggered; what the host hands out, the node only repeats."""

    NONE = 0
    ENDSTOP = 1
    """The endstop switched, here or on another node of the trigger group."""
    HOST = 2
    """The host relayed another node's trigger, or ended the round."""
    TIMEOUT = 3
    """Nobody renewed the time-out: host and node had lost each other."""


@dataclass(frozen=True, slots=True)
class TrsyncState:
    """What a stop group reports."""

    armed: bool
    reason: TriggerReason
    clock32: int
    """When it triggered, or when it reported."""


class Trsync:
    """One stop group; its name in messages is that of what it is FOR."""

    def __init__(self, purpose: str) -> None:
        self.purpose = purpose
        self.oid: int | None = None
        """Its object id; known when its node's configuration is built."""
        self.groups = 0
        """How many trigger groups its node knows."""

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when the firmware has no stop groups."""
        config.require(self.purpose, COMMANDS)
        self.groups = config.dictionary.int_constant(GROUPS_CONSTANT, 0)
        self.oid = config.create_oid()
        config.add_config(self.purpose, f"config_trsync oid={self.oid}")

    def start(self, node: "Node", *, report_clock: int, report_ticks: int, timeout_clock: int) -> None:
        """Arm it: reports come every REPORT_TICKS from REPORT_CLOCK on, and it triggers at TIMEOUT_CLOCK."""
        node.send(
            "trsync_start",
            oid=self._oid,
            report_clock=report_clock % 2**32,
            report_ticks=report_ticks,
            expire_reason=int(TriggerReason.TIMEOUT),
        )
        self.renew(node, timeout_clock)

    def renew(self, node: "Node", timeout_clock: int) -> None:
        """Put its time-out off to TIMEOUT_CLOCK (64 or 32 bits, less than 2^31 ticks away)."""
        node.send("trsync_set_timeout", oid=self._oid, clock=timeout_clock % 2**32)

    def join(self, node: "Node", group: int) -> None:
        """Let it trigger with all others of GROUP on its bus; NO_GROUP: alone. See ``groups``."""
        node.send("trsync_set_group", oid=self._oid, group=group)

    def stop_on_trigger(self, node: "Node", stepper_oid: int) -> None:
        """Have a stepper of NODE stop when it triggers; after ``start``."""
        node.send("stepper_stop_on_trigger", oid=stepper_oid, trsync_oid=self._oid)

    def trigger_now(self, node: "Node") -> None:
        """Trigger it ahead of all that is queued for NODE; what is queued and unsent is dropped."""
        content = node.dictionary.encode("trsync_trigger", oid=self._oid, reason=int(TriggerReason.HOST))
        node.link.send_urgent(content)

    async def finish(self, node: "Node") -> TrsyncState:
        """End the round and return how it ended; triggers it when nothing did."""
        while True:
            answer = await node.query(
                "trsync_trigger", "trsync_state", oid=self._oid, reason=int(TriggerReason.HOST)
            )
            # A report of before the end, held up by a repeated block, looks like the answer.
            if not (state := _state(answer)).armed:
                return state

    def listen(self, node: "Node", on_state: Callable[[TrsyncState], None]) -> Callable[[], None]:
        """Call ON_STATE for every report; returns what ends that."""
        return node.on("trsync_state", self._oid, lambda message: on_state(_state(message)))

    @property
    def _oid(self) -> int:
        if self.oid is None:
            raise NodeError(f"the stop group for {self.purpose} is not configured on any node")
        return self.oid


_REASONS: Final = frozenset(map(int, TriggerReason))


def _state(message: Message) -> TrsyncState:
    reason = message.integer("trigger_reason")
    known = TriggerReason(reason) if reason in _REASONS else TriggerReason.NONE
    return TrsyncState(bool(message.integer("can_trigger")), known, message.integer("clock"))
