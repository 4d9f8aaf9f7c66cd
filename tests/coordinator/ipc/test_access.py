"""Who gets into the server, on each way, and what each may do."""

import asyncio
import json
import os
import socket
import stat
from pathlib import Path
from typing import Any

import pytest

from coordinator.ipc.protocol.methods import Scope
from coordinator.ipc.server.server import IpcServer
from coordinator.ipc.server.settings import IpcSettings, TcpSettings
from nodes.support.errors import CanductorError
from tests.coordinator.ipc.served import (
    TOKENS,
    Script,
    Served,
    plain_tcp,
    registry_of,
    run,
    tokens_file,
)
from tests.stages.own_sockets import own_sockets


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
        with pytest.raises(CanductorError, match="not a socket"):
            await fourth.start()
        assert dead.read_text() == "precious"

    run(tmp_path, body)


def test_no_socket_goes_where_others_can_write_and_commands_look(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a folder of /tmp that another user was the first to make."""
    own_sockets(monkeypatch, tmp_path)
    (folder := tmp_path / "canductor").chmod(0o777)
    problem = "must be a folder of this user's, no link, that nobody else may write to; choose another path"

    async def body(served: Served) -> None:  # elsewhere it is for who starts it to know
        again = IpcServer(registry_of(served), served.state, IpcSettings(unix_path=folder / "m.sock"))
        with pytest.raises(CanductorError) as refused:
            await again.start()
        assert str(refused.value) == f"the socket {folder}/m.sock cannot be opened: {folder} {problem}"
        assert not list(folder.iterdir())
        folder.chmod(0o700)
        await again.start()
        await again.close()

    tmp_path.chmod(0o770)
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


def test_a_flood_over_tcp_leaves_room_for_the_owner(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        for _ in range(2):
            reader, _ = await served.dial(tcp=True)
        reader, _ = await served.dial(tcp=True)
        assert "over TCP" in json.loads(await reader.read())["error"]["message"]
        assert "result" in await (await served.script()).ask("machine.info")

    run(tmp_path, body, tcp=plain_tcp(tmp_path), tcp_connections_max=2)


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


@pytest.mark.parametrize("host", ["a..b", "x" * 64])
def test_a_host_that_cannot_be_is_refused(tmp_path: Path, certificate: tuple[Path, Path], host: str) -> None:
    pem, key = certificate
    tcp = TcpSettings(host=host, port=80, tokens=tokens_file(tmp_path), certificate=pem, private_key=key)
    with pytest.raises(CanductorError) as refused:
        run(tmp_path, lambda _: asyncio.sleep(0), tcp=tcp)
    assert str(refused.value) == f"port 80 of {host} cannot be opened: no host can have this name"
    assert not (tmp_path / "m.sock").exists()


def test_tokens_that_others_can_read_are_refused(tmp_path: Path) -> None:
    tcp = plain_tcp(tmp_path)
    tokens_file(tmp_path, 0o640)
    with pytest.raises(CanductorError, match="chmod 600"):
        run(tmp_path, lambda _: asyncio.sleep(0), tcp=tcp)
