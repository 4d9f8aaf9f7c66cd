"""Frames of a made-up conversation, from the slow and obvious twin of the wire protocol."""

import itertools
import json
import zlib
from collections.abc import Sequence
from pathlib import Path

from canbus_tools.protocol.decoded import Decoded
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.frame import Frame
from canbus_tools.protocol.protocol import Direction, data_id
from nodes.dictionary.dictionary import Dictionary
from tests import wire_twin as twin

DICTIONARY_JSON = (Path(__file__).parents[1] / "data" / "dictionary.json").read_bytes()
DICTIONARY = Dictionary.from_json(DICTIONARY_JSON)
TO, FROM = Direction.TO_NODE, Direction.FROM_NODE


class Talk:
    """Makes frames, a millisecond apart."""

    def __init__(self, nodeid: int = 4, start_s: float = 100.0, step_s: float = 0.001) -> None:
        self.nodeid = nodeid
        self.frames: list[Frame] = []
        self._times = (start_s + i * step_s for i in itertools.count())

    def data(self, direction: Direction, data: bytes) -> "Talk":
        can_id = data_id(self.nodeid, direction)
        for at in range(0, len(data), 8):
            self.frames.append(Frame(next(self._times), can_id, data[at : at + 8], channel="can0"))
        return self

    def command(self, seq: int, *texts: str) -> "Talk":
        return self.data(TO, twin.block(seq, b"".join(DICTIONARY.encode_text(text) for text in texts)))

    def response(self, following: int, name: str, **values: int | bytes) -> "Talk":
        return self.data(FROM, twin.block(following, DICTIONARY.responses[name].encode(values)))

    def ack(self, following: int) -> "Talk":
        return self.data(FROM, twin.block(following))

    def frame(self, can_id: int, data: bytes) -> "Talk":
        self.frames.append(Frame(next(self._times), can_id, data, channel="can0"))
        return self


def identify_pieces(size: int = 40, text: bytes = DICTIONARY_JSON) -> list[tuple[int, bytes]]:
    """Return a whole download: offsets and data, the last one empty."""
    compressed = zlib.compress(text)
    pieces = [(at, compressed[at : at + size]) for at in range(0, len(compressed), size)]
    return [*pieces, (len(compressed), b"")]


def download(talk: Talk, pieces: list[tuple[int, bytes]]) -> Talk:
    """Add to TALK the answers to a host that asks for these pieces of a dictionary."""
    for n, (offset, data) in enumerate(pieces):
        talk.response(n, "identify_response", offset=offset, data=data)
    return talk


def other_dictionary() -> bytes:
    """Return the text of another firmware: get_clock has another id."""
    source = json.loads(DICTIONARY_JSON)
    source["commands"]["get_clock"] = 99
    source["version"] = "another"
    return json.dumps(source).encode()


def decode(decoder: BusDecoder, frames: Sequence[Frame]) -> list[Decoded]:
    return [*itertools.chain.from_iterable(map(decoder.feed, frames)), *decoder.flush()]


def texts(said: Sequence[Decoded]) -> list[str]:
    return [item.text for item in said]
