"""The client for programs without a loop: the same calls, which wait."""

import asyncio
import contextlib
import threading
from collections.abc import AsyncGenerator, Coroutine, Generator, Iterable, Mapping
from concurrent.futures import Future
from typing import Any, Self, TypeVar

from coordinator.ipc.client.client import Client
from coordinator.ipc.client.feeds import Update
from coordinator.support.values import Value

T = TypeVar("T")


class BlockingClient:
    """``with BlockingClient(address) as client``; its connection lives on a loop in a thread of its own.

    OPTIONS are those of ``Client``; any thread may call.
    """

    def __init__(self, address: str | None = None, **options: Any) -> None:
        self._address = address
        self._options = options
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="canductor client", daemon=True)
        self._client: Client

    def __enter__(self) -> Self:
        self._thread.start()
        try:
            self._client = self._wait(self._enter())
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._wait(self._client.__aexit__())
        finally:
            self._end()

    def call(self, method: str, params: Mapping[str, Value] | None = None) -> Any:
        """Call METHOD with PARAMS and return its result; raises ApiError, ConnectionLost."""
        return self._wait(self._client.call(method, params))

    def begin(self, method: str, params: Mapping[str, Value] | None = None) -> Future[Any]:
        """Do the same without waiting: calls reach the machine in the order in which they were begun."""
        return asyncio.run_coroutine_threadsafe(self._client.call(method, params), self._loop)

    def watch(self, fields: Iterable[str] = ("*",), rate_hz: float = 10.0) -> Generator[Update, None, None]:
        """Yield updates as ``Client.watch`` does."""
        updates = self._client.watch(fields, rate_hz)
        try:
            while True:
                yield self._wait(_next(updates))
        finally:
            self._wait(_close(updates))

    async def _enter(self) -> Client:
        return await Client(self._address, **self._options).__aenter__()

    def _wait(self, work: Coroutine[Any, Any, T]) -> T:
        future = asyncio.run_coroutine_threadsafe(work, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        with contextlib.suppress(RuntimeError):
            self._loop.close()


async def _next(updates: AsyncGenerator[Update, None]) -> Update:
    return await anext(updates)


async def _close(updates: AsyncGenerator[Update, None]) -> None:
    await updates.aclose()
