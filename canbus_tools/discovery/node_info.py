"""Information that one node reports about itself, by those queries that its firmware knows."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from canbus_tools.bus.talk import BusTalk, NodeTalk
from nodes.bus.assign import Uuid
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.message_format import Message
from nodes.dictionary.parts import DictionaryError
from nodes.support.can_protocol import UUID_SIZE

BUS_STATES: Final = "canbus_bus_state"
_TICKS_PER_WORD: Final = 1 << 32
_QUESTIONS: Final = (
    ("get_canbus_id", "canbus_id"),
    ("get_config", "config"),
    ("get_uptime", "uptime"),
    ("get_canbus_status", "canbus_status"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Firmware:
    """Properties of a firmware build, from its dictionary."""

    mcu: str
    version: str
    app: str
    build: str
    clock_hz: int | None
    bitrate: int | None

    @classmethod
    def common(cls, dictionaries: Sequence[Dictionary]) -> "Firmware":
        """Return the properties that all of them agree on; the others are empty or None."""
        first, *others = (cls.of(dictionary) for dictionary in dictionaries)
        unknown: dict[str, Any] = {
            name: "" if isinstance(value, str) else None
            for name, value in asdict(first).items()
            if any(getattr(other, name) != value for other in others)
        }
        return replace(first, **unknown)

    @classmethod
    def of(cls, dictionary: Dictionary) -> "Firmware":
        """Read the properties; missing or invalid ones are empty or None."""
        return cls(
            mcu=_text(dictionary, "MCU"),
            version=dictionary.version,
            app=dictionary.app,
            build=dictionary.build_versions,
            clock_hz=_number(dictionary, "CLOCK_FREQ"),
            bitrate=_number(dictionary, "CANBUS_FREQUENCY"),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class CanStatus:
    """The node's own counters of its CAN controller."""

    rx_errors: int
    tx_errors: int
    tx_retries: int
    state: str
    """active, warn, passive or off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeInfo:
    """Information about a node. None: its firmware does not know the query."""

    firmware: Firmware
    uuid: Uuid | None = None
    believed_nodeid: int | None = None
    """The id that it reports."""
    uptime_s: float | None = None
    configured: bool | None = None
    shut_down: bool | None = None
    can: CanStatus | None = None


async def read_node_info(bus: BusTalk, nodeid: int) -> NodeInfo:
    """Query node NODEID, which no other host uses; raises CanductorError."""
    async with bus.node(nodeid) as talk:
        said = [await _said(talk, command, response) for command, response in _QUESTIONS]
        return node_info_of((talk.dictionary,), {message.name: message for message in said if message})


def node_info_of(alike: Sequence[Dictionary], said: Mapping[str, Message]) -> NodeInfo:
    """Return the information from responses by name; of several possible dictionaries what all agree on."""
    firmware = Firmware.common(alike)
    board, config = said.get("canbus_id"), said.get("config")
    return NodeInfo(
        firmware=firmware,
        uuid=_uuid(board),
        believed_nodeid=_integer(board, "canbus_nodeid"),
        uptime_s=_uptime_s(said.get("uptime"), firmware.clock_hz),
        configured=_flag(config, "is_config"),
        shut_down=_flag(config, "is_shutdown"),
        can=_status(said.get("canbus_status"), alike[0]),
    )


async def _said(talk: NodeTalk, command: str, response: str) -> Message | None:
    """Return the answer; None if the firmware lacks the query, or has it with other parameters."""
    if not talk.knows(command, response) or talk.dictionary.commands[command].names:
        return None
    return (await talk.ask(command, response)).message


def _text(dictionary: Dictionary, constant: str) -> str:
    try:
        return dictionary.str_constant(constant, "")
    except DictionaryError:
        return ""


def _number(dictionary: Dictionary, constant: str) -> int | None:
    try:
        return dictionary.int_constant(constant)
    except DictionaryError:
        return None


def _integer(message: Message | None, param: str) -> int | None:
    value = message.params.get(param) if message is not None else None
    return value if isinstance(value, int) else None


def _flag(message: Message | None, param: str) -> bool | None:
    value = _integer(message, param)
    return None if value is None else bool(value)


def _uuid(message: Message | None) -> Uuid | None:
    value = message.params.get("canbus_uuid") if message is not None else None
    return Uuid(value) if isinstance(value, bytes) and len(value) == UUID_SIZE else None


def _uptime_s(message: Message | None, clock_hz: int | None) -> float | None:
    high, clock = _integer(message, "high"), _integer(message, "clock")
    if high is None or clock is None or clock_hz is None:
        return None
    return (high * _TICKS_PER_WORD + clock % _TICKS_PER_WORD) / clock_hz


def _status(message: Message | None, dictionary: Dictionary) -> CanStatus | None:
    numbers = [_integer(message, name) for name in ("rx_error", "tx_error", "tx_retries", BUS_STATES)]
    rx_errors, tx_errors, tx_retries, state = numbers
    if rx_errors is None or tx_errors is None or tx_retries is None or state is None:
        return None
    return CanStatus(
        rx_errors=rx_errors,
        tx_errors=tx_errors,
        tx_retries=tx_retries,
        state=dictionary.enum_name(BUS_STATES, state),
    )
