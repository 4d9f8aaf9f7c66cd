"""The page's server without a browser: who gets in, what one may do, and that nobody costs without bound."""

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

from coordinator.ipc.methods import Scope
from coordinator.ipc.settings import Limits
from coordinator.web import server as web_server
from coordinator.web.files import FOLDER
from coordinator.web.settings import WebSettings
from tests.coordinator.web.paged import Paged, ask, paging, receive, rest

TOKEN = "t" * 32


def run(folder: Path, go: Callable[[Paged], Coroutine[Any, Any, None]], **settings: Any) -> None:
    async def main() -> None:
        async with asyncio.timeout(60), paging(folder, **settings) as paged:
            await go(paged)

    asyncio.run(main())


def tokens(folder: Path) -> Path:
    path = folder / "tokens"
    path.touch(0o600)
    path.write_text(f"watch hall {'w' * 32}\noperate phone {TOKEN}\nadmin owner {'a' * 32}\n")
    return path


def strangers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every program seem to be another user's."""
    monkeypatch.setattr(web_server, "is_own_program", lambda *_: False)


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


# ------------------------------------------------------------------------------------------------ who gets in


def test_foreign_names_and_pages_are_refused(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        async with paged.http.get(paged.at, headers={"Host": "evil.example"}) as answer:
            assert answer.status == 403
            assert "evil.example" in await answer.text()
        port = paged.page.port
        for headers in (
            {"Origin": "http://evil.example"},
            {"Origin": "null"},
            {"Origin": f"http://127.0.0.1:{port + 1}"},
            {"Origin": f"http://evil.example:{port}", "Host": f"evil.example:{port}"},
        ):
            with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                await paged.socket(**headers)
            assert refused.value.status == 403
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await paged.http.ws_connect(
                f"{paged.at}/socket"
            )  # no browser says nothing of where it comes from
        assert refused.value.status == 403
        assert paged.page.refused == 6
        assert paged.served.server.figures()["connections"] == 0

    run(tmp_path, go)


def test_the_users_own_browser_may_operate_and_no_more(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        async with paged.socket() as page:
            told = await ask(page, "api.hello", version=1, client="the page")
            assert told["result"]["scope"] == "operate"
            assert (await ask(page, "move.to", 2, x_mm=3.0))["result"] == {"to": 3.0}
            assert (await ask(page, "node.command", 3, command="x"))["error"]["code"] == "not_allowed"
            caller = (await ask(page, "machine.info", 4))["result"]["caller"]
            assert caller == "the page (127.0.0.1)"

    run(tmp_path, go, unix_scope=Scope.ADMIN)


@pytest.mark.parametrize(
    ("token", "scope"), [("w" * 32, "watch"), (TOKEN, "operate"), ("a" * 32, "admin"), (None, None)]
)
def test_others_need_a_token(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, token: str | None, scope: str | None
) -> None:
    strangers(monkeypatch)

    async def go(paged: Paged) -> None:
        async with paged.socket() as page:
            told = await ask(page, "api.hello", version=1, token=token)
            if scope is None:
                assert told["error"]["code"] == "no_token"
                assert (await page.receive()).type is aiohttp.WSMsgType.CLOSE
                return
            assert told["result"]["scope"] == scope
            wanted: list[tuple[str, dict[str, Any]]] = [
                ("machine.info", {}),
                ("move.to", {"x_mm": 1.0}),
                ("machine.emergency_stop", {}),
                ("node.command", {"command": "x"}),
            ]
            answers = {}
            for number, (name, params) in enumerate(wanted, 2):
                answers[name] = (await ask(page, name, number, **params)).get("error", {}).get("code")
            no = "not_allowed"
            assert answers == {
                "machine.info": None,
                "move.to": no if scope == "watch" else None,
                "machine.emergency_stop": no if scope == "watch" else None,
                "node.command": None if scope == "admin" else no,
            }

    run(tmp_path, go, tokens=tokens(tmp_path))


def test_who_guesses_tokens_is_shut_out_but_not_the_owner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = False
    monkeypatch.setattr(web_server, "is_own_program", lambda *_: own)

    async def go(paged: Paged) -> None:
        nonlocal own
        codes = []
        for _ in range(6):
            async with paged.socket() as page:
                told = await ask(page, "api.hello", version=1, token="x" * 32)
                codes.append(told["error"]["code"])
        assert codes == ["bad_token"] * 5 + ["too_many_failures"]
        own = True
        async with paged.socket() as page:
            assert "result" in await ask(page, "api.hello", version=1)
            assert "result" in await ask(page, "machine.emergency_stop", 2)

    run(tmp_path, go, tokens=tokens(tmp_path))


# ---------------------------------------------------------------------------------------------------- limits


@pytest.mark.parametrize(
    ("text", "code"),
    [("{" + " " * 3000 + "}", 1009), ("hello", 1003), ("\0\0\0\1\x80", 1003)],
    ids=["too long", "no JSON", "msgpack"],
)
def test_what_is_no_message_ends_that_client(tmp_path: Path, text: str, code: int) -> None:
    async def go(paged: Paged) -> None:
        async with paged.socket() as good, paged.socket() as bad:
            assert "result" in await ask(good, "api.hello", version=1)
            await bad.send_str(text)
            async with asyncio.timeout(20):
                ended = await bad.receive()
            assert (ended.type, ended.data) == (aiohttp.WSMsgType.CLOSE, code)
            assert "result" in await ask(good, "api.ping", 2)

    run(tmp_path, go, limits=Limits(message_bytes=2000))


def test_bytes_are_no_text(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        async with paged.socket() as page:
            await page.send_bytes(b'{"id":1,"method":"api.ping"}')
            async with asyncio.timeout(20):
                ended = await page.receive()
            assert (ended.type, ended.data) == (aiohttp.WSMsgType.CLOSE, 1003)

    run(tmp_path, go)


def test_deep_messages_and_broken_ones_are_told_why(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        for text, code in (('{"a":' + "[" * 40 + "]" * 40 + "}", "too_deep"), ('{"id":', "bad_message")):
            async with paged.socket() as page:
                await page.send_str(text)
                assert (await rest(page))[-1]["error"]["code"] == code

    run(tmp_path, go)


def test_a_stop_overtakes_what_waits(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        async with paged.socket() as page:
            await ask(page, "api.hello", version=1)
            lines: list[Any] = [{"id": n, "method": "wait"} for n in range(2, 150)]
            lines += [{"method": "machine.info"}, {"id": 1, "method": "machine.emergency_stop"}]
            await page.send_str("\n".join(map(json.dumps, lines)))
            assert (await receive(page))["id"] == 1
            assert paged.served.order == ["stop"]

    run(tmp_path, go)


def test_who_does_not_read_gets_the_newest_and_costs_no_more(tmp_path: Path) -> None:
    """A browser that sleeps: updates merge in the session, and the pipe holds no more than its limit."""

    async def go(paged: Paged) -> None:
        url = f"{paged.at}/socket"
        # Small buffers of the kernel, or megabytes would be under way.
        connector = aiohttp.TCPConnector(socket_factory=small_socket)
        async with (
            aiohttp.ClientSession(connector=connector) as http,
            http.ws_connect(url, headers={"Origin": paged.at}) as page,
        ):
            await ask(page, "api.hello", version=1)
            await ask(page, "api.watch", 2, fields=["big.*"], rate_hz=50)
            transport = page.get_extra_info("socket")
            assert transport is not None
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


def small_socket(info: Any) -> socket.socket:
    made = socket.socket(info[0], info[1], info[2])
    made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    return made


def test_connections_that_do_nothing_are_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def go(paged: Paged) -> None:
        async with paged.socket() as page:
            await ask(page, "api.hello", version=1)
            monkeypatch.setattr(web_server, "REQUEST_S", 0.2)  # now: a busy computer's page may take longer
            for begun in (b"", b"GET / HT", b"GET /socket HTTP/1.1\r\nHost: localhost\r\n"):
                reader, writer = await asyncio.open_connection("127.0.0.1", paged.page.port)
                writer.write(begun)
                with contextlib.suppress(ConnectionResetError):
                    assert await reader.read() == b""
                writer.close()
            assert "result" in await ask(page, "api.ping", 2), "a page stays"

    run(tmp_path, go)


def test_only_so_many_connections(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_server, "CONNECTIONS_MAX", 3)

    async def go(paged: Paged) -> None:
        pages = [await paged.socket() for _ in range(3)]
        with pytest.raises(aiohttp.ClientConnectionError):
            await paged.socket()
        assert paged.page.refused >= 1
        assert "result" in await ask(pages[0], "api.hello", version=1)
        for page in pages:
            await page.close()

    run(tmp_path, go)


def test_silence_before_tls_counts_as_a_connection(
    tmp_path: Path, certificate: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web_server, "CONNECTIONS_MAX", 3)
    settings = WebSettings(host="127.0.0.1", port=0, certificate=certificate[0], private_key=certificate[1])

    async def go(paged: Paged) -> None:
        page = web_server.WebServer(paged.served.server, settings)
        await page.start()
        silent = [await asyncio.open_connection("127.0.0.1", page.port) for _ in range(5)]
        ends = [asyncio.ensure_future(reader.read()) for reader, _ in silent]
        await asyncio.wait(ends[3:])
        assert not any(end.done() for end in ends[:3])
        assert page.refused == 2
        await page.close()
        await asyncio.wait(ends)
        for _, writer in silent:
            writer.close()

    run(tmp_path, go)


def test_when_the_server_ends_pages_are_told(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        async with paged.socket() as page:
            await ask(page, "api.hello", version=1)
            await paged.served.server.close()
            assert (await rest(page))[-1]["error"]["code"] == "closing"

    run(tmp_path, go)


def test_a_page_that_goes_ends_what_it_asked_for(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        async with paged.socket() as page:
            await ask(page, "api.hello", version=1)
            await page.send_str('{"id":2,"method":"wait"}')
            await ask(page, "api.ping", 3)
        async with asyncio.timeout(20):
            await paged.served.cancelled.wait()

    run(tmp_path, go)
