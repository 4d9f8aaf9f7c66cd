"""One client as the server sees it; sans-IO: bytes and times in, requests and bytes out.

The way of a request: ``receive`` takes bytes, ``read`` turns some of them into requests and returns the
urgent ones, ``next_request`` gives the others in order, and ``perform``, ``answer`` or ``fail`` ends each.
Messages to the client wait for ``take_output``. While the client does not read (``writable`` is False)
requests wait, updates merge and notifications are dropped, but reading never stops: behind whatever waits
there may be an emergency stop.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from coordinator.ipc.protocol.limits import EndReason, Limits
from coordinator.ipc.protocol.messages import Encoding, WireReader
from coordinator.ipc.protocol.methods import ApiError, Caller, Method, Registry, Scope, shown
from coordinator.ipc.server import session_methods
from coordinator.ipc.server.auth import Grant
from coordinator.ipc.server.publisher import Publisher, Subscription
from coordinator.ipc.server.state import FieldFilter
from coordinator.support.values import Value

MESSAGES_PER_TURN: Final = 64
"""Messages taken from the bytes before others get their turn."""
BYTES_PER_TURN: Final = 65_536
"""Likewise; the message that reaches it is the last one."""
ID_MAX: Final = 2**53 - 1
"""Every JSON library can carry it exactly."""
METHOD_LENGTH_MAX: Final = 128
_ESCAPE: Final = b"\\"
"""JSON can write each character in another way behind it."""
PHASES: Final = 8
"""Watchers of one rate are spread over so many groups, or all updates would be due at one instant."""


@dataclass(slots=True, eq=False)
class Request:
    """A request with its parameters, checked. ID is None when no answer is wanted.

    IGNORED: what was wrong with an urgent one, which is carried out all the same; empty: nothing.
    URGENT: it is called at once; so is what stops the machine by its parameters.
    OVERTAKEN: an urgent one came behind it and was called first.
    """

    id: int | None
    method: Method
    params: dict[str, Any]
    ignored: str = ""
    urgent: bool = False
    overtaken: bool = False


@dataclass(slots=True)
class SessionCounters:
    """Counters of a client's messages."""

    requests: int = 0
    failed: int = 0
    refused_busy: int = 0
    updates: int = 0
    updates_skipped: int = 0
    notifications_dropped: int = 0
    bytes_out: int = 0


@dataclass(frozen=True, slots=True)
class SessionContext:
    """What all sessions of a server share."""

    registry: Registry
    publisher: Publisher
    limits: Limits


def _to_the_end() -> bool:
    return True


class Session:
    """One client. PEER names it for people; GRANTED is what it may do without a token.

    CHECK_TOKEN is None where there are no tokens; FIND_TOKEN does the same in any thread, and counts nothing.
    Times are seconds of one clock.
    """

    def __init__(
        self,
        context: SessionContext,
        now_s: float,
        *,
        number: int,
        peer: str,
        granted: Scope | None,
        check_token: Callable[[str], Grant | None] | None = None,
        find_token: Callable[[str], Grant | None] | None = None,
    ) -> None:
        self.context = context
        self.number = number
        self.peer = peer
        self.granted = granted
        self.check_token = check_token
        self._find_token = find_token
        self.caller: Caller | None = None
        """None until the hello."""
        self.end_reason: EndReason | None = None
        """Why the session has ended; the last message to the client has it."""
        self.writable = True
        """Whether the client takes what is sent; set by the driver."""
        self.counters = SessionCounters()
        self.subscriptions: dict[int, Subscription] = {}
        self.listens = FieldFilter(())
        self._limits = context.limits
        self._encoder = context.publisher.encoder
        self._reader = WireReader(context.limits)
        self._reader.message_bytes_max = min(context.limits.hello_bytes, context.limits.message_bytes)
        self._hello_until_s = now_s + context.limits.message_timeout_s
        self._waiting: deque[Request] = deque()
        self._running: set[Request] = set()
        self._cancelled: list[Request] = []
        self._ids: dict[int, Request] = {}
        self._out: list[bytes] = []
        self._out_bytes = 0
        self._notifications: deque[bytes] = deque()
        self._lost = 0  # notifications, since the last "api.lost"
        self._last_subscription = 0

    # ------------------------------------------------------------------------------------------- time

    def next_deadline(self) -> float | None:
        """Return when ``handle_timer`` has something to do."""
        if self.end_reason is not None:
            return None
        times = [subscription.next_s for subscription in self.subscriptions.values()]
        if self.caller is None:
            times.append(self._hello_until_s)
        if (deadline_s := self._reader.next_deadline()) is not None:
            times.append(deadline_s)
        return min(times, default=None)

    def handle_timer(self, now_s: float) -> None:
        """Send what is due, end what took too long."""
        if self.end_reason is not None:
            return
        if (reason := self._reader.handle_timer(now_s)) is not None:
            self.end(reason)
            return
        if self.caller is None and now_s >= self._hello_until_s:
            self.end(EndReason("timeout", f"no api.hello within {self._limits.message_timeout_s:g} s"))
            return
        for subscription in self.subscriptions.values():
            if now_s >= subscription.next_s:
                self._send_update(subscription)
                subscription.schedule(now_s)

    def _send_update(self, subscription: Subscription) -> None:
        if self.congested:
            subscription.skipped += 1
            self.counters.updates_skipped += 1
            return
        update = subscription.update(self.context.publisher, self.encoding)
        if update is not None:
            self.counters.updates += 1
            self._put(update)

    # ------------------------------------------------------------------------------------------ bytes

    @property
    def encoding(self) -> Encoding:
        """How the client writes; JSON until it has written."""
        return self._reader.encoding or Encoding.JSON

    @property
    def congested(self) -> bool:
        """Whether the client is behind with reading."""
        return not self.writable or self._out_bytes > self._limits.output_bytes

    @property
    def unread_bytes(self) -> int:
        """Bytes that wait for ``read``."""
        return self._reader.waiting_bytes

    @property
    def output_bytes(self) -> int:
        """Bytes that wait for ``take_output``."""
        return self._out_bytes

    def receive(self, data: bytes | memoryview, now_s: float) -> bool:
        """Take DATA that has arrived; ``read`` looks at it. Return whether it seems to be a stop."""
        before = self._reader.waiting_bytes
        self._reader.feed(data, now_s)
        if self.caller is None:
            return False
        words = self.context.registry.stop_words[self.caller.scope]
        return bool(words) and self._reader.find(words, before) >= 0

    def take_output(self) -> bytes:
        """Return what to send, in order."""
        self._move_notifications()
        data = b"".join(self._out)
        self._out.clear()
        self._out_bytes = 0
        self.counters.bytes_out += len(data)
        return data

    def _put(self, data: bytes) -> None:
        if self._out_bytes + len(data) > self._limits.output_bytes_max:
            self._out.clear()  # it would not be read
            self._out_bytes = 0
            self.end(EndReason("not_reading", "answers are not read; read them, or ask less"))
            return
        self._out.append(data)
        self._out_bytes += len(data)

    def _send(self, message: dict[str, Value]) -> None:
        self._put(self._encoder.message(self.encoding, message))

    def end(self, reason: EndReason) -> None:
        """End the session and send the client the reason."""
        if self.end_reason is not None:
            return
        self.end_reason = reason
        self._waiting.clear()
        self._notifications.clear()
        self.subscriptions.clear()
        self._send({"error": {"code": reason.code, "message": reason.sentence}})

    # ------------------------------------------------------------------------------ while the loop is held

    def find_stop(self, unread: bytes, goes_on: Callable[[], bool] = _to_the_end) -> str | None:
        """Return who stops the machine with what waits here and with the UNREAD bytes behind it; else None.

        In any thread; the session stays as it is. A twin of it reads the messages that may be a stop, so that
        rights are the same; after each ``read`` of it GOES_ON returns whether there is time for more.
        """
        if self.end_reason is not None or not (unread or self._reader.waiting_bytes):
            return None
        twin = Session(self.context, 0.0, number=self.number, peer=self.peer, granted=self.granted)
        twin.check_token = self._find_token
        twin.caller, twin._reader = self.caller, self._reader.copy()
        twin._reader.feed(unread, 0.0)
        while twin.skip_to_stop():
            before = twin.unread_bytes
            for request in twin.read(0.0):
                assert twin.caller is not None
                if (who := request.method.stops(twin.caller, request.params)) is not None:
                    return who
            twin._waiting.clear()
            twin._ids.clear()
            if twin.unread_bytes == before or not goes_on():
                break
        return None

    def skip_to_stop(self) -> bool:
        """Drop unread messages before the first one that may stop the machine; return whether there is one.

        They get no answer. Before the hello nothing is dropped.
        """
        scope = Scope.ADMIN if self.caller is None else self.caller.scope
        words = self.context.registry.stop_words[scope]
        if not words or self.end_reason is not None:
            return False
        at = self._reader.find((*words, _ESCAPE))
        if self.caller is not None and at >= 0:
            self._reader.skip_to(at)
        return at >= 0

    # --------------------------------------------------------------------------------------- requests

    def read(self, now_s: float) -> list[Request]:
        """Turn a bounded part of the bytes into requests; return the urgent ones, to be called at once."""
        urgent: list[Request] = []
        stop_at = self._reader.waiting_bytes - BYTES_PER_TURN
        for _ in range(MESSAGES_PER_TURN):
            if self.end_reason is not None:
                break
            message = self._reader.next_message()
            if isinstance(message, EndReason):
                self.end(message)
            elif message is None:
                break
            else:
                self._handle_message(message, urgent, now_s)
            if self._reader.waiting_bytes <= stop_at:
                break
        return urgent

    @property
    def has_work(self) -> bool:
        """Whether ``read`` or ``next_request`` may have more at once."""
        if self.end_reason is not None:
            return False
        unread = self._reader.waiting_bytes > 0 and self._reader.next_deadline() is None
        return unread or (bool(self._waiting) and self._may_start)

    @property
    def should_read(self) -> bool:
        """Whether it is time for ``read``: not while half of all that may wait does, and can be started."""
        return not self._may_start or 2 * len(self._waiting) < self._limits.pending_requests

    @property
    def is_idle(self) -> bool:
        """Whether nothing the client has asked for is without answer."""
        return not self._waiting and not self._running and not self.has_work

    @property
    def _may_start(self) -> bool:
        return len(self._running) < self._limits.running_requests and not self.congested

    def next_request(self) -> Request | None:
        """Return the next request to ``perform`` or call, None while there is none or none may start."""
        if not self._waiting or not self._may_start or self.end_reason is not None:
            return None
        request = self._waiting.popleft()
        self._running.add(request)
        return request

    def perform(self, request: Request, now_s: float) -> bool:
        """Perform and answer REQUEST if it is the session's own; return whether it was."""
        own = session_methods.HANDLERS.get(request.method.name)
        if own is not None:
            self._perform(request, own, now_s)
        return own is not None

    def take_cancelled(self) -> list[Request]:
        """Return the running requests that the client has cancelled meanwhile."""
        cancelled, self._cancelled = self._cancelled, []
        return cancelled

    def answer(self, request: Request, result: Value) -> None:
        """End REQUEST with its RESULT."""
        self._forget(request)
        if request.id is None or self.end_reason is not None:
            return
        if request.ignored and isinstance(result, dict):
            result = result | {"ignored": request.ignored}
        try:
            self._send({"id": request.id, "result": result})
        except ValueError as error:
            name = request.method.name
            self.fail(request, ApiError("internal", f"{name} has a result that cannot be sent: {error}"))

    def fail(self, request: Request, error: ApiError) -> None:
        """End REQUEST with ERROR."""
        self._forget(request)
        self._refuse(request.id, error)

    def _forget(self, request: Request) -> None:
        self._running.discard(request)
        if request.id is not None and self._ids.get(request.id) is request:
            del self._ids[request.id]

    def _refuse(self, request_id: int | None, error: ApiError) -> None:
        self.counters.failed += 1
        if request_id is not None and self.end_reason is None:
            self._send({"id": request_id, "error": {"code": error.code, "message": error.sentence}})

    def _handle_message(self, message: dict[str, Any], urgent: list[Request], now_s: float) -> None:
        request_id, name = message.get("id"), message.get("method")
        if type(name) is not str:
            self.end(EndReason("bad_message", "a request must be a map with method, and with id and params"))
            return
        if len(name) > METHOD_LENGTH_MAX:
            self.end(
                EndReason("bad_message", f"the name of a method has at most {METHOD_LENGTH_MAX} characters")
            )
            return
        is_id = request_id is None or (type(request_id) is int and 0 <= request_id <= ID_MAX)
        if not is_id and not self._is_urgent(name):
            self._end_for_id(request_id)
            return
        self.counters.requests += 1
        try:
            request = self._request(request_id if is_id else None, name, message.get("params"))
        except ApiError as error:
            self._refuse(request_id, error)
            if self.caller is None:
                self.end(EndReason(error.code, error.sentence))
            return
        self._dispatch(request, urgent, now_s)
        if not is_id:
            self._end_for_id(request_id, f"; {name} was carried out all the same")

    def _end_for_id(self, request_id: object, addition: str = "") -> None:
        sentence = f"an id is a whole number from 0 to 2^53 - 1, not {shown(request_id)}{addition}"
        self.end(EndReason("bad_message", sentence))

    def _is_urgent(self, name: str) -> bool:
        try:
            return self._method(name).urgent
        except ApiError:
            return False

    def _request(self, request_id: int | None, name: str, params: object) -> Request:
        """Return the request; an urgent one whatever is wrong with it, if the client may. Raises ApiError."""
        method = self._method(name)
        taken = ""
        if request_id is not None and request_id in self._ids:
            taken = f"the id {request_id} is that of a request without answer yet"
        usable, wrong = method.check_urgent(params) if method.urgent else (method.check(params), "")
        urgent = method.urgent or (self.caller is not None and method.stops(self.caller, usable) is not None)
        if taken and not urgent:
            raise ApiError("bad_params", taken)
        return Request(request_id, method, usable, "; ".join(filter(None, (taken, wrong))), urgent)

    def _method(self, name: str) -> Method:
        """Return the method NAME if this client may call it now; raises ApiError."""
        if self.caller is None and name != session_methods.HELLO:
            raise ApiError("no_hello", "the first request must be api.hello")
        method = self.context.registry.methods.get(name)
        if method is None:
            raise ApiError("no_such_method", f"there is no method {shown(name)}; api.methods lists them")
        if self.caller is not None and method.scope > self.caller.scope:
            needed, has = method.scope.word, self.caller.scope.word
            raise ApiError("not_allowed", f"{name} needs the scope {needed}, this client has {has}")
        return method

    def _dispatch(self, request: Request, urgent: list[Request], now_s: float) -> None:
        """Put REQUEST where it belongs: done at once, urgent, or waiting."""
        immediate = session_methods.IMMEDIATE_HANDLERS.get(request.method.name)
        if immediate is not None:
            self._perform(request, immediate, now_s)
        elif request.urgent:
            urgent.append(request)
            for waiting in self._waiting:
                waiting.overtaken = True
        elif len(self._waiting) >= self._limits.pending_requests:
            self.counters.refused_busy += 1
            most = self._limits.pending_requests
            self._refuse(request.id, ApiError("busy", f"{most} requests of this client wait; await answers"))
        else:
            self._waiting.append(request)
            if request.id is not None:
                self._ids[request.id] = request

    def _perform(self, request: Request, handler: session_methods.Handler, now_s: float) -> None:
        try:
            result = handler(self, request.params, now_s)
        except ApiError as error:
            self.fail(request, error)
        else:
            self.answer(request, result)

    # ------------------------------------------------------------------ what session_methods build on

    def admit(self, caller: Caller) -> None:
        """Let the client call methods, as CALLER."""
        self.caller = caller
        self._reader.message_bytes_max = self._limits.message_bytes

    def cancel(self, request_id: int) -> bool:
        """Cancel the request REQUEST_ID; return whether there was one."""
        request = self._ids.get(request_id)
        if request is None:
            return False
        if request in self._running:
            self._cancelled.append(request)
        else:
            self._waiting.remove(request)
            self.fail(request, ApiError("cancelled", f"{request.method.name} was cancelled"))
        return True

    def subscribe(self, wanted: FieldFilter, period_s: float, sequence: int, now_s: float) -> int:
        """Begin a subscription of what changes after SEQUENCE; return its number."""
        self._last_subscription += 1
        subscription = Subscription(
            self._last_subscription, wanted, period_s, self.number % PHASES / PHASES, sequence
        )
        subscription.schedule(now_s)
        self.subscriptions[subscription.number] = subscription
        return subscription.number

    # ---------------------------------------------------------------------------------- notifications

    def notify(self, event: str, data: bytes) -> None:
        """Send DATA, the notification EVENT as this client writes, if it listens and as far as it reads."""
        if self.end_reason is not None or not self.listens.matches(event):
            return
        self._notifications.append(data)
        if len(self._notifications) > self._limits.notifications:
            self._notifications.popleft()
            self._lost += 1
            self.counters.notifications_dropped += 1
        self._move_notifications()

    def _move_notifications(self) -> None:
        """Send what waits, and before it how many were lost."""
        while self._notifications and not self.congested:
            if self._lost:
                lost, self._lost = self._lost, 0
                self._send({"event": "api.lost", "values": {"count": lost}})
            self._put(self._notifications.popleft())
