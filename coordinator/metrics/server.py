"""The endpoint: answers ``GET /metrics``, and nothing else, to a few clients at a time.

Prometheus asks every few seconds, in one request; so each connection has one, is bounded in bytes and time,
and answers that are asked for within a second are the same. The text is made by another thread: the loop,
which also feeds motion, only copies the fields.
"""

import asyncio
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from ipaddress import ip_address
from typing import Final

from prometheus_client.exposition import choose_encoder

from coordinator.metrics.collect import registry_of
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

CONNECTIONS_MAX: Final = 8
REQUEST_BYTES_MAX: Final = 8_192
REQUEST_S: Final = 5.0
"""For the request to be complete, and for the answer to be taken."""
SAME_S: Final = 1.0
"""For so long the same answer is given to all."""
OPENMETRICS: Final = "application/openmetrics-text; version=1.0.0"
"""What Prometheus asks for if it can; to others the older form is given."""
TEXT: Final = "text/plain; charset=utf-8"


@dataclass(frozen=True, slots=True)
class MetricsSettings:
    """Where the endpoint is; on the loopback only, unless it is OPEN to all who reach it."""

    host: str
    """An IP address: a name may come to mean another one."""
    port: int
    open: bool = False


@dataclass(frozen=True, slots=True)
class Request:
    """What is of interest of an HTTP request."""

    method: str
    path: str
    host: str
    accept: str


class _Refusal(Exception):  # noqa: N818 (an answer like others)
    def __init__(self, status: HTTPStatus, sentence: str) -> None:
        super().__init__(sentence)
        self.status = status


class MetricsServer:
    """Serves FIELDS (the state tree's, and ``api.*``) at SETTINGS; lives on the loop that starts it.

    ABOUT: name, version and api of the machine.
    """

    def __init__(
        self, fields: Callable[[], dict[str, Value]], about: Mapping[str, str], settings: MetricsSettings
    ) -> None:
        self._fields = fields
        self._about = about
        self._settings = settings
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self._answers: dict[str, tuple[float, asyncio.Future[bytes]]] = {}  # by the form asked for
        self.scrapes = 0
        self.refused = 0
        self.collect_s = 0.0
        """What it took to make the last answer."""
        self.port = 0
        """Once open."""

    async def start(self) -> None:
        """Open the port; raises CanductorError."""
        host, port = self._settings.host, self._settings.port
        if not _is_loopback(host) and not self._settings.open:
            raise CanductorError(f"metrics at {host} could be read by all who reach it; see docs/security.md")
        try:
            self._server = await asyncio.start_server(
                self._serve, host, port, limit=REQUEST_BYTES_MAX, backlog=CONNECTIONS_MAX
            )
        except OSError as error:
            raise CanductorError(
                f"port {port} of {host} cannot be opened for metrics: {error.strerror}"
            ) from None
        self.port = self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """Let go of all clients and close the port."""
        if self._server is not None:
            self._server.close()
        clients = list(self._clients)
        for client in clients:
            client.cancel()
        await asyncio.gather(*clients, return_exceptions=True)

    # ---------------------------------------------------------------------------------------- clients

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        if len(self._clients) >= CONNECTIONS_MAX:
            self.refused += 1
            writer.transport.abort()
            return
        self._clients.add(task)
        try:
            async with asyncio.timeout(REQUEST_S):
                writer.write(await self._answer(reader))
                await writer.drain()
                writer.close()
                await writer.wait_closed()
        except (TimeoutError, OSError, asyncio.IncompleteReadError):
            self.refused += 1  # it said too little too late, did not read, or went away
        finally:
            self._clients.discard(task)
            writer.transport.abort()

    async def _answer(self, reader: asyncio.StreamReader) -> bytes:
        """Return what to send to a client, having read what it wants."""
        kind, status, with_body = TEXT, HTTPStatus.OK, True
        try:
            request = self._checked(await reader.readuntil(b"\r\n\r\n"))
            self.scrapes += 1
            with_body = request.method != "HEAD"
            accept = OPENMETRICS if "application/openmetrics-text" in request.accept else ""
            _, kind = choose_encoder(accept)
            body = await self._metrics(accept)
        except asyncio.LimitOverrunError:
            self.refused += 1
            status, body = HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, b"the request is too long\n"
        except _Refusal as refusal:
            self.refused += 1
            status, body = refusal.status, f"{refusal}\n".encode()
        head = (
            f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: {kind}\r\n"
            f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
        )
        return head.encode() + (body if with_body else b"")

    def _checked(self, head: bytes) -> Request:
        """Return the request that is to be answered; raises _Refusal."""
        request = read_request(head)
        if request is None:
            raise _Refusal(HTTPStatus.BAD_REQUEST, "this is no HTTP request")
        if not self._settings.open and not _names_loopback(request.host):
            # A page of the web that has its own name mean 127.0.0.1 shall not read along.
            raise _Refusal(HTTPStatus.FORBIDDEN, "ask by an address of the loopback, or as localhost")
        if request.method not in ("GET", "HEAD"):
            raise _Refusal(HTTPStatus.METHOD_NOT_ALLOWED, "only GET is answered")
        if request.path.partition("?")[0] != "/metrics":
            raise _Refusal(HTTPStatus.NOT_FOUND, "metrics are at /metrics")
        return request

    # ------------------------------------------------------------------------------------------- text

    async def _metrics(self, accept: str) -> bytes:
        """Return the figures in the form that ACCEPT leads to, made at most once in SAME_S."""
        now_s = asyncio.get_running_loop().time()
        self._answers = {k: made for k, made in self._answers.items() if now_s - made[0] < SAME_S}
        if accept not in self._answers:
            self._answers[accept] = (now_s, asyncio.ensure_future(self._make(accept)))
        return await asyncio.shield(self._answers[accept][1])

    async def _make(self, accept: str) -> bytes:
        began_s = time.perf_counter()
        fields = self._fields()
        own: dict[str, Value] = {
            **self._about,
            "scrapes": self.scrapes,
            "refused": self.refused,
            "collect_s": self.collect_s,
        }
        fields.update({f"metrics.{name}": value for name, value in own.items()})
        text = await asyncio.to_thread(_text, fields, accept)
        self.collect_s = time.perf_counter() - began_s
        return text


def _text(fields: dict[str, Value], accept: str) -> bytes:
    encode, _ = choose_encoder(accept)
    return encode(registry_of(fields))


def read_request(head: bytes) -> Request | None:
    """Return what HEAD, up to its empty line, asks for; None when it is no HTTP."""
    first, *lines = head.decode("latin-1").split("\r\n")
    words = first.split(" ")
    if len(words) != 3 or not words[2].startswith("HTTP/1."):
        return None
    named = {}
    for line in lines:
        name, _, value = line.partition(":")
        named[name.strip().lower()] = value.strip()
    return Request(words[0], words[1], named.get("host", ""), named.get("accept", ""))


def _names_loopback(host: str) -> bool:
    """Whether the Host of a request says an address of the loopback; HTTP/1.0 need not say any."""
    name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
    return name in ("", "localhost") or _is_loopback(name.strip("[]"))


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False
