"""The transport of TLS: what asyncio's own would do, and bytes that another takes beside the loop."""

import asyncio
import random
import socket
import ssl
from asyncio.selector_events import _SelectorTransport  # type: ignore[attr-defined]
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from coordinator.ipc.server.tcp_listener import TcpListener
from coordinator.ipc.server.tls_transport import READS_PER_ROUND, TlsServer, TlsState, TlsTransport
from tests.stages import jump_loop

MIB = 1 << 20


class Guest(asyncio.Protocol):
    """Keeps what it gets; notes what else happens."""

    def __init__(self) -> None:
        self.transport: TlsTransport
        self.got = bytearray()
        self.events: list[str] = []
        self.lost: asyncio.Future[Exception | None] = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, TlsTransport)
        self.transport = transport

    def data_received(self, data: bytes) -> None:
        self.got += data

    def eof_received(self) -> None:
        self.events.append("eof")

    def pause_writing(self) -> None:
        self.events.append("pause")

    def resume_writing(self) -> None:
        self.events.append("resume")

    def connection_lost(self, exc: Exception | None) -> None:
        self.lost.set_result(exc)

    async def has(self, size: int) -> None:
        while len(self.got) < size:  # noqa: ASYNC110 (it tells nobody)
            await asyncio.sleep(0.001)


class BufferedGuest(asyncio.BufferedProtocol):
    """Has a small buffer of its own."""

    def __init__(self) -> None:
        self.buffer = bytearray(1000)
        self.got = bytearray()

    def get_buffer(self, sizehint: int) -> bytearray:
        del sizehint
        return self.buffer

    def buffer_updated(self, nbytes: int) -> None:
        self.got += self.buffer[:nbytes]


Body = Callable[[Guest, asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


async def listening(certificate: tuple[Path, Path]) -> tuple[TcpListener, list[Guest], ssl.SSLContext]:
    """Return a server, the protocols of its connections, and what a client needs to trust it."""
    guests: list[Guest] = []

    def make() -> Guest:
        guests.append(Guest())
        return guests[-1]

    listener = TcpListener(make, TlsServer(*certificate))
    await listener.open("127.0.0.1", 0)
    return listener, guests, ssl.create_default_context(cafile=str(certificate[0]))


def run(certificate: tuple[Path, Path], body: Body) -> None:
    """Have BODY use a connection: the server's protocol, and the client's streams."""

    async def main() -> None:
        listener, guests, trusting = await listening(certificate)
        reader, writer = await asyncio.open_connection(*listener.addresses[0], ssl=trusting)
        while not guests:  # noqa: ASYNC110 (it tells nobody)
            await asyncio.sleep(0.001)
        try:
            await body(guests[0], reader, writer)
        finally:
            writer.transport.abort()
            guests[0].transport.abort()
            await guests[0].lost
            listener.close()

    jump_loop.run(main())


def some(size: int) -> bytes:
    return random.Random(size).randbytes(size)


def test_bytes_go_both_ways(certificate: tuple[Path, Path]) -> None:
    sent = some(3 * MIB)

    async def body(guest: Guest, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(sent)
        await guest.has(len(sent))
        assert guest.got == sent
        guest.transport.write(sent)
        assert await reader.readexactly(len(sent)) == sent

    run(certificate, body)


def test_an_old_asyncio_takes_no_bytes(
    certificate: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of Python 3.11.2 reads what was paused in connection_made; it took the handshake before."""
    sent = some(MIB)

    def add_reader(self: Any, fd: int, callback: Callable[[], None]) -> None:
        if not self.is_closing():
            self._loop._add_reader(fd, callback)

    async def body(guest: Guest, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(sent)
        await guest.has(len(sent))
        assert guest.got == sent

    monkeypatch.setattr(_SelectorTransport, "_add_reader", add_reader)
    run(certificate, body)


def test_what_another_takes_beside_the_loop_stays_in_order(certificate: tuple[Path, Path]) -> None:
    """Failed before with asyncio's TLS, which nobody else can read."""
    sent, seen = some(MIB), []

    async def body(guest: Guest, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        chance = random.Random(1)
        for at in range(0, len(sent), 4096):
            writer.write(sent[at : at + 4096])
            if chance.random() < 0.5:
                guest.transport.find_in(lambda waiting: seen.append(len(waiting)))
            if chance.random() < 0.3:
                await asyncio.sleep(0)
        await guest.has(len(sent))
        assert guest.got == sent
        assert max(seen) > 4096

    run(certificate, body)


def test_what_comes_waits_while_reading_is_paused(certificate: tuple[Path, Path]) -> None:
    sent = some(16 * MIB)

    async def body(guest: Guest, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        guest.transport.pause_reading()
        before = len(guest.got)
        writer.write(sent)
        await asyncio.sleep(1.0)
        assert len(guest.got) == before
        guest.transport.resume_reading()
        await guest.has(len(sent))
        assert guest.got == sent

    run(certificate, body)


def test_a_client_that_does_not_read_pauses_writing(certificate: tuple[Path, Path]) -> None:
    sent = some(16 * MIB)

    async def body(guest: Guest, reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
        guest.transport.set_write_buffer_limits(high=MIB)
        guest.transport.write(sent)
        assert guest.events == ["pause"]
        assert guest.transport.get_write_buffer_size() > MIB
        assert await reader.readexactly(len(sent)) == sent
        assert guest.events == ["pause", "resume"]

    run(certificate, body)


def test_what_was_written_arrives_before_the_end(certificate: tuple[Path, Path]) -> None:
    sent = some(2 * MIB)

    async def body(guest: Guest, reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
        guest.transport.write(sent)
        guest.transport.close()
        guest.transport.write(b"nobody gets this")
        assert guest.transport.is_closing()
        assert await reader.read() == sent
        assert await guest.lost is None

    run(certificate, body)


def test_the_client_ends_it(certificate: tuple[Path, Path]) -> None:
    async def body(guest: Guest, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"the last words")
        writer.close()
        assert await guest.lost is None
        assert (bytes(guest.got), guest.events) == (b"the last words", ["eof"])

    run(certificate, body)


def test_what_is_no_tls_ends_it(certificate: tuple[Path, Path]) -> None:
    async def body(guest: Guest, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"sound")
        opened = writer.get_extra_info("socket")
        with suppress(BlockingIOError):
            await asyncio.sleep(0.1)
            opened._sock.send(b"\x17\x03\x03\x00\x20" + bytes(32))
        assert isinstance(await guest.lost, ssl.SSLError)
        assert bytes(guest.got) == b"sound"

    run(certificate, body)


def test_a_handshake_that_fails_while_the_client_does_not_read_ends_once(
    certificate: tuple[Path, Path], caplog: pytest.LogCaptureFixture
) -> None:
    """Failed before: asyncio, asked to end what it had ended, logged a traceback."""

    async def main() -> None:
        ours, theirs = socket.socketpair()
        for end in (ours, theirs):
            end.setblocking(False)
        filling = 0
        with suppress(BlockingIOError):
            while True:
                filling += ours.send(b"x")
        theirs.send(b"\x16\x03\x01\x00\x05\x01\x00\x00\x01\x00")  # a hello that is too short
        serving = asyncio.ensure_future(TlsServer(*certificate).begin(ours.dup()).serve(Guest, ours, 5.0))
        for _ in range(5):
            await asyncio.sleep(0)
        assert not serving.done(), "an alert is still to be sent"
        while filling > 0:
            filling -= len(theirs.recv(4096))
        with pytest.raises(OSError, match="during the handshake"):
            await serving
        await asyncio.sleep(0.1)
        theirs.close()

    jump_loop.run(main())
    assert not caplog.records


def test_a_protocol_with_a_buffer(certificate: tuple[Path, Path]) -> None:
    sent = some(MIB)

    async def body(guest: Guest, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        other = BufferedGuest()
        guest.transport.set_protocol(other)
        assert guest.transport.get_protocol() is other
        writer.write(sent)
        while len(other.got) < len(sent):  # noqa: ASYNC110 (it tells nobody)
            await asyncio.sleep(0.001)
        assert other.got == sent
        guest.transport.set_protocol(guest)

    run(certificate, body)


@pytest.mark.parametrize("name", ["peername", "sockname", "sslcontext", "socket"])
def test_what_is_known_of_it(certificate: tuple[Path, Path], name: str) -> None:
    async def body(guest: Guest, _: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        known = guest.transport.get_extra_info(name)
        assert known is not None
        if name == "peername":
            assert known == writer.get_extra_info("sockname")

    run(certificate, body)


def test_few_connections_are_decrypted_in_a_round_of_the_loop(
    certificate: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Failed before: all in one, a few ms for each that sends records of one byte, without a token."""
    rounds, reads = 0, Counter[int]()
    receive = TlsState.receive

    def count(state: TlsState) -> bool:
        reads[rounds] += 1
        return receive(state)

    def tick() -> None:
        nonlocal rounds
        rounds += 1
        asyncio.get_running_loop().call_soon(tick)

    async def main() -> None:
        listener, guests, trusting = await listening(certificate)
        opened = [await asyncio.open_connection(*listener.addresses[0], ssl=trusting) for _ in range(12)]
        monkeypatch.setattr(TlsState, "receive", count)
        tick()
        for _, writer in opened:
            for _ in range(100):
                writer.write(b"x")
        for guest in guests:
            await guest.has(100)
        for _, writer in opened:
            writer.transport.abort()
        for guest in guests:
            await guest.lost
        listener.close()

    asyncio.run(main())
    assert reads.total() >= 12
    assert max(reads.values()) <= READS_PER_ROUND
