"""Stop groups on a node (trsync): steppers that stop when a trigger occurs anywhere on the machine."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from nodes.devices.device import Device
from nodes.dictionary.message_format import Message
from nodes.node.config import NodeConfig
from nodes.node.errors import NodeError
from nodes.node.node import Node

COMMANDS: Final = ("config_trsync", "trsync_start", "trsync_set_timeout", "trsync_trigger")
RESPONSES: Final = ("trsync_state oid=%c can_trigger=%c trigger_reason=%c clock=%u",)
GROUPS_CONSTANT: Final = "CAN_TRIGGER_GROUPS"
"""Constant of the dictionary: number of trigger groups of the firmware; other firmware has none."""
NO_GROUP: Final = 255
END_S: Final = 3.0
"""A node that is not lost has received a command long before."""


class TriggerReason(IntEnum):
    """Why a stop group triggered: defined by the host, which sends it to the node."""

    NONE = 0
    ENDSTOP = 1
    """The endstop switched, on this or another node of the trigger group."""
    HOST = 2
    """The host relayed another node's trigger, or ended the homing move."""
    TIMEOUT = 3
    """The timeout was not renewed: host and node had lost contact."""
    SENSOR_ERROR_0 = 4
    """A sensor that homing looks at cannot be relied upon: its error number 0, and so on."""
    SENSOR_ERROR_1 = 5
    SENSOR_ERROR_2 = 6
    SENSOR_ERROR_3 = 7

    @property
    def sensor_error(self) -> int | None:
        """Return the number of a sensor's error; None: it is none."""
        return self - self.SENSOR_ERROR_0 if self >= self.SENSOR_ERROR_0 else None


@dataclass(frozen=True, slots=True)
class TrsyncState:
    """State of a stop group, as its node reports it."""

    armed: bool
    reason: TriggerReason
    clock32: int
    """The node's clock when it triggered or, before that, when it reported."""


class Trsync(Device):
    """The stop group for PURPOSE, such as "homing on node mcu"."""

    def __init__(self, purpose: str) -> None:
        super().__init__(f"the stop group for {purpose}")
        self._purpose = purpose
        self.groups = 0
        """Number of trigger groups that its node supports."""

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG; NodeConfigError when the firmware has no stop groups."""
        config.require(self._purpose, COMMANDS, RESPONSES)
        self.groups = config.dictionary.int_constant(GROUPS_CONSTANT, 0)
        self.oid = config.create_oid()
        config.add_config(self._purpose, f"config_trsync oid={self.oid}")

    def start(self, node: Node, *, report_clock: int, report_ticks: int, timeout_clock: int) -> None:
        """Arm it: it reports every REPORT_TICKS from REPORT_CLOCK on, and triggers at TIMEOUT_CLOCK."""
        node.send(
            "trsync_start",
            oid=self._oid,
            report_clock=report_clock % 2**32,
            report_ticks=report_ticks,
            expire_reason=int(TriggerReason.TIMEOUT),
        )
        self.renew(node, timeout_clock)

    def renew(self, node: Node, timeout_clock: int) -> None:
        """Postpone its timeout to TIMEOUT_CLOCK (64 or 32 bits, less than 2^31 ticks away)."""
        node.send("trsync_set_timeout", oid=self._oid, clock=timeout_clock % 2**32)

    def join(self, node: Node, group: int) -> None:
        """Make it trigger with all others of GROUP on its bus; NO_GROUP: alone. See ``groups``."""
        node.send("trsync_set_group", oid=self._oid, group=group)

    def stop_on_trigger(self, node: Node, stepper_oid: int) -> None:
        """Stop a stepper of NODE when it triggers; call it after ``start``."""
        node.send("stepper_stop_on_trigger", oid=stepper_oid, trsync_oid=self._oid)

    def trigger_now(self, node: Node) -> None:
        """Trigger it ahead of everything queued for NODE; what is queued and unsent is dropped."""
        content = node.dictionary.encode("trsync_trigger", oid=self._oid, reason=int(TriggerReason.HOST))
        node.link.send_urgent(content)

    async def finish(self, node: Node) -> TrsyncState:
        """End the homing move and return how it ended; trigger it unless it has triggered.

        Raises NodeError when NODE does not say within END_S that it has, and as ``Node.query`` does.
        """
        loop = asyncio.get_running_loop()
        end_s = loop.time() + END_S
        while loop.time() < end_s:
            answer = await node.query(
                "trsync_trigger", "trsync_state", oid=self._oid, reason=int(TriggerReason.HOST)
            )
            # A report that the node makes before the command has arrived looks like the answer.
            if not (state := _state(answer)).armed:
                return state
        raise NodeError(
            f"{self.description} did not stop, though node {node.name} was sent the trigger for {END_S:g} s;"
            " restart the machine, and flash the node's firmware again if this comes again"
        )

    def listen(self, node: Node, on_state: Callable[[TrsyncState], None]) -> Callable[[], None]:
        """Call ON_STATE for every report; return a function that ends it."""
        return node.on("trsync_state", self._oid, lambda message: on_state(_state(message)))


_REASONS: Final = frozenset(map(int, TriggerReason))


def _state(message: Message) -> TrsyncState:
    reason = message.integer("trigger_reason")
    known = TriggerReason(reason) if reason in _REASONS else TriggerReason.NONE
    return TrsyncState(bool(message.integer("can_trigger")), known, message.integer("clock"))
