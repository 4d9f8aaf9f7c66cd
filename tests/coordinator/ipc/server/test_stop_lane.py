"""Emergency stops that wait unread while the loop is held: by the test, which gives it no turn."""

import asyncio
import functools
import json
import select
import socket
import ssl
import threading
import time
from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.ipc.protocol.messages import Encoder, Encoding
from coordinator.ipc.protocol.methods import Scope
from coordinator.ipc.server.acceptor import AHEAD_MAX
from coordinator.ipc.server.fair_scheduler import ROUND_S, FairScheduler
from coordinator.ipc.server.settings import TcpSettings
from coordinator.ipc.server.stop_lane import StopLane
from coordinator.web.settings import WebSettings
from coordinator.web.stop_request import STOP_PATH, parse_request
from tests.coordinator.ipc.served import TOKENS, Served, plain_tcp, run, tokens_file
from tests.coordinator.web.paged import LOOPBACK, Paged, paging
from tests.stages import jump_loop

HELLO: dict[str, Any] = {"id": 1, "method": "api.hello", "params": {"version": 1, "client": "new"}}
PATIENCE_S = 30.0
STOP: dict[str, Any] = {"id": 2, "method": "machine.emergency_stop", "params": {"who": "me"}}


TLS = pytest.mark.parametrize("secret", [False, True], ids=["plain", "tls"])


def line(message: object) -> bytes:
    return json.dumps(message).encode() + b"\n"


class Lane(StopLane):
    """Notes who stops the machine."""

    def __init__(self) -> None:
        self.stops: list[str] = []
        super().__init__(self.stops.append)

    def seen(self) -> list[str]:
        """Look once, as the watchdog's thread does; return who stopped the machine by then."""
        self.look()
        return self.stops

    def sees(self, stops: list[str]) -> bool:
        """Look until STOPS have been seen, which may take a moment; return whether there were no others."""
        until_s = time.monotonic() + PATIENCE_S
        while self.seen() != stops and len(self.stops) < len(stops) and time.monotonic() < until_s:
            pass
        return self.stops == stops

    async def is_unread_until_done(self, done: list[str]) -> None:
        """Let the loop go on until it has DONE a stop: it has to be found until then, and no longer."""
        while not done:
            assert self.find() is not None
            await asyncio.sleep(0)
        assert self.find() is None


def test_a_client_stops_the_machine_and_gets_its_answer_later(tmp_path: Path) -> None:
    lane = Lane()

    async def go(served: Served) -> None:
        script = await served.script(client="old")
        assert lane.seen() == []
        script.send("machine.info", 5)
        script.send("machine.emergency_stop", 6)
        assert len(lane.seen()) == 1
        assert lane.stops[0].startswith("old (uid")
        assert served.stops == [], "the loop has not read it"
        await lane.is_unread_until_done(served.stops)
        assert {(await script.receive())["id"] for _ in range(2)} == {5, 6}
        assert served.stops == lane.stops, "it carries out what it reads, in its turn"
        script.send("machine.info", 7, what="machine.emergency_stop")
        assert len(lane.seen()) == 1

    run(tmp_path, go, stop_lane=lane)


@pytest.mark.parametrize("cut", [1, 20, -1])
def test_a_stop_whose_first_bytes_were_read_is_seen(tmp_path: Path, cut: int) -> None:
    lane, sent = Lane(), line(STOP)

    async def go(served: Served) -> None:
        script = await served.script()
        script.writer.write(sent[:cut])
        await asyncio.sleep(0.1)
        assert lane.seen() == []
        script.writer.write(sent[cut:])
        assert lane.seen() == ["me"]
        await lane.is_unread_until_done(served.stops)
        await script.receive()

    run(tmp_path, go, stop_lane=lane)


@pytest.mark.parametrize("encoding", list(Encoding))
def test_a_new_connection_stops_the_machine_with_its_first_bytes(tmp_path: Path, encoding: Encoding) -> None:
    lane, encoder = Lane(), Encoder()

    async def go(served: Served) -> None:
        with socket.socket(socket.AF_UNIX) as opened:
            opened.connect(served.at)
            opened.sendall(encoder.message(encoding, HELLO))
            assert lane.seen() == []
            opened.sendall(encoder.message(encoding, STOP))
            assert lane.seen() == ["me"]
            opened.setblocking(False)
            answer = b""
            async with asyncio.timeout(30):
                while b"shutdown" not in answer:
                    answer += await asyncio.get_running_loop().sock_recv(opened, 10_000)
        assert served.stops == ["me"]

    run(tmp_path, go, stop_lane=lane)


def test_who_may_not_stop_the_machine_does_not(tmp_path: Path) -> None:
    lane = Lane()

    async def go(served: Served) -> None:
        guest = await served.script(scope="watch")
        guest.send("machine.emergency_stop")
        new = [socket.socket(socket.AF_UNIX) for _ in range(4)]
        for opened, sent in zip(
            new, (line(STOP), b"\x00garbage", b"", line(HELLO) + line([STOP])), strict=True
        ):
            opened.connect(served.at)
            opened.sendall(sent)
        assert lane.seen() == []
        assert (await guest.receive())["error"]["code"] == "not_allowed"
        for opened in new:
            opened.close()

    run(tmp_path, go, stop_lane=lane)


def test_over_tcp_the_rights_of_the_token_count(tmp_path: Path) -> None:
    lane = Lane()

    async def go(served: Served) -> None:
        for scope, stops in ((Scope.WATCH, []), (Scope.OPERATE, ["me"])):
            reader, writer = await served.dial(tcp=True)
            hello = {**HELLO, "params": {"version": 1, "token": TOKENS[scope]}}
            writer.write(line(hello))
            await reader.readline()
            writer.write(line(STOP))
            assert lane.seen() == stops

    run(tmp_path, go, stop_lane=lane, tcp=plain_tcp(tmp_path))


@TLS
def test_the_page_stops_the_machine(tmp_path: Path, certificate: tuple[Path, Path], *, secret: bool) -> None:
    lane, (pem, key) = Lane(), certificate
    settings = WebSettings(host="127.0.0.1", port=0, certificate=pem, private_key=key) if secret else LOOPBACK

    async def go(paged: Paged) -> None:
        for scope, stops in ((Scope.WATCH, []), (Scope.OPERATE, ["me"])):
            async with paged.other() as other:
                await other.sign_in(scope)
                async with other.socket() as page:
                    await other.hello(page)
                    await page.ping()
                    await page.send_str(json.dumps(STOP))
                    assert lane.sees(stops)
                    if stops:
                        await lane.is_unread_until_done(paged.served.stops)

    async def main() -> None:
        async with paging(tmp_path, settings, stop_lane=lane) as paged:
            await go(paged)

    jump_loop.run(main())


def test_a_client_that_has_left_is_forgotten(tmp_path: Path) -> None:
    lane = Lane()

    async def go(served: Served) -> None:
        script = await served.script()
        script.writer.close()
        await asyncio.sleep(0.1)
        assert not lane._unread
        lane.close()
        assert lane.seen() == []

    run(tmp_path, go, stop_lane=lane)


class Hog:
    """A client with so much work that others wait for their turn many rounds."""

    transport: asyncio.Transport

    def __init__(self, scheduler: FairScheduler) -> None:
        self._scheduler = scheduler
        self.rounds = 20

    def work(self, until_s: float) -> bool:
        del until_s
        self._scheduler._spent_s = ROUND_S
        self.rounds -= 1
        return self.rounds > 0

    def pause(self) -> None:
        pass


@TLS
def test_a_client_that_leaves_before_its_turn_has_stopped_the_machine(
    tmp_path: Path, certificate: tuple[Path, Path], *, secret: bool
) -> None:
    """Failed before: what it had sent was forgotten."""
    lane, chosen = Lane(), certificate if secret else None

    async def go(served: Served) -> None:
        scheduler = served.server._scheduler
        assert scheduler is not None
        dialled = Dialled(served.server.tcp_port or 0, chosen)
        while not dialled.shake_hands():  # noqa: ASYNC110 (there is no event for it)
            await asyncio.sleep(0)
        while not served.server.figures()["connections"]:  # noqa: ASYNC110 (likewise)
            await asyncio.sleep(0)
        for _ in range(10):
            scheduler.request_turn(Hog(scheduler))
        dialled.send(line({**HELLO, "params": {"version": 1, "token": TOKENS[Scope.OPERATE]}}) + line(STOP))
        dialled.close()
        while served.server.figures()["connections"]:  # noqa: ASYNC110 (likewise)
            await asyncio.sleep(0)
        await lane.is_unread_until_done(served.stops)
        assert served.stops == ["me"]

    run(tmp_path, go, stop_lane=lane, tcp=over(tmp_path, chosen))


def test_a_stop_is_done_before_what_others_wait_for(tmp_path: Path) -> None:
    """Failed before: it waited for a turn of each, 58 ms with 100 who send without a pause."""

    async def go(served: Served) -> None:
        script = await served.script()
        scheduler = served.server._scheduler
        assert scheduler is not None
        hogs = [Hog(scheduler) for _ in range(10)]
        for hog in hogs:
            scheduler.request_turn(hog)
        script.send("machine.emergency_stop", who="me")
        while not served.stops:  # noqa: ASYNC110 (there is no event for it)
            await asyncio.sleep(0)
        assert sum(20 - hog.rounds for hog in hogs) < 5

    run(tmp_path, go)


def over(folder: Path, certificate: tuple[Path, Path] | None) -> TcpSettings:
    """Return the settings of TCP with or without TLS."""
    plain = plain_tcp(folder)
    if certificate is None:
        return plain
    return replace(plain, plain_on_loopback=False, certificate=certificate[0], private_key=certificate[1])


class Dialled:
    """A client whose bytes the test moves itself, with TLS or without: its loop gets no turn."""

    def __init__(self, port: int, certificate: tuple[Path, Path] | None) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.settimeout(0.0)
        self._tls: ssl.SSLObject | None = None
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        if certificate is not None:
            trusting = ssl.create_default_context(cafile=str(certificate[0]))
            self._tls = trusting.wrap_bio(self._incoming, self._outgoing, server_hostname="127.0.0.1")

    def shake_hands(self) -> bool:
        """Do what can be done of the handshake; return whether it is done."""
        if self._tls is None:
            return True
        with suppress(BlockingIOError):
            self._incoming.write(self._socket.recv(65_536))
        done = True
        try:
            self._tls.do_handshake()
        except ssl.SSLWantReadError:
            done = False
        self._socket.sendall(self._outgoing.read())
        return done

    def send(self, data: bytes) -> None:
        if self._tls is None:
            self._socket.sendall(data)
            return
        self._tls.write(data)
        self._socket.sendall(self._outgoing.read())

    def receive(self) -> bytes:
        """Return what has come."""
        with suppress(BlockingIOError):
            data = self._socket.recv(65_536)
            if self._tls is None:
                return data
            self._incoming.write(data)
        found = b""
        if self._tls is not None:
            with suppress(ssl.SSLWantReadError):
                while data := self._tls.read(65_536):
                    found += data
        return found

    def close(self) -> None:
        self._socket.close()


@TLS
@pytest.mark.parametrize("scope", [Scope.WATCH, Scope.OPERATE])
def test_a_new_connection_over_tcp(
    tmp_path: Path, certificate: tuple[Path, Path], scope: Scope, *, secret: bool
) -> None:
    """It comes, shakes hands and stops the machine while the loop has no turn; then it gets its answer."""
    lane, chosen = Lane(), certificate if secret else None

    async def go(served: Served) -> None:
        dialled = Dialled(served.server.tcp_port or 0, chosen)
        while not dialled.shake_hands():
            assert lane.seen() == []
        dialled.send(line({**HELLO, "params": {"version": 1, "token": "x" * 32}}) + line(STOP))
        assert lane.seen() == [], "nobody knows that token"
        dialled.close()
        dialled = Dialled(served.server.tcp_port or 0, chosen)
        while not dialled.shake_hands():
            assert lane.seen() == []
        dialled.send(line({**HELLO, "params": {"version": 1, "token": TOKENS[scope]}}))
        assert lane.seen() == []
        dialled.send(line(STOP))
        assert lane.sees(["me"] if scope is Scope.OPERATE else [])
        assert served.stops == []
        await asyncio.sleep(0.1)
        assert served.stops == lane.stops[:1], "the loop has read it, too"
        assert served.server.figures()["connections"] == 1
        dialled.close()
        await served.server_has(0)

    run(tmp_path, go, stop_lane=lane, tcp=over(tmp_path, chosen))


ROUNDS = pytest.mark.parametrize("rounds", range(8))
"""Of the loop between a connection and the hold: it is accepted, gets a transport, a protocol, is read."""


@ROUNDS
def test_a_new_connection_that_the_loop_has_begun_to_take(tmp_path: Path, rounds: int) -> None:
    """Failed before: what was accepted was looked at only when its protocol was there."""
    lane = Lane()

    async def go(served: Served) -> None:
        with socket.socket(socket.AF_UNIX) as opened:
            opened.connect(served.at)
            opened.sendall(line(HELLO))
            for _ in range(rounds):
                await asyncio.sleep(0)
            opened.sendall(line(STOP))
            assert lane.seen() == ["me"]
            assert served.stops == []
            await lane.is_unread_until_done(served.stops)

    run(tmp_path, go, stop_lane=lane)


@ROUNDS
@TLS
def test_a_new_connection_over_tcp_that_the_loop_has_begun_to_take(
    tmp_path: Path, certificate: tuple[Path, Path], rounds: int, *, secret: bool
) -> None:
    """Failed before, likewise; handshakes that the loop had begun waited for it."""
    lane, chosen = Lane(), certificate if secret else None
    hello = line({**HELLO, "params": {"version": 1, "token": TOKENS[Scope.OPERATE]}})

    async def go(served: Served) -> None:
        dialled = Dialled(served.server.tcp_port or 0, chosen)
        done = dialled.shake_hands()
        for _ in range(rounds):
            await asyncio.sleep(0)
        while not done:
            assert lane.seen() == []
            done = dialled.shake_hands()
        dialled.send(hello + line(STOP))
        assert lane.sees(["me"])
        await lane.is_unread_until_done(served.stops)
        dialled.close()
        await served.server_has(0)

    run(tmp_path, go, stop_lane=lane, tcp=over(tmp_path, chosen))


@TLS
def test_a_new_connection_is_looked_at_while_the_loop_is_free(
    tmp_path: Path, certificate: tuple[Path, Path], *, secret: bool
) -> None:
    """By the thread, while nothing holds the loop: a stop waited for some rounds of it, more with TLS."""
    lane, chosen = Lane(), certificate if secret else None
    hello = line({**HELLO, "params": {"version": 1, "token": TOKENS[Scope.OPERATE]}})

    def is_readable() -> bool:
        return bool(select.select([lane.events_fd], [], [], 0.0)[0])

    def handle() -> None:
        assert select.select([lane.events_fd], [], [], PATIENCE_S)[0]
        lane.handle_events()

    async def go(served: Served) -> None:
        dialled = Dialled(served.server.tcp_port or 0, chosen)
        while not dialled.shake_hands():
            handle()
        dialled.send(hello)
        while is_readable():
            lane.handle_events()
        assert lane.stops == []
        dialled.send(line(STOP))
        while not lane.stops:
            handle()
        assert lane.stops == ["me"]
        assert not is_readable(), "it is said once"
        assert served.stops == []
        await lane.is_unread_until_done(served.stops)
        dialled.send(line({"id": 3, "method": "machine.info"}))
        answers = b""
        async with asyncio.timeout(PATIENCE_S):
            while b'"id":3' not in answers.replace(b" ", b""):
                await asyncio.sleep(0.01)
                answers += dialled.receive()
        assert not is_readable(), "the loop reads it now"
        dialled.close()
        await served.server_has(0)

    run(tmp_path, go, stop_lane=lane, tcp=over(tmp_path, chosen))


def test_many_connections_at_once_are_all_served(tmp_path: Path) -> None:
    """Those that the thread has accepted, some in each round of the loop, and those beyond."""
    lane = Lane()

    async def go(served: Served) -> None:
        come = [socket.socket(socket.AF_UNIX) for _ in range(AHEAD_MAX + 20)]
        for opened in come:
            opened.connect(served.at)
            opened.sendall(line(HELLO))
            lane.handle_events()
        for opened in come:
            opened.setblocking(False)
            async with asyncio.timeout(PATIENCE_S):
                assert b"result" in await asyncio.get_running_loop().sock_recv(opened, 10_000)
            opened.close()
        assert lane._new == {}, "all have their protocols"

    run(tmp_path, go, stop_lane=lane)


def test_a_look_that_fails_hides_no_stop() -> None:
    """Failed before: the first failure ended the look, and each further one of the hold."""
    lane = Lane()

    def fail() -> str:
        raise OSError("closed")

    with socket.socket(socket.AF_UNIX) as listener:
        lane.listen(listener, fail)
        lane.look_also(fail)
        lane.look_also(lambda: "me")
        with pytest.raises(OSError, match="closed"):
            lane.look()
        assert lane.stops == ["me"]


def test_an_event_that_fails_hides_no_stop() -> None:
    """Of another connection, and closed sockets are no failure."""
    lane, (ours, theirs), (left, gone) = Lane(), socket.socketpair(), socket.socketpair()

    def fail() -> None:
        raise OSError("no file left")

    with socket.socket(socket.AF_INET) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        lane.listen(listener, fail)
        lane.watch_new(ours, lambda: "me")
        lane.watch_new(left, lambda: "nobody")
        left.close()
        gone.close()
        with socket.create_connection(listener.getsockname()):
            theirs.sendall(b"a stop")
            with pytest.raises(OSError, match="no file left"):
                lane.handle_events()
        assert lane.stops == ["me"]
        lane.settle(left)
        lane.listen_no_more(listener)
        lane.close()
    for opened in (ours, theirs):
        opened.close()


def test_a_look_ends_when_the_loop_goes_on() -> None:
    lane, looked = Lane(), list[int]()
    for number in range(5):
        lane.look_also(functools.partial(looked.append, number))
    lane.look(lambda: len(looked) < 2)
    assert looked == [0, 1]


class NextLock:
    """A lock that tells when the thread that made it has taken it."""

    def __init__(self) -> None:
        self.taken = threading.Event()
        self._owner = threading.get_ident()
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        self._lock.acquire()
        if threading.get_ident() == self._owner:
            self.taken.set()

    def __exit__(self, *error: object) -> None:
        self._lock.release()


def test_the_loop_waits_for_one_finder_at_most() -> None:
    """Failed before: a TLS connection that came took 30 ms more while clients had sent much."""
    lane, begun, looked, found = Lane(), threading.Event(), list[int](), list[int]()

    def find_slowly(number: int) -> None:
        looked.append(number)
        begun.set()
        assert next_lock.taken.wait(PATIENCE_S)

    class Connection:
        def close(self) -> None:
            found.append(len(looked))

    for number in range(5):
        lane.look_also(functools.partial(find_slowly, number))
    lane._peeking["a connection"] = cast("socket.socket", Connection())
    lane._next = cast("threading.Lock", next_lock := NextLock())
    thread = threading.Thread(target=lane.look)
    thread.start()
    assert begun.wait(PATIENCE_S)
    lane.forget("a connection")  # as the loop does
    thread.join()
    assert found == [1]
    assert looked == [0, 1, 2, 3, 4]


def test_a_finder_that_takes_long_ends_for_the_loop() -> None:
    """Failed before: a connection that was closed waited for all messages of another client, 75 ms."""
    lane, begun, is_held = Lane(), threading.Event(), True

    def find_slowly() -> None:
        begun.set()
        until_s = time.monotonic() + PATIENCE_S
        while lane.goes_on():
            assert time.monotonic() < until_s

    lane.look_also(find_slowly)
    thread = threading.Thread(target=lane.look, args=(lambda: is_held,))
    thread.start()
    assert begun.wait(PATIENCE_S)
    lane.forget("a connection")  # as the loop does, which cannot go on before
    thread.join()
    begun.clear()
    thread = threading.Thread(target=lane.look, args=(lambda: is_held,))
    thread.start()
    assert begun.wait(PATIENCE_S)
    is_held = False
    thread.join()
    lane.look_also(lambda: str(lane.goes_on()))
    del lane._others[find_slowly]
    assert lane.find() == "True", "a restart needs to know it"


def test_a_new_connection_that_has_closed_is_no_failure(tmp_path: Path) -> None:
    """As one that is cut off while its protocol is made; failed before."""
    lane = Lane()

    async def go(served: Served) -> None:
        closed = socket.socket(socket.AF_UNIX)
        closed.close()
        assert served.server._find_stop(closed, b"") is None
        assert lane.seen() == []

    run(tmp_path, go, stop_lane=lane)


def test_what_is_given_up_is_not_looked_at(tmp_path: Path) -> None:
    lane = Lane()

    async def go(served: Served) -> None:
        new = [socket.create_connection(("127.0.0.1", served.server.tcp_port or 0)) for _ in range(40)]
        for opened in new[:20]:
            opened.close()
        assert lane.seen() == []
        for opened in new[20:]:
            opened.close()
        while served.server.figures()["connections"] or lane._new or lane._unread:  # noqa: ASYNC110
            await asyncio.sleep(0)

    run(tmp_path, go, stop_lane=lane, tcp=plain_tcp(tmp_path), tcp_connections_max=4)


def test_a_connection_with_tls_that_exists(tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    lane = Lane()

    async def go(served: Served) -> None:
        trusting = ssl.create_default_context(cafile=str(certificate[0]))
        for scope, stops in ((Scope.WATCH, []), (Scope.OPERATE, ["me"])):
            reader, writer = await asyncio.open_connection(
                "127.0.0.1", served.server.tcp_port, ssl=trusting, server_hostname="127.0.0.1"
            )
            writer.write(line({**HELLO, "params": {"version": 1, "token": TOKENS[scope]}}))
            await reader.readline()
            writer.write(line({"id": 7, "method": "machine.info"}) + line(STOP))
            assert lane.sees(stops)
            answers = [json.loads(await reader.readline()) for _ in range(2)]
            assert {answer["id"] for answer in answers} == {2, 7}, "what the lane took is not lost"
            assert served.stops == stops
            writer.close()
        await served.server_has(0)

    run(tmp_path, go, stop_lane=lane, tcp=over(tmp_path, certificate))


# ------------------------------------------------------------------------ the page's stop as a request


def run_page(
    folder: Path,
    certificate: tuple[Path, Path] | None,
    lane: Lane,
    go: Callable[[Paged], Coroutine[Any, Any, None]],
    **settings: Any,
) -> None:
    """Serve the page, with TLS if there is a CERTIFICATE, and let GO test it."""
    page = LOOPBACK
    if certificate is not None:
        page = WebSettings(host="127.0.0.1", port=0, certificate=certificate[0], private_key=certificate[1])

    async def main() -> None:
        async with paging(folder, page, stop_lane=lane, **settings) as paged:
            await go(paged)

    jump_loop.run(main())


def request_stop(paged: Paged, lane: Lane, chosen: tuple[Path, Path] | None, data: bytes) -> Dialled:
    """Send DATA over a new connection while the loop has no turn."""
    dialled = Dialled(paged.page.port, chosen)
    while not dialled.shake_hands():
        assert lane.seen() == []
    dialled.send(data)
    return dialled


@TLS
def test_a_page_without_a_connection_stops_the_machine(
    tmp_path: Path, certificate: tuple[Path, Path], *, secret: bool
) -> None:
    """Failed before: a page that comes back waited for the loop."""
    lane, chosen = Lane(), certificate if secret else None

    async def go(paged: Paged) -> None:
        await paged.sign_in(Scope.WATCH)
        request_stop(paged, lane, chosen, paged.stop_request()).close()
        await paged.sign_in(Scope.OPERATE)
        data = paged.stop_request()
        cut = len(data) - 1
        dialled = request_stop(paged, lane, chosen, data[:cut])
        for _ in range(3):
            assert lane.seen() == []
        dialled.send(data[cut:])
        assert lane.sees(["me"])
        assert paged.served.stops == [], "the loop has not read it"
        await lane.is_unread_until_done(paged.served.stops)
        answer = b""
        while b'"state"' not in answer:
            await asyncio.sleep(0)
            answer += dialled.receive()
        assert answer.startswith(b"HTTP/1.1 200 ")
        lane.stops.clear()
        for _ in range(3):
            assert lane.seen() == [], "what was answered stops nothing any more"
        dialled.send(data)
        assert lane.sees(["me"]), "the connection is kept alive"
        dialled.close()

    run_page(tmp_path, chosen, lane, go)


@TLS
@pytest.mark.parametrize("is_new", [True, False])
def test_a_page_that_leaves_right_behind_its_request(
    tmp_path: Path, certificate: tuple[Path, Path], *, secret: bool, is_new: bool
) -> None:
    """Failed before: nobody found the stop from the end of the connection until it was done."""
    lane, chosen = Lane(), certificate if secret else None

    async def go(paged: Paged) -> None:
        await paged.sign_in()
        data, others = paged.stop_request(), set(lane._unread)
        dialled = request_stop(paged, lane, chosen, b"" if is_new else data[:10])
        if not is_new:
            await asyncio.sleep(0.1)
        dialled.send(data if is_new else data[10:])
        assert lane.sees(["me"])
        dialled.close()
        await lane.is_unread_until_done(paged.served.stops)
        await asyncio.sleep(0.1)
        assert set(lane._unread) == others

    run_page(tmp_path, chosen, lane, go)


@TLS
@pytest.mark.parametrize("cut", [1, 60, -30])
def test_a_page_on_a_connection_that_has_served_it(
    tmp_path: Path, certificate: tuple[Path, Path], cut: int, *, secret: bool
) -> None:
    """Its files came by it; the first bytes of the stop were read before the hold."""
    lane, chosen = Lane(), certificate if secret else None

    async def go(paged: Paged) -> None:
        await paged.sign_in()
        dialled = Dialled(paged.page.port, chosen)
        while not dialled.shake_hands():  # noqa: ASYNC110 (there is no event for it)
            await asyncio.sleep(0)
        for _ in range(2):
            dialled.send(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{paged.page.port}\r\n\r\n".encode())
            received = b""
            while b"</html>" not in received:
                await asyncio.sleep(0)
                received += dialled.receive()
        data = paged.stop_request()
        dialled.send(data[:cut])
        await asyncio.sleep(0.1)
        assert lane.seen() == []
        dialled.send(data[cut:])
        assert lane.sees(["me"])
        await lane.is_unread_until_done(paged.served.stops)
        assert paged.served.stops == ["me"]
        dialled.close()

    run_page(tmp_path, chosen, lane, go)


@ROUNDS
@TLS
def test_a_request_of_the_page_that_the_loop_has_begun_to_take(
    tmp_path: Path, certificate: tuple[Path, Path], rounds: int, *, secret: bool
) -> None:
    """The hold begins in any round between its first byte and its answer."""
    lane, chosen = Lane(), certificate if secret else None

    async def go(paged: Paged) -> None:
        await paged.sign_in()
        dialled = Dialled(paged.page.port, chosen)
        while not dialled.shake_hands():  # noqa: ASYNC110 (there is no event for it)
            await asyncio.sleep(0)
        dialled.send(paged.stop_request())
        for _ in range(rounds):
            await asyncio.sleep(0)
        if not paged.served.stops:
            assert lane.sees(["me"])
        await lane.is_unread_until_done(paged.served.stops)
        lane.stops.clear()
        assert lane.seen() == []
        dialled.close()

    run_page(tmp_path, chosen, lane, go)


WRONG: list[dict[str, Any]] = [
    {"Host": "evil.example"},
    {"Host": "evil.example", "Origin": "http://evil.example"},
    {"Host": ""},
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Origin": ""},
    {"Cookie": ""},
    {"Cookie": "canductor-1=x"},
    {"Content_Length": ""},
    {"Content_Length": "x"},
    {"Content_Length": "-1"},
    {"Content_Length": "", "Transfer_Encoding": "chunked"},
    {"Content_Length": "", "Transfer_Encoding": "chunked", "body": b"1\r\nx\r\n" * 2600},
    {"Transfer_Encoding": "chunked"},
    {"Content_Length": "9" * 5000},
    {"Content_Length": "\u0661"},
    {"X Y": "1"},
    {"X": "1\r\nHost: 127.0.0.1"},
    {"X": "y" * 20_000},
    {"body": b""},
    {"body": b"[]"},
    {"body": b"{}"},
    {"body": b'{"key": 1}'},
    {"body": b'{"key": "x"}'},
    {"body": b"\xff"},
    {"body": b"[" * 1000},
    {"body": b"[" * 20_000},
]


def test_requests_of_others_stop_nothing(tmp_path: Path) -> None:
    """Whether the loop has met the connection or not; nothing is raised. It refuses them likewise."""
    lane = Lane()

    async def go(paged: Paged) -> None:
        await paged.sign_in(Scope.WATCH)
        data = [paged.stop_request()]
        async with paged.other() as other:
            await other.sign_in(Scope.OPERATE)
            data += [other.stop_request(**wrong) for wrong in WRONG]
            mixed = replace(other, key=paged.key)
            data += [mixed.stop_request(), b"POST /other HTTP/1.1" + other.stop_request()[29:]]
            data += [other.stop_request().replace(b"POST", b"GET"), b"X" + other.stop_request()]
            opened = [Dialled(paged.page.port, None) for _ in data]
            for dialled, sent in zip(opened, data, strict=True):
                dialled.send(sent)
            assert lane.seen() == []
            await asyncio.sleep(1)
            assert lane.seen() == []
            assert paged.served.stops == []
            for dialled in opened:
                dialled.close()
            request_stop(paged, lane, None, other.stop_request()).close()
            assert lane.seen() == ["me"], "of all those it was the right one"

    run_page(tmp_path, None, lane, go)


INSERTED: Final = (
    b"\r\n",
    b"Transfer-Encoding: chunked\r\n",
    b"Content-Length: 3\r\n",
    b"Content-Encoding: gzip\r\n",
    b"Connection: upgrade\r\nUpgrade: websocket\r\n",
    b"1\r\nx\r\n" * 300,
    b" continued\r\n",
)


@given(st.data())
def test_what_is_no_request_is_none(data: st.DataObject) -> None:
    """A stop that is cut, changed or followed by anything is read as one, or not; nothing is raised."""
    body = b'{"key": "x"}'
    head = f"POST {STOP_PATH} HTTP/1.1\r\nHost: a\r\nContent-Length: {len(body)}\r\n\r\n".encode()
    sent = bytearray(head + body)
    for at in data.draw(st.lists(st.integers(30, len(sent)), max_size=2)):
        sent[at:at] = data.draw(st.sampled_from(INSERTED))
    for _ in range(data.draw(st.integers(0, 3))):
        sent[data.draw(st.integers(0, len(sent) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(sent)))
    loop = asyncio.new_event_loop()
    loop.close()  # nobody may use it
    found = parse_request(bytes(sent[:cut]), loop)
    assert found is None or found[0]["Content-Length"]
    parse_request(bytes(sent) + data.draw(st.binary()), loop)
    assert (parse_request((head + body)[:cut], loop) is not None) == (cut >= len(head + body))


def test_a_token_that_was_taken_away_stops_nothing(tmp_path: Path) -> None:
    lane = Lane()

    async def go(paged: Paged) -> None:
        await paged.log_in(TOKENS[Scope.OPERATE])
        request_stop(paged, lane, None, paged.stop_request()).close()
        assert lane.seen() == ["me"]
        await asyncio.sleep(0.1)
        lane.stops.clear()
        paged.served.server._tokens = None
        request_stop(paged, lane, None, paged.stop_request()).close()
        assert lane.seen() == []

    run_page(tmp_path, None, lane, go, tokens=tokens_file(tmp_path))


def test_a_session_under_a_foreign_name_stops_nothing(tmp_path: Path) -> None:
    """Nobody can sign in there; if somebody could, it would not help."""
    lane = Lane()

    async def go(paged: Paged) -> None:
        await paged.sign_in()
        (session,) = paged.page._access.sessions
        session.host = "evil.example"
        data = paged.stop_request(Host="evil.example", Origin="http://evil.example")
        request_stop(paged, lane, None, data).close()
        assert lane.seen() == []

    run_page(tmp_path, None, lane, go)


def test_a_page_that_has_left_is_forgotten(tmp_path: Path) -> None:
    lane = Lane()

    async def go(paged: Paged) -> None:
        before = len(lane._unread)
        await paged.sign_in()
        assert len(lane._unread) == before + 1
        async with paged.socket() as page:
            await paged.hello(page)
            assert len(lane._unread) == before + 1, "as a WebSocket it is looked at as one"
        await paged.http.close()
        await asyncio.sleep(1)
        assert len(lane._unread) == before
        assert not lane._new

    run_page(tmp_path, None, lane, go)
