"""Dictionaries of nodes that nobody asked: guessed from traffic, and taken back when they do not hold."""

from pathlib import Path

import pytest

from canbus_tools.bus.bus_load import LoadMeter
from canbus_tools.monitor.bus_watch import BusWatch, MonitorOptions
from canbus_tools.protocol.decoded import Decoded
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.dictionaries import GUESSED, LEARNT, DictionarySource
from canbus_tools.protocol.frame import Frame
from canbus_tools.protocol.protocol import Direction
from canbus_tools.recordings.candump import candump_line
from canbus_tools.tools.monitor import Lines
from coordinator.cli.main import main
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.dictionary import Dictionary
from tests import real_dictionaries
from tests import wire_twin as twin
from tests.canbus_tools.talk_twin import (
    DICTIONARY,
    DICTIONARY_JSON,
    FROM,
    TO,
    Talk,
    decode,
    identify_pieces,
    other_dictionary,
)
from tests.stages.can_stage import CanStage


def changed(*words: tuple[bytes, bytes]) -> bytes:
    """Return the text of the made-up dictionary with some words replaced."""
    text = DICTIONARY_JSON
    for old, new in words:
        assert old in text
        text = text.replace(old, new)
    return text


def cache_of(folder: Path, *texts: bytes) -> DictionaryCache:
    """Return a cache as a user has it who used the texts in this order."""
    cache = DictionaryCache(folder)
    for text in texts:
        cache.store(b"".join(data for _, data in identify_pieces(text=text)), Dictionary.from_json(text))
    return DictionaryCache(folder)


def host(
    dictionary: Dictionary = DICTIONARY, *, seconds: int = 3, clock: int = 0xFFFF0000, rate: float = 1.0
) -> list[Frame]:
    """Return what a host that asks for the clock every second says and hears."""
    frames: list[Frame] = []
    for n in range(seconds):
        talk = Talk(start_s=100.0 + n)
        talk.data(TO, twin.block(n, dictionary.encode_text("get_clock")))
        ticks = (clock + round(n * rate * dictionary.clock_freq_hz)) & 0xFFFFFFFF
        talk.data(FROM, twin.block(n + 1, dictionary.responses["clock"].encode({"clock": ticks})))
        frames += talk.frames
    return frames


def names(said: list[Decoded]) -> list[str]:
    return [item.name for item in said]


@pytest.mark.parametrize("clock", [0, 0x7FFFF000, 0xFFFFF000])
def test_a_node_that_ran_before_is_named_after_two_clocks(tmp_path: Path, clock: int) -> None:
    cache = cache_of(tmp_path, DICTIONARY_JSON, other_dictionary())
    decoder = BusDecoder(DictionarySource(cache=cache))
    said = names(decode(decoder, host(clock=clock)))
    assert said == ["unknown", "unknown", "unknown", "clock", "get_clock", "clock"]
    node = decoder.nodes[4]
    assert (node.mcu, node.version, node.dictionary_origin) == ("twin", DICTIONARY.version, GUESSED)


@pytest.mark.parametrize("rate", [0.5, 0.95, 1.05, 2.0])
def test_a_clock_that_runs_at_another_rate_is_another_mcu(tmp_path: Path, rate: float) -> None:
    decoder = BusDecoder(DictionarySource(cache=cache_of(tmp_path, DICTIONARY_JSON)))
    assert set(names(decode(decoder, host(seconds=8, rate=rate)))) == {"unknown"}
    assert decoder.nodes[4].dictionary_origin == ""


def test_a_guess_is_taken_back_when_a_block_contradicts_it(tmp_path: Path) -> None:
    decoder = BusDecoder(DictionarySource(cache=cache_of(tmp_path, DICTIONARY_JSON)))
    decode(decoder, host())
    assert decoder.nodes[4].dictionary_origin == GUESSED
    said = decode(decoder, Talk(start_s=110).data(TO, twin.block(5, b"\x5f\x01\x02")).frames)
    assert names(said) == ["unknown"]
    node = decoder.nodes[4]
    assert (node.mcu, node.version, node.dictionary_origin) == ("", "", "")
    assert set(names(decode(decoder, host()))) == {"unknown"}


def test_several_that_fit_are_told_as_far_as_they_agree(tmp_path: Path) -> None:
    newer = changed((DICTIONARY.version.encode(), b"newer"))
    decoder = BusDecoder(DictionarySource(cache=cache_of(tmp_path, newer, DICTIONARY_JSON)))
    assert names(decode(decoder, host()))[-1] == "clock"
    assert (decoder.nodes[4].mcu, decoder.nodes[4].version) == ("twin", "")


def test_several_that_call_it_differently_are_none(tmp_path: Path) -> None:
    other = changed((b'"get_clock"', b'"get_moment"'))
    decoder = BusDecoder(DictionarySource(cache=cache_of(tmp_path, other, DICTIONARY_JSON)))
    assert set(names(decode(decoder, host()))) == {"unknown"}


def test_what_was_heard_is_kept_for_the_next_time(tmp_path: Path) -> None:
    decoder = BusDecoder(DictionarySource(cache=DictionaryCache(tmp_path)))
    talk = Talk()
    for n, (offset, data) in enumerate(identify_pieces()):
        talk.response(n, "identify_response", offset=offset, data=data)
    decode(decoder, talk.frames)
    assert decoder.nodes[4].dictionary_origin == LEARNT
    later = BusDecoder(DictionarySource(cache=DictionaryCache(tmp_path)))
    assert names(decode(later, host()))[-1] == "clock"
    assert later.nodes[4].dictionary_origin == GUESSED


def test_without_a_cache_nothing_is_guessed() -> None:
    source = DictionarySource()
    assert not source.unread(4, Direction.TO_NODE, b"\x04", 1.0)
    assert source.known == {}


@pytest.mark.skipif(not real_dictionaries.PATHS, reason=real_dictionaries.MISSING)
def test_real_firmwares_are_distinguished(tmp_path: Path) -> None:
    texts = {path.stem: path.read_bytes() for path in real_dictionaries.PATHS}
    assert tuple(texts) == real_dictionaries.NAMES
    cache = cache_of(tmp_path, *texts.values())
    for stem, text in texts.items():
        dictionary = Dictionary.from_json(text)
        decoder = BusDecoder(DictionarySource(cache=cache))
        decode(decoder, host(dictionary))
        assert decoder.nodes[4].mcu == dictionary.constants["MCU"], stem


def test_decode_says_that_it_guessed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cache_of(tmp_path / "cache" / "canductor" / "dictionaries", DICTIONARY_JSON)
    log = tmp_path / "some.log"
    log.write_text("".join(map(candump_line, host())))
    assert main(["can", "decode", str(log)]) == 0
    said = capsys.readouterr()
    assert "clock clock=" in said.out.splitlines()[-1]
    assert said.err == (
        f"canductor: node 4: its dictionary (twin {DICTIONARY.version}) is guessed: a dictionary in the"
        " cache explains its traffic; give --dictionary 4=FILE to be certain\n"
    )


def test_lines_say_once_that_they_are_guessed(
    stage: CanStage, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    decoder = BusDecoder(DictionarySource(cache=cache_of(tmp_path / "cache", DICTIONARY_JSON)))
    watch = BusWatch(decoder, LoadMeter(1_000_000), 0.0)
    for frame in host():
        watch.feed(frame)
    options = MonitorOptions(
        bus=stage.options,
        bitrate=1_000_000,
        bitrate_is_known=False,
        dictionaries={},
        duration_s=2.0,  # many rounds
    )
    with stage.computer.listen(options.bus) as queue:
        assert Lines(stage.computer, options, watch, queue).run() == 0
    assert capsys.readouterr().err.count("is guessed") == 1
