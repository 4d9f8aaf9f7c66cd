"""The page's server without a browser: what a client of it may do, and that nobody costs without bound."""

import asyncio
import contextlib
import gzip
import json
import socket
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from aiohttp import web
from yarl import URL

from coordinator.ipc.protocol.limits import Limits
from coordinator.ipc.server.tcp_listener import HANDSHAKE_S, HANDSHAKES_MAX
from coordinator.web.files import FOLDER
from coordinator.web.server import CONNECTIONS_MAX, POLICY, REQUEST_S
from coordinator.web.settings import WebSettings
from coordinator.web.websocket_frames import FRAMES_MAX, FRAMES_PER_TURN
from tests.coordinator.web.paged import LOOPBACK, Paged, ask, paging, receive, rest
from tests.coordinator.web.strangers import masked_frame
from tests.stages import jump_loop


def run(
    folder: Path,
    go: Callable[[Paged], Coroutine[Any, Any, None]],
    page: WebSettings = LOOPBACK,
    **settings: Any,
) -> None:
    async def main() -> None:
        async with paging(folder, page, **settings) as paged:
            await go(paged)

    jump_loop.run(main())


# --------------------------------------------------------------------------------------------------- files


def test_every_file_is_there_and_nothing_else(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        names = sorted(path.name for path in FOLDER.iterdir())
        for name in ["", *(n for n in names if n != "index.html")]:
            async with paged.http.get(f"{paged.at}/{name}") as answer:
                assert answer.status == 200, name
                assert await answer.read() == (FOLDER / (name or "index.html")).read_bytes()
                assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
                assert "unsafe" not in answer.headers["Content-Security-Policy"]
                assert "http" not in answer.headers["Content-Security-Policy"], "a source elsewhere"
                assert answer.headers["X-Content-Type-Options"] == "nosniff"
                tag = answer.headers["ETag"]
            async with paged.http.get(f"{paged.at}/{name}", headers={"If-None-Match": tag}) as answer:
                assert (answer.status, await answer.read()) == (304, b"")
        for path in (
            "/index.html",
            "/../server.py",
            "/%2e%2e/server.py",
            "/page.css/",
            "//page.css",
            "/.git",
        ):
            async with paged.http.get(f"{paged.at}{path}") as answer:
                assert answer.status == 404, path
        async with paged.http.post(f"{paged.at}/", data=b"x") as answer:
            assert answer.status == 405

    run(tmp_path, go)


def test_packed_for_those_who_can_unpack(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        url = f"{paged.at}/main.js"
        async with aiohttp.ClientSession(auto_decompress=False) as plain:
            async with plain.get(url, headers={"Accept-Encoding": "gzip"}) as answer:
                assert gzip.decompress(await answer.read()) == (FOLDER / "main.js").read_bytes()
            async with plain.get(url, headers={"Accept-Encoding": "identity"}) as answer:
                assert await answer.read() == (FOLDER / "main.js").read_bytes()

    run(tmp_path, go)


def test_packed_bodies_are_refused(tmp_path: Path) -> None:
    """Failed before: answered with 500, without the headers that keep the page safe."""

    async def go(paged: Paged) -> None:
        headers = {"Origin": paged.at, "Content-Encoding": "gzip"}
        async with paged.http.post(f"{paged.at}/login", data=b"{}", headers=headers) as answer:
            assert answer.status == 415
            assert answer.headers["Content-Security-Policy"] == POLICY
            assert answer.headers["Server"] == "canductor"
        await paged.sign_in()
        async with paged.socket() as page:
            assert page._response.headers["Server"] == "canductor"

    run(tmp_path, go)


# ---------------------------------------------------------------------------------------------------- limits


@pytest.mark.parametrize(
    ("text", "code"),
    [("{" + " " * 3000 + "}", 1009), ("hello", 1003), ("\0\0\0\1\x80", 1003)],
    ids=["too long", "no JSON", "msgpack"],
)
def test_what_is_no_message_ends_that_client(tmp_path: Path, text: str, code: int) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in()
        async with paged.socket() as good, paged.socket() as bad:
            assert "result" in await paged.hello(good)
            await bad.send_str(text)
            ended = await bad.receive()
            assert (ended.type, ended.data) == (aiohttp.WSMsgType.CLOSE, code)
            assert "result" in await ask(good, "api.ping", 2)

    run(tmp_path, go, limits=Limits(message_bytes=2000))


def test_bytes_are_no_text(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in()
        async with paged.socket() as page:
            await page.send_bytes(b'{"id":1,"method":"api.ping"}')
            ended = await page.receive()
            assert (ended.type, ended.data) == (aiohttp.WSMsgType.CLOSE, 1003)

    run(tmp_path, go)


FLOODS = {
    "empty": masked_frame(b""),
    "blank": masked_frame(b" "),
    "pings": masked_frame(b"", opcode=9),
    "parts": b"\x01" + masked_frame(b"")[1:] + (b"\x00" + masked_frame(b"")[1:]) * 40_000,
}


@pytest.mark.parametrize("kind", FLOODS)
def test_a_flood_of_frames_ends_that_client(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Failed before: 256 KiB of them were one turn, 0.2 s; pings on six connections ended a print."""

    async def go(paged: Paged) -> None:
        await paged.sign_in()
        async with paged.socket() as good, paged.socket() as bad:
            assert "result" in await paged.hello(good)
            assert "result" in await paged.hello(bad)
            handed = note_frames(monkeypatch)
            transport = bad._writer.transport
            transport.write((FLOODS[kind] * 40_000)[:240_000])
            answer = (await rest(bad))[-1]
            assert answer["error"]["code"] == "too_many"
            assert "disconnected" in paged.served.notices.get_nowait()
            assert max(handed) <= FRAMES_PER_TURN * len(masked_frame(b" "))
            assert sum(handed) <= FRAMES_MAX * len(masked_frame(b" "))
            assert "result" in await ask(good, "api.ping", 2)

    run(tmp_path, go)


def note_frames(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that gets how many bytes of WebSockets aiohttp has got, each time."""
    handed: list[int] = []
    take = web.RequestHandler.data_received

    def data_received(handler: web.RequestHandler, data: bytes) -> None:
        handed.append(len(data))
        take(handler, data)

    monkeypatch.setattr(web.RequestHandler, "data_received", data_received)
    return handed


def test_deep_messages_and_broken_ones_are_told_why(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in()
        for text, code in (('{"a":' + "[" * 40 + "]" * 40 + "}", "too_deep"), ('{"id":', "bad_message")):
            async with paged.socket() as page:
                await page.send_str(text)
                assert (await rest(page))[-1]["error"]["code"] == code

    run(tmp_path, go)


def test_a_stop_overtakes_what_waits(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in()
        async with paged.socket() as page:
            await paged.hello(page)
            lines: list[Any] = [{"id": n, "method": "wait"} for n in range(2, 150)]
            lines += [{"method": "machine.info"}, {"id": 1, "method": "machine.emergency_stop"}]
            await page.send_str("\n".join(map(json.dumps, lines)))
            assert (await receive(page))["id"] == 1
            assert paged.served.order == ["stop"]

    run(tmp_path, go)


def test_who_does_not_read_gets_the_newest_and_costs_no_more(tmp_path: Path) -> None:
    """A browser that sleeps: updates merge in the session, and the pipe holds no more than its limit."""

    async def go(paged: Paged) -> None:
        await paged.sign_in()
        cookies = paged.http.cookie_jar.filter_cookies(URL(paged.at))
        # Small buffers of the kernel, or megabytes would be under way.
        connector = aiohttp.TCPConnector(socket_factory=small_socket)
        async with (
            aiohttp.ClientSession(connector=connector, cookies=cookies, cookie_jar=unsafe_jar()) as http,
            http.ws_connect(f"{paged.at}/socket", headers={"Origin": paged.at}) as page,
        ):
            await paged.hello(page)
            await ask(page, "api.watch", 2, fields=["big.*"], rate_hz=50)
            connection = page._conn
            assert connection is not None
            assert connection.transport is not None
            connection.transport.pause_reading()
            sent = 0
            while not paged.served.server.figures()["updates_skipped"]:
                sent += 1
                for k in range(8):
                    paged.served.state.set(f"big.{k}", f"{sent:06d}" + "x" * 20_000)
                await asyncio.sleep(0.02)
            (other,) = paged.served.server._connections
            assert other.transport.get_write_buffer_size() < 2 * 65_536 + 8 * 21_000
            paged.served.state.set("big.0", "the newest")
            connection.transport.resume_reading()
            while True:
                update = await receive(page)
                if update["values"].get("big.0") == "the newest":
                    break

    run(tmp_path, go)


def unsafe_jar() -> aiohttp.CookieJar:
    return aiohttp.CookieJar(unsafe=True)


def small_socket(info: Any) -> socket.socket:
    made = socket.socket(info[0], info[1], info[2])
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    return made


def test_connections_that_do_nothing_are_closed(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in()
        loop = asyncio.get_running_loop()
        async with paged.socket() as page:
            await paged.hello(page)
            answer = asyncio.ensure_future(page.receive())  # who reads answers what the server pings with
            for begun in (b"", b"GET / HT", b"GET /socket HTTP/1.1\r\nHost: localhost\r\n"):
                opened_s = loop.time()
                reader, writer = await asyncio.open_connection("127.0.0.1", paged.page.port)
                writer.write(begun)
                with contextlib.suppress(ConnectionResetError):
                    assert await reader.read() == b""
                assert loop.time() == pytest.approx(opened_s + REQUEST_S)
                writer.close()
            await page.send_str('{"id":2,"method":"api.ping"}')
            assert json.loads((await answer).data)["id"] == 2, "a page stays"

    run(tmp_path, go)


async def hang_up(opened: list[tuple[asyncio.StreamReader, asyncio.StreamWriter]]) -> None:
    for _, writer in opened:
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


def test_only_so_many_connections(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in()
        page = await paged.socket()
        others = [await asyncio.open_connection("127.0.0.1", paged.page.port) for _ in range(CONNECTIONS_MAX)]
        ends = {asyncio.ensure_future(reader.read()) for reader, _ in others}
        refused, let_in = await asyncio.wait(ends, timeout=1)
        assert len(let_in) >= CONNECTIONS_MAX - 2, "besides the page, and the connection that signed in"
        assert paged.page.refused == len(refused) > 0
        with pytest.raises(aiohttp.ClientConnectionError):
            await paged.socket()
        assert "result" in await paged.hello(page)
        await page.close()
        await asyncio.wait(ends)
        await hang_up(others)

    run(tmp_path, go)


def test_silence_before_tls_counts_as_a_connection(tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    settings = WebSettings(host="127.0.0.1", port=0, certificate=certificate[0], private_key=certificate[1])

    async def go(paged: Paged) -> None:
        port, begun_s = paged.page.port, asyncio.get_running_loop().time()
        silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(HANDSHAKES_MAX + 2)]
        ends = {asyncio.ensure_future(reader.read()) for reader, _ in silent}
        refused, let_in = await asyncio.wait(ends, timeout=1)
        assert (len(refused), len(let_in)) == (2, HANDSHAKES_MAX)
        await asyncio.wait(ends)
        assert asyncio.get_running_loop().time() == pytest.approx(begun_s + HANDSHAKE_S)
        await hang_up(silent)

    run(tmp_path, go, settings)


def test_when_the_server_ends_pages_are_told(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in()
        async with paged.socket() as page:
            await paged.hello(page)
            await paged.served.server.close()
            assert (await rest(page))[-1]["error"]["code"] == "closing"

    run(tmp_path, go)


def test_a_page_that_goes_ends_what_it_asked_for(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in()
        async with paged.socket() as page:
            await paged.hello(page)
            await page.send_str('{"id":2,"method":"wait"}')
            await ask(page, "api.ping", 3)
        await paged.served.cancelled.wait()

    run(tmp_path, go)
