"""Serves the live page and its WebSockets; each WebSocket is a client of the IPC server and no more."""

import asyncio
import contextlib
import logging
from dataclasses import replace
from typing import Final

from aiohttp import WSMsgType, web

from coordinator.ipc.door import Door
from coordinator.ipc.methods import Scope
from coordinator.ipc.server import IpcServer, tls_context
from coordinator.web.files import PageFile, page_files
from coordinator.web.peers import is_own_host, is_own_origin, is_own_program, own_names
from coordinator.web.pipe import Pipe
from coordinator.web.settings import WebSettings
from nodes.errors import CanductorError

SOCKET_PATH: Final = "/socket"
CONNECTIONS_MAX: Final = 256
"""Open at a time, WebSockets and TLS handshakes included; further ones are closed."""
REQUEST_S: Final = 30.0
"""A connection that is no WebSocket is closed after so long: who only fetches files is done by then."""
HEARTBEAT_S: Final = 15.0
"""Between looks at whether a browser is still there."""
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'"
)
"""Nothing from elsewhere, nothing inline, in no other page's frame."""
HEADERS: Final = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
    "Server": "canductor",
}


class WebServer:
    """Serves the page at SETTINGS.host; its clients are clients of IPC. Lives on the loop that starts it."""

    def __init__(self, ipc: IpcServer, settings: WebSettings) -> None:
        self._ipc = ipc
        self._settings = settings
        self._files = page_files()
        self._names = own_names()
        self._door: Door | None = None
        self._sockets: set[asyncio.BaseProtocol] = set()
        """Connections that have become WebSockets."""
        quiet = logging.getLogger("canductor.web")
        quiet.addHandler(logging.NullHandler())
        quiet.propagate = False
        self._http = web.Server(self._answer, logger=quiet, access_log=None, keepalive_timeout=REQUEST_S)
        self.refused = 0
        """Connections and WebSockets."""

    # ------------------------------------------------------------------------------------------- life

    async def start(self) -> None:
        """Open the port; raises CanductorError."""
        settings = self._settings
        context = None
        if settings.certificate is not None and settings.private_key is not None:
            context = await asyncio.to_thread(tls_context, settings.certificate, settings.private_key)
        try:
            self._door = Door(self._protocol, context, may_enter=self._may_enter)
            await self._door.open(settings.host, settings.port)
        except OSError as error:
            raise CanductorError(
                f"the live page's port {settings.port} of {settings.host} cannot be opened: {error.strerror};"
                " choose another with --web"
            ) from None

    @property
    def port(self) -> int:
        """The port, once open."""
        assert self._door is not None
        return self._door.names[0][1]

    @property
    def url(self) -> str:
        """What to type into a browser, once the port is open."""
        return replace(self._settings, port=self.port).url

    async def close(self) -> None:
        """Let go of every browser; the IPC server has told them why when it was closed before."""
        if self._door is not None:
            self._door.close()
        await self._http.shutdown(timeout=1.0)

    # ------------------------------------------------------------------------------------ connections

    def _may_enter(self, entering: int) -> bool:
        if len(self._http.connections) + entering < CONNECTIONS_MAX:
            return True
        self.refused += 1
        return False

    def _protocol(self) -> asyncio.BaseProtocol:
        protocol = self._http()
        asyncio.get_running_loop().call_later(REQUEST_S, self._end_idle, protocol)
        return protocol

    def _end_idle(self, protocol: web.RequestHandler) -> None:
        if protocol not in self._sockets and protocol.transport is not None:
            protocol.transport.abort()

    # --------------------------------------------------------------------------------------- requests

    async def _answer(self, request: web.BaseRequest) -> web.StreamResponse:
        if not is_own_host(request.headers.get("Host", ""), self._names):
            return self._refuse(f"this is not {request.host!r}; use the computer's name or address")
        if request.path == SOCKET_PATH:
            return await self._serve_socket(request)
        if request.method not in ("GET", "HEAD"):
            return web.Response(status=405, headers={**HEADERS, "Allow": "GET, HEAD"})
        file = self._files.get(request.path)
        if file is None:
            return web.Response(status=404, text="there is no such page\n", headers=HEADERS)
        return _send(file, request)

    def _refuse(self, sentence: str) -> web.Response:
        self.refused += 1
        return web.Response(status=403, text=sentence + "\n", headers=HEADERS)

    async def _serve_socket(self, request: web.BaseRequest) -> web.StreamResponse:
        if not is_own_origin(request.headers.get("Origin"), request.headers.get("Host", "")):
            return self._refuse("only the page of this server may connect here")
        socket = web.WebSocketResponse(
            max_msg_size=self._ipc.limits.message_bytes, heartbeat=HEARTBEAT_S, compress=False
        )
        if not socket.can_prepare(request).ok:
            return web.Response(status=426, headers={**HEADERS, "Upgrade": "websocket"})
        address, granted = await self._judge(request)
        await socket.prepare(request)
        self._sockets.add(request.protocol)
        try:
            await self._pass_on(socket, address, granted)
        finally:
            self._sockets.discard(request.protocol)
        return socket

    async def _judge(self, request: web.BaseRequest) -> tuple[str, Scope | None]:
        """Return where a browser is, and what it may do without a token."""
        transport = request.transport
        if transport is None:
            return "unknown", None
        peer, here = (transport.get_extra_info(name) for name in ("peername", "sockname"))
        if not peer or not here:
            return "unknown", None
        own = await asyncio.to_thread(is_own_program, peer[:2], here[:2])
        return str(peer[0]), Scope.OPERATE if own else None

    async def _pass_on(self, socket: web.WebSocketResponse, address: str, granted: Scope | None) -> None:
        """Carry messages both ways until one side ends."""
        pipe = Pipe(socket)
        connection = self._ipc.adopt(pipe, address, granted)
        pipe.connection = connection
        sending = asyncio.ensure_future(pipe.run())
        begun = False
        try:
            async for message in socket:
                if message.type is not WSMsgType.TEXT or not (begun or message.data.startswith("{")):
                    await socket.close(code=1003, message=b"messages are JSON, as text")
                    break
                begun = True
                connection.receive(message.data.encode() + b"\n")
                await pipe.readable()
        finally:
            pipe.abort()
            connection.connection_lost(None)
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await sending


def _send(file: PageFile, request: web.BaseRequest) -> web.Response:
    headers = {**HEADERS, "ETag": file.tag, "Content-Type": file.content_type, "Vary": "Accept-Encoding"}
    if request.headers.get("If-None-Match") == file.tag:
        return web.Response(status=304, headers=headers)
    if "gzip" in request.headers.get("Accept-Encoding", ""):
        return web.Response(body=file.packed, headers={**headers, "Content-Encoding": "gzip"})
    return web.Response(body=file.content, headers=headers)
