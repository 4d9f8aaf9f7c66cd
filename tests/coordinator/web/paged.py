"""A web server in front of an IPC server with one method of each scope, and browsers that are none."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import aiohttp

from coordinator.ipc.protocol.methods import Scope
from coordinator.web.server import WebServer
from coordinator.web.settings import WebSettings
from coordinator.web.stop_request import STOP_PATH
from tests.coordinator.ipc.served import Served, serving

LIMIT_S = 20.0
"""For one answer, in the loop's time."""
LOOPBACK = WebSettings(host="127.0.0.1", port=0)


@dataclass
class Paged:
    """The servers, and a browser that can reach the page."""

    served: Served
    page: WebServer
    http: aiohttp.ClientSession
    key: str = ""
    """Of the session, once the browser has signed in."""
    scheme: str = "http"
    loop: asyncio.AbstractEventLoop = field(default_factory=asyncio.get_running_loop)
    """That of the servers."""

    @property
    def at(self) -> str:
        return f"{self.scheme}://127.0.0.1:{self.page.port}"

    def socket(self, **headers: str) -> Any:
        """Connect as the page's script does."""
        return self.http.ws_connect(f"{self.at}/socket", headers={"Origin": self.at, **headers})

    async def log_in(self, token: str, *, keep: bool = True, **headers: str) -> tuple[int, Any]:
        """Give a link's code, or a token, as the page's script does; return the status and the answer."""
        origin = {"Origin": self.at, **headers}
        asked = {"token": token, "keep": keep}
        async with self.http.post(f"{self.at}/login", json=asked, headers=origin) as answer:
            told = await answer.json()
        self.key = told.get("key", self.key)
        return answer.status, told

    async def sign_in(self, scope: Scope = Scope.OPERATE) -> None:
        """Open a one-time link."""
        status, told = await self.log_in(code_of(self.page.new_link(scope)))
        assert (status, told["scope"]) == (200, scope.word)

    async def hello(self, socket: aiohttp.ClientWebSocketResponse) -> Any:
        """Say hello as the page's script does, and return the answer."""
        return await ask(socket, "api.hello", version=1, client="the page", token=self.key)

    @property
    def cookie(self) -> str:
        """The session's cookie, as a browser sends it."""
        return "; ".join(f"{cookie.key}={cookie.value}" for cookie in self.http.cookie_jar)

    def stop_request(self, body: bytes | None = None, **headers: str) -> bytes:
        """Return the emergency stop as the page's script sends it as a request; HEADERS change its own."""
        if body is None:
            body = json.dumps({"key": self.key, "who": "me"}).encode()
        own = {"Host": self.at.partition("//")[2], "Origin": self.at, "Cookie": self.cookie}
        changed = {name.replace("_", "-"): value for name, value in headers.items()}
        sent = own | {"Content-Length": str(len(body))} | changed
        lines = [f"{name}: {value}\r\n" for name, value in sent.items() if value]
        return f"POST {STOP_PATH} HTTP/1.1\r\n{''.join(lines)}\r\n".encode() + body

    async def stop(self, body: Any = None, **headers: str) -> tuple[int, Any]:
        """Stop the machine by a request; return the status and the answer."""
        given = {"key": self.key, "who": "me"} if body is None else body
        data = given if isinstance(given, bytes) else json.dumps(given).encode()
        posted = self.http.post(f"{self.at}{STOP_PATH}", data=data, headers={"Origin": self.at, **headers})
        async with posted as answer:
            return answer.status, json.loads(await answer.read() or b"null")

    async def session_status(self) -> int:
        """Ask whether this browser is signed in."""
        async with self.http.get(f"{self.at}/session") as answer:
            return answer.status

    @contextlib.asynccontextmanager
    async def other(self) -> AsyncIterator["Paged"]:
        """Another browser."""
        async with browser() as http:
            yield replace(self, http=http, key="")


def browser() -> aiohttp.ClientSession:
    """Return a browser that keeps cookies, as all do; of IP addresses, too, and trusts any certificate."""
    connector = aiohttp.TCPConnector(ssl=False)
    return aiohttp.ClientSession(connector=connector, cookie_jar=aiohttp.CookieJar(unsafe=True))


@contextlib.asynccontextmanager
async def paging(folder: Path, page: WebSettings = LOOPBACK, **settings: Any) -> AsyncIterator[Paged]:
    """Serve the page as PAGE says in front of ``serving``."""
    async with serving(folder, **settings) as served:
        server = WebServer(served.server, page, on_notice=served.notices.put_nowait)
        await server.start()
        try:
            async with browser() as http:
                yield Paged(served, server, http, scheme="http" if page.certificate is None else "https")
        finally:
            await served.server.close()
            await server.close()


def code_of(link: str) -> str:
    """Return the code of a one-time link."""
    return link.partition("#")[2]


async def ask(socket: aiohttp.ClientWebSocketResponse, method: str, number: int = 1, **params: Any) -> Any:
    """Send a request and return the next message."""
    await socket.send_str(json.dumps({"id": number, "method": method, "params": params}))
    return await receive(socket)


async def receive(socket: aiohttp.ClientWebSocketResponse) -> Any:
    async with asyncio.timeout(LIMIT_S):
        message = await socket.receive()
    assert message.type is aiohttp.WSMsgType.TEXT, message
    return json.loads(message.data)


async def rest(socket: aiohttp.ClientWebSocketResponse) -> list[Any]:
    """Return what comes until the server closes."""
    found: list[Any] = []
    async with asyncio.timeout(LIMIT_S):
        async for message in socket:
            found += [json.loads(line) for line in message.data.splitlines()]
    return found
