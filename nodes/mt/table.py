"""A table on a node, transferred by MT (firmware/objects/table.h): its configuration and its state."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Protocol

from nodes.devices.device import Device
from nodes.devices.stepper import Stepper
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.message_format import Message, Value
from nodes.link.interfaces import LinkInterface
from nodes.mt.mt import AXLES, MtStatus, Pair, checksum, digest
from nodes.node.config import NodeConfig, NodeConfigError
from nodes.node.errors import NodeError

COMMANDS: Final = ("config_table", "table_query", "table_bytes", "table_activate", "table_query_active")
RESPONSES: Final = (
    "table_state oid=%c table_status=%c generation=%u length=%hu checksum=%u digest=%u words=%u",
    "table_active oid=%c table_activation=%c generation=%u length=%hu clock=%u",
)
CONSTANT: Final = "MT_AXLES"
"""Constant of the dictionary: the firmware keeps tables; its value is how many axles a mask can select."""
CAPACITY_MAX: Final = 0xFFFF
ANSWER_S: Final = 0.25
ANSWER_TRIES: Final = 6
_NO_STEPPER: Final = 255


class TableNode(Protocol):
    """Interface of a table's node: one of the coordinator's, or one that a tool uses."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def dictionary(self) -> Dictionary: ...  # noqa: D102
    @property
    def link(self) -> LinkInterface: ...  # noqa: D102
    async def query(  # noqa: D102
        self,
        name: str,
        response: str,
        /,
        *,
        timeout_s: float = ...,
        tries: int = ...,
        patient: bool = ...,
        **args: Value | str,
    ) -> Message: ...


@dataclass(frozen=True, slots=True)
class TableState:
    """State of the table that a node keeps, as the node reports it."""

    status: MtStatus
    """Of the last transmission to it."""
    generation: int
    """Number of tables accepted since it was configured; 0: it has none, whatever the status."""
    length: int
    checksum: int
    digest: int
    words: int
    """Number of MT words it has received, modulo 2^32."""

    def holds(self, pairs: Sequence[Pair]) -> bool:
        """Return whether the kept table is PAIRS for certain."""
        found = (self.length, self.checksum, self.digest)
        return self.generation > 0 and found == (len(pairs), checksum(pairs), digest(pairs))


class Activation(IntEnum):
    """Result of the last ``activate``."""

    NEVER = 0
    WAITING = 1
    DONE = 2
    LATE = 3
    """The clock was in the past when the command arrived, or the node shut down before."""
    MOVING = 4
    """The table's stepper moved at that clock."""
    REPLACED = 5
    """Another table was kept by then."""


@dataclass(frozen=True, slots=True)
class ActiveTable:
    """Which of the tables kept is in use."""

    activation: Activation
    generation: int
    """0: none."""
    length: int
    clock32: int
    """The node's clock at which it came into use."""


class AxleTable(Device):
    """The table for AXLE (1..28) with room for CAPACITY pairs; activated only while STEPPER stands still.

    NAME is for messages, such as "axis x forward". Raises NodeConfigError for an axle or capacity out of
    range.
    """

    def __init__(self, name: str, axle: int, capacity: int, stepper: Stepper | None = None) -> None:
        if axle not in AXLES or not 1 <= capacity <= CAPACITY_MAX:
            raise NodeConfigError(
                f"{name}: a table of axle {axle} with {capacity} points; give an axle of {AXLES[0]}.."
                f"{AXLES[-1]} and 1..{CAPACITY_MAX} points"
            )
        super().__init__(name)
        self.name = name
        self.axle = axle
        self.capacity = capacity
        self._stepper = stepper

    def configure(self, config: NodeConfig) -> None:
        """Add it to its node's CONFIG, after its stepper; NodeConfigError when firmware keeps no tables."""
        config.require(self.name, COMMANDS, RESPONSES)
        stepper_oid = _NO_STEPPER if self._stepper is None else self._stepper.oid
        assert stepper_oid is not None
        self.oid = config.create_oid()
        config.add_config(
            self.name,
            f"config_table oid={self.oid} axle={self.axle} capacity={self.capacity}"
            f" stepper_oid={stepper_oid}",
        )

    async def state(
        self, node: TableNode, *, timeout_s: float = ANSWER_S, tries: int = ANSWER_TRIES
    ) -> TableState:
        """Query NODE for the table that it keeps, TRIES times; raises QueryTimeout, NodeError."""
        answer = await node.query(
            "table_query", "table_state", timeout_s=timeout_s, tries=tries, oid=self._oid
        )
        status = answer.integer("table_status")
        if status not in tuple(MtStatus):
            raise NodeError(f"{self.name}: node {node.name} answered with an unknown status {status}")
        return TableState(
            MtStatus(status),
            answer.integer("generation"),
            answer.integer("length"),
            answer.integer("checksum"),
            answer.integer("digest"),
            answer.integer("words"),
        )

    async def active(self, node: TableNode) -> ActiveTable:
        """Query NODE for the table in use; raises NodeError."""
        answer = await node.query("table_query_active", "table_active", oid=self._oid)
        activation = answer.integer("table_activation")
        if activation not in tuple(Activation):
            raise NodeError(f"{self.name}: node {node.name} answered with an unknown activation {activation}")
        return ActiveTable(
            Activation(activation),
            answer.integer("generation"),
            answer.integer("length"),
            answer.integer("clock"),
        )

    def activate(self, node: TableNode, *, clock: int, generation: int) -> None:
        """Make NODE use the table of GENERATION (0: none) from CLOCK (ticks); ``active`` returns the result.

        Tables of several nodes come into use together when each gets its own clock for the same time.
        """
        node.link.send(
            node.dictionary.encode(
                "table_activate", oid=self._oid, clock=clock & 0xFFFFFFFF, generation=generation
            )
        )
