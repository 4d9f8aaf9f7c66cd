"""The Wireshark dissector: in tshark it says of every frame what the project's own decoder says."""

import random
from collections.abc import Sequence
from pathlib import Path

import pytest

from canbus_tools.decoder import BusDecoder
from canbus_tools.decoded import Kind
from canbus_tools.dictionaries import DictionarySource, read_dictionary
from canbus_tools.dissector import ANY, lua
from canbus_tools.frame import Frame, FrameKind
from canbus_tools.protocol import ADMIN_FRAMES, SIGNAL_FRAMES, Direction, data_id
from coordinator import cli
from nodes.dictionary import Dictionary
from nodes.virtual.firmware import TOOLHEAD, firmware_dictionary
from tests.canbus_tools import recorded
from tests.canbus_tools.tshark import Tshark

NODEID = recorded.NODEID


def linux_dictionary() -> Dictionary:
    """Of the node in the recorded session."""
    paths = sorted((recorded.SHARED / "dictionaries").glob("linuxprocess*"))
    if not paths:
        pytest.skip("no dictionary of the recorded session in ../shared")
    return read_dictionary(paths[0])


def said_by_decoder(frames: Sequence[Frame], dictionaries: dict[int, Dictionary]) -> list[list[str]]:
    """For every frame the texts it completes, repeats marked, frames of other protocols left out."""
    source = DictionarySource(dictionaries)
    source.hear = lambda *_: None  # type: ignore[method-assign]  # the dissector knows only what it was given
    decoder = BusDecoder(source)
    said = []
    for frame in frames:
        found = [d for d in decoder.feed(frame) if d.kind not in (Kind.OTHER, Kind.ERROR)]
        said.append([f"{d.kind.value} {d.text}" for d in found])
    return said


def said_by_tshark(tshark: Tshark, *words: str) -> list[list[str]]:
    """The same from Wireshark."""
    found = []
    for layers in tshark.layers(["canductor.kind", "canductor.text"], *words):
        texts, kinds = layers.get("canductor.text", []), layers.get("canductor.kind", [])
        # A block with several commands has one kind.
        if len(set(kinds)) == 1:
            kinds = kinds[:1] * len(texts)
        assert len(kinds) == len(texts), (kinds, texts)
        found.append([f"{kind} {text}" for kind, text in zip(kinds, texts, strict=True)])
    return found


def test_a_real_session_reads_as_our_decoder_reads_it(tmp_path: Path) -> None:
    frames = recorded.frames()
    dictionary = linux_dictionary()
    tshark = Tshark(tmp_path, {ANY: dictionary})
    tshark.load(frames)
    expected = said_by_decoder(frames, {NODEID: dictionary})
    assert sum(map(len, expected)) > 800
    assert said_by_tshark(tshark) == expected
    assert said_by_tshark(tshark, "-2") == expected
