"""The endpoint: who may ask, what strangers cost."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from coordinator.metrics.server import (
    CONNECTIONS_MAX,
    REQUEST_S,
    SAME_S,
    MetricsServer,
    MetricsSettings,
)
from coordinator.support.values import Value
from nodes.support.errors import CanductorError
from tests.stages import jump_loop

ASK = b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1:1\r\n\r\n"


def run(body: Callable[[MetricsServer, list[int]], Awaitable[None]], **settings: Any) -> None:
    looks: list[int] = []

    def fields() -> dict[str, Value]:
        looks.append(1)
        return {"machine.starts": len(looks)}

    async def main() -> None:
        about = {"name": "m", "version": "1", "api": "1"}
        server = MetricsServer(fields, about, MetricsSettings("127.0.0.1", 0, **settings))
        await server.start()
        try:
            await body(server, looks)
        finally:
            await server.close()

    jump_loop.run(main())


async def ask(server: MetricsServer, request: bytes = ASK) -> tuple[int, str, str]:
    """Send REQUEST; return status, head and body, 0 when the connection is just closed."""
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    try:
        writer.write(request)
        head, _, body = (await reader.read()).decode().partition("\r\n\r\n")
    except ConnectionError:
        return 0, "", ""
    finally:
        writer.transport.abort()
    return (int(head.split()[1]) if head else 0), head, body


def test_prometheus_is_answered() -> None:
    async def body(server: MetricsServer, looks: list[int]) -> None:
        status, head, text = await ask(server)
        assert status == 200
        assert "Content-Type: text/plain; version=0.0.4" in head
        assert f"Content-Length: {len(text)}" in head
        assert "canductor_machine_starts_total 1.0\n" in text
        assert 'canductor_build_info{api="1",name="m",version="1"} 1.0\n' in text
        newer = ASK.replace(b"\r\n\r\n", b"\r\nAccept: application/openmetrics-text;version=1.0.0\r\n\r\n")
        status, head, text = await ask(server, newer)
        assert "Content-Type: application/openmetrics-text" in head
        assert text.endswith("# EOF\n")
        status, head, text = await ask(server, ASK.replace(b"GET", b"HEAD"))
        assert (status, text) == (200, "")
        assert server.scrapes == 3

    run(body)


def test_many_that_ask_at_once_cost_one_answer() -> None:
    async def body(server: MetricsServer, looks: list[int]) -> None:
        answers = await asyncio.gather(*(ask(server) for _ in range(CONNECTIONS_MAX // 2)))
        answers += [await ask(server) for _ in range(20)]
        odd = ASK.replace(b"\r\n\r\n", b"\r\nAccept: text/plain;version=9.%d;escaping=x\r\n\r\n")
        answers += [await ask(server, odd % number) for number in range(20)]
        assert len({text for _, _, text in answers}) == 1
        assert len(looks) == 1
        await asyncio.sleep(SAME_S)
        assert "canductor_machine_starts_total 2.0\n" in (await ask(server))[2]

    run(body)


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"nonsense\r\n\r\n", 400),
        (b"\0\xff\x16\x03\x01\r\n\r\n", 400),
        (b"GET /metrics HTTP/2\r\n\r\n", 400),
        (ASK.replace(b"GET", b"POST"), 405),
        (ASK.replace(b"/metrics", b"/"), 404),
        (ASK.replace(b"/metrics", b"/../../etc/passwd"), 404),
        (ASK.replace(b"127.0.0.1:1", b"evil.example"), 403),
        (ASK.replace(b"127.0.0.1:1", b"evil.example:9177"), 403),
        (ASK.replace(b"127.0.0.1:1", b"10.0.0.7"), 403),
        (b"GET /metrics HTTP/1.0\r\n\r\n", 200),
        (ASK.replace(b"127.0.0.1:1", b"[::1]:9177"), 200),
        (ASK.replace(b"127.0.0.1:1", b"[::1]"), 200),
        (ASK.replace(b"127.0.0.1:1", b"localhost"), 200),
        (ASK.replace(b"/metrics", b"/metrics?name[]=x"), 200),
    ],
)
def test_nothing_else_is(request_: bytes, status: int) -> None:
    async def body(server: MetricsServer, looks: list[int]) -> None:
        assert (await ask(server, request_))[0] == status
        assert server.refused == (status not in (200, 400))  # aiohttp itself refuses what is no HTTP
        assert (await ask(server))[0] == 200

    run(body)


def test_whoever_reaches_an_open_one_may_call_it_what_he_likes() -> None:
    async def body(server: MetricsServer, looks: list[int]) -> None:
        assert (await ask(server, ASK.replace(b"127.0.0.1:1", b"printer.example")))[0] == 200

    run(body, open=True)


def test_long_slow_and_many_connections_end() -> None:
    async def body(server: MetricsServer, looks: list[int]) -> None:
        status, _, _ = await ask(server, b"GET /metrics HTTP/1.1\r\nX: " + b"x" * 32_768)
        assert status in (0, 431)  # what was not read takes the answer away, or not
        begun_s = asyncio.get_running_loop().time()
        silent = [await asyncio.open_connection("127.0.0.1", server.port) for _ in range(CONNECTIONS_MAX)]
        assert await ask(server) == (0, "", "")
        for reader, writer in silent:
            assert await reader.read() == b""  # their time is over
            writer.close()
        assert asyncio.get_running_loop().time() == pytest.approx(begun_s + REQUEST_S)
        await asyncio.sleep(1)
        assert (await ask(server))[0] == 200
        assert server.refused == CONNECTIONS_MAX + 2

    run(body)


def test_where_it_may_be() -> None:
    async def opened(host: str, port: int = 0, **settings: Any) -> None:
        server = MetricsServer(dict, {}, MetricsSettings(host, port, **settings))
        try:
            await server.start()
        finally:
            await server.close()

    anywhere = "0.0.0.0"  # noqa: S104 (that is the question)
    with pytest.raises(CanductorError, match="could be read by all"):
        jump_loop.run(opened(anywhere))
    jump_loop.run(opened(anywhere, open=True))

    async def twice() -> None:
        server = MetricsServer(dict, {}, MetricsSettings("127.0.0.1", 0))
        await server.start()
        try:
            await opened("127.0.0.1", server.port)
        finally:
            await server.close()

    with pytest.raises(CanductorError, match=r"cannot be opened for metrics: .*in use"):
        jump_loop.run(twice())
