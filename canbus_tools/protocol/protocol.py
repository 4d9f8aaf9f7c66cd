"""The protocol on the bus, described once: ids, admin and signal frames, message blocks.

The decoder reads frames by these tables, and the Wireshark dissector is generated from them. The project's
own nodes and hosts take the same numbers from ``nodes.support.can_protocol`` and ``firmware/wire``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from nodes.support._wire import lib
from nodes.support.can_protocol import (
    ADMIN_ID,
    ADMIN_RESPONSE_ID,
    BUS_STOP_ID,
    DATA_NODEID_MAX,
    FIRST_DATA_ID,
    NEED_NODEID,
    NODE_IS_HERE,
    QUERY_UNASSIGNED,
    REQUEST_BOOTLOADER,
    SET_NODEID,
    SET_NODEID_BOOTLOADER,
    SYNC_PULSE,
    TRIGGER_GROUPS,
    TRIGGER_ID,
    UUID_SIZE,
    WHO_IS_HERE,
)


class Direction(Enum):
    """Direction of a frame."""

    TO_NODE = "to"
    FROM_NODE = "from"
    ANY = "any"
    """The host and every node may send it."""

    __hash__ = object.__hash__  # Enum's own is a slow Python function


# -------------------------------------------------------------------------------------------------------- ids


def data_id(nodeid: int, direction: Direction) -> int:
    """Return the CAN id of the bytes to or from node NODEID (1..255)."""
    return FIRST_DATA_ID + 2 * nodeid + (direction is Direction.FROM_NODE)


def owner_of(can_id: int) -> tuple[int, Direction] | None:
    """Return the node and the direction of a data id; None for other ids, also for those of nodeid 0."""
    nodeid, odd = divmod(can_id - FIRST_DATA_ID, 2)
    if not 1 <= nodeid <= DATA_NODEID_MAX:
        return None
    return nodeid, Direction.FROM_NODE if odd else Direction.TO_NODE


# ----------------------------------------------------------------------------------------------------- frames


class FieldKind(Enum):
    """Encoding of a field."""

    UNSIGNED = "unsigned, little-endian"
    HEX = "unsigned, little-endian, shown in hex"
    UUID = "a board's bytes as they stand, shown as hex digits"


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """One field of a frame."""

    name: str
    size: int
    """Bytes."""
    kind: FieldKind = FieldKind.UNSIGNED
    sentence: str = ""
    """Its meaning."""
    values: Mapping[int, str] = field(default_factory=dict)
    """Names of values, if it is an enumeration."""

    def read(self, data: bytes, at: int) -> int | bytes:
        """Return the value at offset AT of DATA, which is long enough."""
        raw = data[at : at + self.size]
        return raw if self.kind is FieldKind.UUID else int.from_bytes(raw, "little")

    def text(self, value: int | bytes) -> str:
        """Return a value as text."""
        if isinstance(value, bytes):
            return value.hex()
        digits = f"0x{value:02x}" if self.kind is FieldKind.HEX else str(value)
        return self.values.get(value, digits)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameFormat:
    """A frame that is a complete message."""

    name: str
    direction: Direction
    can_id: int
    """Its first id."""
    ids: int = 1
    """Number of consecutive ids that it may have."""
    command: int | None = None
    """Its first byte, which distinguishes it from others of the same id; None: the id alone does."""
    fields: tuple[Field, ...] = ()
    """From the second byte on if there is a command, else from the first."""
    extension: bool = False
    """Whether only firmware of this project knows it; Klipper's ignores it."""
    sentence: str = ""

    @property
    def size(self) -> int:
        """Bytes of a complete frame; further bytes have no meaning."""
        return self.fields_at + sum(f.size for f in self.fields)

    @property
    def fields_at(self) -> int:
        """Offset of the first field."""
        return 0 if self.command is None else 1


_UUID: Final = Field(
    name="uuid", size=UUID_SIZE, kind=FieldKind.UUID, sentence="the board's own number, from its chip's"
)
_NODEID: Final = Field(name="nodeid", size=1, sentence="the node's id; its data ids follow from it")
_SET_COMMANDS: Final = {SET_NODEID: "application", SET_NODEID_BOOTLOADER: "bootloader"}

ADMIN_FRAMES: Final = (
    FrameFormat(
        name="query_unassigned",
        direction=Direction.TO_NODE,
        can_id=ADMIN_ID,
        command=QUERY_UNASSIGNED,
        sentence="Who waits for an id? Nodes without one answer need_nodeid.",
    ),
    FrameFormat(
        name="set_nodeid",
        direction=Direction.TO_NODE,
        can_id=ADMIN_ID,
        command=SET_NODEID,
        fields=(_UUID, _NODEID),
        sentence="Gives a node that runs its application its id; another that has this id shuts down.",
    ),
    FrameFormat(
        name="request_bootloader",
        direction=Direction.TO_NODE,
        can_id=ADMIN_ID,
        command=REQUEST_BOOTLOADER,
        fields=(_UUID,),
        sentence="Makes a node restart into its bootloader.",
    ),
    FrameFormat(
        name="set_nodeid_bootloader",
        direction=Direction.TO_NODE,
        can_id=ADMIN_ID,
        command=SET_NODEID_BOOTLOADER,
        fields=(_UUID, _NODEID),
        sentence="Gives a node that runs its bootloader (Katapult) its id.",
    ),
    FrameFormat(
        name="sync_pulse",
        direction=Direction.TO_NODE,
        can_id=ADMIN_ID,
        command=SYNC_PULSE,
        fields=(Field(name="seq", size=1, sentence="number of the pulse, 1..255"),),
        extension=True,
        sentence="Every node latches its clock on reception, all within a bit time.",
    ),
    FrameFormat(
        name="who_is_here",
        direction=Direction.TO_NODE,
        can_id=ADMIN_ID,
        command=WHO_IS_HERE,
        extension=True,
        sentence="Which nodes have an id? They answer node_is_here.",
    ),
    FrameFormat(
        name="need_nodeid",
        direction=Direction.FROM_NODE,
        can_id=ADMIN_RESPONSE_ID,
        command=NEED_NODEID,
        fields=(
            _UUID,
            Field(
                name="set_command",
                size=1,
                kind=FieldKind.HEX,
                values=_SET_COMMANDS,
                sentence="the command that sets its id, which identifies what runs on it",
            ),
        ),
        sentence="This node waits for an id.",
    ),
    FrameFormat(
        name="node_is_here",
        direction=Direction.FROM_NODE,
        can_id=ADMIN_RESPONSE_ID,
        command=NODE_IS_HERE,
        fields=(_UUID, _NODEID),
        extension=True,
        sentence="This node has an id.",
    ),
)
"""Frames that assign node ids and synchronise clocks; distinguished by their id and first byte."""

_SIGNAL_CLOCK: Final = "clock of the sender when it triggered or shut down; 0 from a host"

SIGNAL_FRAMES: Final = (
    FrameFormat(
        name="bus_stop",
        direction=Direction.ANY,
        can_id=BUS_STOP_ID,
        fields=(
            Field(
                name="reason",
                size=1,
                sentence="number of the reason in the origin's enumeration static_string_id; 0: none given",
            ),
            Field(name="origin", size=1, sentence="node id of the sender", values={0: "host"}),
            Field(name="clock", size=4, sentence=_SIGNAL_CLOCK),
        ),
        extension=True,
        sentence="Emergency stop of the whole bus: receivers shut down from the receive interrupt.",
    ),
    FrameFormat(
        name="trigger",
        direction=Direction.FROM_NODE,
        can_id=TRIGGER_ID,
        ids=TRIGGER_GROUPS,
        fields=(
            Field(name="group", size=1, sentence="the stop group, also the id less 0x020"),
            Field(name="reason", size=1, sentence="what trsync_state reports as trigger_reason"),
            Field(name="clock", size=4, sentence=_SIGNAL_CLOCK),
        ),
        extension=True,
        sentence="A trsync triggered: every node whose trsync joined the group stops at once.",
    ),
)
"""Frames from node to node, with ids of higher priority than all data."""


def frame_format(can_id: int, data: bytes) -> FrameFormat | None:
    """Return the format of a complete admin or signal frame; None for any other frame."""
    first = data[0] if data else None
    for known in _BY_ID.get(can_id, ()):
        if known.command in (None, first) and len(data) >= known.size:
            return known
    return None


_BY_ID: Final[dict[int, list[FrameFormat]]] = {}
for _frame in (*ADMIN_FRAMES, *SIGNAL_FRAMES):
    for _id in range(_frame.can_id, _frame.can_id + _frame.ids):
        _BY_ID.setdefault(_id, []).append(_frame)

BLOCK: Final[Mapping[str, int]] = {
    "length_min": lib.WIRE_BLOCK_MIN,
    "length_max": lib.WIRE_BLOCK_MAX,
    "sequence_mark": lib.WIRE_SEQ_MARK,
    "content_at": lib.WIRE_HEADER,
    "crc_polynomial": 0x8408,
    "crc_start": 0xFFFF,
    "sync": lib.WIRE_SYNC,
}
"""Numbers of a message block (firmware/wire/wire.h): ``<length> <sequence> <content> <crc, 2 bytes> <sync>``.

The checksum is CRC-16/MCRF4XX, least significant bit first: the polynomial 0x1021, reflected.
"""
