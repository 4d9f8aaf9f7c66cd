"""Other CAN programs on the virtual bus by socketcand: python-can's own client, and bare sockets."""

import asyncio
import contextlib
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import can
import pytest

from canbus_tools.inject.socketcand_server import CLIENTS_MAX, SocketcandServer
from nodes.support.errors import CanductorError
from nodes.transport.frame import CanFrame
from nodes.virtual.hub import VirtualBus

WAIT_S = 60.0


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[VirtualBus]:
    with VirtualBus(tmp_path / "bus", bitrate=None) as running:
        yield running


@contextlib.contextmanager
def serving(bus: VirtualBus) -> Iterator[SocketcandServer]:
    """A server in a thread of its own, as it must not wait for its clients."""
    server = SocketcandServer(bus.path, port=0)
    ready, ending = threading.Event(), asyncio.Event()
    loops: list[asyncio.AbstractEventLoop] = []

    async def serve() -> None:
        loops.append(asyncio.get_running_loop())
        async with server:
            ready.set()
            await ending.wait()

    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    assert ready.wait(WAIT_S)
    try:
        yield server
    finally:
        loops[0].call_soon_threadsafe(ending.set)
        thread.join(WAIT_S)
        assert not thread.is_alive()


def until(condition: Callable[[], bool]) -> None:
    """Wait for what the server's thread does."""
    end_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end_s, "it did not come to that"
        os.sched_yield()


def python_can(server: SocketcandServer) -> can.BusABC:
    return can.Bus(interface="socketcand", host=server.host, port=server.port, channel=server.name)


def plain(can_id: int, data: bytes = b"") -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=False)


def next_frame(bus: can.BusABC) -> tuple[int, bytes]:
    """The next frame; python-can's client may return early, when only a part of one came."""
    for _ in range(100):
        if (message := bus.recv(WAIT_S)) is not None:
            return message.arbitration_id, bytes(message.data)
    raise AssertionError("no frame came")


@contextlib.contextmanager
def bare(server: SocketcandServer) -> Iterator[socket.socket]:
    with socket.create_connection((server.host, server.port), WAIT_S) as sock:
        yield sock


def read_until(sock: socket.socket, end: bytes) -> bytes:
    data = b""
    while not data.endswith(end):
        part = sock.recv(65536)
        assert part, f"the server closed after {data!r}"
        data += part
    return data


def test_python_can_carries_frames_both_ways(bus: VirtualBus) -> None:
    with (
        serving(bus) as server,
        python_can(server) as remote,
        can.Bus(interface="canductor", channel=str(bus.path)) as local,
    ):
        for data in (b"", b"\x00", b"\x01\xff", bytes(range(8))):
            remote.send(plain(0x123, data))
            assert next_frame(local) == (0x123, data)
            local.send(plain(0x7FF, data))
            assert next_frame(remote) == (0x7FF, data)
        with python_can(server) as another:
            another.send(plain(5, b"x"))
            assert next_frame(remote) == next_frame(local) == (5, b"x")
            assert server.stats.connected == 2
        until(lambda: server.stats.connected == 1)
        assert asdict(server.stats) == {"connected": 1, "clients": 2, "errors": 0, "slow": 0, "refused": 0}


def test_many_frames_arrive_in_order(bus: VirtualBus) -> None:
    count = 1000
    with serving(bus) as server, bare(server) as sock, python_can(server) as remote:
        read_until(sock, b"< hi >")
        sock.sendall(b"< open can0 >< rawmode >")
        read_until(sock, b"< ok >< ok >")
        sock.sendall(b"".join(b"< send 123 2 %x %x >" % divmod(number, 256) for number in range(count)))
        for number in range(count):
            assert next_frame(remote) == (0x123, number.to_bytes(2))


def test_bad_input_is_answered_and_other_clients_do_not_notice(bus: VirtualBus) -> None:
    with serving(bus) as server, python_can(server) as good:
        with bare(server) as sock:
            sock.sendall(b"\x00\xff garbage < open can0 >< fly >")
            said = read_until(sock, b"'fly' >")
            assert said == b"< hi >< ok >< error unknown command 'fly' >"
        with bare(server) as sock:
            sock.sendall(b"< open vcan7 >")
            assert read_until(sock, b"only can0 >").startswith(b"< hi >< error there is no bus 'vcan7' here")
            assert sock.recv(1) == b""
        until(lambda: server.stats.errors == 2)
        with can.Bus(interface="canductor", channel=str(bus.path)) as local:
            local.send(plain(1))
            assert next_frame(good) == (1, b"")


def test_cyclic_frames_come_until_they_are_deleted(bus: VirtualBus) -> None:
    with (
        serving(bus) as server,
        bare(server) as sock,
        can.Bus(interface="canductor", channel=str(bus.path)) as local,
    ):
        sock.sendall(b"< open can0 >< add 0 1000 77 1 1 >< echo >")
        read_until(sock, b"< echo >")
        assert [next_frame(local) for _ in range(5)] == [(0x77, b"\x01")] * 5
        sock.sendall(b"< delete 77 >< send 78 1 2 >")
        while next_frame(local) != (0x78, b"\x02"):
            pass


def test_a_client_that_does_not_read_is_disconnected_and_the_bus_goes_on(bus: VirtualBus) -> None:
    record = CanFrame(0x123, bytes(8)).to_record() * 256
    with serving(bus) as server, bare(server) as lazy:
        lazy.sendall(b"< open can0 >< rawmode >")
        read_until(lazy, b"< ok >< ok >")
        with socket.socket(socket.AF_UNIX) as sender:
            sender.connect(str(bus.path))
            sender.settimeout(WAIT_S)
            while server.stats.slow == 0:
                sender.sendall(record)
        assert server.stats.connected == 0
        assert bus.stats.expelled == 0
        assert bus.stats.frames > 20_000


def test_a_client_that_only_asks_is_disconnected_too(bus: VirtualBus) -> None:
    with serving(bus) as server, bare(server) as lazy:
        with contextlib.suppress(ConnectionError):
            lazy.sendall(b"< open can0 >")
            while server.stats.slow == 0:
                lazy.sendall(b"<echo>" * 1000)
        assert server.stats.slow == 1


def test_connections_are_bounded(bus: VirtualBus) -> None:
    with serving(bus) as server, contextlib.ExitStack() as stack:
        for _ in range(CLIENTS_MAX):
            read_until(stack.enter_context(bare(server)), b"< hi >")
        with bare(server) as one_more:
            assert read_until(one_more, b" >") == b"< error this server has all the clients it can have >"
            assert one_more.recv(1) == b""
        assert server.stats.refused == 1


def test_clients_are_disconnected_when_the_bus_ends(bus: VirtualBus) -> None:
    with serving(bus) as server, bare(server) as sock:
        sock.sendall(b"< open can0 >")
        read_until(sock, b"< ok >")
        bus.close()
        assert sock.recv(1) == b""


def test_an_address_that_is_taken_is_told(bus: VirtualBus) -> None:
    async def twice() -> None:
        async with SocketcandServer(bus.path, port=0) as first, SocketcandServer(bus.path, port=first.port):
            pass

    with pytest.raises(
        CanductorError, match=r"socketcand at 127\.0\.0\.1:\d+: cannot listen: .*choose another"
    ):
        asyncio.run(twice())
