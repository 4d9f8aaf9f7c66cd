"""The HTTP server under the page and the metrics; its limits are tested there, as users meet them."""

import asyncio
import gc
from http import HTTPStatus

from aiohttp import web

from coordinator.web.http_server import HttpServer, _Handler
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
