"""The endpoint: answers ``GET /metrics``, and nothing else, to a few clients at a time.

Prometheus asks every few seconds, in one request; so each connection has one, and answers that are asked for
within a second are the same. The text is made by another thread: the control loop only copies the fields.
"""

import asyncio
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from ipaddress import ip_address
from typing import Final

from aiohttp import web
from prometheus_client.exposition import choose_encoder

from coordinator.metrics.collect import registry_of
from coordinator.support.shared_task import shared_task
from coordinator.support.values import Value
from coordinator.web.http_server import HttpServer
from nodes.support.errors import CanductorError

CONNECTIONS_MAX: Final = 8
REQUEST_S: Final = 5.0
"""For the request to be complete, and for the answer to be taken."""
SAME_S: Final = 1.0
"""For so long the same answer is given to all."""
OPENMETRICS: Final = "application/openmetrics-text; version=1.0.0"
"""What Prometheus asks for if it can; to others the older form is given."""


@dataclass(frozen=True, slots=True)
class MetricsSettings:
    """Where the endpoint is; on the loopback only, unless it is OPEN to all who reach it."""

    host: str
    """An IP address: a name may come to mean another one."""
    port: int
    open: bool = False


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
        self._http: HttpServer | None = None
        self._answers: dict[str, tuple[float, asyncio.Future[bytes]]] = {}  # by the form asked for
        self._refused = 0
        self.scrapes = 0
        self.collect_s = 0.0
        """What it took to make the last answer."""

    @property
    def port(self) -> int:
        """The port, once open."""
        assert self._http is not None
        return self._http.port

    @property
    def refused(self) -> int:
        """How many connections and requests were refused, or took too long."""
        return self._refused + (0 if self._http is None else self._http.refused + self._http.timed_out)

    async def start(self) -> None:
        """Open the port; raises CanductorError."""
        host, port = self._settings.host, self._settings.port
        if not _is_loopback(host) and not self._settings.open:
            raise CanductorError(f"metrics at {host} could be read by all who reach it; see docs/security.md")
        self._http = HttpServer(self._answer, connections_max=CONNECTIONS_MAX, connection_s=REQUEST_S)
        try:
            await self._http.open(host, port)
        except OSError as error:
            raise CanductorError(
                f"port {port} of {host} cannot be opened for metrics: {error.strerror}"
            ) from None

    async def close(self) -> None:
        """End all connections and close the port."""
        if self._http is not None:
            await self._http.close()

    # --------------------------------------------------------------------------------------- requests

    async def _answer(self, request: web.BaseRequest) -> web.Response:
        response = self._refusal(request)
        if response is None:
            self.scrapes += 1
            accept = (
                OPENMETRICS if "application/openmetrics-text" in request.headers.get("Accept", "") else ""
            )
            _, kind = choose_encoder(accept)
            response = web.Response(body=await self._metrics(accept), headers={"Content-Type": kind})
        else:
            self._refused += 1
        response.force_close()
        return response

    def _refusal(self, request: web.BaseRequest) -> web.Response | None:
        """Return the answer to a request that is not to be served; None: it is."""
        if not self._settings.open and not _names_loopback(request.headers.get("Host", "")):
            # A website must not read them by making its own name mean 127.0.0.1 (DNS rebinding).
            return _refuse(HTTPStatus.FORBIDDEN, "ask by an address of the loopback, or as localhost")
        if request.method not in ("GET", "HEAD"):
            return _refuse(HTTPStatus.METHOD_NOT_ALLOWED, "only GET is answered")
        if request.path != "/metrics":
            return _refuse(HTTPStatus.NOT_FOUND, "metrics are at /metrics")
        return None

    # ------------------------------------------------------------------------------------------- text

    async def _metrics(self, accept: str) -> bytes:
        """Return the figures in the form that ACCEPT leads to, made at most once in SAME_S."""
        now_s = asyncio.get_running_loop().time()
        self._answers = {k: made for k, made in self._answers.items() if now_s - made[0] < SAME_S}
        if accept not in self._answers:
            self._answers[accept] = (now_s, shared_task(self._make(accept)))
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


def _refuse(status: HTTPStatus, sentence: str) -> web.Response:
    return web.Response(status=status, text=f"{sentence}\n")


def _names_loopback(host: str) -> bool:
    """Whether the Host of a request says an address of the loopback; HTTP/1.0 need not say any."""
    name = host.rpartition(":")[0] if not host.endswith("]") and ":" in host else host
    return name in ("", "localhost") or _is_loopback(name.strip("[]"))


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False
