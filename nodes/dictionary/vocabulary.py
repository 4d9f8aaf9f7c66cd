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
REQUIRED_RESPONSES: Final = (
    "config is_config=%c crc=%u is_shutdown=%c move_count=%hu",
    "clock clock=%u",
    "uptime high=%u clock=%u",
)
OPTIONAL_RESPONSES: Final = (
    "stats count=%u sum=%u sumsq=%u",
    "shutdown clock=%u static_string_id=%hu",
    "is_shutdown static_string_id=%hu",
    "sync_pulse seq=%c clock=%u",
)


def check_vocabulary(dictionary: Dictionary) -> None:
    """Raise DictionaryError when a firmware cannot be used: it lacks messages, or a constant is no use."""
    for name, params in REQUIRED_COMMANDS.items():
        found = dictionary.commands.get(name)
        if found is None or found.names != params:
            raise _unusable(dictionary, "command", " ".join((name, *params)))
    optional = [text for text in OPTIONAL_RESPONSES if text.split(" ")[0] in dictionary.responses]
    for text in (*REQUIRED_RESPONSES, *optional):
        if not carries(dictionary, text):
            raise _unusable(dictionary, "response", text)
    dictionary.check_constants()


def carries_identity(dictionary: Dictionary) -> bool:
    """Return whether the node answers get_canbus_id with its uuid as bytes."""
    asked = dictionary.commands.get("get_canbus_id")
    return asked is not None and not asked.names and carries(dictionary, "canbus_id canbus_uuid=%.*s")


def carries(dictionary: Dictionary, response: str) -> bool:
    """Return whether the firmware has RESPONSE, a format; its numbers may have other sizes.

    More parameters do not matter.
    """
    name, *params = response.split(" ")
    found = dictionary.responses.get(name)
    if found is None:
        return False
    codes = dict(zip(found.names, found.code_texts, strict=True))
    wanted = dict(param.split("=") for param in params)
    return all(
        param in codes and codes[param].endswith("s") == code.endswith("s") for param, code in wanted.items()
    )


def _unusable(dictionary: Dictionary, kind: str, wanted: str) -> DictionaryError:
    return DictionaryError(f"firmware {dictionary.version!r} has no {kind} {wanted!r} and cannot be driven")
