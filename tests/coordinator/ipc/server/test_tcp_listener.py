"""Who comes over TCP and never gets as far as a hello."""

import asyncio
import logging
import resource
import socket
import ssl
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from coordinator.ipc.client.client import Client
from coordinator.ipc.protocol.methods import Scope
from coordinator.ipc.server.settings import TcpSettings
from coordinator.ipc.server.stop_lane import StopLane
from coordinator.ipc.server.tcp_listener import (
    FILES_MAX,
    HANDSHAKE_S,
    HANDSHAKES_MAX,
    TcpListener,
    raise_files_limit,
)
from coordinator.ipc.server.tls_transport import TlsServer
from tests.coordinator.ipc.served import TOKENS, Served, plain_tcp, run
from tests.stages import jump_loop


@pytest.fixture
def files_limit() -> Iterator[tuple[int, int]]:
    """Return how many files may be open, and put it back after the test."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    yield limits
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def with_tls(folder: Path, certificate: tuple[Path, Path]) -> TcpSettings:
    pem, key = certificate
    tokens = plain_tcp(folder).tokens
    return TcpSettings(host="127.0.0.1", port=0, tokens=tokens, certificate=pem, private_key=key)


def test_128_silent_clients_keep_nobody_out(tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    """Failed before: the places were theirs until their 5 s were over, and everybody else was closed."""

    async def body(served: Served) -> None:
        listener = served.server._listener
        assert listener is not None
        silent = [await served.dial(tcp=True) for _ in range(HANDSHAKES_MAX)]
        ends = [asyncio.ensure_future(reader.read()) for reader, _ in silent]
        while listener.entering < HANDSHAKES_MAX:  # noqa: ASYNC110 (there is no event for it)
            await asyncio.sleep(0)
        trusting = ssl.create_default_context(cafile=str(certificate[0]))
        address = f"tls://127.0.0.1:{served.server.tcp_port}"
        begun_s = asyncio.get_running_loop().time()
        async with Client(address, token=TOKENS[Scope.OPERATE], tls=trusting) as client:
            assert (await client.call("machine.info"))["scope"] == "operate"
        assert asyncio.get_running_loop().time() - begun_s < HANDSHAKE_S
        assert await ends[0] == b"", "the oldest made room"
        assert (listener.refused, served.server.figures()["refused_connections"]) == (1, 1)
        assert sum(end.done() for end in ends) == 1, "the others may take their time"
        assert "result" in await (await served.script()).ask("machine.info"), "the owner gets in"
        for end in ends:
            end.cancel()
        for _, writer in silent:
            writer.close()
        await served.server_has(0)

    run(tmp_path, body, tcp=with_tls(tmp_path, certificate))


def test_room_is_made_where_most_are_silent(tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    async def body(served: Served) -> None:
        assert served.server._listener is not None
        port = served.server.tcp_port or 0
        other = await asyncio.open_connection("127.0.0.1", port, local_addr=("127.0.0.2", 0))
        flood = [await served.dial(tcp=True) for _ in range(3)]
        assert await asyncio.wait_for(flood[0][0].read(), HANDSHAKE_S / 2) == b""
        rest = asyncio.ensure_future(other[0].read())
        await asyncio.wait([rest], timeout=HANDSHAKE_S / 10)
        assert not rest.done(), "one of another address, though older, stays"
        rest.cancel()
        for _, writer in (other, *flood):
            writer.close()

    run(tmp_path, body, tcp=with_tls(tmp_path, certificate), tcp_connections_max=3)


def test_a_handshake_that_does_not_come_ends(tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    async def body(served: Served) -> None:
        reader, _ = await served.dial(tcp=True)
        assert await reader.read() == b""
        assert asyncio.get_running_loop().time() == pytest.approx(HANDSHAKE_S)
        await served.server_has(0)

    run(tmp_path, body, tcp=with_tls(tmp_path, certificate))


def test_without_files_left_connections_wait_and_nothing_is_said(
    caplog: pytest.LogCaptureFixture, files_limit: tuple[int, int]
) -> None:
    async def main() -> None:
        come: asyncio.Queue[None] = asyncio.Queue()

        class Guest(asyncio.Protocol):
            def connection_made(self, transport: asyncio.BaseTransport) -> None:
                come.put_nowait(None)
                transport.close()

        listener = TcpListener(Guest, None)
        await listener.open("127.0.0.1", 0)
        await asyncio.sleep(0)  # it listens, and accepts
        guest = socket.create_connection(listener.addresses[0])
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, files_limit[1]))  # what is open stays so
        while not listener.starved:  # noqa: ASYNC110 (there is no event for it)
            await asyncio.sleep(0.01)
        resource.setrlimit(resource.RLIMIT_NOFILE, files_limit)
        await come.get()
        listener.close()
        guest.close()

    with caplog.at_level(logging.ERROR):
        jump_loop.run(main())
    assert not caplog.records


def test_what_nobody_looks_at_is_not_kept(certificate: tuple[Path, Path]) -> None:
    """As the page's connections: they are served, and no stop is looked for in them."""

    async def main() -> None:
        come: asyncio.Queue[None] = asyncio.Queue()

        class Guest(asyncio.Protocol):
            def connection_made(self, transport: asyncio.BaseTransport) -> None:
                come.put_nowait(None)

        for tls in (None, TlsServer(*certificate)):
            lane = StopLane()
            listener = TcpListener(Guest, tls, stop_lane=lane)
            await listener.open("127.0.0.1", 0)
            trusting = None if tls is None else ssl.create_default_context(cafile=str(certificate[0]))
            _, writer = await asyncio.open_connection(*listener.addresses[0], ssl=trusting)
            await come.get()
            async with asyncio.timeout(30):
                while lane._new:  # noqa: ASYNC110 (there is no event for it)
                    await asyncio.sleep(0.001)
            assert listener.entering == 0
            writer.transport.abort()
            listener.close()

    jump_loop.run(main())


def test_who_resets_at_once_leaves_nothing_behind(tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    async def body(served: Served) -> None:
        for _ in range(5):
            with socket.create_connection(("127.0.0.1", served.server.tcp_port or 0)) as left:
                left.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        await served.server_has(0)
        assert "result" in await (await served.script()).ask("machine.info")

    run(tmp_path, body, tcp=with_tls(tmp_path, certificate))


def test_a_service_may_open_as_many_files_as_the_system_lets_it(files_limit: tuple[int, int]) -> None:
    _, hard = files_limit
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    raise_files_limit()
    most = FILES_MAX if hard == resource.RLIM_INFINITY else min(hard, FILES_MAX)
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == (most, hard)
