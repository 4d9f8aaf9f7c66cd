"""Who gets into the page, how, and who does not."""

import asyncio
import errno
import json
import os
import socket
from collections.abc import Callable, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from yarl import URL

from coordinator.ipc.protocol.methods import Scope
from coordinator.ipc.server.auth import FAILURES_MAX, LOCKOUT_S
from coordinator.ipc.server.server import TOKENS_CHECK_S
from coordinator.web.access import LINK_S
from coordinator.web.methods import add_page_methods
from coordinator.web.names import is_known_host, is_own_origin
from coordinator.web.server import LOGIN_BYTES_MAX
from coordinator.web.session_file import read_sessions, remove_sessions
from coordinator.web.settings import WebSettings
from tests.coordinator.ipc.served import TOKENS, tokens_file
from tests.coordinator.web.paged import LOOPBACK, Paged, ask, code_of, paging
from tests.coordinator.web.strangers import as_stranger, masked_frame, send_and_close
from tests.stages import jump_loop

PINGS_BYTES = 262_144


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


async def status_of_socket(paged: Paged, **headers: str) -> int:
    """Return the HTTP status with which a WebSocket is refused."""
    with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
        await paged.socket(**headers)
    return refused.value.status


# --------------------------------------------------------------------------------------------------- names


@pytest.mark.parametrize(
    ("host", "known"),
    [
        ("127.0.0.1:8080", True),
        ("[::1]:8080", True),
        ("192.168.1.5", True),
        ("localhost:8080", True),
        ("LOCALHOST", True),
        ("printer.example:8080", True),
        ("Printer.Example", True),
        ("printer.local:8080", False),
        (f"{socket.gethostname()}.local", False),
        ("printer.example.evil.example", False),
        ("evil-printer.example", False),
        ("localhost.", False),
        ("", False),
        (":8080", False),
        ("127.0.0.1.evil.example", False),
        ("user@evil.example", False),
        ("127.0.0.1@evil.example", False),
        ("[::1", False),
        ("[::1]evil", False),
        ("127.1", False),
        ("evil@127.0.0.1", False),
    ],
)
def test_names(host: str, *, known: bool) -> None:
    assert is_known_host(host, ["printer.example"]) is known


@pytest.mark.parametrize(
    ("origin", "own"),
    [
        ("http://127.0.0.1:8080", True),
        ("https://127.0.0.1:8080", True),
        ("HTTP://127.0.0.1:8080", True),
        ("http://127.0.0.1:8081", False),
        ("http://127.0.0.1", False),
        ("http://localhost:8080", False),
        ("ftp://127.0.0.1:8080", False),
        ("null", False),
        ("", False),
        (None, False),
        ("http://[", False),
        ("http://x@127.0.0.1:8080", False),
    ],
)
def test_origins(origin: str | None, *, own: bool) -> None:
    assert is_own_origin(origin, "127.0.0.1:8080") is own


def test_foreign_names_and_pages_are_refused(tmp_path: Path) -> None:
    """Even with a session: what makes a browser send its cookie makes no page ours."""

    async def go(paged: Paged) -> None:
        await paged.sign_in()
        before = paged.page.refused
        for name in ("evil.example", "machine.local", f"{socket.gethostname()}.local"):
            async with paged.http.get(paged.at, headers={"Host": name}) as answer:
                assert answer.status == 403
                assert name in await answer.text()
        port = paged.page.port
        foreign: list[dict[str, str]] = [
            {"Origin": "http://evil.example"},
            {"Origin": "null"},
            {"Origin": f"http://127.0.0.1:{port + 1}"},
            {"Origin": f"http://evil.example:{port}", "Host": f"evil.example:{port}"},
        ]
        for headers in foreign:
            assert await status_of_socket(paged, **headers) == 403
            link = code_of(paged.page.new_link(Scope.OPERATE))
            posted = paged.http.post(f"{paged.at}/login", json={"token": link}, headers=headers)
            async with posted as answer:
                assert (answer.status, answer.cookies) == (403, {})
        with pytest.raises(
            aiohttp.WSServerHandshakeError
        ) as refused:  # every browser says where it comes from
            await paged.http.ws_connect(f"{paged.at}/socket")
        assert refused.value.status == 403
        assert paged.page.refused == before + 3 + 2 * len(foreign) + 1
        assert paged.served.server.figures()["connections"] == 0

    run(tmp_path, go)


def test_a_configured_name_is_answered_to_and_shown(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        async with paged.http.get(paged.at, headers={"Host": "printer.local:80"}) as answer:
            assert answer.status == 200
        assert paged.page.new_link(Scope.WATCH).startswith(f"http://printer.local:{paged.page.port}/#")

    run(tmp_path, go, replace(LOOPBACK, names=("printer.local", "printer.example")))


def test_what_a_user_types_is_an_address() -> None:
    assert WebSettings(host="127.0.0.1", port=80).url == "http://127.0.0.1:80/"
    assert WebSettings(host="::1", port=80).url == "http://[::1]:80/"
    for host in ("0.0.0.0", "::"):  # noqa: S104 (only asked for its address)
        url = WebSettings(host=host, port=80).url
        assert is_known_host(url.removeprefix("http://").removesuffix("/"), [])


# --------------------------------------------------------------------------------------------------- links


def test_a_link_lets_one_browser_in(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        link = paged.page.new_link(Scope.OPERATE)
        assert link.startswith(f"{paged.at}/#")
        assert await status_of_socket(paged) == 401
        assert await paged.session_status() == 401
        assert (await paged.log_in(code_of(link)))[0] == 200
        assert await paged.session_status() == 204
        async with paged.socket() as page:
            told = await paged.hello(page)
            assert told["result"]["scope"] == "operate"
            assert (await ask(page, "move.to", 2, x_mm=3.0))["result"] == {"to": 3.0}
            assert (await ask(page, "node.command", 3, command="x"))["error"]["code"] == "not_allowed"
            assert (await ask(page, "machine.info", 4))["result"]["caller"] == "the page (127.0.0.1)"
        async with paged.other() as other:
            status, told = await other.log_in(code_of(link))
            assert (status, told["code"]) == (403, "bad_token")
            assert "'canductor page' prints another" in told["message"]
            assert await status_of_socket(other) == 401

    run(tmp_path, go, unix_scope=Scope.ADMIN)


def test_a_link_is_not_good_for_ever(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        link = paged.page.new_link(Scope.OPERATE)
        await asyncio.sleep(LINK_S)
        assert (await paged.log_in(code_of(link)))[0] == 403

    run(tmp_path, go)


def test_a_link_to_look_gives_no_more(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in(Scope.WATCH)
        async with paged.socket() as page:
            assert (await paged.hello(page))["result"]["scope"] == "watch"
            assert (await ask(page, "machine.emergency_stop", 2))["error"]["code"] == "not_allowed"
        assert paged.served.stops == []

    run(tmp_path, go)


def test_the_cookie_is_for_this_page_and_not_for_scripts(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        for keep in (True, False):
            given = {"token": code_of(paged.page.new_link(Scope.WATCH)), "keep": keep}
            posted = paged.http.post(f"{paged.at}/login", json=given, headers={"Origin": paged.at})
            async with posted as answer:
                (cookie,) = answer.cookies.values()
                told = await answer.text()
                assert answer.headers["Cache-Control"] == "no-store"
            assert cookie.key == f"canductor-{paged.page.port}"
            assert cookie["httponly"]
            assert (cookie["samesite"], cookie["path"], cookie["domain"]) == ("Strict", "/", "")
            assert bool(cookie["max-age"]) is keep
            assert cookie.value not in told

    run(tmp_path, go)


def test_with_tls_the_cookie_is_never_sent_without(tmp_path: Path, certificate: tuple[Path, Path]) -> None:
    settings = WebSettings(host="127.0.0.1", port=0, certificate=certificate[0], private_key=certificate[1])

    async def go(paged: Paged) -> None:
        link = paged.page.new_link(Scope.WATCH)
        assert link.startswith(f"https://127.0.0.1:{paged.page.port}/#")
        asked = {"token": code_of(link)}
        posted = paged.http.post(f"{paged.at}/login", json=asked, headers={"Origin": paged.at})
        async with posted as answer:
            (cookie,) = answer.cookies.values()
        assert cookie["secure"]

    run(tmp_path, go, settings)


def test_cookie_and_key_are_both_needed(tmp_path: Path) -> None:
    """A browser sends the cookie to every port of this computer; another user may listen there."""

    async def go(paged: Paged) -> None:
        await paged.sign_in()
        for key in (None, "", "x" * 43):
            async with paged.socket() as thief:
                told = await ask(thief, "api.hello", version=1, token=key)
                assert told["error"]["code"] == ("no_token" if key is None else "bad_token")
                assert (await thief.receive()).type is aiohttp.WSMsgType.CLOSE
        async with paged.other() as other:
            await other.sign_in()
            other.key = paged.key
            async with other.socket() as page:
                assert (await other.hello(page))["error"]["code"] == "bad_token"
        async with paged.socket() as page:
            assert "result" in await paged.hello(page), "nobody is shut out for what others try"

    run(tmp_path, go)


def test_the_session_is_found_among_cookies_of_other_ports(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.sign_in()
        (own,) = (cookie.value for cookie in paged.http.cookie_jar)
        name = f"canductor-{paged.page.port}"
        for header, status in (
            (f'x="; {name}=junk; {name}={own}; y=1', 204),
            (f"{name}={own}", 204),
            (f"{name}x={own}", 401),
            (f"x={name}={own}", 401),
            (f"{name}", 401),
            ("; ".join([f"{name}=junk"] * 1000), 401),
        ):
            async with (
                aiohttp.ClientSession() as http,
                http.get(f"{paged.at}/session", headers={"Cookie": header}) as answer,
            ):
                assert answer.status == (status if len(header) < 16_000 else 431), header[:80]

    run(tmp_path, go)


@pytest.mark.parametrize(
    "body",
    [b"", b"{", b"[]", b"null", b"{}", b'{"token":1}', b"\xff", b"[" * 4000, b"x" * (LOGIN_BYTES_MAX + 1)],
)
def test_what_is_no_login(tmp_path: Path, body: bytes) -> None:
    async def go(paged: Paged) -> None:
        headers = {"Origin": paged.at}
        async with paged.http.post(f"{paged.at}/login", data=body, headers=headers) as answer:
            assert answer.status == (413 if len(body) > LOGIN_BYTES_MAX else 400)
            assert answer.cookies == {}
        async with paged.http.get(f"{paged.at}/login", headers=headers) as answer:
            assert answer.status == 405

    run(tmp_path, go)


# ------------------------------------------------------------------------------------------------- sessions


def test_sessions_outlive_the_server(tmp_path: Path) -> None:
    settings = replace(LOOPBACK, sessions=tmp_path / "state" / "page.json")

    async def main() -> None:
        async with paging(tmp_path, settings) as paged:
            await paged.sign_in()
            (cookie,) = (cookie.value for cookie in paged.http.cookie_jar)
            port, key = paged.page.port, paged.key
        async with paging(tmp_path, replace(settings, port=port)) as paged:
            paged.key = key
            paged.http.cookie_jar.update_cookies({f"canductor-{port}": cookie}, URL(paged.at))
            async with paged.socket() as page:
                assert (await paged.hello(page))["result"]["scope"] == "operate"

    jump_loop.run(main())


def test_a_file_of_sessions_that_others_may_write_is_not_believed(tmp_path: Path) -> None:
    path = tmp_path / "page.json"
    path.write_text('{"version":1,"sessions":[]}')
    path.chmod(0o666)

    async def go(paged: Paged) -> None:
        assert "chmod 600" in await paged.served.notices.get()
        await paged.sign_in()
        assert path.stat().st_mode & 0o777 == 0o600

    run(tmp_path, go, replace(LOOPBACK, sessions=path))


def test_a_disk_that_takes_nothing_keeps_nobody_out(tmp_path: Path) -> None:
    (tmp_path / "file").touch()

    async def go(paged: Paged) -> None:
        await paged.sign_in()
        assert "cannot be kept in" in await paged.served.notices.get()
        async with paged.socket() as page:
            assert "result" in await paged.hello(page)

    run(tmp_path, go, replace(LOOPBACK, sessions=tmp_path / "file" / "page.json"))


def test_signing_out_needs_no_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It reported success, and the sessions were there again after the next start."""
    path = tmp_path / "page.json"

    async def go(paged: Paged) -> None:
        await paged.sign_in()
        assert len(read_sessions(path)) == 1
        monkeypatch.setattr("coordinator.web.session_file.atomic_write", full_disk)
        assert await paged.page.sign_all_out() == 1
        assert paged.served.notices.empty()
        assert read_sessions(path) == []
        assert await paged.page.sign_all_out() == 0

    run(tmp_path, go, replace(LOOPBACK, sessions=path))


def full_disk(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def read_only_disk(*_: object) -> None:
    raise OSError(errno.EROFS, os.strerror(errno.EROFS))


def test_who_signs_out_hears_that_the_disk_keeps_the_sessions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "page.json"

    async def go(paged: Paged) -> None:
        add_page_methods(paged.served.server._context.registry, paged.page)
        owner = await paged.served.script()
        with monkeypatch.context() as disk:
            disk.setattr("pathlib.Path.unlink", read_only_disk)
            assert (await owner.ask("page.sign_out"))["result"] == {"sessions": 0}, "no file was there"
        await paged.sign_in()
        with monkeypatch.context() as disk:
            disk.setattr("pathlib.Path.unlink", read_only_disk)
            error = (await owner.ask("page.sign_out"))["error"]
        assert error["message"] == (
            f"all browsers are signed out, but only until the next start: {path} cannot be removed:"
            " read-only file system; remove it before"
        )
        assert await paged.session_status() == 401

    run(tmp_path, go, replace(LOOPBACK, sessions=path))


def test_who_signs_in_while_all_are_signed_out_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "page.json"

    async def go(paged: Paged) -> None:
        await paged.sign_in()

        def meanwhile(removed: Path) -> None:
            paged.page._access.sign_in("127.0.0.1", Scope.WATCH, None, 0.0)
            remove_sessions(removed)

        monkeypatch.setattr("coordinator.web.server.remove_sessions", meanwhile)
        assert await paged.page.sign_all_out() == 1
        assert len(read_sessions(path)) == 1

    run(tmp_path, go, replace(LOOPBACK, sessions=path))


def test_the_owner_makes_links_and_signs_all_out(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        add_page_methods(paged.served.server._context.registry, paged.page)
        owner = await paged.served.script()
        operator = await paged.served.script(scope="operate")
        for method in ("page.link", "page.sign_out"):
            assert (await operator.ask(method))["error"]["code"] == "not_allowed"
        assert (await owner.ask("page.link", scope="admin"))["error"]["code"] == "bad_params"
        link = (await owner.ask("page.link", scope="watch"))["result"]
        assert link["expires_s"] == LINK_S
        unused = (await owner.ask("page.link"))["result"]["url"]
        assert (await paged.log_in(code_of(link["url"])))[1]["scope"] == "watch"
        async with paged.socket() as page:
            await paged.hello(page)
            assert (await owner.ask("page.sign_out"))["result"] == {"sessions": 1}
            assert json.loads((await page.receive()).data)["error"]["code"] == "bad_token"
        assert await status_of_socket(paged) == 401
        assert (await paged.log_in(code_of(unused)))[0] == 403

    run(tmp_path, go)


# --------------------------------------------------------------------------------------------------- tokens


@pytest.mark.parametrize("scope", Scope)
def test_a_token_gives_its_scope(tmp_path: Path, scope: Scope) -> None:
    async def go(paged: Paged) -> None:
        assert (await paged.log_in(TOKENS[scope]))[1]["scope"] == scope.word
        async with paged.socket() as page:
            assert (await paged.hello(page))["result"]["scope"] == scope.word
            codes = [
                (await ask(page, name, number, **params)).get("error", {}).get("code")
                for number, (name, params) in enumerate(CALLS, 2)
            ]
        assert codes == [None if scope >= needed else "not_allowed" for needed in NEEDED]

    run(tmp_path, go, tokens=tokens_file(tmp_path))


CALLS: list[tuple[str, dict[str, Any]]] = [
    ("machine.info", {}),
    ("move.to", {"x_mm": 1.0}),
    ("machine.emergency_stop", {}),
    ("node.command", {"command": "x"}),
]
NEEDED = [Scope.WATCH, Scope.OPERATE, Scope.OPERATE, Scope.ADMIN]


def test_a_token_that_is_taken_away_ends_its_sessions(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        await paged.log_in(TOKENS[Scope.OPERATE])
        async with paged.socket() as page:
            assert "result" in await paged.hello(page)
            tokens_file(tmp_path).write_text(f"watch somebody {'w' * 32}\n")
            await asyncio.sleep(2 * TOKENS_CHECK_S)
            assert json.loads((await page.receive()).data)["error"]["message"] == "the token was revoked"
            assert await status_of_socket(paged) == 401
            tokens_file(tmp_path)
            await asyncio.sleep(2 * TOKENS_CHECK_S)
            assert await paged.session_status() == 204, "it is good again"

    run(tmp_path, go, tokens=tokens_file(tmp_path))


def test_who_guesses_tokens_is_shut_out_but_not_the_owner(tmp_path: Path) -> None:
    async def go(paged: Paged) -> None:
        codes = [(await paged.log_in("x" * 32))[1]["code"] for _ in range(FAILURES_MAX + 1)]
        assert codes == ["bad_token"] * FAILURES_MAX + ["too_many_failures"]
        assert (await paged.log_in(TOKENS[Scope.ADMIN]))[1]["code"] == "too_many_failures"
        async with paged.other() as owner:  # a link cannot be guessed
            await owner.sign_in()
            async with owner.socket() as page:
                assert "result" in await owner.hello(page)
                assert "result" in await ask(page, "machine.emergency_stop", 2)
        await asyncio.sleep(LOCKOUT_S + 1)
        assert (await paged.log_in(TOKENS[Scope.ADMIN]))[0] == 200

    run(tmp_path, go, tokens=tokens_file(tmp_path))


# ----------------------------------------------------------------------------- another user of the computer


def burst(port: int) -> bytes:
    """Return what opened the page to every user: all at once, and enough behind it that the end is read late.

    The server then looked up whose socket it was, when the kernel had forgotten that and said: root's.
    """
    upgrade = (
        f"GET /socket HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nOrigin: http://127.0.0.1:{port}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    ).encode()
    requests = [
        {"id": 1, "method": "api.hello", "params": {"version": 1}},
        {"id": 2, "method": "machine.info"},
        {"id": 3, "method": "move.to", "params": {"x_mm": 1.0}},
        {"id": 4, "method": "machine.emergency_stop"},
    ]
    ping = masked_frame(b"p" * 100, opcode=9)
    frames = b"".join(masked_frame(json.dumps(request).encode()) for request in requests)
    return upgrade + frames + ping * (PINGS_BYTES // len(ping) + 1)


@pytest.mark.parametrize("pings", [True, False], ids=["with pings", "the commands alone"])
def test_another_user_who_sends_and_closes_gets_nothing(tmp_path: Path, *, pings: bool) -> None:
    async def go(paged: Paged) -> None:
        port = paged.page.port
        data = burst(port) if pings else burst(port)[:-PINGS_BYTES]
        for count in range(1, 6):
            as_stranger(lambda: send_and_close(socket.AF_INET, ("127.0.0.1", port), data))
            await asyncio.sleep(1)
            assert paged.page.refused == count
        assert paged.served.order == []
        assert paged.served.server.figures()["connections"] == 0
        assert paged.served.server.figures()["requests"] == 0

    run(tmp_path, go)


def test_another_user_at_the_unix_socket_gets_nothing(tmp_path: Path) -> None:
    """The kernel notes who connects (SO_PEERCRED), and keeps that when the socket is closed."""

    tmp_path.chmod(0o711)

    async def go(paged: Paged) -> None:
        paged.served.path.chmod(0o666)
        folder = os.open(tmp_path, os.O_RDONLY | os.O_DIRECTORY)
        requests = [
            {"id": 1, "method": "api.hello", "params": {"version": 1}},
            {"id": 2, "method": "move.to", "params": {"x_mm": 1.0}},
            {"id": 3, "method": "machine.emergency_stop"},
        ]
        lines = "".join(json.dumps(request) + "\n" for request in requests).encode()

        def send() -> None:
            os.fchdir(folder)  # whoever may look into the folders above it
            send_and_close(socket.AF_UNIX, paged.served.path.name, lines)

        try:
            as_stranger(send)
        finally:
            os.close(folder)
        await asyncio.sleep(1)
        assert paged.served.order == []
        assert paged.served.server.figures()["refused_connections"] == 1

    run(tmp_path, go)
