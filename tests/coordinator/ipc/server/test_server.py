"""What clients may do to a server, and what it costs the others."""

import asyncio
import json
import struct
from pathlib import Path
from typing import Any

import msgpack
import pytest

from coordinator.ipc.protocol.limits import Limits
from coordinator.ipc.protocol.methods import Caller, Kind, Method, Param, Scope
from coordinator.ipc.server.connection import UNREAD_BYTES
from coordinator.ipc.server.fair_scheduler import ROUND_S, TURN_S
from coordinator.ipc.server.session import MESSAGES_PER_TURN, PHASES
from tests.coordinator.ipc.served import (
    Script,
    Served,
    run,
)


def framed(body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + body


ATTACKS = {
    "a huge message": (struct.pack(">I", 2**24 - 1), "too_long"),
    "a huge line": (b'{"a":"' + b"x" * 300_000, "too_long"),
    "deep msgpack": (framed(b"\x81\xa1a" + b"\x91" * 500 + b"\xc0"), "too_deep"),
    "abysmal msgpack": (framed(b"\x91" * 200_000 + b"\xc0"), "too_long"),
    "deep JSON": (b'{"a":' + b"[" * 500 + b"]" * 500 + b"}\n", "too_deep"),
    "abysmal JSON": (b'{"a":' + b"[" * 100_000 + b"]" * 100_000 + b"}\n", "too_long"),
    "many small lists": (
        framed(b"\x81\xa1a\xdc\x00\x40" + (b"\xdc\x0f\xa0" + b"\x90" * 4000) * 64),
        "too_long",
    ),
    "many small lists in JSON": (
        b'{"a":[' + b",".join([b"[" + b"[]," * 3000 + b"[]]"] * 3) + b"]}\n",
        "too_long",
    ),
    "half a message": (framed(b"\x81\xa1")[:-1], "timeout"),
    "half a length": (b"\0\0", "timeout"),
    "half a line": (b'{"id":1', "timeout"),
    "silence": (b"", "timeout"),
    "HTTP": (b"GET / HTTP/1.1\r\n\r\n", "bad_message"),
    "no hello": (b'{"id":1,"method":"machine.emergency_stop"}\n', "no_hello"),
    "an old version": (b'{"id":1,"method":"api.hello","params":{"version":0}}\n', "bad_version"),
    "a promise of 4 billion items": (framed(b"\xdd\xff\xff\xff\xff"), "bad_message"),
    "bytes for text": (framed(b"\x81\xc4\x01a\x01"), "bad_message"),
    "an extension": (framed(b"\x81\xa1a\xd4\x01\x00"), "bad_message"),
    "half a surrogate": (b'{"method":"\\ud800"}\n', "bad_message"),
    "not a number": (b'{"method":"x","id":NaN}\n', "bad_message"),
    "a list": (framed(b"\x91\x01"), "bad_message"),
    "an id that is none": (b'{"method":"api.hello","id":"x"}\n', "bad_message"),
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_what_is_wrong_ends_that_client_only_with_a_clear_error(tmp_path: Path, attack: str) -> None:
    data, code = ATTACKS[attack]

    async def body(served: Served) -> None:
        bystander = await served.script()
        reader, writer = await served.dial()
        writer.write(data)
        raw = await reader.read()
        last = raw[raw.rindex(b"\xa4code") - 1 :] if raw[:1] == b"\0" else raw.splitlines()[-1]
        assert code.encode() in last, raw
        assert "result" in await bystander.ask("machine.info")
        assert not served.stops
        writer.close()

    run(tmp_path, body)


BIG_ATTACKS = {  # the same from a client that may send more than a hello
    "a huge message": "too_long",
    "a huge line": "too_long",
    "abysmal msgpack": "too_deep",
    "abysmal JSON": "too_deep",
    "many small lists": "too_long",
    "many small lists in JSON": "too_long",
}


@pytest.mark.parametrize("attack", BIG_ATTACKS)
def test_who_was_let_in_may_not_do_it_either(tmp_path: Path, attack: str) -> None:
    data, code = ATTACKS[attack][0], BIG_ATTACKS[attack]
    hello = {"id": 1, "method": "api.hello", "params": {"version": 1}}

    async def body(served: Served) -> None:
        bystander = await served.script()
        reader, writer = await served.dial()
        packed = data[:1] == b"\0"
        writer.write(framed(msgpack.packb(hello)) if packed else json.dumps(hello).encode() + b"\n")
        writer.write(data)
        raw = await reader.read()
        assert b"message_bytes_max" in raw
        assert code.encode() in raw[raw.rindex(b"code") :]
        assert "result" in await bystander.ask("machine.info")
        writer.close()

    run(tmp_path, body)


def test_before_the_hello_a_message_has_a_few_kilobytes(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        most = served.settings.limits.hello_bytes
        for size, accepted in ((most, True), (most + 1, False)):
            script = Script(*await served.dial())
            line = json.dumps({"id": 1, "method": "api.hello", "params": {"version": 1}}).encode()
            script.writer.write(line + b" " * (size - len(line)) + b"\n")
            answer = await script.receive()
            assert ("result" in answer) == accepted
            if not accepted:
                assert answer["error"]["code"] == "too_long"
                continue
            script.writer.write(b'{"id":2,"method":"api.ping"}' + b" " * 2 * most + b"\n")
            assert (await script.receive())["id"] == 2

    run(tmp_path, body)


def test_however_many_are_sent_at_once_what_is_answered_at_once_is_never_too_much(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        script = await served.script()
        count = 4 * served.settings.limits.pending_requests
        for number in range(count):
            script.send("machine.info", number)
        for number in range(count):
            answer = await script.receive()
            assert (answer.get("id"), "result" in answer) == (number, True), answer

    run(tmp_path, body, look_s=TURN_S)  # one request takes a whole turn


def test_what_the_server_itself_answers_takes_turns_with_other_clients(tmp_path: Path) -> None:
    """Failed before: all of them were answered in one turn."""

    async def body(served: Served) -> None:
        many, other = await served.script(client="many"), await served.script(client="other")
        count = served.settings.limits.pending_requests // 2
        for number in range(count):
            many.send("api.ping", number)
        many.send("machine.info", count)
        other.send("machine.info")
        assert "result" in await other.receive()
        assert served.order == ["info"]
        for number in range(count + 1):
            assert (await many.receive())["id"] == number

    run(tmp_path, body, look_s=TURN_S)  # one request takes a whole turn


def test_updates_that_are_due_at_one_instant_do_not_fill_one_round(tmp_path: Path) -> None:
    """Failed before: all were sent in one."""

    async def body(served: Served) -> None:
        scripts = [await served.script() for _ in range(8 * PHASES)]
        for script in scripts:
            await script.ask("api.watch", rate_hz=1.0)
        sessions = [connection.session for connection in served.server._connections]
        sent, most = 0, 0
        served.state.set("x", 1)
        while sent < len(scripts):
            await asyncio.sleep(0)
            now_sent = sum(session.counters.updates for session in sessions)
            most, sent = max(most, now_sent - sent), now_sent
        assert most <= ROUND_S / TURN_S + 1

    run(tmp_path, body, look_s=TURN_S)  # one update takes a whole turn


def test_lines_for_many_who_listen_do_not_fill_one_round(tmp_path: Path) -> None:
    """Failed before: each line was sent to each of them at once, 50 lines for 250 in 0.14 s."""

    async def body(served: Served) -> None:
        scripts = [await served.script() for _ in range(64)]
        for script in scripts:
            await script.ask("api.listen", events=["log"])
        sessions = [connection.session for connection in served.server._connections]
        before = [session.counters.bytes_out for session in sessions]

        def count_new() -> int:
            """Return to how many something was sent since this was asked last."""
            now = [session.counters.bytes_out for session in sessions]
            new = sum(map(int.__ne__, now, before))
            before[:] = now
            return new

        for number in range(50):
            served.server.notify("log", {"number": number})
        while (new := count_new()) or served.server._scheduler._waiting:  # type: ignore[union-attr]
            assert new <= ROUND_S / TURN_S
            await asyncio.sleep(0)
        for script in scripts:
            received = [await script.receive() for _ in range(50)]
            assert [message["values"]["number"] for message in received] == list(range(50))

    run(tmp_path, body, look_s=TURN_S)  # one turn takes all of its time


def test_what_a_request_has_others_told_comes_in_order(tmp_path: Path) -> None:
    """A turn does not begin within another one, neither of the client that is at work nor of others."""

    async def body(served: Served) -> None:
        def say(_: Caller, params: dict[str, Any]) -> None:
            served.server.notify("log", params)

        number = Param("number", Kind.INT)
        served.server._context.registry.add(Method("say", Scope.WATCH, "Say it.", say, (number,)))
        speaking, listening = await served.script(), await served.script()
        for script in (speaking, listening):
            await script.ask("api.listen", events=["log"])
        for script in (speaking, listening):
            for request_id in range(2 * MESSAGES_PER_TURN):
                script.send("say", request_id, number=request_id)
        for script in (speaking, listening):
            received = [await script.receive() for _ in range(6 * MESSAGES_PER_TURN)]
            answers = [message["id"] for message in received if "id" in message]
            assert answers == list(range(2 * MESSAGES_PER_TURN))
            said = [message["values"]["number"] for message in received if "event" in message]
            assert sorted(said) == sorted(2 * answers)

    run(tmp_path, body)


def test_a_client_that_has_said_all_and_reads_late_is_disconnected_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Failed before, with a traceback: asyncio must not be told to close while it says that there is room."""

    async def body(served: Served) -> None:
        served.state.set("x", "y" * 400_000)  # more than the kernel takes at once
        script = await served.script()
        (connection,) = served.server._connections
        script.send("state.get")
        script.send("api.ping", 2)
        script.writer.write_eof()
        script.writer.transport.pause_reading()  # type: ignore[attr-defined]
        while connection.session.writable:  # noqa: ASYNC110 (it tells nobody)
            await asyncio.sleep(0.1)
        script.writer.transport.resume_reading()  # type: ignore[attr-defined]
        assert [answer["id"] for answer in await script.rest()] == [1, 2]
        await asyncio.sleep(0.1)

    run(tmp_path, body)
    assert not caplog.records


def test_of_a_client_that_waits_for_its_turn_no_more_than_a_bounded_part_is_taken_in(tmp_path: Path) -> None:
    read_at_once = 256 * 1024  # by asyncio
    requests = [b'{"id":%d,"method":"machine.info"}%s\n' % (n, b" " * 8000) for n in range(200)]

    async def body(served: Served) -> None:
        script = await served.script()
        (connection,) = served.server._connections
        first = asyncio.ensure_future(script.receive())
        script.writer.write(b"".join(requests))
        most = 0
        while not first.done() or connection.session.unread_bytes:
            most = max(most, connection.session.unread_bytes)
            await asyncio.sleep(0)
        assert UNREAD_BYTES <= most <= UNREAD_BYTES + read_at_once
        received = [first.result()] + [await script.receive() for _ in requests[1:]]
        assert [answer["id"] for answer in received] == list(range(len(requests)))

    run(tmp_path, body, look_s=TURN_S)


NO_STOP = b'{"method":"M112 machine.emergency_stop"}\n'
"""What has to be read to know that it is none."""


async def leave_with(served: Served, data: bytes, clients: int, **hello: Any) -> int:
    """Have CLIENTS send DATA and leave together; return for how many something is still to be read."""
    scripts = [await served.script(**hello) for _ in range(clients)]
    for script in scripts:
        script.writer.write(data)
        script.writer.close()
    while served.server._connections:  # noqa: ASYNC110 (there is no event for it)
        await asyncio.sleep(0)
    return len(served.server._leaving)


def test_what_clients_have_sent_that_leave_together_is_read_in_turns(tmp_path: Path) -> None:
    """Failed before: all of it in one turn of the loop; 20 clients held it for a second."""
    data = NO_STOP * 1000 + b'{"method":"machine.emergency_stop"}\n'

    async def body(served: Served) -> None:
        assert await leave_with(served, data, 8) == 8
        read, most = int(str(served.server.figures()["requests"])), 0
        while served.server._leaving:
            await asyncio.sleep(0)
            now_read = int(str(served.server.figures()["requests"]))
            most, read = max(most, now_read - read), now_read
        assert most <= MESSAGES_PER_TURN * (ROUND_S / TURN_S + 1)
        assert read == 8 * 1002
        assert len(served.stops) == 8
        assert not served.server.stop_lane._unread

    run(tmp_path, body, look_s=TURN_S)


@pytest.mark.parametrize(("data", "scope"), [(NO_STOP, "watch"), (b'{"method":""}\n', "admin")])
def test_what_cannot_be_a_stop_is_not_read_for_one_who_has_left(
    tmp_path: Path, data: bytes, scope: str
) -> None:
    async def body(served: Served) -> None:
        assert await leave_with(served, data * 1000, 8, scope=scope) == 0
        assert int(str(served.server.figures()["requests"])) < 4000
        assert not served.server.stop_lane._unread

    run(tmp_path, body, look_s=TURN_S)


def test_who_has_left_takes_nobody_elses_place(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        assert await leave_with(served, NO_STOP * 1500, 3) == 3
        first = next(iter(served.server._leaving))
        assert await leave_with(served, NO_STOP * 1500, 3) == 3
        assert first not in served.server._leaving, "those who left first made room"
        await served.server.close()
        assert not served.server._leaving
        assert not served.server.stop_lane._unread

    run(tmp_path, body, look_s=TURN_S, connections_max=3)


@pytest.mark.filterwarnings("error")
def test_what_is_cancelled_before_it_begins_is_answered_too(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        script = await served.script()
        (connection,) = served.server._connections
        session, now_s = connection.session, asyncio.get_running_loop().time()
        session.receive(b'{"id":5,"method":"wait"}\n', now_s)
        connection.work(now_s + 1)
        session.receive(b'{"id":6,"method":"api.cancel","params":{"id":5}}\n', now_s)
        connection.work(now_s + 1)  # within the same round of the loop
        answers = {answer["id"]: answer for answer in [await script.receive() for _ in range(2)]}
        assert answers[5]["error"]["code"] == "cancelled"
        assert answers[6]["result"] == {"found": True}
        assert not connection._tasks

    run(tmp_path, body)


def test_a_notification_that_cannot_be_sent_harms_nobody(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        script = await served.script()
        await script.ask("api.listen", events=["*"])
        served.server.notify("bad", {"x": float("nan")})
        served.server.notify("good", {"x": 1})
        assert await script.receive() == {"event": "good", "values": {"x": 1}}
        assert served.server.figures()["unsendable"] == 1

    run(tmp_path, body)


def test_names_of_clients_cannot_steer_a_terminal(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        script = await served.script(client="\x1b[2J\nroot")
        assert (await script.ask("machine.info"))["result"]["caller"].startswith("?[2J?root (uid")

    run(tmp_path, body)


def test_methods_that_fail(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    async def body(served: Served) -> None:
        script = await served.script()
        for name, params, code in (
            ("broken", {}, "internal"),
            ("unsendable", {}, "internal"),
            ("nothing", {}, "no_such_method"),
            ("move.to", {}, "bad_params"),
            ("move.to", {"x_mm": 201}, "bad_params"),
            ("move.to", {"x_mm": True}, "bad_params"),
            ("move.to", {"x_mm": 1, "%s{0}": 1}, "bad_params"),
        ):
            answer = await script.ask(name, **params)
            assert answer["error"]["code"] == code
            assert "\n" not in answer["error"]["message"]
        assert (await script.ask("move.to", x_mm=200))["result"] == {"to": 200.0}

    run(tmp_path, body)
    assert "the method broken failed" in caplog.text


def test_a_bug_in_what_fills_the_state_is_answered(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Failed before: whoever read the state was disconnected."""

    def fail() -> None:
        raise ZeroDivisionError

    async def body(served: Served) -> None:
        script = await served.script()
        served.state.bring_up_to_date = fail
        for method in ("state.get", "api.watch"):
            assert (await script.ask(method))["error"]["code"] == "internal"
        assert (await script.ask("api.ping"))["result"] == {}

    run(tmp_path, body)
    assert "the method state.get failed" in caplog.text


def test_a_script_may_close_its_side_and_still_gets_its_answers(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        script = await served.script()
        script.send("machine.info", 2)
        script.send("move.to", 3, x_mm=1)
        script.writer.write_eof()
        assert [answer["id"] for answer in await script.rest()] == [2, 3]

    run(tmp_path, body)


HOSTILE_GLOBS = {
    "stars": (["*a" * 60 + "*"] * 64, "at most 16 * that are not at the end of theirs"),
    "spread": ([f"*{n}*" for n in range(17)], "at most 16 * that are not at the end of theirs"),
    "long": (["a" * 129], "64 strings of at most 128 characters"),
    "many": (["a"] * 65, "64 strings of at most 128 characters"),
    "numbers": ([1], "64 strings of at most 128 characters"),
}


@pytest.mark.parametrize("kind", HOSTILE_GLOBS)
def test_globs_that_would_keep_the_loop_are_refused(tmp_path: Path, kind: str) -> None:
    globs, sentence = HOSTILE_GLOBS[kind]

    async def body(served: Served) -> None:
        script = await served.script()
        for method, name in (("state.get", "fields"), ("api.watch", "fields"), ("api.listen", "events")):
            params: dict[str, Any] = {name: globs}
            error = (await script.ask(method, **params))["error"]
            assert error["code"] == "bad_params"
            assert sentence in error["message"]
        assert "result" in await script.ask("state.get", fields=[f"*.{n}" for n in range(16)] + ["a.*"] * 40)

    run(tmp_path, body)


def test_a_client_that_does_not_read_costs_bounded_memory_and_gets_one_merged_update(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        script = await served.script()
        served.state.update("big", {f"f{i}": "x" * 1000 for i in range(100)})
        begun = (await script.ask("api.watch", rate_hz=50))["result"]
        await script.ask("api.listen", events=["*"])
        script.writer.transport.pause_reading()  # type: ignore[attr-defined]
        (connection,) = served.server._connections
        session, rounds = connection.session, 0
        while session.counters.updates_skipped < 20:  # only once nothing more fits on the way
            rounds += 1
            served.state.update("big", {f"f{i}": f"{rounds}" * 500 for i in range(100)})
            served.server.notify("log", {"text": "y" * 1000, "number": rounds})
            await asyncio.sleep(0.005)
        for number in range(1000):
            served.server.notify("log", {"text": "y" * 1000, "number": rounds + number})
        limits = served.settings.limits
        held = connection.transport.get_write_buffer_size() + session.output_bytes
        assert held < 4 * limits.output_bytes
        assert len(session._notifications) == limits.notifications
        script.writer.transport.resume_reading()  # type: ignore[attr-defined]
        sequence, merged, lost = begun["sequence"], False, 0
        while not merged or not lost:
            message = await script.receive()
            if message["event"] == "state":
                assert message["since"] == sequence
                sequence = message["sequence"]
                merged = merged or message["skipped"] >= 20
            elif message["event"] == "api.lost":
                lost = message["values"]["count"]
        assert sequence == served.state.sequence
        assert lost == session.counters.notifications_dropped

    run(tmp_path, body)


def test_a_client_that_asks_without_reading_is_cut_off(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        script = await served.script()
        served.state.set("big", "x" * 100_000)
        script.writer.transport.pause_reading()  # type: ignore[attr-defined]
        line = json.dumps({"id": 1, "method": "nothing" * 15}).encode() + b"\n"
        (connection,) = served.server._connections
        most = 0
        while connection.session.end_reason is None:
            script.writer.write(line * 500)
            await asyncio.sleep(0)
            most = max(most, connection.session.output_bytes)
        assert connection.session.end_reason.code == "not_reading"
        assert most <= served.settings.limits.output_bytes_max
        script.writer.transport.abort()

    run(tmp_path, body, limits=Limits(output_bytes_max=500_000))


@pytest.mark.parametrize("rate_hz", [1e300, 51, -1, 0])
def test_a_rate_of_updates_has_two_ends(tmp_path: Path, rate_hz: float) -> None:
    async def body(served: Served) -> None:
        script = Script(*await served.dial())
        assert (await script.ask("api.hello", version=1))["result"]["rate_hz_max"] == 50
        error = (await script.ask("api.watch", rate_hz=rate_hz))["error"]
        assert error["message"].endswith(", must be a number from 0.01 to 50 1/s")
        methods = {m["name"]: m for m in (await script.ask("api.methods"))["result"]["methods"]}
        (rate,) = (param for param in methods["api.watch"]["params"] if param["name"] == "rate_hz")
        assert (rate["low"], rate["high"]) == (0.01, 50)

    run(tmp_path, body)


def test_a_name_that_is_too_long_is_called_that(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        script = await served.script()
        script.send("x" * 128)
        script.send("x" * 129)
        known, end = await script.rest()
        assert known["error"]["code"] == "no_such_method"
        assert end["error"]["message"] == "the name of a method has at most 128 characters"

    run(tmp_path, body)
