"""A web server in front of an IPC server with one method of each scope, and browsers that are none."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import aiohttp

from coordinator.web.server import WebServer
from coordinator.web.settings import WebSettings
from tests.coordinator.ipc.served import Served, serving


@dataclass
class Paged:
    """The servers, and how to reach the page."""

    served: Served
    page: WebServer
    http: aiohttp.ClientSession

    @property
    def at(self) -> str:
        return f"http://127.0.0.1:{self.page.port}"

    def socket(self, **headers: str) -> Any:
        """Connect as the page's script does."""
        return self.http.ws_connect(f"{self.at}/socket", headers={"Origin": self.at, **headers})


@contextlib.asynccontextmanager
async def paging(folder: Path, **settings: Any) -> AsyncIterator[Paged]:
    """Serve the page on loopback in front of ``serving``."""
    async with serving(folder, **settings) as served:
        page = WebServer(served.server, WebSettings(host="127.0.0.1", port=0))
        await page.start()
        try:
            async with aiohttp.ClientSession() as http:
                yield Paged(served, page, http)
        finally:
            await served.server.close()
            await page.close()


async def ask(socket: aiohttp.ClientWebSocketResponse, method: str, number: int = 1, **params: Any) -> Any:
    """Send a request and return the next message."""
    await socket.send_str(json.dumps({"id": number, "method": method, "params": params}))
    return await receive(socket)


async def receive(socket: aiohttp.ClientWebSocketResponse) -> Any:
    async with asyncio.timeout(20):
        message = await socket.receive()
    assert message.type is aiohttp.WSMsgType.TEXT, message
    return json.loads(message.data)


async def rest(socket: aiohttp.ClientWebSocketResponse) -> list[Any]:
    """Return what comes until the server closes."""
    found: list[Any] = []
    async with asyncio.timeout(20):
        async for message in socket:
            found += [json.loads(line) for line in message.data.splitlines()]
    return found
