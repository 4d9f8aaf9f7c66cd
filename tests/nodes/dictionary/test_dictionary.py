"""The data dictionary: what it reads, refuses, encodes and decodes."""

import contextlib
import json
import zlib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodes.dictionary.dictionary import BOOTSTRAP, MAX_INFLATED_BYTES, Dictionary, _unique
from nodes.dictionary.message_format import Message, MessageError, MessageFormat, Value
from nodes.dictionary.parts import OUTPUT, DictionaryError
from tests import real_dictionaries
from tests import wire_twin as twin
from tests.nodes.dictionary.as_sent import decode_as_sent
from tests.profiles import examples

ROOT = Path(__file__).parents[3]
DATA = ROOT / "tests" / "data"
REAL = real_dictionaries.PATHS
TEXT = (DATA / "dictionary.json").read_bytes()
SMALL = Dictionary.from_json(TEXT)
real_only = pytest.mark.skipif(not REAL, reason=real_dictionaries.MISSING)


def changed(**parts: Any) -> bytes:
    return json.dumps(json.loads(TEXT) | parts).encode()


# ------------------------------------------------------------------------------------------------------ reads


def test_what_a_dictionary_says() -> None:
    assert (SMALL.version, SMALL.app, SMALL.license) == ("vectors-1", "canductor", "Apache-2.0")
    assert SMALL.clock_freq_hz == 1_000_000
    assert SMALL.receive_window == 192
    assert SMALL.str_constant("MCU") == "twin"


def test_ranges_count_up_from_the_number_at_the_names_end() -> None:
    assert SMALL.enumerations["pin"].value_of("PA15") == 15
    assert SMALL.enumerations["pin"].value_of("PB0") == 16
    assert SMALL.enumerations["pin"].value_of("gpiochip1/gpio3") == 291
    with pytest.raises(MessageError, match="no pin 'PA16'"):
        SMALL.enumerations["pin"].value_of("PA16")
    assert SMALL.enum_name("static_string_id", 1) == "Timer too close"
    assert SMALL.enum_name("static_string_id", 77) == "?77"


def test_an_enumeration_applies_to_parameters_that_end_in_its_name() -> None:
    for param in ("pin", "step_pin", "a_step_pin", "static_string_id"):
        assert SMALL.enumeration_for(param) is not None, param
    for param in ("pins", "spin", "id", ""):
        assert SMALL.enumeration_for(param) is None, param


@real_only
@pytest.mark.parametrize("path", REAL, ids=lambda p: p.stem)
def test_dictionaries_of_real_boards_load(path: Path) -> None:
    dictionary = Dictionary.parse(zlib.compress(path.read_bytes()))
    raw = json.loads(path.read_bytes())
    assert len(dictionary.commands) == len(raw["commands"])
    assert len(dictionary.responses) == len(raw["responses"])
    assert dictionary.constants == raw["config"]
    assert {f.text: f.message_id for f in dictionary.commands.values()} == raw["commands"]


# ------------------------------------------------------------------------------------------------- round trip


DICTIONARIES = {"small": SMALL, **{path.stem: Dictionary.from_json(path.read_bytes()) for path in REAL}}
LONGEST = 20
"""Bytes of the longest text that is tried; a message has room for 59."""


def messages_of(dictionary: Dictionary) -> list[MessageFormat]:
    return [*dictionary.commands.values(), *dictionary.responses.values()]


def bounds(code: str) -> tuple[int, int]:
    bits, signed = twin.CODES[code]
    low = -(1 << (bits - 1)) if signed else 0
    return low, low + (1 << bits) - 1


def check_round_trip(dictionary: Dictionary, message: MessageFormat, values: dict[str, Value]) -> None:
    encoded = twin.encode_message(message.message_id, list(message.code_texts), list(values.values()))
    if len(encoded) > 59:
        with pytest.raises(MessageError, match="59 bytes"):
            message.encode(values)
        return
    assert message.encode(values) == encoded
    expected = Message(message.name, values)
    if message.name in dictionary.responses:
        assert dictionary.decode(encoded) == expected
        assert dictionary.decode(encoded + b"\0") is None
        assert dictionary.decode(encoded[:-1]) is None
    else:
        assert dictionary.decode_commands(encoded * 2) == [expected] * 2
        assert dictionary.encode_text(str(expected)) == encoded


def values_at(message: MessageFormat, place: int) -> dict[str, Value]:
    """Return the lowest values (PLACE 0), the highest (1), or numbers of a middling size."""
    texts: tuple[Value, ...] = (b"", b"\xff" * LONGEST, b"\x7e\0")
    choices: list[tuple[Value, ...]] = [
        (*bounds(code), 200) if code in twin.CODES else texts for code in message.code_texts
    ]
    return {name: choice[place] for name, choice in zip(message.names, choices, strict=True)}


@pytest.mark.parametrize("name", DICTIONARIES)
def test_every_format_round_trips(name: str) -> None:
    dictionary = DICTIONARIES[name]
    for message in messages_of(dictionary):
        for place in range(3):
            check_round_trip(dictionary, message, values_at(message, place))


@st.composite
def any_message(draw: st.DrawFn) -> tuple[Dictionary, MessageFormat, dict[str, Value]]:
    dictionary = draw(st.sampled_from(list(DICTIONARIES.values())))
    message = draw(st.sampled_from(messages_of(dictionary)))
    values: dict[str, Value] = {
        name: draw(st.integers(*bounds(code))) if code in twin.CODES else draw(st.binary(max_size=LONGEST))
        for name, code in zip(message.names, message.code_texts, strict=True)
    }
    return dictionary, message, values


@settings(max_examples=examples(400))
@given(any_message())
def test_any_values_round_trip(drawn: tuple[Dictionary, MessageFormat, dict[str, Value]]) -> None:
    check_round_trip(*drawn)


@given(st.binary(max_size=70))
def test_garbage_decodes_to_a_message_or_nothing(content: bytes) -> None:
    assert isinstance(SMALL.decode(content), Message | None)
    commands = SMALL.decode_commands(content)
    assert commands is None or all(isinstance(m, Message) for m in commands)
    exact = decode_as_sent(SMALL, content)
    assert (exact is None) == (commands is None)


def test_ids_in_more_bytes_than_they_need_are_legal() -> None:
    assert SMALL.decode(bytes.fromhex("ff78")) == Message("starting", {})
    assert SMALL.decode(bytes.fromhex("78")) == Message("starting", {})
    assert SMALL.decode(bytes.fromhex("8100 05 7f")) == Message("stepper_position", {"oid": 5, "pos": -1})


def test_debug_outputs_become_their_text() -> None:
    encoded = twin.vlq_encode(129) + twin.vlq_encode(3) + b"bed" + twin.vlq_encode(-7) + twin.vlq_encode(40)
    assert SMALL.decode(encoded) == Message(OUTPUT, {"text": b"heater bed at -7 of 40%"})
    assert SMALL.decode(encoded[:-1]) is None
    assert SMALL.decode(twin.vlq_encode(130)) == Message(OUTPUT, {"text": b"plain text"})


# ----------------------------------------------------------------------------------------------------- encode


def test_names_stand_for_their_values() -> None:
    text = "config_stepper oid=0 step_pin=PB3 dir_pin=PA1 invert_step=-1 step_pulse_ticks=0x10"
    assert SMALL.encode_text(text) == SMALL.encode(
        "config_stepper", oid=0, step_pin=19, dir_pin="PA1", invert_step=-1, step_pulse_ticks=16
    )


def test_buffers_in_text_are_hex_or_quoted() -> None:
    for text in ("data=680069", "data=0x680069", 'data="h\0i"'):
        assert SMALL.encode_text("debug_ping " + text) == SMALL.encode("debug_ping", data=b"h\0i")
    assert SMALL.encode_text(r'debug_ping data="a \"b\""') == SMALL.encode("debug_ping", data=b'a "b"')
    assert SMALL.encode_text("debug_ping data=") == SMALL.encode("debug_ping", data=b"")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("fly_away", "no command 'fly_away'"),
        ("", "no command ''"),
        ("queue_step oid=1 interval=1 count=1", "missing add; .*has 'queue_step oid=%c"),
        ("queue_step oid=1 interval=1 count=1 add=0 speed=3", "unknown speed"),
        ("queue_step oid=256 interval=1 count=1 add=0", "oid=256 is outside -128..255"),
        ("queue_step oid=1 interval=4294967296 count=1 add=0", "interval=4294967296 is outside"),
        ("queue_step oid=1 interval=1 count=65536 add=0", "count=65536"),
        ("queue_step oid=1 interval=1 count=1 add=32768", "add=32768 is outside -32768..32767"),
        ("queue_step oid=1 oid=1 interval=1 count=1 add=0", "oid is given twice"),
        ("queue_step oid=one interval=1 count=1 add=0", "oid takes no names"),
        ("set_digital_out pin=PZ9 value=1", "no pin 'PZ9'"),
        ("set_digital_out pin value=1", "'pin value=1' is not parameter=value"),
        ("debug_ping data=abc", "hex digits"),
        ("debug_ping data=" + "00" * 60, "59 bytes"),
    ],
)
def test_what_cannot_be_encoded_is_said(text: str, sentence: str) -> None:
    with pytest.raises(MessageError, match=sentence):
        SMALL.encode_text(text)


@given(st.text(max_size=60))
def test_any_text_encodes_or_is_refused(text: str) -> None:
    for prefix in ("", "queue_step ", "debug_ping data="):
        try:
            encoded = SMALL.encode_text(prefix + text)
        except MessageError:
            continue
        assert SMALL.decode_commands(encoded) is not None


# ---------------------------------------------------------------------------------------------------- refuses


@pytest.mark.parametrize(
    ("parts", "sentence"),
    [
        ({"commands": []}, "commands must be an object"),
        ({"commands": {"a": 5, "b": 5}}, "id 5 belongs to both 'a' and 'b'"),
        ({"commands": {"a": 5}, "responses": {"b": 5}}, "id 5 belongs to both"),
        ({"commands": {"a x=%c": 5, "a y=%c": 6}}, "commands has 'a' twice"),
        ({"commands": {"a": "5"}}, "id of 'a' must be a whole number"),
        ({"commands": {"a": True}}, "id of 'a' must be a whole number"),
        ({"commands": {"a": 1.5}}, "id of 'a' must be a whole number"),
        ({"commands": {"a": 8192}}, "outside -4096..8191"),
        ({"commands": {"a": -4097}}, "outside -4096..8191"),
        ({"commands": {"a x=%q": 5}}, "unknown parameter code '%q'"),
        ({"commands": {"a x": 5}}, "unknown parameter code ''"),
        ({"commands": {"a x=%c x=%c": 5}}, "not a new name=code"),
        ({"commands": {"a  x=%c": 5}}, "not a new name=code"),
        ({"commands": {"9a": 5}}, "does not start with a message name"),
        ({"commands": {"a " + " ".join(f"p{i}=%c" for i in range(17)): 5}}, "too long"),
        ({"commands": {f"c{i}": i for i in range(513)}}, "more than 512"),
        ({"commands": {f"c{i}": 1000 + i for i in range(500)}}, "more than 512 messages"),
        ({"commands": {"identify offset=%u count=%c": 9}}, "identify must be .* id 1"),
        ({"responses": {"identify_response offset=%u data=%u": 0}}, "identify_response must be"),
        ({"output": {"hm %x": 500}}, "unknown code"),
        ({"output": {"hm": 1}}, "id 1 belongs to both"),
        ({"enumerations": 3}, "enumerations must be an object"),
        ({"enumerations": {"pin": [1]}}, "enumeration 'pin' must be an object"),
        ({"enumerations": {"pin": {"PA0": "x"}}}, "must be a number or"),
        ({"enumerations": {"pin": {"PA0": [0]}}}, "must be a number or"),
        ({"enumerations": {"pin": {"PA0": [0, 0]}}}, "must be a number or"),
        ({"enumerations": {"pin": {"PA0": [0, 1 << 40]}}}, "must be a number or"),
        ({"enumerations": {"pin": {"PA0": [True, 2]}}}, "must be a number or"),
        ({"enumerations": {"pin": {"PA": [0, 8]}}}, "does not end in a number"),
        ({"enumerations": {"pin": {"PA0": [0, 8], "PA3": 9}}}, "two values for 'PA3'"),
        ({"enumerations": {f"e{i}": {"a0": [0, 6000]} for i in range(3)}}, "more than 16384 values"),
        ({"config": {"CLOCK_FREQ": []}}, "constant 'CLOCK_FREQ' must be a number or a text"),
        ({"config": 1}, "config must be an object"),
        ({"version": 3}, "version must be a text"),
    ],
)
def test_hostile_parts_are_refused_in_a_sentence(parts: dict[str, Any], sentence: str) -> None:
    with pytest.raises(DictionaryError, match=sentence):
        Dictionary.from_json(changed(**parts))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (b"", "not usable JSON"),
        (b"\xff\xfe", "not usable JSON"),
        (b"[]", "not a JSON object"),
        (b"[" * 60_000, "not usable JSON"),
        (b'{"config": {"A": NaN}}', "NaN is not a number"),
        (b'{"version": "a", "version": "b"}', "'version' stands twice"),
        (b'{"config": {"A": ' + b"9" * 5000 + b"}}", "not usable JSON"),
        (b'{"config": {"ADC_MAX": ' + b"9" * 400 + b"}}", "has more than 64 bits"),
        (b'{"config": {"A": -1e999}}', "is too large"),
        (b'{"output": {"x\\ud800 %u": 7}}', "a text in it has half of a surrogate pair"),
        (b" " * (MAX_INFLATED_BYTES + 1), "more than 65536 bytes"),
    ],
)
def test_hostile_json_is_refused_in_a_sentence(text: bytes, sentence: str) -> None:
    with pytest.raises(DictionaryError, match=sentence):
        Dictionary.from_json(text)


class ComparedName(str):
    """A name that counts how often names are compared."""

    __slots__ = ()
    compared = 0

    def __eq__(self, other: object) -> bool:
        ComparedName.compared += 1
        return str.__eq__(self, other)

    __hash__ = str.__hash__


def test_a_name_that_stands_twice_is_found_in_one_pass() -> None:
    """By the square of their number, the names that a node can send took the loop minutes."""
    names = [ComparedName(f"n{i}") for i in range(1000)] + [ComparedName("n999")]
    with pytest.raises(ValueError, match="'n999' stands twice in one object"):
        _unique([(name, 1) for name in names])
    assert ComparedName.compared <= len(names)


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        (b"garbage", "not zlib data"),
        (b"", "ends early"),
        (zlib.compress(TEXT)[:-5], "ends early"),
        (zlib.compress(b"\0" * (8 << 20)), "inflates to more than 65536 bytes"),
        (b"\x78\xda" + b"x" * (1 << 15), "more than 32768 bytes compressed"),
    ],
)
def test_hostile_downloads_are_refused_in_a_sentence(data: bytes, sentence: str) -> None:
    with pytest.raises(DictionaryError, match=sentence):
        Dictionary.parse(data)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=12), inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.sampled_from(sorted(json.loads(TEXT))), JSON))
def test_any_json_parses_or_is_refused(source: dict[str, Any]) -> None:
    with contextlib.suppress(DictionaryError):
        Dictionary.from_json(json.dumps(source).encode())


@pytest.mark.parametrize(
    ("config", "sentence"),
    [
        ({}, r"CLOCK_FREQ must be a whole number of 1\.\.4294967295 and is missing"),
        ({"CLOCK_FREQ": 0}, "and is 0; flash"),
        ({"CLOCK_FREQ": "fast"}, "is 'fast'"),
        (
            {"CLOCK_FREQ": 1, "RECEIVE_WINDOW": 5},
            r"RECEIVE_WINDOW must be .* 64\.\.1048575 and is 5",
        ),
    ],
)
def test_constants_that_cannot_work_are_said(config: dict[str, Any], sentence: str) -> None:
    dictionary = Dictionary.from_json(changed(config=config))
    with pytest.raises(DictionaryError, match=sentence):
        assert dictionary.clock_freq_hz + dictionary.receive_window


def test_before_the_dictionary_a_node_can_be_identified() -> None:
    assert BOOTSTRAP.encode("identify", offset=0, count=40) == bytes.fromhex("010028")
    assert BOOTSTRAP.decode(b"\x00\x00\x02ab") == Message("identify_response", {"offset": 0, "data": b"ab"})
