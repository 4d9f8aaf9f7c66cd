"""Information about nodes in use, without queries: from their traffic with their host.

Hosts query the clocks of their nodes, and on CAN their error counters, about once a second.
"""

from typing import Final

from canbus_tools.discovery.node_info import NodeInfo, node_info_of
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.dictionaries import DictionarySource
from canbus_tools.protocol.frame import Frame as BusFrame
from canbus_tools.protocol.protocol import Direction
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.message_format import Message
from nodes.link import Frame

_ANSWERS: Final = {"canbus_id", "config", "uptime", "canbus_status"}
ID_MAX: Final = 0x7FF


class PassiveDiscovery:
    """Evaluates the traffic of one bus."""

    def __init__(self, cache: DictionaryCache) -> None:
        self._source = DictionarySource(cache=cache)
        self._decoder = BusDecoder(self._source)
        self._said: dict[int, dict[str, Message]] = {}

    def frame(self, frame: Frame) -> None:
        """Take a frame between a node and another program."""
        if frame.can_id > ID_MAX:
            return
        for said in self._decoder.feed(BusFrame(frame.received_ns * 1e-9, frame.can_id, frame.data)):
            if said.nodeid is not None and said.direction is Direction.FROM_NODE and said.name in _ANSWERS:
                messages = self._said.setdefault(said.nodeid, {})
                messages[said.name] = Message(said.name, dict(said.params))

    def is_open(self, nodeid: int) -> bool:
        """Return whether more traffic may identify NODEID's dictionary."""
        return self._source.is_open(nodeid)

    def facts(self, nodeid: int) -> NodeInfo | None:
        """Return the information about a node; None: its dictionary is unknown."""
        dictionary = self._source.known.get(nodeid)
        if dictionary is None:
            return None
        alike = self._source.fitting.get(nodeid, (dictionary,))
        return node_info_of(alike, self._said.get(nodeid, {}))
