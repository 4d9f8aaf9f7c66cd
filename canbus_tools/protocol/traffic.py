"""Counters of one node's traffic, from listening."""

import math
from collections.abc import Iterable

from canbus_tools.protocol.dictionaries import GUESSED, DictionarySource
from canbus_tools.protocol.flow import Flow


class DirectionTraffic:
    """Counters of one direction."""

    def __init__(self) -> None:
        self.frames = 0
        self.bytes = 0
        """Bytes of payload."""
        self.blocks = 0
        self.messages = 0
        """Commands or responses; repeated ones count once."""
        self.unknown_messages = 0
        """Blocks with a message that could not be read: no dictionary, or another firmware's."""
        self.invalid_bytes = 0
        """Bytes of payload that are not part of a block."""
        self.noises = 0
        """Sequences of such bytes."""

    def to_json(self) -> dict[str, int]:
        """Return all counters."""
        return dict(vars(self))


class NodeTraffic:
    """What listening shows about one node."""

    def __init__(self, nodeid: int) -> None:
        self.nodeid = nodeid
        self.uuid: str | None = None
        """From admin frames or the node; None: unknown."""
        self.mcu = ""
        self.version = ""
        self.dictionary_origin = ""
        """Empty: there is no dictionary."""
        self.to_node = DirectionTraffic()
        self.from_node = DirectionTraffic()
        self.flow = Flow()
        self.last_heard_s = math.nan
        """Time of the node's last frame."""

    def take_dictionary(self, dictionaries: DictionarySource) -> None:
        """Set the fields that come from the node's dictionary."""
        dictionary = dictionaries.known.get(self.nodeid)
        self.dictionary_origin = dictionaries.origins.get(self.nodeid, "")
        alike = dictionaries.fitting.get(self.nodeid) or ((dictionary,) if dictionary else ())
        self.mcu = _common(str(each.constants.get("MCU", ""))[:80] for each in alike)
        self.version = _common(each.version for each in alike)

    @property
    def guess(self) -> str | None:
        """A sentence about the node's dictionary if it is a guess."""
        if self.dictionary_origin != GUESSED:
            return None
        what = " ".join(filter(None, (self.mcu, self.version))) or "one of several"
        return (
            f"node {self.nodeid}: its dictionary ({what}) is guessed: a dictionary in the cache explains its "
            f"traffic; give --dictionary {self.nodeid}=FILE to be certain"
        )

    def to_json(self) -> dict[str, object]:
        """Return it as ``--json`` shows it."""
        return {
            "nodeid": self.nodeid,
            "uuid": self.uuid,
            "mcu": self.mcu or None,
            "version": self.version or None,
            "dictionary": self.dictionary_origin or None,
            "to_node": self.to_node.to_json(),
            "from_node": self.from_node.to_json(),
            "repeated_blocks": self.flow.repeated_blocks,
            "missed_blocks": self.flow.missed_blocks,
            "naks": self.flow.naks,
            "rtt": self.flow.round_trips.to_json(),
            "last_heard_s": None if math.isnan(self.last_heard_s) else self.last_heard_s,
        }


def _common(texts: Iterable[str]) -> str:
    """Return the text that all of TEXTS are, or an empty one."""
    different = set(texts)
    return different.pop() if len(different) == 1 else ""
