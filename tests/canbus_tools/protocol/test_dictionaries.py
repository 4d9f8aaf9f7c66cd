"""Dictionaries that the decoder learns by listening: downloads, the cache, other firmware."""

from pathlib import Path

from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.dictionaries import CACHED, GIVEN, LEARNT, DictionarySource
from nodes.dictionary.cache import DictionaryCache
from tests.canbus_tools.talk_twin import (
    DICTIONARY,
    DICTIONARY_JSON,
    Talk,
    decode,
    download,
    identify_pieces,
    other_dictionary,
)


def test_a_dictionary_is_learnt_from_a_download() -> None:
    talk = download(Talk(), identify_pieces()[:-1]).response(3, "clock", clock=9)
    decoder = BusDecoder()
    assert decode(decoder, talk.frames)[-1].text == "clock clock=9"
    assert (decoder.nodes[4].mcu, decoder.nodes[4].dictionary_origin) == ("twin", LEARNT)


def test_pieces_asked_twice_and_a_download_begun_anew() -> None:
    pieces = identify_pieces()
    talk = download(Talk(), [*pieces[:3], pieces[1], *pieces[:2], *pieces[2:]])
    decoder = BusDecoder()
    decode(decoder, talk.frames)
    learnt = decoder.dictionaries.known[4]
    assert learnt.constants == DICTIONARY.constants
    assert (learnt.commands.keys(), learnt.responses.keys()) == (
        DICTIONARY.commands.keys(),
        DICTIONARY.responses.keys(),
    )


def test_other_firmware_replaces_what_was_learnt_and_not_what_was_given() -> None:
    talk = download(download(Talk(), identify_pieces()), identify_pieces(text=other_dictionary()))
    decoder = BusDecoder()
    decode(decoder, talk.frames)
    assert decoder.nodes[4].version == "another"
    decoder = BusDecoder(DictionarySource({4: DICTIONARY}))
    decode(decoder, talk.frames)
    assert decoder.dictionaries.known[4] is DICTIONARY
    assert decoder.nodes[4].dictionary_origin == GIVEN


def test_another_board_with_the_id_is_not_taken_for_the_first() -> None:
    talk = Talk().frame(0x3F0, b"\x01" + b"first!" + b"\x04")
    download(talk, identify_pieces()).frame(0x3F0, b"\x01" + b"first!" + b"\x04").response(
        1, "clock", clock=9
    )
    talk.frame(0x3F0, b"\x01" + b"second" + b"\x04").response(1, "clock", clock=9)
    decoder = BusDecoder()
    said = decode(decoder, talk.frames)
    assert [item.name for item in said if item.name in ("clock", "unknown")] == ["clock", "unknown"]
    assert decoder.nodes[4].mcu == ""


def test_a_dictionary_of_the_cache_is_recognised_by_three_pieces(tmp_path: Path) -> None:
    pieces = identify_pieces(size=40)
    compressed = b"".join(data for _, data in pieces)
    cache = DictionaryCache(tmp_path)
    cache.store(compressed, DICTIONARY)
    tail_at = len(compressed) - 40
    proof = [(0, compressed[:40]), (tail_at, compressed[tail_at:]), (len(compressed), b"")]
    decoder = BusDecoder(DictionarySource(cache=DictionaryCache(tmp_path)))
    decode(decoder, download(Talk(), proof).response(1, "clock", clock=9).frames)
    assert decoder.nodes[4].dictionary_origin == CACHED
    assert decoder.nodes[4].from_node.unknown_messages == 0
    for wrong in ([proof[0], proof[2]], [proof[0], (tail_at, bytes(40)), proof[2]], proof[:2]):
        decoder = BusDecoder(DictionarySource(cache=DictionaryCache(tmp_path)))
        decode(decoder, download(Talk(), wrong).frames)
        assert decoder.nodes[4].dictionary_origin == ""


def test_a_bomb_is_given_up() -> None:
    pieces = identify_pieces(text=DICTIONARY_JSON + b" " * (2 << 20))
    decoder = BusDecoder()
    decode(decoder, download(Talk(), pieces).frames)
    assert decoder.dictionaries.known == {}
