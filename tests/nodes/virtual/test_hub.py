"""The virtual bus with real sockets, threads and processes."""

import contextlib
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from nodes.support.errors import CanductorError
from nodes.transport import CanFrame, TransportClosedError, open_can
from nodes.transport.frame import RECORD_SIZE
from nodes.virtual.hub import VirtualBus

WAIT_S = 20.0


def record(can_id: int, number: int) -> bytes:
    return CanFrame(can_id, number.to_bytes(8)).to_record()


@contextlib.contextmanager
def client(bus: VirtualBus) -> Iterator[socket.socket]:
    """A bare socket connected to BUS."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.connect(str(bus.path))
        sock.settimeout(WAIT_S)
        yield sock


def read_records(sock: socket.socket, count: int) -> list[bytes]:
    data = b""
    while len(data) < count * RECORD_SIZE:
        part = sock.recv(65536)
        if not part:
            break
        data += part
    return [data[at : at + RECORD_SIZE] for at in range(0, len(data), RECORD_SIZE)]


def yield_until(condition: Callable[[], object]) -> None:
    """Give the bus's thread its turns until CONDITION is true: its counters cannot be waited for."""
    end_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end_s
        os.sched_yield()


def until_end(sock: socket.socket) -> None:
    with contextlib.suppress(ConnectionResetError):
        while sock.recv(65536):
            pass


@contextlib.contextmanager
def sending(jobs: list[tuple[socket.socket, bytes]]) -> Iterator[None]:
    """Send everything at once, each socket from a thread of its own."""
    threads = [threading.Thread(target=sock.sendall, args=(data,)) for sock, data in jobs]
    for thread in threads:
        thread.start()
    yield
    for thread in threads:
        thread.join(WAIT_S)
        assert not thread.is_alive()


def test_all_receivers_see_one_order_and_nobody_its_own(tmp_path: Path) -> None:
    count = 3000
    with VirtualBus(tmp_path / "bus", bitrate=None) as bus, contextlib.ExitStack() as stack:
        senders = [stack.enter_context(client(bus)) for _ in range(3)]
        listeners = [stack.enter_context(client(bus)) for _ in range(2)]
        jobs = [
            (sock, b"".join(record(0x100 + i, n) for n in range(count))) for i, sock in enumerate(senders)
        ]
        seen: dict[int, list[bytes]] = {}

        def read(index: int, sock: socket.socket, number: int) -> None:
            seen[index] = read_records(sock, number)

        readers = [
            threading.Thread(target=read, args=(i, sock, count * (3 if sock in listeners else 2)))
            for i, sock in enumerate(senders + listeners)
        ]
        for reader in readers:
            reader.start()
        with sending(jobs):
            for reader in readers:
                reader.join(WAIT_S)
        assert len(seen[3]) == 3 * count
        assert seen[3] == seen[4]
        for i in range(3):
            own = CanFrame(0x100 + i).to_record()[:4]
            assert seen[i] == [r for r in seen[3] if r[:4] != own]
            assert [r for r in seen[3] if r[:4] == own] == [record(0x100 + i, n) for n in range(count)]
        assert bus.stats.frames == 3 * count
        assert bus.stats.lost == 0


def test_whoever_is_connected_before_a_frame_is_sent_gets_it(tmp_path: Path) -> None:
    with VirtualBus(tmp_path / "bus", bitrate=None) as bus, client(bus) as sender:
        for number in range(200):
            with client(bus) as listener:
                sender.sendall(record(1, number))
                assert read_records(listener, 1) == [record(1, number)]


def test_bit_rate_is_kept(tmp_path: Path) -> None:
    """A bus may be slower than nominal, on a busy machine, never faster; test_hub.c has its time exactly."""
    count = 500
    with (
        VirtualBus(tmp_path / "bus", bitrate=500_000) as bus,
        client(bus) as sender,
        client(bus) as listener,
    ):
        begin_ns = time.monotonic_ns()
        with sending([(sender, b"".join(record(0x123, n) for n in range(count)))]):
            assert len(read_records(listener, count)) == count
        elapsed_ns = time.monotonic_ns() - begin_ns
        assert bus.stats.busy_ns == bus.stats.bits * 2000
        assert elapsed_ns >= bus.stats.busy_ns


def test_a_slow_reader_gets_everything_and_the_sender_waits(tmp_path: Path) -> None:
    count = 40_000
    with VirtualBus(tmp_path / "bus", bitrate=None) as bus, client(bus) as sender, client(bus) as slow:
        with sending([(sender, b"".join(record(5, n) for n in range(count)))]):
            # Nothing was read yet: all must come to a stand while far from all was taken.
            poller = select.poll()
            poller.register(slow, select.POLLIN)
            assert poller.poll(WAIT_S * 1000)
            assert bus.stats.frames < count
            got: list[bytes] = []
            while len(got) < count:
                got += read_records(slow, min(100, count - len(got)))
        assert got == [record(5, n) for n in range(count)]
        assert bus.stats.expelled == 0


def test_a_stuck_client_is_disconnected_and_the_others_go_on(tmp_path: Path) -> None:
    count = 40_000
    with (
        VirtualBus(tmp_path / "bus", bitrate=None, stuck_limit_s=0.2) as bus,
        client(bus) as sender,
        client(bus) as stuck,
    ):
        with sending([(sender, b"".join(record(5, n) for n in range(count)))]):
            yield_until(lambda: bus.stats.expelled)
        yield_until(lambda: bus.stats.frames == count)
        assert bus.stats.expelled == 1
        with client(bus) as listener:
            sender.sendall(record(6, 1))
            assert read_records(listener, 1) == [record(6, 1)]
        until_end(stuck)


def test_frames_of_a_client_that_closes_at_once_are_delivered(tmp_path: Path) -> None:
    count = 2000
    with VirtualBus(tmp_path / "bus", bitrate=10_000_000) as bus, client(bus) as listener:
        with client(bus) as brief:
            # More than the hub's own queue: most of it is read after the client has gone.
            brief.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
            brief.sendall(b"".join(record(9, n) for n in range(count)))
        assert read_records(listener, count) == [record(9, n) for n in range(count)]


def test_a_half_closed_client_still_listens(tmp_path: Path) -> None:
    with VirtualBus(tmp_path / "bus") as bus, client(bus) as sender, client(bus) as listener:
        listener.sendall(record(1, 1))
        listener.shutdown(socket.SHUT_WR)
        assert read_records(sender, 1) == [record(1, 1)]
        sender.sendall(record(2, 2))
        assert read_records(listener, 1) == [record(2, 2)]


def test_garbage_is_counted_and_hurts_nobody(tmp_path: Path) -> None:
    with VirtualBus(tmp_path / "bus", bitrate=None) as bus, client(bus) as listener:
        with client(bus) as noisy:
            noisy.sendall(struct.pack("=IB3x8s", 0x80000001, 8, b"") * 10)  # extended
            noisy.sendall(struct.pack("=IB3x8s", 1, 9, b"") * 10)  # too long
            noisy.sendall(os.urandom(7))  # and cut off
        with client(bus) as good:
            good.sendall(record(3, 3))
            assert read_records(listener, 1) == [record(3, 3)]
        assert bus.stats.rejected == 20


def test_lost_frames_follow_from_the_seed(tmp_path: Path) -> None:
    def arrived(seed: int, name: str) -> list[bytes]:
        with VirtualBus(tmp_path / name, bitrate=None, loss=0.2, seed=seed) as bus, client(bus) as listener:
            with client(bus) as sender:
                sender.sendall(b"".join(record(7, n) for n in range(500)))
            yield_until(lambda: bus.stats.frames == 500)
            return read_records(listener, 500 - bus.stats.lost)

    first = arrived(1, "a")
    assert 350 < len(first) < 450
    assert arrived(1, "b") == first
    assert arrived(2, "c") != first


def test_more_clients_than_places_are_refused(tmp_path: Path) -> None:
    with VirtualBus(tmp_path / "bus") as bus, contextlib.ExitStack() as stack:
        clients = [stack.enter_context(client(bus)) for _ in range(64)]
        late = stack.enter_context(client(bus))
        assert late.recv(1) == b""
        assert bus.stats.refused == 1
        clients[0].sendall(record(1, 1))
        assert read_records(clients[63], 1) == [record(1, 1)]


def test_a_path_in_use_is_refused_and_a_stale_one_replaced(tmp_path: Path) -> None:
    path = tmp_path / "bus"
    with VirtualBus(path) as bus:
        with pytest.raises(CanductorError, match="already running"):
            VirtualBus(path).start()
        with client(bus) as a, client(bus) as b:  # the refused one did no harm
            a.sendall(record(1, 1))
            assert read_records(b, 1) == [record(1, 1)]
    assert not path.exists()
    stale = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    stale.bind(str(path))
    stale.close()
    with VirtualBus(path) as bus:
        open_can(bus.address).close()


def test_what_is_no_socket_is_never_removed(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("data")
    with pytest.raises(CanductorError, match="a file other than a socket"):
        VirtualBus(tmp_path / "precious").start()
    assert (tmp_path / "precious").read_text() == "data"


@pytest.mark.parametrize(
    ("path", "options", "said"),
    [
        ("x" * 108, {}, "longer than the 107 bytes"),
        ("bus", {"bitrate": 5}, "bit rate 5 is not between"),
        ("bus", {"loss": 1.5}, "loss 1.5 is not a share"),
        ("bus", {"loss": float("nan")}, "loss nan is not a share"),
        ("bus", {"stuck_limit_s": 0}, "stuck limit 0 s"),
    ],
)
def test_bad_arguments_are_refused(path: str, options: dict[str, float], said: str) -> None:
    with pytest.raises(CanductorError, match=said):
        VirtualBus(path, **options)  # type: ignore[arg-type]


def test_a_folder_that_does_not_exist_is_told(tmp_path: Path) -> None:
    with pytest.raises(CanductorError, match="the folder must exist"):
        VirtualBus(tmp_path / "no" / "bus").start()


def test_close_ends_connections_and_keeps_the_figures(tmp_path: Path) -> None:
    bus = VirtualBus(tmp_path / "bus").start()
    with pytest.raises(CanductorError, match="started twice"):
        bus.start()
    transport = open_can(bus.address)
    bus.close()
    bus.close()
    with pytest.raises(TransportClosedError, match="ended the connection"):
        transport.receive(WAIT_S)
    transport.close()
    assert bus.stats.frames == 0


def test_the_process_says_when_it_is_ready_and_reports_at_the_end(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.stages.bus_process", str(tmp_path / "bus"), "--bitrate", "250000"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert f'"address": "virtual:{tmp_path / "bus"}"' in process.stdout.readline()
        a, b = open_can(f"virtual:{tmp_path / 'bus'}"), open_can(f"virtual:{tmp_path / 'bus'}")
        a.send(CanFrame(1, b"x"))
        assert b.receive(WAIT_S) == CanFrame(1, b"x")
        refused = subprocess.run(command, capture_output=True, text=True, check=False, timeout=WAIT_S)
        assert refused.returncode == 1
        assert "already running" in refused.stderr
        assert "Traceback" not in refused.stderr
        process.send_signal(signal.SIGTERM)
        assert '"frames": 1,' in process.stdout.readline()
        assert process.wait(WAIT_S) == 0
        a.close()
        b.close()
    assert not (tmp_path / "bus").exists()
