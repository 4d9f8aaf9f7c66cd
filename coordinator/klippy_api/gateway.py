"""The socket of the API: clients, the 0.25 s of their updates, what g-code answers (asyncio)."""

import asyncio
import contextlib
import socket
from collections import deque
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from coordinator.gcode.reply_kinds import ReplyKind, line_of
from coordinator.ipc.protocol.overtaken import doing
from coordinator.ipc.protocol.peer import may_use, peer_of
from coordinator.ipc.server.fair_scheduler import FairScheduler
from coordinator.ipc.server.stop_lane import StopLane
from coordinator.ipc.server.unix_socket import UnixListener
from coordinator.klippy_api.client import RUNNING_MAX, Client
from coordinator.klippy_api.endpoints import Endpoints, Result
from coordinator.klippy_api.subscription import Status, Subscription
from coordinator.klippy_api.wire import (
    Request,
    TooLongError,
    UnreadableError,
    UnwritableError,
    error_message,
    event_message,
    result_message,
)
from coordinator.service.core.machine_service import MachineService, ServiceState
from coordinator.service.state.log_ring import Entry
from nodes.support.errors import CanductorError

UPDATE_S: Final = 0.25
"""Between two updates of what clients watch."""
CLIENTS_MAX: Final = 64
CALLS_MAX: Final = 256
"""That run for all clients together, also for those that have left."""
OUTPUT_BYTES_MAX: Final = 4_194_304
"""A client with more unread is disconnected."""
BLOCKED_S: Final = 5.0
"""A client that reads nothing for so long is disconnected."""
LAST_MAX: Final = 64
"""Messages that look like stops and are looked at after their client has left."""
LINES_MAX: Final = 1_000
"""Of g-code's answers that wait to be sent together; of more the first are left out."""


LINES_CHARS_MAX: Final = 65_536
"""Likewise; the line that reaches it is the last one."""
LOOKS_MAX: Final = 16
"""That wait to be sent: with more the oldest are left out, and later ones have what they had."""


class Connection(asyncio.BufferedProtocol):
    """One client's end of the socket."""

    def __init__(self, gateway: "Gateway", scheduler: FairScheduler) -> None:
        self._gateway = gateway
        self._scheduler = scheduler
        self._loop = asyncio.get_running_loop()
        self._blocked: asyncio.TimerHandle | None = None
        self.client: Client
        self.transport: asyncio.Transport

    @property
    def writable(self) -> bool:
        """Whether the client reads."""
        return self._blocked is None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin, unless the client may not."""
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        opened = transport.get_extra_info("socket")
        pid, uid = (0, None) if opened is None else peer_of(opened)
        self.client = Client("a client" if uid is None else f"the client with pid {pid}")
        self._gateway.admit(self, uid)
        self._gateway.watch_stops(self, opened)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the client, after a stop that waits for its turn; what it has begun goes on."""
        del exc
        if self._blocked is not None:
            self._blocked.cancel()
        self._gateway.carry_out_stop(self)
        self._scheduler.remove(self)
        self._gateway.forget(self)

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return the shared buffer to receive into."""
        del sizehint
        return self._scheduler.received

    def buffer_updated(self, nbytes: int) -> None:
        """Process what was received."""
        self.receive(self._scheduler.received[:nbytes])

    def receive(self, data: bytes | memoryview) -> None:
        """Take DATA."""
        if not self.transport.is_closing():
            self.client.receive(data)
            self._scheduler.request_turn(self)

    def pause_writing(self) -> None:
        """Give the client some time to read."""
        self._blocked = self._loop.call_later(
            BLOCKED_S, self.drop, f"it has read nothing for {BLOCKED_S:g} s"
        )

    def resume_writing(self) -> None:
        """Take note that it reads."""
        if self._blocked is not None:
            self._blocked.cancel()
            self._blocked = None

    def pause(self) -> None:
        """Read no more until the next turn."""
        self.transport.pause_reading()

    def work(self, until_s: float) -> bool:
        """Begin what was asked for; return whether there is more."""
        while not self.transport.is_closing():
            try:
                request = self.client.next_request()
            except TooLongError as problem:
                self.drop(str(problem))
                return False
            except UnreadableError as problem:
                if self.client.dropped == 1:
                    self._gateway.notice(
                        f"{self.client.peer} of the Klippy API sent what is dropped: {problem}"
                    )
            else:
                if request is None:
                    self.transport.resume_reading()
                    return False
                self._gateway.call(self, request)
            if self.client.has_work and self._loop.time() >= until_s:
                self.pause()
                return True
        return False

    def send(self, data: bytes) -> None:
        """Send DATA, unless the client does not read."""
        if self.transport.is_closing():
            return
        self.transport.write(data)
        unread = self.transport.get_write_buffer_size()
        if unread > OUTPUT_BYTES_MAX:
            self.drop(f"it has not read {unread:,} bytes")

    def drop(self, why: str) -> None:
        """Disconnect the client."""
        if not self.transport.is_closing():
            self._gateway.notice(f"{self.client.peer} of the Klippy API was disconnected: {why}")
            self.transport.abort()


@dataclass(slots=True)
class _Look:
    """All objects at one moment, and who was watching then."""

    status: Status
    now_s: float
    watching: Sequence[tuple[Connection, Subscription | None]]
    encoded: tuple[Mapping[str, Any], Status, bytes] | None = None
    """What was sent last: template, changes, message."""


class Gateway:
    """Serves SERVICE, of the configuration file CONFIG; lives on the loop that starts it.

    ON_NOTICE gets sentences for the machine's owner.
    """

    def __init__(
        self,
        service: "MachineService",
        config: Path,
        *,
        on_notice: Callable[[str], None],
        stop_lane: StopLane | None = None,
        log_file: Path | None = None,
    ) -> None:
        self.notice = on_notice
        self._stop_lane = stop_lane or StopLane()
        self.endpoints = Endpoints(service, config, self.say, self.registered, log_file)
        service.programs.on_remote = self._call_remote
        self._service = service
        self._connections: dict[Connection, None] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._subscribed = asyncio.Event()
        """Whether any client may wait for updates."""
        self._updates: asyncio.Task[None] | None = None
        self._early: asyncio.Handle | None = None
        self._looks: deque[_Look] = deque(maxlen=LOOKS_MAX)
        """In the order in which they were taken; those that clients have not been sent."""
        self._sending: asyncio.Task[None] | None = None
        self._lines: list[str] = []
        self._lines_chars = 0
        self._starts = service.starts
        self._listener: UnixListener | None = None
        self._scheduler = FairScheduler()

    # ------------------------------------------------------------------------------------------- life

    async def start(self, path: Path | None) -> None:
        """Serve at PATH (None: at no socket, for clients that are adopted); raises CanductorError."""
        if path is not None:
            self._listener = UnixListener(self.make_connection, self._stop_lane, self._find_stop_of_new)
            await self._listener.open(path)
        self._updates = asyncio.get_running_loop().create_task(self._update())

    async def close(self) -> None:
        """Disconnect every client and close the socket."""
        for task in (self._updates, self._sending):
            if task is not None:
                task.cancel()
                await asyncio.gather(task, return_exceptions=True)
        if self._listener is not None:
            self._listener.close()
        self._close_all()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.sleep(0)

    def make_connection(self) -> Connection:
        """Return the protocol of a new client."""
        return Connection(self, self._scheduler)

    def note(self, entry: "Entry") -> None:
        """Take note of a line of the service's log: what g-code answers goes to clients."""
        if "output" in entry:
            self.say(line_of(ReplyKind(str(entry["output"])), str(entry["text"])))
        if entry["kind"] == "job" and self._early is None:
            # Moonraker follows a job by each state it is in: none may be gone by the time of the next update.
            self._early = asyncio.get_running_loop().call_soon(self._look_early)
        if self._service.starts != self._starts and self._service.state is ServiceState.STARTUP:
            # Clients read configuration and objects again only when they have to connect again.
            if self._starts:
                self._close_all()
            self._starts = self._service.starts

    def _close_all(self) -> None:
        for connection in list(self._connections):
            connection.transport.close()
        self._connections.clear()
        self.registered()

    # ---------------------------------------------------------------------------------------- clients

    def admit(self, connection: Connection, uid: int | None) -> None:
        """Take CONNECTION on, of the user with UID (None: it came by no socket)."""
        self._connections[connection] = None
        if uid is not None and not may_use(uid):
            connection.drop(f"the socket is not for the user with uid {uid}")
        elif len(self._connections) > CLIENTS_MAX:
            connection.drop(f"there are {CLIENTS_MAX} clients already")

    def watch_stops(self, connection: Connection, opened: socket.socket | None) -> None:
        """Look for stops in what the socket of CONNECTION has unread, while the loop is held."""
        if opened is None or connection.transport.is_closing():
            return
        client = connection.client
        self._stop_lane.watch(connection, opened, lambda unread: self._find_stop(client, unread))

    def _find_stop(self, client: Client, unread: bytes) -> str | None:
        stops = (self.endpoints.stops(request) for request in client.unread_calls(unread))
        return next((who for who in stops if who is not None), None)

    def _find_stop_of_new(self, opened: socket.socket, unread: bytes) -> str | None:
        if not unread or not may_use(peer_of(opened)[1]):  # without bytes it may have closed
            return None
        return self._find_stop(Client(""), unread)

    def forget(self, connection: Connection) -> None:
        """Take note that CONNECTION is over."""
        self._connections.pop(connection, None)
        self._stop_lane.forget(connection)
        self.registered()

    def call(self, connection: Connection, request: Request) -> None:
        """Begin REQUEST; it is answered when it is done."""
        with doing(overtaken=request.overtaken):
            self._begin(connection, request)

    def carry_out_stop(self, connection: Connection) -> None:
        """Stop the machine if CONNECTION, which is over, has asked for that and nobody has read it."""
        with contextlib.suppress(TooLongError):
            for _ in range(LAST_MAX):
                request = connection.client.next_urgent()
                if request is None:
                    return
                if self.endpoints.stops(request) is not None:
                    self.call(connection, request)
                    return

    def _begin(self, connection: Connection, request: Request) -> None:
        client = connection.client
        full = client.running >= RUNNING_MAX or len(self._tasks) >= CALLS_MAX
        if full and self.endpoints.stops(request) is None:
            self._fail(connection, request, "too many requests are being done; wait for their answers")
            return
        try:
            result = self.endpoints.begin(client, request)
            if not isinstance(result, Awaitable):
                self._succeed(connection, request, result)
        except Exception as error:  # noqa: BLE001 (a bug of one endpoint must not end the machine)
            self._fail(connection, request, self._sentence(request, error))
            return
        if client.listens:
            self._subscribed.set()
        if isinstance(result, Awaitable):
            client.running += 1
            task = asyncio.get_running_loop().create_task(self._finish(connection, request, result))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _finish(self, connection: Connection, request: Request, result: Awaitable[Result]) -> None:
        try:
            self._succeed(connection, request, await result)
        except Exception as error:  # noqa: BLE001 (as above)
            self._fail(connection, request, self._sentence(request, error))
        finally:
            connection.client.running -= 1

    @staticmethod
    def _succeed(connection: Connection, request: Request, result: Result) -> None:
        if request.id is not None:
            connection.send(result_message(request.id, result))

    @staticmethod
    def _fail(connection: Connection, request: Request, sentence: str) -> None:
        if request.id is not None:
            connection.send(error_message(request.id, sentence))

    @staticmethod
    def _sentence(request: Request, error: Exception) -> str:
        if isinstance(error, CanductorError):
            return str(error)
        name = request.method[:80]
        asyncio.get_running_loop().call_exception_handler(
            {"message": f"canductor: the endpoint {name} failed", "exception": error}
        )
        return f"{name} failed by a mistake of the program: {type(error).__name__}; please report it"

    # ---------------------------------------------------------------------------------- what they hear

    async def _update(self) -> None:
        while True:
            await self._subscribed.wait()
            await asyncio.sleep(UPDATE_S)
            self._look()
            if self._sending is not None:
                await self._sending
            with self._surviving():
                await self._send_steps()

    def _look_early(self) -> None:
        self._early = None
        self._look()

    def _look(self) -> None:
        """Look at all objects now; clients get what has changed in turns that follow."""
        waiting = [connection for connection in self._connections if connection.client.listens]
        if not waiting:
            self._subscribed.clear()
            return
        watching = [(connection, connection.client.subscription) for connection in waiting]
        with self._surviving():
            status = self.endpoints.status.build() if any(seen for _, seen in watching) else {}
            self._looks.append(_Look(status, self._service.now_s, watching))
        if self._sending is None or self._sending.done():
            self._sending = asyncio.get_running_loop().create_task(self._send_looks())

    @contextlib.contextmanager
    def _surviving(self) -> Iterator[None]:
        """Report what fails; updates go on."""
        try:
            yield
        except CanductorError:
            return  # it is stopped or closed in this moment: the next look finds how it is then
        except Exception as error:  # noqa: BLE001 (a bug of one module's status must not end all updates)
            asyncio.get_running_loop().call_exception_handler(
                {"message": "canductor: an update of the Klippy API failed", "exception": error}
            )

    async def _send_looks(self) -> None:
        """Send what was seen, one client in each turn of the loop."""
        while self._looks:
            look = self._looks.popleft()
            for connection, subscription in look.watching:
                with self._surviving():
                    await self._send_moves(connection)
                    # One that has subscribed again since then knows more than this.
                    if subscription is not None and connection.client.subscription is subscription:
                        self._send_changes(connection, subscription, look)
                await asyncio.sleep(0)

    def _send_changes(self, connection: Connection, subscription: Subscription, look: _Look) -> None:
        changed = subscription.changes(look.status) if connection.writable else {}
        if not changed:
            return
        # Clients that watch the same have the same changes: those are encoded once.
        if look.encoded is None or look.encoded[:2] != (subscription.template, changed):
            params = {"eventtime": look.now_s, "status": changed}
            try:
                message = event_message(subscription.template, params)
            except UnwritableError as error:
                self.notice(f"an update for {connection.client.peer} of the Klippy API was left out: {error}")
                return
            look.encoded = subscription.template, changed, message
        connection.send(look.encoded[2])

    async def _send_moves(self, connection: Connection) -> None:
        for dump in connection.client.move_dumps:
            motion, machine = self._service.motion, self._service.machine
            if motion is None or machine is None or machine.stopped is not None or not connection.writable:
                return
            rows = dump.take(motion.trace, motion.now_s, motion.planned.status.active)
            if rows:
                connection.send(event_message(dump.template, {"data": rows}))
                await asyncio.sleep(0)

    async def _send_steps(self) -> None:
        for connection in list(self._connections):
            for dump in connection.client.step_dumps:
                motion, machine = self._service.motion, self._service.machine
                if motion is None or machine is None or machine.stopped is not None:
                    return
                if connection.writable and (params := await dump.take(motion, machine)):
                    connection.send(event_message(dump.template, params))

    def say(self, text: str) -> None:
        """Show TEXT to all who listen to g-code, together with what else comes in this round of the loop."""
        if not any(connection.client.output is not None for connection in self._connections):
            return
        if not self._lines:
            asyncio.get_running_loop().call_soon(self._say_all)
        if len(self._lines) < LINES_MAX and self._lines_chars < LINES_CHARS_MAX:
            self._lines.append(text)
            self._lines_chars += len(text)

    def _say_all(self) -> None:
        text, self._lines, self._lines_chars = "\n".join(self._lines), [], 0
        for connection in list(self._connections):
            if connection.client.output is not None:
                connection.send(event_message(connection.client.output, {"response": text}))

    def registered(self) -> None:
        """Take note that what clients have registered may have changed."""
        names = (name for connection in self._connections for name in connection.client.remote_methods)
        self._service.programs.remote_methods = frozenset(names)

    def _call_remote(self, name: str, values: Mapping[str, object]) -> None:
        for connection in list(self._connections):
            template = connection.client.remote_methods.get(name)
            if template is not None:
                connection.send(event_message(template, values))
