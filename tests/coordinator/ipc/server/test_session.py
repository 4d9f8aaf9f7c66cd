"""Sessions without sockets: what they find of a stop in what they have not read."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.ipc.protocol.limits import Limits
from coordinator.ipc.protocol.messages import Encoder, Encoding
from coordinator.ipc.protocol.methods import Caller, Kind, Method, Param, Registry, Scope
from coordinator.ipc.server.publisher import Publisher
from coordinator.ipc.server.session import MESSAGES_PER_TURN, Session, SessionContext
from coordinator.ipc.server.session_methods import add_session_methods
from coordinator.ipc.server.state import StateTree
from tests.stages.call_counter import count_calls

HELLO = {"method": "api.hello", "params": {"version": 1}}
STOP = {"method": "machine.emergency_stop"}
LINES = {"method": "gcode.run", "params": {"script": "M117 a\nm112"}}
OTHERS: tuple[dict[str, Any], ...] = (
    {"method": ""},
    {"method": "M112"},
    {"method": "machine.emergency_stop2", "id": 5},
    {"method": "gcode.run", "params": {"script": "G28"}, "id": 5},
    {"method": "gcode.run", "params": {"script": "M117 M112\n"}},
    {"method": "api.ping", "params": {"\n": "\\"}},
)


def new_session(granted: Scope = Scope.OPERATE) -> Session:
    """Return a session of which nothing is known yet."""

    def who_stops(_: Caller, params: dict[str, Any]) -> str | None:
        return "a line" if "m112" in params["script"] else None

    registry = Registry()
    add_session_methods(registry)
    script = Param("script", Kind.STR)
    for method in (
        Method(
            "machine.emergency_stop",
            Scope.OPERATE,
            "Stop.",
            lambda _, __: None,
            urgent=True,
            stops=lambda _, __: "me",
        ),
        Method(
            "gcode.run",
            Scope.OPERATE,
            "Run.",
            lambda _, __: None,
            (script,),
            stops=who_stops,
            stop_words=("M112", "m112"),
        ),
    ):
        registry.add(method)
    context = SessionContext(registry, Publisher(StateTree(), Encoder()), Limits())
    return Session(context, 0.0, number=1, peer="a test", granted=granted)


def stream(encoding: Encoding, *messages: dict[str, Any]) -> bytes:
    encoder = Encoder()
    return b"".join(encoder.message(encoding, message) for message in messages)


@given(
    st.lists(st.sampled_from((*OTHERS, STOP, LINES)), max_size=8),
    st.sampled_from(Encoding),
    st.sampled_from(Scope),
    st.data(),
)
def test_a_stop_is_found_where_the_session_would_read_it(
    sent: list[dict[str, Any]], encoding: Encoding, scope: Scope, data: st.DataObject
) -> None:
    whole = stream(encoding, HELLO, *sent)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(whole)), min_size=2, max_size=2)))
    session = new_session(scope)
    session.receive(whole[: cuts[0]], 0.0)
    done = session.read(0.0)
    session.receive(whole[cuts[0] : cuts[1]], 0.0)
    found = session.find_stop(whole[cuts[1] :])
    session.receive(whole[cuts[1] :], 0.0)
    unread = session.read(0.0)
    assert session.unread_bytes == 0
    assert session.end_reason is None
    is_stop = scope >= Scope.OPERATE and (STOP in sent or LINES in sent)
    assert bool(done or unread) == is_stop
    assert (found is not None) == bool(unread)


@pytest.mark.parametrize("encoding", Encoding)
@pytest.mark.parametrize("message", [STOP, LINES])
def test_a_stop_seems_to_be_one_when_it_comes(encoding: Encoding, message: dict[str, Any]) -> None:
    """By whichever bytes complete its word; it costs others their turn, so not for who may not stop."""
    data = stream(encoding, message)
    for cut in range(len(data)):
        session = new_session()
        assert not session.receive(stream(encoding, HELLO), 0.0)
        session.read(0.0)
        seems = [session.receive(part, 0.0) for part in (data[:cut], data[cut:])]
        assert sum(seems) == 1
        assert not session.receive(stream(encoding, OTHERS[0]), 0.0)
    watching = new_session(Scope.WATCH)
    watching.receive(stream(encoding, HELLO), 0.0)
    watching.read(0.0)
    assert not watching.receive(data, 0.0)


@pytest.mark.parametrize("written", [rb'"machine.emergency\u005fstop"', rb'"machine.emergency_s\u0074op"'])
def test_a_stop_is_found_however_its_characters_are_written(written: bytes) -> None:
    assert new_session().find_stop(stream(Encoding.JSON, HELLO) + b'{"method":%b}\n' % written) == "me"


@pytest.mark.parametrize("encoding", Encoding)
def test_what_cannot_be_a_stop_is_not_read_to_find_one(encoding: Encoding) -> None:
    """Failed before: each message was; 28,000 took a third of a second, on the loop at a restart."""
    many, session = stream(encoding, *[{"method": ""}] * 5000), new_session()
    session.receive(stream(encoding, HELLO), 0.0)
    session.read(0.0)
    alone = count_calls(lambda: session.find_stop(stream(encoding, STOP)))
    assert session.find_stop(many + stream(encoding, STOP)) == "me"
    with_many = count_calls(lambda: session.find_stop(many + stream(encoding, STOP)))
    per_message = 0 if encoding is Encoding.JSON else 1  # one look at the length
    assert with_many - alone <= 5000 * per_message + 50


def test_who_may_not_stop_the_machine_costs_no_reading() -> None:
    session, sent = new_session(Scope.WATCH), stream(Encoding.JSON, HELLO)
    session.receive(sent, 0.0)
    session.read(0.0)
    none = count_calls(lambda: session.find_stop(b" "))
    many = stream(Encoding.JSON, *[{"method": "M112"}] * 5000)
    assert count_calls(lambda: session.find_stop(many)) <= none


def test_a_search_that_takes_long_ends_when_it_should() -> None:
    """Failed before: who waited for the lane's lock waited for all messages of a client."""
    session, asked = new_session(), list[None]()

    def goes_on() -> bool:
        asked.append(None)
        return len(asked) < 3

    many = stream(Encoding.JSON, HELLO, *[{"method": "M112"}] * 5 * MESSAGES_PER_TURN, STOP)
    assert session.find_stop(many, goes_on) is None
    assert len(asked) == 3
    assert session.find_stop(many) == "me"
