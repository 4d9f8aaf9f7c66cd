"""The messages that the coordinator needs of any firmware, checked once when its dictionary is read.

Afterwards these messages, and the constants, can be used without a check; an unsuitable dictionary raises one
sentence here.
"""

from typing import Final

from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.parts import DictionaryError

KNOWS_BUS_STOP: Final = "CAN_BUS_STOP"
"""A constant: firmware that has it stops its whole bus on request, or when it shuts down itself."""
REQUIRED_COMMANDS: Final = {
    "get_config": (),
    "allocate_oids": ("count",),
    "finalize_config": ("crc",),
    "get_clock": (),
    "get_uptime": (),
}
REQUIRED_RESPONSES: Final = {
    "config": ("is_config", "crc", "is_shutdown", "move_count"),
    "clock": ("clock",),
    "uptime": ("high", "clock"),
}
OPTIONAL_RESPONSES: Final = {
    "stats": ("count", "sum", "sumsq"),
    "shutdown": ("clock", "static_string_id"),
    "is_shutdown": ("static_string_id",),
    "stepper_position": ("oid", "pos"),
    "sync_pulse": ("seq", "clock"),
}


def check_vocabulary(dictionary: Dictionary) -> None:
    """Raise DictionaryError when a firmware cannot be used: it lacks messages, or a constant is no use."""
    for name, params in REQUIRED_COMMANDS.items():
        found = dictionary.commands.get(name)
        if found is None or found.names != params:
            raise _unusable(dictionary, "command", name, params)
    optional = {name: p for name, p in OPTIONAL_RESPONSES.items() if name in dictionary.responses}
    for name, params in (REQUIRED_RESPONSES | optional).items():
        if name not in dictionary.responses or not _carries(dictionary, name, params):
            raise _unusable(dictionary, "response", name, params)
    dictionary.check_constants()


def carries_identity(dictionary: Dictionary) -> bool:
    """Return whether the node answers get_canbus_id with its uuid as bytes."""
    format_ = dictionary.responses.get("canbus_id")
    asked = dictionary.commands.get("get_canbus_id")
    if format_ is None or asked is None or asked.names:
        return False
    codes = dict(zip(format_.names, format_.code_texts, strict=True))
    return codes.get("canbus_uuid", "").endswith("s")


def _carries(dictionary: Dictionary, name: str, params: tuple[str, ...]) -> bool:
    found = dictionary.responses[name]
    codes = dict(zip(found.names, found.code_texts, strict=True))
    return all(not codes.get(param, "s").endswith("s") for param in params)


def _unusable(dictionary: Dictionary, kind: str, name: str, params: tuple[str, ...]) -> DictionaryError:
    wanted = " ".join((name, *params))
    return DictionaryError(f"firmware {dictionary.version!r} has no {kind} {wanted!r} and cannot be driven")
