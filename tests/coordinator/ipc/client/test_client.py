import asyncio
import os
import ssl
from dataclasses import replace
from pathlib import Path

import pytest

from coordinator.ipc.client.blocking import BlockingClient
from coordinator.ipc.client.client import Client, ConnectionLost, Refused
from coordinator.ipc.client.connect_errors import connect_error_sentence
from coordinator.ipc.protocol.address import read_address
from coordinator.ipc.protocol.messages import Encoding
from coordinator.ipc.protocol.methods import ApiError, Scope
from coordinator.ipc.protocol.peer import peer_of
from coordinator.ipc.server.server import IpcServer
from coordinator.ipc.server.settings import TcpSettings
from nodes.support.errors import CanductorError
from tests.coordinator.certificates import make_certificate
from tests.coordinator.ipc.served import TOKENS, Served, plain_tcp, registry_of, run, serving
from tests.stages.loop_thread import in_thread
from tests.stages.own_sockets import own_sockets


@pytest.mark.parametrize("encoding", Encoding)
def test_calls(tmp_path: Path, encoding: Encoding) -> None:
    async def body(served: Served) -> None:
        async with Client(served.at, name="test", scope=Scope.OPERATE, encoding=encoding) as client:
            assert client.hello is not None
            assert client.hello.scope is Scope.OPERATE
            assert (await client.call("machine.info"))["scope"] == "operate"
            moves = [client.call("move.to", {"x_mm": x}) for x in range(100)]
            assert [m["to"] for m in await asyncio.gather(*moves)] == list(range(100))
            with pytest.raises(ApiError, match="needs the scope admin") as refused:
                await client.call("node.command", {"command": "x"})
            assert refused.value.code == "not_allowed"

    run(tmp_path, body)


def test_cancelling_a_call_cancels_it_in_the_machine(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        async with Client(served.at) as client:
            call = asyncio.create_task(client.call("wait"))
            await client.call("machine.info")
            call.cancel()
            await served.cancelled.wait()
            await client.call("machine.info")

    run(tmp_path, body)


def test_watching(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        served.state.update("nodes.a", {"load": 1, "state": "ready"})
        served.state.set("job.progress", 0.5)
        async with Client(served.at) as client:
            updates = client.watch(["nodes.*"], rate_hz=50)
            first = await anext(updates)
            assert first.snapshot
            assert first.values == {"nodes.a.load": 1, "nodes.a.state": "ready"}
            served.state.set("job.progress", 0.6)
            served.state.set("nodes.a.load", 2)
            second = await anext(updates)
            assert (second.values, second.snapshot) == ({"nodes.a.load": 2}, False)
            served.state.remove("nodes.a.load")
            assert (await anext(updates)).removed == {"nodes.a.load"}
            await updates.aclose()
            await client.call("api.ping")
            (connection,) = served.server._connections
            assert not connection.session.subscriptions

    run(tmp_path, body)


def test_a_gap_is_noticed_and_filled_with_a_snapshot(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        served.state.set("a", 1)
        async with Client(served.at) as client:
            updates = client.watch(rate_hz=50)
            await anext(updates)
            (connection,) = served.server._connections
            (subscription,) = connection.session.subscriptions.values()
            subscription._sent += 1  # as if a message had got lost
            served.state.set("b", 2)
            healed = await anext(updates)
            assert healed.snapshot
            assert healed.values == {"a": 1, "b": 2}

    run(tmp_path, body)


def test_notifications(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        async with Client(served.at) as client:
            events = client.events(["log", "gcode.*"])
            taken = asyncio.ensure_future(anext(events))
            (connection,) = served.server._connections
            while not connection.session.listens.matches("log"):
                await client.call("api.ping")
            served.server.notify("other", {})
            served.server.notify("gcode.reply", {"text": "ok \ud800"})
            event = await taken
            assert (event.name, event.values) == ("gcode.reply", {"text": "ok ?"})

    run(tmp_path, body)


def test_it_comes_back_and_goes_on_watching(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        served.state.set("a", 1)
        async with Client(served.at) as client:
            updates = client.watch(rate_hz=50)
            await anext(updates)
            lost = asyncio.create_task(client.call("wait"))
            await client.call("machine.info")
            await served.server.close()
            with pytest.raises(ConnectionLost, match="server is closing"):
                await lost
            served.state.set("a", 2)
            again = IpcServer(registry_of(served), served.state, served.settings)
            await again.start()
            fresh = await anext(updates)
            assert fresh.snapshot
            assert fresh.values == {"a": 2}
            served.state.set("a", 3)
            assert (await anext(updates)).values == {"a": 3}
            assert await client.call("machine.info")
            await again.close()

    run(tmp_path, body)


def test_who_is_not_there_or_refuses(tmp_path: Path) -> None:
    async def body(served: Served) -> None:
        with pytest.raises(ConnectionLost, match="does not answer"):
            await Client(str(tmp_path / "none")).__aenter__()
        address = f"tcp://127.0.0.1:{served.server.tcp_port}"
        with pytest.raises(Refused, match="token is not known"):
            await Client(address, token="x" * 40).__aenter__()
        async with Client(address, token=TOKENS[Scope.WATCH]) as client:
            assert client.hello is not None
            assert client.hello.scope is Scope.WATCH

    run(tmp_path, body, tcp=plain_tcp(tmp_path))


def test_the_blocking_face(tmp_path: Path) -> None:
    with in_thread(lambda: serving(tmp_path)) as served:
        served.state.set("a", 1)
        with BlockingClient(served.at, name="script") as client:
            assert client.call("move.to", {"x_mm": 3}) == {"to": 3}
            updates = client.watch()
            assert next(updates).values == {"a": 1}
            updates.close()
            with pytest.raises(ApiError, match="no method"):
                client.call("nothing")
    with pytest.raises(ConnectionLost):
        BlockingClient("/none").__enter__()


def test_addresses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own_sockets(monkeypatch, tmp_path)
    assert str(read_address("tls://printer.local:7130")) == "tls://printer.local:7130"
    assert read_address("unix:/a/b").path == Path("/a/b")
    for bad in ("http://x:1", "tcp://x", "tcp://:1", "tcp://x:99999", "tcp://[x:1"):
        with pytest.raises(CanductorError, match="is not an address"):
            read_address(bad)
    with pytest.raises(CanductorError, match="no machine of this user runs here"):
        read_address(None)


def test_tls(tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    pem, key = certificate
    tokens = plain_tcp(tmp_path).tokens
    tcp = TcpSettings(host="127.0.0.1", port=0, tokens=tokens, certificate=pem, private_key=key)

    async def body(served: Served) -> None:
        address = f"tls://127.0.0.1:{served.server.tcp_port}"
        trusting = ssl.create_default_context(cafile=str(pem))
        async with Client(address, token=TOKENS[Scope.OPERATE], tls=trusting) as client:
            assert (await client.call("machine.info"))["scope"] == "operate"
        with pytest.raises(ConnectionLost, match="cannot be trusted"):  # a server that nothing vouches for
            await Client(address, token=TOKENS[Scope.OPERATE]).__aenter__()
        reader, writer = await served.dial(tcp=True)  # without TLS
        writer.write(b'{"id":1,"method":"api.hello","params":{"version":1}}\n')
        assert b"result" not in await reader.read()

    run(tmp_path, body, tcp=tcp)


@pytest.mark.parametrize("at", ["named", "found"])
def test_a_stranger_in_the_machines_place_gets_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: str
) -> None:
    """He answered a stop with a lie, and got what was sent."""
    own_sockets(monkeypatch, tmp_path)

    async def body(served: Served) -> None:
        opened = (await served.dial())[1].get_extra_info("socket")
        assert peer_of(opened) == (os.getpid(), os.geteuid())
        address = read_address(served.at if at == "named" else None)
        with monkeypatch.context() as patched:
            patched.setattr("os.geteuid", lambda: 1000)
            patched.setattr("coordinator.ipc.client.client.peer_of", lambda _: (7, 1001))
            with pytest.raises(ConnectionLost) as refused:
                await Client(str(address), first="machine.emergency_stop").__aenter__()
        assert str(refused.value) == (
            f"{served.at} is served by the user with uid 1001, neither by this user nor by root;"
            " nothing was sent"
        )
        async with Client(served.at) as client:  # whatever had come before would have been carried out
            await client.call("machine.info")
        assert served.order == ["info"]

    run(tmp_path / "canductor", body)


async def refusal(at: str, token: str | None = None, trusted: Path | None = None) -> str:
    tls = None if trusted is None else ssl.create_default_context(cafile=trusted)
    with pytest.raises(CanductorError) as failure:
        await Client(at, token=token, tls=tls).__aenter__()
    return str(failure.value)


def test_who_may_have_taken_the_wrong_address_or_certificate_is_told(
    tmp_path: Path, certificate: tuple[Path, Path]
) -> None:
    pem, key = certificate
    tcp = plain_tcp(tmp_path)
    token = TOKENS[Scope.OPERATE]
    (tmp_path / "other").mkdir()
    other, _ = make_certificate(tmp_path / "other")

    async def with_tls(served: Served) -> None:
        port = served.server.tcp_port
        tls_at, plain_at = f"tls://127.0.0.1:{port}", f"tcp://127.0.0.1:{port}"
        assert f"before it sent anything; with TLS its address is {tls_at}" in await refusal(plain_at, token)
        for trusted in (None, other):
            answer = await refusal(tls_at, token, trusted)
            assert answer.startswith(
                f"the certificate of {tls_at} cannot be trusted: self-signed certificate; "
            )
            assert answer.endswith("give the certificate that it must have with --certificate PEM")
        answer = await refusal(f"tls://localhost:{port}", token, pem)
        assert "is not valid for 'localhost'; use a name that is in its certificate" in answer
        assert await refusal(tls_at, None, pem) == (
            f"{tls_at} needs a token; give the file that holds it with --token-file (programs: token)"
        )

    async def without(served: Served) -> None:
        port = served.server.tcp_port
        tls_at, plain_at = f"tls://127.0.0.1:{port}", f"tcp://127.0.0.1:{port}"
        answer = await refusal(tls_at, token, pem)
        assert answer == f"{tls_at} does not use TLS; without TLS its address is {plain_at}"
        await served.server.close()
        assert (
            await refusal(plain_at, token) == f"{plain_at} does not answer: no program listens at this port"
        )

    run(tmp_path, with_tls, tcp=replace(tcp, certificate=pem, private_key=key))
    run(tmp_path, without, tcp=tcp)


def test_a_certificate_of_yesterday_is_called_so() -> None:
    error = ssl.SSLCertVerificationError(1, "certificate verify failed")
    error.verify_code, error.verify_message = 10, "certificate has expired"
    assert connect_error_sentence(read_address("tls://printer.local:7130"), error) == (
        "the certificate of tls://printer.local:7130 cannot be trusted: certificate has expired; "
        "check the clocks of both computers, and renew the certificate if they are right"
    )
