"""Serves the live page and its WebSockets; each WebSocket is a client of the IPC server and no more."""

import asyncio
import contextlib
import functools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from http import HTTPStatus
from typing import Any, Final

from aiohttp import WSMsgType, web
from multidict import MultiMapping

from coordinator.ipc.protocol.limits import EndReason
from coordinator.ipc.protocol.methods import ApiError, Scope
from coordinator.ipc.server.auth import Grant, digest_of
from coordinator.ipc.server.connection import Connection
from coordinator.ipc.server.server import ExternalGrant, IpcServer, StopCall
from coordinator.ipc.server.tls_transport import TlsServer
from coordinator.web.access import LINK_S, SESSION_S, PageAccess, PageSession, is_key_of
from coordinator.web.files import PageFile, page_files
from coordinator.web.http_server import HttpServer
from coordinator.web.names import is_known_host, is_own_origin
from coordinator.web.session_file import read_sessions, remove_sessions, write_sessions
from coordinator.web.settings import WebSettings
from coordinator.web.stop_request import BODY_BYTES_MAX, STOP_PATH, parse_request, read_body
from coordinator.web.websocket_frames import FRAMES_PER_S, FrameIntake, UnrelayedMessages
from coordinator.web.websocket_transport import WebSocketTransport
from nodes.support.errors import CanductorError

SOCKET_PATH: Final = "/socket"
LOGIN_PATH: Final = "/login"
"""Takes a link's code, or a token; gives a session."""
SESSION_PATH: Final = "/session"
"""Whether the browser has a session: browsers do not report why a WebSocket was refused."""
LOGIN_BYTES_MAX: Final = 4_096
COOKIES_MAX: Final = 8
"""Of our name that are looked at: programs on other ports of this computer can set such cookies, too."""
CONNECTIONS_MAX: Final = 256
"""Open at a time, WebSockets and TLS handshakes included; further ones are closed."""
REQUEST_S: Final = 30.0
"""A connection that is no WebSocket is closed after so long: who only fetches files is done by then."""
HEARTBEAT_S: Final = 15.0
"""Between looks at whether a browser is still there."""
CLIENT: Final = "the live page"
"""As the page's script calls itself."""
UNKNOWN: Final = ApiError(
    "bad_token",
    "This link or token is not known. A link works once, for "
    f"{LINK_S / 60:.0f} minutes; 'canductor page' prints another.",
)
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


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a request is not carried out."""

    status: HTTPStatus
    error: ApiError


class WebServer:
    """Serves the page at SETTINGS.host; its clients are clients of IPC. Lives on the loop that starts it."""

    def __init__(
        self, ipc: IpcServer, settings: WebSettings, *, on_notice: Callable[[str], None] = lambda _: None
    ) -> None:
        self._ipc = ipc
        self._settings = settings
        self._on_notice = on_notice
        """Gets sentences for the machine's owner."""
        self._files = page_files()
        self._names = frozenset(settings.names)
        self._access = PageAccess()
        self._saving = asyncio.Lock()
        self._clients: dict[Connection, PageSession] = {}
        self._http: HttpServer | None = None
        self._refused = 0

    # ------------------------------------------------------------------------------------------- life

    async def start(self) -> None:
        """Open the port; raises CanductorError."""
        settings = self._settings
        await self._read_sessions()
        tls = None
        if settings.certificate is not None and settings.private_key is not None:
            tls = await asyncio.to_thread(TlsServer, settings.certificate, settings.private_key)
        self._http = HttpServer(
            self._answer,
            connections_max=CONNECTIONS_MAX,
            connection_s=REQUEST_S,
            headers=HEADERS,
            tls=tls,
            stop_lane=self._ipc.stop_lane,
            find_stop=functools.partial(self._find_stop, asyncio.get_running_loop()),
        )
        try:
            await self._http.open(settings.host, settings.port)
        except OSError as error:
            raise CanductorError(
                f"the live page's port {settings.port} of {settings.host} cannot be opened: {error.strerror};"
                " choose another with --web"
            ) from None

    @property
    def port(self) -> int:
        """The port, once open."""
        assert self._http is not None
        return self._http.port

    @property
    def refused(self) -> int:
        """How many connections, requests and WebSockets were refused."""
        return self._refused + (0 if self._http is None else self._http.refused)

    @property
    def url(self) -> str:
        """What to type into a browser, once the port is open."""
        return replace(self._settings, port=self.port).url

    async def close(self) -> None:
        """Disconnect every browser; they got the reason when the IPC server was closed before."""
        if self._http is not None:
            await self._http.close()

    # --------------------------------------------------------------------------------------- sessions

    def new_link(self, scope: Scope) -> str:
        """Return an address that lets one browser in with SCOPE, once; to be called once the port is open."""
        return f"{self.url}#{self._access.new_link(scope, asyncio.get_running_loop().time())}"

    async def sign_all_out(self) -> int:
        """End all sessions with their connections, and all links; return how many sessions there were.

        Raises CanductorError when the next start would find the sessions again.
        """
        count = self._access.sign_all_out()
        for connection in list(self._clients):
            connection.session.end(EndReason("bad_token", "all browsers were signed out"))
            connection.flush()
        if self._settings.sessions is not None:
            async with self._saving:
                await asyncio.to_thread(remove_sessions, self._settings.sessions)
            if self._access.sessions:  # a browser has signed in meanwhile
                await self._save_sessions()
        return count

    async def _read_sessions(self) -> None:
        if self._settings.sessions is None:
            return
        try:
            self._access = PageAccess(await asyncio.to_thread(read_sessions, self._settings.sessions))
        except CanductorError as error:
            self._on_notice(f"{error}; until then browsers need a new link after each start")

    async def _save_sessions(self) -> None:
        """Keep the sessions; when that fails they hold until the end of this run."""
        if self._settings.sessions is None:
            return
        async with self._saving:
            sessions = [replace(session) for session in self._access.sessions]
            try:
                await asyncio.to_thread(write_sessions, self._settings.sessions, sessions)
            except CanductorError as error:
                self._on_notice(f"{error}; browsers need a new link after the next start")

    def _session_of(self, headers: MultiMapping[str]) -> PageSession | None:
        """Return the session of the browser that asks, None if it has none, or its token was taken away."""
        host, time_s = _host(headers), time.time()
        for cookie in _cookies(headers, self._cookie_name)[:COOKIES_MAX]:
            session = self._access.find(cookie, host, time_s)
            if session is not None and self._grant(session) is not None:
                return session
        return None

    def _grant(self, session: PageSession) -> Grant | None:
        """Return what SESSION may do now: no more than its token, if it has one."""
        if session.token is None:
            return Grant("", session.scope)
        grant = self._ipc.grant_of(session.token)
        return None if grant is None else replace(grant, scope=min(grant.scope, session.scope))

    def _check_key(self, session: PageSession, key: str) -> ExternalGrant | None:
        """Return what the browser of SESSION that gives KEY may do; None: nothing."""
        grant = self._grant(session)
        if grant is None or session not in self._access.sessions or not is_key_of(session, key):
            return None
        return ExternalGrant(grant, session.token)

    @property
    def _cookie_name(self) -> str:
        return f"canductor-{self.port}"  # cookies are shared by all ports of a host

    # --------------------------------------------------------------------------------------- requests

    async def _answer(self, request: web.BaseRequest) -> web.StreamResponse:
        if not is_known_host(request.headers.get("Host", ""), self._names):
            name = repr(request.headers.get("Host", ""))  # aiohttp's own looks for this host's in the DNS
            return self._refuse(f"{name} is not a name of this page; use its IP address, or give --web-name")
        if request.path == SOCKET_PATH:
            return await self._serve_socket(request)
        if request.path == LOGIN_PATH:
            return await self._sign_in(request)
        if request.path == STOP_PATH:
            return await self._stop(request)
        return self._serve_file(request)

    def _serve_file(self, request: web.BaseRequest) -> web.Response:
        if request.method not in ("GET", "HEAD"):
            return web.Response(status=405, headers={"Allow": "GET, HEAD"})
        if request.path == SESSION_PATH:
            return web.Response(status=204 if self._session_of(request.headers) else 401)
        file = self._files.get(request.path)
        if file is None:
            return web.Response(status=404, text="there is no such page\n")
        return _send(file, request)

    async def _sign_in(self, request: web.BaseRequest) -> web.Response:
        """Give a session for the code of a link, or for a token."""
        if request.method != "POST":
            return web.Response(status=405, headers={"Allow": "POST"})
        if not is_own_origin(request.headers.get("Origin"), request.headers.get("Host", "")):
            return self._refuse("only the page of this server may sign in here")
        if request.content_length is None or request.content_length > LOGIN_BYTES_MAX:
            return web.Response(status=413)
        given = _read_login(await request.read())
        if given is None:
            return _fault(HTTPStatus.BAD_REQUEST, ApiError("bad_message", "token and keep are needed"))
        token, keep = given
        scope, digest = self._access.use_link(token, asyncio.get_running_loop().time()), None
        if scope is None:
            try:
                scope, digest = self._ipc.check_token(token, _address(request)).scope, digest_of(token)
            except ApiError as error:
                self._refused += 1
                return _fault(HTTPStatus.FORBIDDEN, UNKNOWN if error.code == UNKNOWN.code else error)
        former = self._session_of(request.headers)
        if former is not None:
            self._access.sign_out(former)
        signed_in = self._access.sign_in(_host(request.headers), scope, digest, time.time())
        await self._save_sessions()
        headers = {"Cache-Control": "no-store"}
        answer = web.json_response({"key": signed_in.key, "scope": scope.word}, headers=headers)
        answer.set_cookie(
            self._cookie_name,
            signed_in.cookie,
            path="/",
            httponly=True,
            samesite="Strict",
            secure=self._settings.certificate is not None,
            max_age=int(SESSION_S) if keep else None,
        )
        return answer

    async def _stop(self, request: web.BaseRequest) -> web.Response:
        """Carry out an emergency stop that is a request of its own."""
        if request.method != "POST":
            return web.Response(status=405, headers={"Allow": "POST"})
        if request.content_length is None or request.content_length > BODY_BYTES_MAX:
            return web.Response(status=413)
        judged = self._judge_stop(request.headers, await request.read(), _address(request))
        if isinstance(judged, Refusal):
            self._refused += 1
            return _fault(judged.status, judged.error)
        # No await from here to the answer: the stop lane would find the stop again.
        return web.json_response(judged.carry_out(), headers={"Cache-Control": "no-store"})

    def _judge_stop(self, headers: MultiMapping[str], body: bytes, address: str) -> StopCall | Refusal:
        """Return what a stop with HEADERS and BODY from ADDRESS does; in any thread.

        It needs what a WebSocket needs, and its hello.
        """
        host = headers.get("Host", "")
        if not is_known_host(host, self._names) or not is_own_origin(headers.get("Origin"), host):
            return Refusal(
                HTTPStatus.FORBIDDEN,
                ApiError("not_allowed", "only the page of this server may stop the machine here"),
            )
        session = self._session_of(headers)
        if session is None:
            return Refusal(HTTPStatus.UNAUTHORIZED, ApiError("no_token", "this browser is not signed in"))
        given = read_body(body)
        if given is None:
            return Refusal(HTTPStatus.BAD_REQUEST, ApiError("bad_message", "key is needed"))
        grant = self._check_key(session, given.key)
        if grant is None:
            return Refusal(HTTPStatus.FORBIDDEN, ApiError("bad_token", "the key is not that of the session"))
        try:
            return self._ipc.stop_call(CLIENT, address, grant.grant, given.params)
        except ApiError as error:
            return Refusal(HTTPStatus.FORBIDDEN, error)

    def _find_stop(self, loop: asyncio.AbstractEventLoop, address: str, unread: bytes) -> str | None:
        """Return who stops the machine with the UNREAD bytes of a connection from ADDRESS; in any thread."""
        request = parse_request(unread, loop)
        if request is None:
            return None
        judged = self._judge_stop(*request, address)
        return judged.who if isinstance(judged, StopCall) else None

    def _refuse(self, sentence: str) -> web.Response:
        self._refused += 1
        return web.Response(status=403, text=sentence + "\n")

    async def _serve_socket(self, request: web.BaseRequest) -> web.StreamResponse:
        if not is_own_origin(request.headers.get("Origin"), request.headers.get("Host", "")):
            return self._refuse("only the page of this server may connect here")
        socket = web.WebSocketResponse(
            max_msg_size=self._ipc.limits.message_bytes, heartbeat=HEARTBEAT_S, compress=False
        )
        if not socket.can_prepare(request).ok:
            return web.Response(status=426, headers={"Upgrade": "websocket"})
        session = self._session_of(request.headers)
        if session is None:
            self._refused += 1
            return web.Response(status=401, text="sign in first\n")
        if self._access.note_use(session, time.time()):
            await self._save_sessions()
        socket.headers.update(HEADERS)
        await socket.prepare(request)
        await self._relay(socket, request, session)
        return socket

    async def _relay(
        self, socket: web.WebSocketResponse, request: web.BaseRequest, session: PageSession
    ) -> None:
        """Carry messages both ways until one side ends."""
        transport = WebSocketTransport(socket)
        connection = self._ipc.adopt(
            transport, _address(request), functools.partial(self._check_key, session)
        )
        transport.connection = connection
        unrelayed = UnrelayedMessages(self._ipc.limits.message_bytes)
        end_flood = functools.partial(self._end_flood, connection, _address(request))
        waiting = HttpServer.keep(request, FrameIntake(unrelayed, asyncio.get_running_loop().time, end_flood))
        self._ipc.stop_lane.watch_transport(
            connection,
            request.transport,
            lambda unread: connection.session.find_stop(
                unrelayed.lines(waiting() + unread), self._ipc.stop_lane.goes_on
            ),
        )
        self._clients[connection] = session
        sending = asyncio.ensure_future(transport.run())
        begun = False
        try:
            async for message in socket:
                if message.type is not WSMsgType.TEXT or not (begun or message.data.startswith("{")):
                    unrelayed.end()
                    HttpServer.go_on(request)
                    await socket.close(code=1003, message=b"messages are JSON, as text")
                    break
                begun = True
                unrelayed.relayed()  # without an await: the stop lane finds it here or there
                connection.receive(message.data.encode() + b"\n")
                await transport.readable()
                HttpServer.go_on(request)
        finally:
            del self._clients[connection]
            transport.abort()
            connection.connection_lost(None)
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await sending

    def _end_flood(self, connection: Connection, address: str) -> None:
        """End CONNECTION, the page's at ADDRESS: it sends what no page does, and others would wait for it."""
        sentence = f"more than {FRAMES_PER_S} messages or pings a second"
        self._on_notice(f"the live page at {address} was disconnected: it sent {sentence}")
        connection.session.end(EndReason("too_many", sentence))
        connection.flush()


def _address(request: web.BaseRequest) -> str:
    peer = None if request.transport is None else request.transport.get_extra_info("peername")
    return str(peer[0]) if peer else "unknown"


def _host(headers: MultiMapping[str]) -> str:
    return headers.get("Host", "").lower()


def _cookies(headers: MultiMapping[str], name: str) -> list[str]:
    """Return the values of the cookies called NAME; there may be several, of other ports and paths."""
    parts = ";".join(headers.getall("Cookie", ())).split(";")
    pairs = (part.strip().partition("=") for part in parts)
    return [value for found, _, value in pairs if found == name]


def _read_login(body: bytes) -> tuple[str, bool] | None:
    """Return the code or token of BODY, and whether its session outlives the browser."""
    try:
        given: Any = json.loads(body)
    except (ValueError, RecursionError):
        return None
    if not isinstance(given, dict) or type(given.get("token")) is not str:
        return None
    return given["token"], given.get("keep") is True


def _fault(status: HTTPStatus, error: ApiError) -> web.Response:
    return web.json_response({"code": error.code, "message": error.sentence}, status=status.value)


def _send(file: PageFile, request: web.BaseRequest) -> web.Response:
    headers = {"ETag": file.tag, "Content-Type": file.content_type, "Vary": "Accept-Encoding"}
    if request.headers.get("If-None-Match") == file.tag:
        return web.Response(status=304, headers=headers)
    if "gzip" in request.headers.get("Accept-Encoding", ""):
        return web.Response(body=file.packed, headers={**headers, "Content-Encoding": "gzip"})
    return web.Response(body=file.content, headers=headers)
