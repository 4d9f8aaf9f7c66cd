"""The client of the interface: calls, watches and notifications; reconnects when the machine is back."""

import asyncio
import contextlib
import ssl
from collections.abc import AsyncGenerator, Coroutine, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

from coordinator.ipc.client.connect_errors import connect_error_sentence, refusal_sentence, tls_hint
from coordinator.ipc.client.feeds import Event, EventQueue, Update, Watch
from coordinator.ipc.protocol.address import read_address
from coordinator.ipc.protocol.limits import EndReason, Limits
from coordinator.ipc.protocol.messages import LENGTH_MAX, Encoder, Encoding, WireReader
from coordinator.ipc.protocol.methods import ApiError, Scope
from coordinator.ipc.protocol.peer import may_serve, peer_of
from coordinator.ipc.server.session_methods import API_VERSION
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

__all__ = ["Client", "ConnectionLost", "Event", "Hello", "Refused", "Update"]

READ_BYTES: Final = 65_536
RETRY_S: Final = (0.1, 0.2, 0.5, 1.0, 2.0)
"""Pauses between attempts to reconnect; the last one repeats."""
LIMITS: Final = Limits(message_bytes=LENGTH_MAX, nesting=32, items=2_000_000, message_timeout_s=30.0)
"""Of what a server sends: it is trusted more than a client is."""


class ConnectionLost(CanductorError):  # noqa: N818
    """The connection ended before the answer came: whether the call was carried out is not known."""


class Refused(ApiError):  # noqa: N818
    """The server ended the connection and said why; another attempt would end the same way."""


@dataclass(frozen=True, slots=True)
class Hello:
    """What the server said about itself and this client."""

    version: int
    session: int
    scope: Scope


class Client:
    """The machine at ADDRESS (see ``read_address``): ``async with Client(…) as client``.

    It lives on the loop that enters it. TLS: None trusts the certificates that this computer trusts.
    TIMEOUT_S: for connecting, and for calls while there is no connection. FIRST: a method that is called
    without waiting for the answer to the hello, so that an emergency stop is there even when nobody reads.
    Raises CanductorError for an invalid address; entering raises it when no machine answers there.

    When the connection is lost, calls under way raise ConnectionLost; watches and notifications go on as soon
    as the machine is back, watches with a snapshot; new calls wait for that, up to TIMEOUT_S.
    """

    def __init__(
        self,
        address: str | None = None,
        *,
        token: str | None = None,
        name: str = "",
        scope: Scope | None = None,
        tls: ssl.SSLContext | None = None,
        encoding: Encoding = Encoding.MSGPACK,
        timeout_s: float = 5.0,
        first: str | None = None,
    ) -> None:
        self.first: asyncio.Task[Any] | None = None
        """The answer to the call that was sent right behind the hello."""
        self._first = first
        self.address = read_address(address)
        self.hello: Hello | None = None
        """Of the connection that is open; None while there is none."""
        self._hello_params: dict[str, Value] = {"version": API_VERSION, "client": name}
        if token is not None:
            self._hello_params["token"] = token
        if scope is not None:
            self._hello_params["scope"] = scope.word
        self._tls = tls
        self._encoding = encoding
        self._timeout_s = timeout_s
        self._encoder = Encoder()
        self._reader: asyncio.StreamReader
        self._writer: asyncio.StreamWriter | None = None
        self._wire = WireReader(LIMITS, checked=False)
        self._last_id = 0
        self._answers: dict[int, asyncio.Future[Value]] = {}
        self._begun: dict[int, Watch] = {}  # by the id of the request that begins it
        self._watches: set[Watch] = set()
        self._event_queues: set[EventQueue] = set()
        self._connected = asyncio.Event()
        self._refusal: Refused | None = None
        self._keeper: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Self:
        try:
            async with asyncio.timeout(self._timeout_s):
                await self._open()
        except TimeoutError:
            await self._disconnect()
            raise ConnectionLost(f"{self.address} did not answer within {self._timeout_s:g} s") from None
        except CanductorError:
            await self._disconnect()
            raise
        self._keeper = asyncio.create_task(self._keep())
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._keeper is not None:
            self._keeper.cancel()
            for task in self._tasks:
                task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._keeper
        await self._disconnect()

    # ------------------------------------------------------------------------------------------ calls

    async def call(self, method: str, params: Mapping[str, Value] | None = None) -> Any:
        """Call METHOD with PARAMS and return its result; cancelling this cancels the call in the machine.

        Raises ApiError as the machine does, ConnectionLost.
        """
        await self._wait_connected()
        return await self._ask(method, params or {})

    async def _wait_connected(self) -> None:
        if self._connected.is_set():
            return
        try:
            async with asyncio.timeout(self._timeout_s):
                await self._connected.wait()
        except TimeoutError:
            raise ConnectionLost(f"{self.address} is not connected; waited {self._timeout_s:g} s") from None
        if self._refusal is not None:
            raise self._refusal.with_traceback(None)

    async def _ask(self, method: str, params: Mapping[str, Value], begins: Watch | None = None) -> Any:
        assert self._writer is not None
        self._last_id += 1
        request_id = self._last_id
        try:
            data = self._encoder.message(
                self._encoding, {"id": request_id, "method": method, "params": dict(params)}
            )
        except ValueError as error:
            raise ApiError("bad_params", f"{method}: the parameters cannot be sent: {error}") from None
        answer = self._answers[request_id] = asyncio.get_running_loop().create_future()
        try:
            if begins is not None:
                self._begun[request_id] = begins
            self._writer.write(data)
            await self._writer.drain()
            return await answer
        except OSError as error:
            raise ConnectionLost(f"{self.address} is gone: {error.strerror or error}") from None
        except asyncio.CancelledError:
            self._send("api.cancel", {"id": request_id})
            raise
        finally:
            answer.cancel()
            self._answers.pop(request_id, None)
            self._begun.pop(request_id, None)

    def _send(self, method: str, params: dict[str, Value]) -> None:
        """Send a request that gets no answer."""
        if self._writer is not None and not self._writer.is_closing():
            self._writer.write(self._encoder.message(self._encoding, {"method": method, "params": params}))

    # ----------------------------------------------------------------------------------------- feeds

    async def watch(
        self, fields: Iterable[str] = ("*",), rate_hz: float = 10.0
    ) -> AsyncGenerator[Update, None]:
        """Yield fields that match the globs FIELDS: a snapshot, then changes, RATE_HZ times a second.

        Updates that come while the last one is looked at are merged. Raises ApiError, ConnectionLost.
        """
        watch = Watch(list(fields), rate_hz)
        await self._wait_connected()
        await self._begin_watch(watch)
        self._watches.add(watch)
        try:
            while True:
                yield await watch.next()
        finally:
            self._watches.discard(watch)
            if watch.number is not None:
                self._send("api.unwatch", {"subscription": watch.number})

    async def events(self, names: Iterable[str] = ("*",)) -> AsyncGenerator[Event, None]:
        """Yield the notifications that match the globs NAMES; when not taken, the oldest are dropped."""
        queue = EventQueue(tuple(names))
        self._event_queues.add(queue)
        try:
            await self._wait_connected()
            await self._listen()
            while True:
                yield await queue.next()
        finally:
            self._event_queues.discard(queue)

    async def _begin_watch(self, watch: Watch) -> None:
        watch.number = None
        await self._ask("api.watch", {"fields": list(watch.fields), "rate_hz": watch.rate_hz}, watch)

    async def _listen(self) -> None:
        names = sorted({name for queue in self._event_queues for name in queue.names})
        await self._ask("api.listen", {"events": list(names)})

    # ------------------------------------------------------------------------------------- connection

    async def _open(self) -> None:
        """Connect and say hello; raises CanductorError."""
        address = self.address
        try:
            if address.path is not None:
                self._reader, self._writer = await asyncio.open_unix_connection(str(address.path))
            else:
                tls = (self._tls or ssl.create_default_context()) if address.tls else None
                self._reader, self._writer = await asyncio.open_connection(
                    address.host, address.port, ssl=tls
                )
        except (OSError, ValueError) as error:
            raise ConnectionLost(connect_error_sentence(address, error)) from None
        if address.path is not None:
            self._check_server(self._writer)
        self._wire = WireReader(LIMITS, checked=False)
        hello = asyncio.create_task(self._ask("api.hello", self._hello_params))
        if self._first is not None:
            self.first = asyncio.create_task(self._ask(self._first, {}))
            self._first = None
        try:
            while not hello.done():
                await self._read_some(tls_hint(address))
                await asyncio.sleep(0)
            answer = hello.result()
        finally:
            hello.cancel()
        self.hello = Hello(answer["version"], answer["session"], Scope[answer["scope"].upper()])
        self._connected.set()

    def _check_server(self, writer: asyncio.StreamWriter) -> None:
        """Raise ConnectionLost when a stranger has taken the place of the machine at the Unix socket."""
        _, uid = peer_of(writer.get_extra_info("socket"))
        if not may_serve(uid):
            raise ConnectionLost(
                f"{self.address} is served by the user with uid {uid}, neither by this user nor by root;"
                " nothing was sent"
            )

    async def _keep(self) -> None:
        """Read while there is a connection, and reconnect when it is lost."""
        while True:
            with contextlib.suppress(ConnectionLost):
                while True:
                    await self._read_some()
            await self._disconnect()
            if not await self._reconnect():
                return

    async def _reconnect(self) -> bool:
        """Reconnect, and resume watches and notifications; return False when that is refused."""
        attempt = 0
        while True:
            await asyncio.sleep(RETRY_S[min(attempt, len(RETRY_S) - 1)])
            attempt += 1
            try:
                async with asyncio.timeout(self._timeout_s):
                    await self._open()
            except (ConnectionLost, TimeoutError):
                await self._disconnect()
                continue
            except ApiError as error:
                await self._disconnect()
                self._refuse(error)
                return False
            self._spawn(self._resume())
            return True

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _resume(self) -> None:
        for watch in list(self._watches):
            await self._resume_watch(watch)
        if self._event_queues:
            with contextlib.suppress(ConnectionLost):  # the next connection listens again
                await self._listen()

    async def _resume_watch(self, watch: Watch) -> None:
        try:
            await self._begin_watch(watch)
        except ConnectionLost:
            pass  # the next connection begins it again
        except ApiError as error:
            watch.fail(error)

    def _refuse(self, error: ApiError) -> None:
        self._refusal = Refused(error.code, error.sentence)
        self._connected.set()  # so that nobody waits
        for watch in self._watches:
            watch.fail(self._refusal)
        for queue in self._event_queues:
            queue.fail(self._refusal)

    async def _disconnect(self) -> None:
        self._connected.clear()
        self.hello = None
        writer, self._writer = self._writer, None
        for answer in self._answers.values():
            if not answer.done():
                answer.set_exception(ConnectionLost(f"{self.address} is gone, the answer did not come"))
        if writer is not None:
            writer.close()
            with contextlib.suppress(OSError, ssl.SSLError):
                await writer.wait_closed()

    # ---------------------------------------------------------------------------------------- reading

    async def _read_some(self, addition: str = "") -> None:
        """Take what comes next; raises ConnectionLost. ADDITION: to be added when the server says nothing."""
        try:
            data = await self._reader.read(READ_BYTES)
        except OSError as error:
            raise ConnectionLost(f"{self.address} is gone{addition}: {error.strerror or error}") from None
        if not data:
            raise ConnectionLost(f"{self.address} has closed the connection{addition}")
        self._wire.feed(data, 0.0)
        while (message := self._wire.next_message()) is not None:
            if isinstance(message, EndReason):
                raise ConnectionLost(f"{self.address} sent an invalid message: {message.sentence}")
            self._handle_message(message)

    def _handle_message(self, message: dict[str, Any]) -> None:
        if "event" in message:
            self._handle_event(message)
            return
        failure: ApiError | None = None
        if "error" in message:
            error = message["error"]
            failure = ApiError(str(error.get("code")), str(error.get("message")))
        if "id" not in message:
            if failure is not None:
                self._fail_answers(failure)
            return
        answer = self._answers.get(message["id"])
        if answer is None or answer.done():
            return
        if failure is not None:
            answer.set_exception(failure)
            return
        result: Any = message.get("result")
        if (watch := self._begun.get(message["id"])) is not None:
            watch.begin(
                result["subscription"], result["sequence"], result["values"]
            )  # its updates may follow
        answer.set_result(result)

    def _fail_answers(self, fault: ApiError) -> None:
        """Fail all calls under way, for the reason that the server gave."""
        sentence = refusal_sentence(self.address, fault)
        refused = ConnectionLost(sentence) if fault.code == "closing" else Refused(fault.code, sentence)
        for answer in self._answers.values():
            if not answer.done():
                answer.set_exception(refused)

    def _handle_event(self, message: dict[str, Any]) -> None:
        if message["event"] != "state":
            event = Event(message["event"], message.get("values", {}))
            for queue in self._event_queues:
                queue.put(event)
            return
        for watch in self._watches:
            if watch.number == message["subscription"] and not watch.take(message):
                self._send("api.unwatch", {"subscription": watch.number})
                self._spawn(self._resume_watch(watch))
