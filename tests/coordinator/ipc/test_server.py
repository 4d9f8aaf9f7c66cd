import asyncio
import json
import os
import socket
import stat
import struct
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from coordinator.ipc import turns as turns_module
from coordinator.ipc.connection import REQUESTS_PER_TURN
from coordinator.ipc.methods import Scope
from coordinator.ipc.server import IpcServer
from coordinator.ipc.settings import IpcSettings, Limits, TcpSettings
from nodes.errors import CanductorError
from tests.coordinator.ipc.served import Script, Served, registry_of, serving

TOKENS = {scope: f"{scope.word}-token-of-at-least-32-characters" for scope in Scope}


def run(folder: Path, body: Callable[[Served], Awaitable[None]], **settings: Any) -> None:
    async def main() -> None:
        async with asyncio.timeout(60), serving(folder, **settings) as served:
            await body(served)

    asyncio.run(main())


def tokens_file(folder: Path, mode: int = 0o600) -> Path:
    path = folder / "tokens"
    path.write_text("# ours\n" + "".join(f"{s.word} of-{s.word} {t}\n" for s, t in TOKENS.items()))
    path.chmod(mode)
    return path


def plain_tcp(folder: Path, host: str = "127.0.0.1") -> TcpSettings:
    return TcpSettings(host=host, port=0, tokens=tokens_file(folder), plain_on_loopback=True)


def test_the_socket_is_its_owners_alone(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        status = served.path.stat()
        assert stat.S_IMODE(status.st_mode) == 0o600
        script = await served.script(client="test")
        info = (await script.ask("machine.info"))["result"]
        assert info == {"caller": f"test (uid {os.getuid()}, pid {os.getpid()})", "scope": "admin"}

    run(tmp_path, body)
    assert not (tmp_path / "m.sock").exists()


def test_a_dead_socket_is_replaced_a_live_one_and_a_file_are_not(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        second = IpcServer(registry_of(served), served.state, served.settings)
        with pytest.raises(CanductorError, match="another coordinator serves"):
            await second.start()
        assert "result" in await (await served.script()).ask("machine.info")
        dead = tmp_path / "dead"
        with socket.socket(socket.AF_UNIX) as left:
            left.bind(str(dead))
        third = IpcServer(registry_of(served), served.state, IpcSettings(unix_path=dead))
        await third.start()
        await third.close()
        dead.write_text("precious")
        fourth = IpcServer(registry_of(served), served.state, IpcSettings(unix_path=dead))
        with pytest.raises(CanductorError, match="no socket"):
            await fourth.start()
        assert dead.read_text() == "precious"

    run(tmp_path, body)


@pytest.mark.parametrize("scope", Scope)
def test_scope_matrix(tmp_path: Path, scope: Scope) -> None:
    """Every method, called with every scope: done, or refused with the reason."""

    async def body(served: Served) -> None:
        script = await served.script(scope=scope.word)
        params: dict[str, Any] = {"move.to": {"x_mm": 5}, "node.command": {"command": "x"}, "wait": {}}
        listed = (await script.ask("api.methods"))["result"]["methods"]
        assert {m["name"] for m in listed} >= {"api.watch", "machine.info", "node.command"}
        for method in listed:
            name = method["name"]
            script.send(name, 7, **params.get(name, {}))
            if name == "wait":
                script.send("api.cancel", 8, id=7)
            answers = [await script.receive() for _ in range(2 if name == "wait" else 1)]
            answer = next(answer for answer in answers if answer["id"] == 7)
            refused = answer.get("error", {}).get("code") == "not_allowed"
            assert refused == (Scope[method["scope"].upper()] > scope), (name, answer)
        assert bool(served.stops) == (scope >= Scope.OPERATE)

    run(tmp_path, body)


def test_tokens_give_their_scope_and_no_more(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        for scope, token in TOKENS.items():
            reader, writer = await served.dial(tcp=True)
            script = Script(reader, writer)
            hello = await script.ask("api.hello", version=1, token=token, scope="operate")
            assert hello["result"]["scope"] == min(scope, Scope.OPERATE).word
            assert f"token of-{scope.word}" in (await script.ask("machine.info"))["result"]["caller"]
            writer.close()

    run(tmp_path, body, tcp=plain_tcp(tmp_path))


@pytest.mark.parametrize(("hello", "code"), [({}, "no_token"), ({"token": "x" * 40}, "bad_token")])
def test_strangers_stay_out_of_tcp_and_are_slowed_down(
    tmp_path: Path, hello: dict[str, Any], code: str
) -> None:
    async def body(served: Served) -> None:
        bystander = await served.script()
        codes = []
        for _ in range(7):
            reader, writer = await served.dial(tcp=True)
            script = Script(reader, writer)
            script.send("api.hello", version=1, **hello)
            script.send("machine.emergency_stop")
            codes.append((await script.rest())[-1]["error"]["code"])
            writer.close()
        slowed = ["bad_token"] * 5 + ["too_many_failures"] * 2
        assert codes == (slowed if code == "bad_token" else [code] * 7)
        assert not served.stops
        assert "result" in await bystander.ask("machine.info")

    run(tmp_path, body, tcp=plain_tcp(tmp_path))


def framed(body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + body


ATTACKS = {
    "a huge message": (struct.pack(">I", 2**24 - 1), "too_long"),
    "a huge line": (b'{"a":"' + b"x" * 300_000, "too_long"),
    "deep msgpack": (framed(b"\x81\xa1a" + b"\x91" * 500 + b"\xc0"), "too_deep"),
    "abysmal msgpack": (framed(b"\x91" * 200_000 + b"\xc0"), "too_long"),
    "deep JSON": (b'{"a":' + b"[" * 500 + b"]" * 500 + b"}\n", "too_deep"),
    "abysmal JSON": (b'{"a":' + b"[" * 100_000 + b"]" * 100_000 + b"}\n", "too_deep"),
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

    run(tmp_path, body, limits=Limits(message_timeout_s=0.2))


def test_however_many_are_sent_at_once_what_is_answered_at_once_is_never_too_much(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(turns_module, "TURN_S", 0.0)  # time for one request, on the slowest of computers

    async def body(served: Served) -> None:
        script = await served.script()
        count = 4 * served.settings.limits.pending_requests
        for number in range(count):
            script.send("machine.info", number)
        for number in range(count):
            answer = await script.receive()
            assert (answer.get("id"), "result" in answer) == (number, True), answer

    run(tmp_path, body)


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


def test_an_emergency_stop_overtakes_what_waits(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        script = await served.script()
        for number in range(REQUESTS_PER_TURN - 2):
            script.send("machine.info", number + 10)
        script.send("machine.emergency_stop", 1)
        first = await script.receive()
        assert first["id"] == 1
        assert served.order[0] == "stop"

    run(tmp_path, body)


def test_an_emergency_stop_comes_through_when_nothing_else_does(tmp_path: Path) -> None:
    """All places to run and to wait are taken, answers are not read: it acts all the same."""

    async def body(served: Served) -> None:
        script = await served.script()
        limits = served.settings.limits
        for number in range(limits.running_requests + limits.pending_requests + 10):
            script.send("wait", 100 + number)
        for _ in range(10):
            assert (await script.receive())["error"]["code"] == "busy"
        script.send("machine.emergency_stop", 1)
        assert (await script.receive())["id"] == 1
        assert len(served.stops) == 1
        script.writer.close()
        await served.cancelled.wait()  # what ran for it ends with it

    run(tmp_path, body)


def test_a_flood_over_tcp_leaves_room_for_the_owner(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        for _ in range(2):
            reader, _ = await served.dial(tcp=True)
        reader, _ = await served.dial(tcp=True)
        assert "over TCP" in json.loads(await reader.read())["error"]["message"]
        assert "result" in await (await served.script()).ask("machine.info")

    run(tmp_path, body, tcp=plain_tcp(tmp_path), tcp_connections_max=2)


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


def test_a_script_may_close_its_side_and_still_gets_its_answers(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        script = await served.script()
        script.send("machine.info", 2)
        script.send("move.to", 3, x_mm=1)
        script.writer.write_eof()
        assert [answer["id"] for answer in await script.rest()] == [2, 3]

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
        while connection.session.fault is None:
            script.writer.write(line * 500)
            await asyncio.sleep(0)
            most = max(most, connection.session.output_bytes)
        assert connection.session.fault.code == "not_reading"
        assert most <= served.settings.limits.output_bytes_max
        script.writer.transport.abort()

    run(tmp_path, body, limits=Limits(output_bytes_max=500_000))


def test_too_many_connections(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        kept = [await served.script() for _ in range(2)]
        reader, writer = await served.dial()
        assert json.loads(await reader.read())["error"]["code"] == "busy"
        writer.close()
        kept[0].writer.close()
        await kept[0].writer.wait_closed()
        left = served.server._connections
        while len(left) > 1:  # until the server has noticed
            await asyncio.sleep(0)
            left = served.server._connections
        assert "result" in await (await served.script()).ask("machine.info")

    run(tmp_path, body, connections_max=2)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"host": "0.0.0.0"}, "for loopback only"),  # noqa: S104 (refused, which is the point)
        ({"host": "localhost"}, "for loopback only"),
        ({"plain_on_loopback": False}, "needs a certificate"),
        ({"certificate": Path("none"), "private_key": Path("none")}, "cannot be used"),
        ({"tokens": Path("none")}, "cannot be read"),
    ],
)
def test_tcp_settings_that_are_not_safe(tmp_path: Path, change: dict[str, Any], sentence: str) -> None:
    given: dict[str, Any] = {
        "host": "127.0.0.1",
        "port": 0,
        "tokens": tokens_file(tmp_path),
        "plain_on_loopback": True,
    }
    with pytest.raises(CanductorError, match=sentence):
        run(tmp_path, lambda _: asyncio.sleep(0), tcp=TcpSettings(**given | change))
    assert not (tmp_path / "m.sock").exists()


def test_tokens_that_others_can_read_are_refused(tmp_path: Path) -> None:
    tcp = plain_tcp(tmp_path)
    tokens_file(tmp_path, 0o640)
    with pytest.raises(CanductorError, match="chmod 600"):
        run(tmp_path, lambda _: asyncio.sleep(0), tcp=tcp)
