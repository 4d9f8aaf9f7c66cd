"""Framing, calls and messages, without any I/O: whatever comes, memory is bounded and nothing raises."""

import contextlib
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.klippy_api.client import Client
from coordinator.klippy_api.params import RequestError, objects_param, template_param, text_param
from coordinator.klippy_api.subscription import Status, Subscription, select_fields
from coordinator.klippy_api.wire import (
    MESSAGE_BYTES_MAX,
    Framer,
    Request,
    TooLongError,
    UnreadableError,
    UnwritableError,
    encode,
    read_request,
    result_message,
)
from tests.profiles import examples
from tests.stages.call_counter import count_calls


@given(st.lists(st.binary(max_size=40).filter(lambda body: b"\x03" not in body), max_size=6), st.data())
@settings(max_examples=examples(40))
def test_messages_come_out_whole_however_they_are_cut(bodies: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(body + b"\x03" for body in bodies)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    framer, found = Framer(), list[bytes]()
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        framer.feed(stream[begin:end])
        found += [body for body, _ in iter(framer.next_message, None)]
        assert not framer.has_message
    assert found == [body for body in bodies if body]


def test_a_message_may_have_so_many_bytes_and_no_more() -> None:
    body = b"x" * MESSAGE_BYTES_MAX
    framer = Framer()
    framer.feed(body + b"\x03")
    assert framer.next_message() == (body, False)
    for too_long in (body + b"x", body + b"x\x03"):
        framer = Framer()
        framer.feed(too_long)
        with pytest.raises(TooLongError):
            framer.next_message()


@given(st.lists(st.sampled_from(["a", "b", "", "m112", "{EMERGENCY_STOP"]), max_size=12), st.data())
@settings(max_examples=examples(60))
def test_urgent_messages_come_first_however_they_are_cut(bodies: list[str], data: st.DataObject) -> None:
    stream = "".join(body + "\x03" for body in bodies).encode()
    cut = data.draw(st.integers(0, len(stream)))
    framer = Framer()
    framer.feed(stream[:cut])
    early = stream[:cut].count(b"\x03")
    assert taken(framer) == expected(bodies[:early])
    framer.feed(stream[cut:])
    assert taken(framer) == expected(bodies[early:])


def taken(framer: Framer) -> list[tuple[str, bool]]:
    """Return the messages of FRAMER as a client takes them, each with whether it was overtaken."""
    found = list[tuple[str, bool]]()
    while True:
        urgent = framer.next_urgent()
        message = framer.next_message() if urgent is None else (urgent, False)
        if message is None:
            return found
        found.append((message[0].decode(), message[1]))


def expected(bodies: list[str]) -> list[tuple[str, bool]]:
    urgent = [place for place, body in enumerate(bodies) if len(body) > 1]
    others = [(body, place < max(urgent, default=0)) for place, body in enumerate(bodies) if len(body) == 1]
    return [(bodies[place], False) for place in urgent] + others


@pytest.mark.parametrize("body", [b"", b"{}", b"M112", b'{"method":"x"}'])
def test_what_is_received_costs_nothing_before_its_turn(body: bytes) -> None:
    """Failed before: all of it was cut and searched at once, beyond the share of its client."""
    client = Client("a client")
    flood = (body + b"\x03") * (65_536 // (len(body) + 1))
    assert count_calls(lambda: client.receive(flood)) < 10

    def take_one() -> None:
        with contextlib.suppress(UnreadableError):
            client.next_request()

    assert count_calls(take_one) < 100
    assert client.has_work == bool(body), "empty ones go all together"


@given(st.binary(max_size=200))
@settings(max_examples=examples(60))
def test_garbage_is_a_call_or_is_dropped(body: bytes) -> None:
    with contextlib.suppress(UnreadableError):
        assert isinstance(read_request(body).method, str)


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[]",
        b"3",
        b"\xff",
        b'{"method": 3}',
        b'{"params": {}}',
        b'{"method": "info", "params": []}',
        b'{"method": "info", "params": null}',
        b'{"method": "info", "id": NaN}',
        b'{"method": "info", "id": ' + b"9" * 5000 + b"}",
        b"[" * 8_000,
        b'{"method": "info", "params": {"x": [' + b"0," * 9_000 + b"0]}}",
    ],
)
def test_what_is_no_call_is_dropped(body: bytes) -> None:
    with pytest.raises(UnreadableError):
        read_request(body)


@pytest.mark.parametrize("number", [1, "one", 1.5, [1, {"a": None}], {"b": 2}, True, 140_000_000_000_000])
def test_an_id_is_of_any_type(number: object) -> None:
    request = read_request(json.dumps({"method": "info", "id": number}).encode())
    assert request == Request("info", {}, number)
    assert json.loads(result_message(number, {})[:-1]) == {"id": number, "result": {}}


def test_numbers_that_json_does_not_have_go_out_as_null() -> None:
    message = encode({"a": float("nan"), "b": [1.0, float("inf")], "c": {"d": -float("inf")}})
    assert json.loads(message[:-1]) == {"a": None, "b": [1.0, None], "c": {"d": None}}


def test_what_cannot_be_written_is_null_or_fails_in_a_sentence() -> None:
    """Failed before: with the errors of json, of all kinds."""
    assert json.loads(encode({"a": [1, 10**5_000]})[:-1]) == {"a": [1, None]}
    deep: list[object] = []
    for _ in range(2_000):
        deep = [deep]
    for unwritable in ({"a": {(1, 2): 3}}, {"a": deep}, {"a": [float("nan"), deep]}):
        with pytest.raises(UnwritableError, match="cannot be written as JSON"):
            encode(unwritable)


def test_what_came_before_a_stop_knows_that_it_was_overtaken_and_nothing_else_does() -> None:
    client = Client("a client")

    def takes(*methods: str) -> list[tuple[str, bool]]:
        client.receive(b"".join(b'{"method":"%s"}\x03' % method.encode() for method in methods))
        found = []
        while (request := client.next_request()) is not None:
            found.append((request.method, request.overtaken))
        return found

    before, stop, behind = ("info", True), ("emergency_stop", False), ("list_endpoints", False)
    assert takes("info", "info", "emergency_stop", "list_endpoints") == [stop, before, before, behind]
    assert takes("list_endpoints") == [behind]
    assert takes("emergency_stop", "list_endpoints") == [stop, behind]


def test_a_stop_is_looked_at_before_all_that_waits() -> None:
    client = Client("a client")
    calls = [b'{"method": "info", "id": %d}\x03' % number for number in range(100)]
    client.receive(b"".join(calls) + b'{"method": "emergency_stop"}\x03')
    first = client.next_request()
    assert first is not None
    assert first.method == "emergency_stop"
    rest = [client.next_request() for _ in calls]
    assert [request.id for request in rest if request is not None] == list(range(100))
    assert client.next_request() is None


def test_parameters() -> None:
    request = Request(
        "gcode/script", {"script": 3, "objects": {"a": None, "b": ["c"]}, "response_template": {}}
    )
    with pytest.raises(RequestError, match="'script' must be a text"):
        text_param(request, "script")
    with pytest.raises(RequestError, match="'remote_method' is missing"):
        text_param(request, "remote_method")
    assert objects_param(request) == {"a": None, "b": ["c"]}
    assert template_param(request) == {}
    wrong: list[object] = [
        [],
        "a",
        {"a": 3},
        {"a": [3]},
        {"a": {}},
        None,
        {"a": ["b"] * 1_025, "c": ["d"] * 1_024},
    ]
    for objects in wrong:
        with pytest.raises(RequestError):
            objects_param(Request("objects/query", {"objects": objects}))


def test_a_subscription_tells_whole_fields_that_changed() -> None:
    status: Status = {"fan": {"speed": 0.0, "rpm": None}, "toolhead": {"position": [0, 0, 0, 0]}}
    assert select_fields({"fan": ["speed", "colour"], "none": None}, status) == {
        "fan": {"speed": 0.0, "colour": None},
        "none": {},
    }
    subscription = Subscription({}, {"fan": None, "toolhead": ["position"], "none": None})
    assert subscription.begin(status) == {**status, "none": {}}
    assert subscription.changes(status) == {}
    later: Status = {"fan": {"speed": 0.5, "rpm": None, "new": 1}, "toolhead": {"position": [0, 0, 1, 0]}}
    # What was wanted with null are the fields that there were.
    assert subscription.changes(later) == {"fan": {"speed": 0.5}, "toolhead": {"position": [0, 0, 1, 0]}}
    assert subscription.changes(later) == {}
    assert subscription.changes({"none": {"came": 1}}) == {"none": {"came": 1}}


def test_a_subscription_costs_what_there_is_and_not_what_is_wanted() -> None:
    """Failed before: each of 8,000 fields that no object has was looked at in each update."""
    status: Status = {"fan": {"speed": 0.0}, "toolhead": {"position": [0, 0, 0, 0]}}
    unknown = [f"field{number}" for number in range(8_000)]
    subscription = Subscription({}, {"fan": ["speed", *unknown], **dict.fromkeys(unknown[:900])})
    assert subscription.begin(status)["fan"]["field7999"] is None
    assert count_calls(lambda: subscription.changes(status)) < 50
    assert subscription.changes({"fan": {"field7": 1}}) == {"fan": {"speed": None, "field7": 1}}
    assert subscription.changes({"fan": {"field7": 1}}) == {}
    assert subscription.changes(status) == {"fan": {"speed": 0.0, "field7": None}}
