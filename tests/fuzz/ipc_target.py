"""What the fuzzers of the interface run: any bytes from a client, in any pieces, at any times."""

import json
import struct
from typing import Any

import msgpack

from coordinator.ipc.protocol.limits import EndReason, Limits
from coordinator.ipc.protocol.messages import Encoder, Encoding, WireReader
from coordinator.ipc.protocol.methods import ApiError, Caller, Kind, Method, Param, Registry, Scope
from coordinator.ipc.server.auth import Grant, Tokens
from coordinator.ipc.server.publisher import Publisher
from coordinator.ipc.server.session import Session, SessionContext
from coordinator.ipc.server.session_methods import add_session_methods
from coordinator.ipc.server.state import StateTree
from coordinator.support.values import Value

LIMITS = Limits(
    message_bytes=2_000,
    items=64,
    pending_requests=8,
    running_requests=4,
    subscriptions=3,
    notifications=8,
    output_bytes=2_000,
    output_bytes_max=20_000,
)
TOKEN = "t" * 32
REQUESTS: tuple[dict[str, Any], ...] = (
    {"id": 1, "method": "api.hello", "params": {"version": 1, "client": "fuzz", "scope": "watch"}},
    {"id": 1, "method": "api.hello", "params": {"version": 1, "token": TOKEN}},
    {"id": 2, "method": "api.watch", "params": {"fields": ["a*", "?"], "rate_hz": 50}},
    {"id": 3, "method": "api.unwatch", "params": {"subscription": 1}},
    {"id": 4, "method": "api.listen", "params": {"events": ["*"]}},
    {"id": 5, "method": "state.get"},
    {"id": 6, "method": "api.methods"},
    {"id": 7, "method": "slow", "params": {"x": 1.5}},
    {"id": 8, "method": "api.cancel", "params": {"id": 7}},
    {"id": 9, "method": "stop"},
    {"method": "quick", "params": {"x": [1, {"a": None}], "s": "ü"}},
)


def packed(message: object) -> bytes:
    body: bytes = msgpack.packb(message)
    return struct.pack(">I", len(body)) + body


def line(message: object) -> bytes:
    return json.dumps(message).encode() + b"\n"


SEEDS = tuple(
    b"".join(write(REQUESTS[i]) for i in order)
    for write in (packed, line)
    for order in ((0, 2, 4, 5, 6, 3), (1, 7, 8, 9, 10), (0, 7, 7, 9, 9, 9), (2,), tuple(range(11)))
)


def _registry(stops: list[str]) -> Registry:
    def stop(caller: Caller, _: dict[str, Any]) -> Value:
        stops.append(caller.name)
        return None

    def quick(_: Caller, params: dict[str, Any]) -> Value:
        return params

    registry = Registry()
    add_session_methods(registry)
    anything = Param("x", Kind.ANY, required=False)
    text = Param("s", Kind.STR, required=False, default="", high=10)
    registry.add(Method("stop", Scope.OPERATE, "", stop, urgent=True))
    registry.add(Method("quick", Scope.OPERATE, "", quick, (anything, text)))
    registry.add(Method("slow", Scope.OPERATE, "", quick, (Param("x", Kind.FLOAT, low=0, high=2),)))
    return registry


def run_session(data: bytes, cuts: int = 1) -> None:
    """Feed DATA in pieces that CUTS decides; whatever it is, all limits hold and all output can be read."""
    stops: list[str] = []
    state = StateTree()
    state.update("a", {"x": 1, "y": "text"})
    context = SessionContext(_registry(stops), Publisher(state, Encoder()), LIMITS)
    tokens = Tokens({TOKEN: Grant("fuzz", Scope.OPERATE)})
    session = Session(context, 0.0, number=1, peer="fuzz", granted=Scope.WATCH, check_token=tokens.check)
    output = bytearray()
    now_s, position, slow = 0.0, 0, []
    while position < len(data) or session.has_work:
        cuts = (cuts * 1103515245 + 12345) & 0x7FFFFFFF
        piece = data[position : position + 1 + (cuts >> 8) % 400]
        position += len(piece)
        now_s += (cuts >> 20) % 8 * 0.02
        session.receive(piece, now_s)
        session.writable = cuts & 0x10000 != 0 or position >= len(data)
        for request in session.read(now_s):
            session.answer(request, request.method.call(session.caller, request.params))  # type: ignore[arg-type]
        while (waiting := session.next_request()) is not None:
            if session.perform(waiting, now_s):
                continue
            if waiting.method.name == "slow":
                slow.append(waiting)
                break
            session.answer(waiting, waiting.params)
        for request in session.take_cancelled():
            if request in slow:
                slow.remove(request)
                session.fail(request, ApiError("cancelled", "it was"))
        if slow and cuts & 0x300 == 0:
            session.answer(slow.pop(), 1)
        state.set("a.x", cuts)
        session.notify(
            "log", context.publisher.encoder.message(session.encoding, {"event": "log", "values": {}})
        )
        session.handle_timer(now_s)
        _check_limits(session)
        if session.writable:
            output += session.take_output()
    if session.caller is None or session.caller.scope < Scope.OPERATE:
        assert not stops, "stopped by one who may not"
    _check_output(bytes(output), session.encoding)


def _check_limits(session: Session) -> None:
    assert session.output_bytes <= LIMITS.output_bytes_max
    assert len(session._waiting) <= LIMITS.pending_requests
    assert len(session._running) <= LIMITS.running_requests
    assert len(session._ids) <= LIMITS.pending_requests + LIMITS.running_requests
    assert len(session._notifications) <= LIMITS.notifications
    assert len(session.subscriptions) <= LIMITS.subscriptions


def _check_output(output: bytes, encoding: Encoding) -> None:
    """Whatever a client did, it is answered in messages that a client can read."""
    reader = WireReader(Limits(message_bytes=100_000))
    reader.encoding = encoding
    reader.feed(output, 0.0)
    while (message := reader.next_message()) is not None:
        assert not isinstance(message, EndReason), message
        assert message.keys() & {"id", "event", "error"}
        if "error" in message:
            assert "\n" not in message["error"]["message"]
    assert reader.waiting_bytes == 0
