"""One client's socket: moves bytes between it and its session, and calls methods (asyncio)."""

import asyncio
import select
import socket
from collections.abc import Awaitable, Callable
from typing import Final

from coordinator.ipc.protocol.methods import ApiError
from coordinator.ipc.protocol.overtaken import doing
from coordinator.ipc.server.fair_scheduler import FairScheduler
from coordinator.ipc.server.session import Request, Session
from coordinator.support.values import Value
from nodes.support.errors import CanductorError

REQUESTS_PER_TURN: Final = 64
"""Requests of one client that are called before others get their turn."""
UNREAD_BYTES: Final = 65_536
"""From so many on no more is read for a client that waits for its turn. With less, the calls of the system
to stop and to go on would cost as much as a request."""
LINGER_S: Final = 2.0
"""For a client that is cut off to take the reason. What it still sends is read and dropped meanwhile: closing
a socket with unread bytes in it would reset it, and the reason would be lost."""
HANG_UP_CHECK_S: Final = 0.5
"""Between looks at whether a client that has closed its side is still there for its answers."""


class Connection(asyncio.BufferedProtocol):
    """A client; ADMIT makes its session once it is there, ON_LOST is called when it has left.

    ON_GONE is called behind that, once no stop can be in what it had sent.
    """

    def __init__(
        self,
        admit: Callable[[asyncio.Transport, "Connection"], Session],
        on_lost: Callable[["Connection"], None],
        on_gone: Callable[["Connection"], None],
        scheduler: FairScheduler,
    ) -> None:
        self._admit = admit
        self._on_lost = on_lost
        self._on_gone = on_gone
        self._scheduler = scheduler
        self._loop = asyncio.get_running_loop()
        self._tasks: dict[Request, asyncio.Task[None]] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._linger: asyncio.TimerHandle | None = None
        self._half_closed = False
        self._ended = False
        self._lost = False
        self.session: Session
        self.transport: asyncio.Transport

    # ----------------------------------------------------------------------- asyncio.BufferedProtocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin."""
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self.session = self._admit(transport, self)
        self.transport.set_write_buffer_limits(high=self.session.context.limits.output_bytes)
        self._request_turn()

    def get_buffer(self, sizehint: int) -> memoryview:
        """Return the shared buffer to receive into: one for each message would double the cost."""
        del sizehint
        return self._scheduler.received

    def buffer_updated(self, nbytes: int) -> None:
        """Process what was received."""
        self.receive(self._scheduler.received[:nbytes])

    def receive(self, data: bytes | memoryview) -> None:
        """Take DATA."""
        self._request_turn(urgent=self.session.receive(data, self._loop.time()))

    def eof_received(self) -> bool:
        """Answer what was requested before the client closed its side; on TCP this counts as leaving."""
        if self._ended or self._has_left():
            return False
        self._half_closed = True
        self._request_turn()
        self._check_hang_up()
        return not self.transport.is_closing()

    def _has_left(self) -> bool:
        opened = self.transport.get_extra_info("socket")
        if opened.family != socket.AF_UNIX:
            return True
        poll = select.poll()
        poll.register(opened.fileno(), 0)
        return any(events & select.POLLHUP for _, events in poll.poll(0))

    def _check_hang_up(self) -> None:
        if self.transport.is_closing():
            return
        if self._has_left():
            self.transport.abort()
            return
        self._linger = self._loop.call_later(HANG_UP_CHECK_S, self._check_hang_up)

    def notify(self, event: str, data: bytes) -> None:
        """Send DATA, the notification EVENT as this client writes, in its turn of a round to come."""
        self.session.notify(event, data)
        if not self.transport.is_closing():
            self._scheduler.request_later(self)

    def pause_writing(self) -> None:
        """Stop sending: the client does not read."""
        self.session.writable = False

    def resume_writing(self) -> None:
        """Go on."""
        self.session.writable = True
        self._loop.call_soon(self._request_turn)  # asyncio would end twice what is closed in here

    def connection_lost(self, exc: Exception | None) -> None:
        """End everything that still runs for the client; a stop that is unread is done in its turn."""
        del exc
        self._lost = True
        for handle in (self._timer, self._linger):
            if handle is not None:
                handle.cancel()
        self._timer = self._linger = None
        for task in self._tasks.values():
            task.cancel()
        if (caller := self.session.caller) is not None:
            for leave in caller.at_end:
                leave(caller)
        self._on_lost(self)
        if self.session.skip_to_stop():
            self._scheduler.request_turn(self)
        else:
            self.forget_rest()

    def forget_rest(self) -> None:
        """Read no more of what a client has sent that has left."""
        self._scheduler.remove(self)
        self._on_gone(self)

    # ------------------------------------------------------------------------------------------- work

    def _request_turn(self, *, urgent: bool = False) -> None:
        if not self.transport.is_closing():
            self._scheduler.request_turn(self, urgent=urgent)

    def pause(self) -> None:
        """Read no more until the next turn, if enough is unread."""
        if self.session.unread_bytes >= UNREAD_BYTES and not self._half_closed:
            self.transport.pause_reading()

    def work(self, until_s: float) -> bool:
        """Do the work there is, at most until UNTIL_S; return whether there is more."""
        if self._lost:
            return self._read_rest()
        session, now_s = self.session, self._loop.time()
        for request in session.read(now_s) if session.should_read else ():
            self._call(request)
        self._work_off(until_s, now_s)
        for request in session.take_cancelled():
            if request in self._tasks:
                self._tasks[request].cancel()
        if self._timer is None:  # it has fired, or there was none
            session.handle_timer(now_s)
        self.flush()
        more = session.has_work
        if self.transport.is_closing():
            return False
        if more:
            self.pause()
        elif not self._half_closed:
            self.transport.resume_reading()
        return more

    def _read_rest(self) -> bool:
        """Read on for a client that has left; return whether there is more that may be a stop."""
        session, before, more = self.session, self.session.unread_bytes, False
        try:
            for request in session.read(self._loop.time()):
                self._call(request)
            more = session.unread_bytes < before and session.skip_to_stop()
        finally:
            if not more:
                self._on_gone(self)
        return more

    def _work_off(self, until_s: float, now_s: float) -> None:
        for _ in range(REQUESTS_PER_TURN):
            waiting = self.session.next_request()
            if waiting is None:
                return
            self._perform(waiting, now_s)
            if self._loop.time() >= until_s:
                return

    def flush(self) -> None:
        """Send what the session has to send, as far as the client reads."""
        session, transport = self.session, self.transport
        if transport.is_closing() or self._ended:
            return
        if (session.writable or session.end_reason is not None) and (data := session.take_output()):
            transport.write(data)
        if session.end_reason is not None:
            self._cut_off()
        elif self._half_closed and session.is_idle:
            transport.close()
        else:
            self._set_timer()

    def _cut_off(self) -> None:
        """Give the client a moment to receive the reason, then close."""
        self._ended = True
        for task in self._tasks.values():
            task.cancel()
        try:
            if self.transport.can_write_eof() and not self._half_closed:
                self.transport.write_eof()
            else:
                self.transport.close()
        except OSError:  # it has left already
            self.transport.abort()
        self._linger = self._loop.call_later(LINGER_S, self.transport.abort)

    def _set_timer(self) -> None:
        deadline_s = self.session.next_deadline()
        if deadline_s is None or (self._timer is not None and self._timer.when() <= deadline_s):
            return  # one that is early finds nothing to do, and sets the next
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_at(deadline_s, self._handle_timer)

    def _handle_timer(self) -> None:
        self._timer = None
        self._request_turn()  # the updates of many clients are due at one instant

    # ---------------------------------------------------------------------------------------- methods

    def _perform(self, request: Request, now_s: float) -> None:
        """Have the session perform REQUEST, or call its method."""
        try:
            is_done = self.session.perform(request, now_s)
        except Exception as error:  # noqa: BLE001 (as below)
            self._fail(request, error)
        else:
            if not is_done:
                self._call(request)

    def _call(self, request: Request) -> None:
        with doing(overtaken=request.overtaken):
            self._begin(request)

    def _begin(self, request: Request) -> None:
        caller = self.session.caller
        assert caller is not None
        try:
            result = request.method.call(caller, request.params)
        except Exception as error:  # noqa: BLE001 (a bug of one method must not end the machine; it is reported)
            self._fail(request, error)
            return
        if isinstance(result, Awaitable):
            task = self._loop.create_task(self._finish(request, result))
            self._tasks[request] = task
            task.add_done_callback(lambda task: self._check_begun(task, request, result))
        else:
            self.session.answer(request, result)

    def _check_begun(self, task: asyncio.Task[None], request: Request, result: Awaitable[Value]) -> None:
        """End REQUEST when its TASK was cancelled before its first step, unheard by ``_finish``."""
        if not task.cancelled():
            return
        if asyncio.iscoroutine(result):
            result.close()
        del self._tasks[request]
        self.session.fail(request, ApiError("cancelled", f"{request.method.name} was cancelled"))
        self._request_turn()

    async def _finish(self, request: Request, result: Awaitable[Value]) -> None:
        try:
            self.session.answer(request, await result)
        except asyncio.CancelledError:
            self.session.fail(request, ApiError("cancelled", f"{request.method.name} was cancelled"))
        except Exception as error:  # noqa: BLE001 (as above)
            self._fail(request, error)
        del self._tasks[request]
        if not self.transport.is_closing():
            self._request_turn()

    def _fail(self, request: Request, error: Exception) -> None:
        name = request.method.name
        if isinstance(error, ApiError):
            self.session.fail(request, error)
        elif isinstance(error, CanductorError):
            self.session.fail(request, ApiError("failed", str(error)))
        else:
            sentence = f"{name} failed by a mistake of the program: {type(error).__name__}; please report it"
            self.session.fail(request, ApiError("internal", sentence))
            self._loop.call_exception_handler(
                {"message": f"canductor: the method {name} failed", "exception": error}
            )
