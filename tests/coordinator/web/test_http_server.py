"""The HTTP server under the page and the metrics; its limits are tested there, as users meet them."""

import asyncio
import contextlib
import gc
from collections.abc import Coroutine
from http import HTTPStatus
from typing import Any

import pytest
from aiohttp import web

from coordinator.web.http_server import HEADERS, HttpServer, _Handler
from coordinator.web.request_reader import BODY_BYTES_MAX, HEAD_BYTES_MAX
from coordinator.web.round_robin import TURNS_PER_ROUND
from tests.stages import jump_loop


async def answer(request: web.BaseRequest) -> web.Response:
    return web.Response(text=request.path)


def handlers() -> int:
    gc.collect()
    return sum(isinstance(each, _Handler) for each in gc.get_objects())


def test_a_connection_that_is_closed_is_not_kept_until_its_time_is_over() -> None:
    async def main() -> None:
        server = HttpServer(answer, connections_max=8, connection_s=30.0)
        await server.open("127.0.0.1", 0)
        for _ in range(20):
            reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
            writer.write(b"GET /x HTTP/1.0\r\nHost: localhost\r\n\r\n")
            assert str(HTTPStatus.OK.value) in (await reader.read()).decode().split("\r\n")[0]
            writer.close()
        await asyncio.sleep(1)
        assert handlers() == 0
        assert (server.refused, server.timed_out) == (0, 0)
        await server.close()

    jump_loop.run(main())


# -------------------------------------------------------------------------------------------- headers


def test_each_answer_has_the_headers_and_names_no_library() -> None:
    """Failed before: aiohttp's own answers had its name and version, and no headers of the page."""

    async def fail(request: web.BaseRequest) -> web.Response:
        if request.path == "/raises":
            raise web.HTTPBadRequest
        return web.Response(body=await request.read(), status=int(request.path[1:]))

    async def main() -> None:
        failures: list[str] = []
        asyncio.get_running_loop().set_exception_handler(
            lambda _, context: failures.append(context["message"])
        )
        server = HttpServer(fail, connections_max=8, connection_s=30.0)
        await server.open("127.0.0.1", 0)
        for line, headers, status in (
            ("GET /200 HTTP/1.1", "", 200),
            ("GET /404 HTTP/1.1", "", 404),
            ("GET /letters HTTP/1.1", "", 500),
            ("GET /raises HTTP/1.1", "", 500),
            ("POST /200 HTTP/1.1", "Content-Encoding: gzip\r\nContent-Length: 2\r\n", 415),
            ("GET\0/200 HTTP/1.1", "", 400),
            ("GET /200 HTTP/1.1", "a: \0\r\n", 400),
        ):
            request = f"{line}\r\nHost: localhost\r\n{headers}Connection: close\r\n\r\n{{}}"
            answer = await send(server, request.encode())
            lines = answer.decode().split("\r\n")
            assert int(lines[0].split()[1]) == status, answer
            assert "aiohttp" not in answer.decode()
            assert {f"{name}: {value}" for name, value in HEADERS.items()} <= set(lines)
        assert failures == [
            f"canductor: the answer to GET '{path}' failed by a mistake of the program"
            for path in ("/letters", "/raises")
        ]
        await server.close()

    jump_loop.run(main())


# ------------------------------------------------------------------------------------ work in a round


class Rounds:
    """What aiohttp gets in each round of the running loop: as many entries of bytes as calls."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.handed: list[list[int]] = [[]]
        self._loop = asyncio.get_running_loop()
        take = web.RequestHandler.data_received

        def data_received(handler: web.RequestHandler, data: bytes) -> None:
            self.handed[-1].append(len(data))
            take(handler, data)

        monkeypatch.setattr(web.RequestHandler, "data_received", data_received)
        self._begin_round()

    def _begin_round(self) -> None:
        if self.handed[-1]:
            self.handed.append([])
        self._next = self._loop.call_soon(self._begin_round)

    def end(self) -> list[list[int]]:
        self._next.cancel()
        return [handed for handed in self.handed if handed]


async def send(server: HttpServer, data: bytes) -> bytes:
    """Send DATA and return all that is answered until the server closes."""
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    writer.write(data)
    answered = b""
    with contextlib.suppress(ConnectionError):
        while piece := await reader.read(65_536):
            answered += piece
    writer.close()
    return answered


def run_server(go: Any, answered: list[str]) -> None:
    async def note(request: web.BaseRequest) -> web.Response:
        answered.append(request.path)
        return await answer(request)

    async def main() -> None:
        server = HttpServer(note, connections_max=100, connection_s=5.0)
        await server.open("127.0.0.1", 0)
        steps: Coroutine[Any, Any, None] = go(server)
        await steps
        await server.close()

    jump_loop.run(main())


HEAD = b"POST /x HTTP/1.1\r\nHost: localhost\r\n"
TINY_CHUNKS = HEAD + b"Transfer-Encoding: chunked\r\n\r\n" + b"1\r\na\r\n" * 20_000


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (TINY_CHUNKS, 415),
        (HEAD + b"Content-Encoding: gzip\r\nContent-Length: 2\r\n\r\n{}", 415),
        (HEAD + f"Content-Length: {BODY_BYTES_MAX + 1}\r\n\r\n".encode(), 413),
        (HEAD + b"a:b\r\n" * 40_000, 431),
    ],
    ids=["chunks", "packed", "long body", "endless headers"],
)
def test_what_the_page_has_no_use_for_is_not_parsed(
    monkeypatch: pytest.MonkeyPatch, data: bytes, status: int
) -> None:
    """Failed before: one connection of tiny chunks held the loop for 65 ms, 16 ended a print."""
    answered: list[str] = []

    async def go(server: HttpServer) -> None:
        rounds = Rounds(monkeypatch)
        (answer,) = {(await send(server, data[:HEAD_BYTES_MAX]))[:12] for _ in range(2)}
        assert answer == f"HTTP/1.1 {status}".encode()
        await asyncio.gather(*(send(server, data) for _ in range(8)))
        assert rounds.end() == []
        assert server.refused == 10

    run_server(go, answered)
    assert answered == []


def test_all_connections_together_have_few_turns_in_a_round(monkeypatch: pytest.MonkeyPatch) -> None:
    """Failed before: all that had come was parsed in one round."""
    answered: list[str] = []
    request = b"GET /x HTTP/1.1\r\nHost: localhost\r\n\r\n"
    last = request[:-2] + b"Connection: close\r\n\r\n"

    async def go(server: HttpServer) -> None:
        rounds = Rounds(monkeypatch)
        await asyncio.gather(*(send(server, request * 49 + last) for _ in range(30)))
        handed = rounds.end()
        assert max(map(len, handed)) <= TURNS_PER_ROUND
        assert {size for sizes in handed for size in sizes} == {len(request), len(last)}

    run_server(go, answered)
    assert len(answered) == 30 * 50


def test_a_connection_is_not_read_while_it_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Failed before: a client that asked without reading the answers was read all the same."""

    async def go(server: HttpServer) -> None:
        kept: list[int] = []
        keep = _Handler.buffer_updated

        def buffer_updated(handler: _Handler, nbytes: int) -> None:
            keep(handler, nbytes)
            kept.append(len(handler.waiting()))

        monkeypatch.setattr(_Handler, "buffer_updated", buffer_updated)
        request = b"GET /x HTTP/1.1\r\nHost: localhost\r\n\r\n"
        _, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(request * 20_000)
        await asyncio.sleep(6)
        assert server.timed_out == 1
        assert max(kept) <= 2 * HEAD_BYTES_MAX
        writer.close()

    run_server(go, [])
