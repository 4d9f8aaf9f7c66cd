"""Messages to and from one node: queries matched with their answers, and listeners for unsolicited responses.

Used on the control loop only. Responses can get lost, so a query is repeated.
"""

import asyncio
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final, NamedTuple

from nodes.dictionary.dictionary import BOOTSTRAP, Dictionary, encode_values
from nodes.dictionary.message_format import Message, MessageError, MessageFormat, Value
from nodes.link.interfaces import LinkInterface
from nodes.link.types import Response
from nodes.support.bug_reports import BugReports
from nodes.support.errors import CanductorError

QUERY_TIMEOUT_S: Final = 0.25
QUERY_TRIES: Final = 12
"""On a bus that loses one frame in ten, every third answer does not arrive: one query in 500,000 fails."""
_NO_ARGS: Final[Mapping[str, Value | str]] = MappingProxyType({})
MAX_WAITERS: Final = 256
"""Most queries in flight at once; more is a programming error, not load."""


class QueryTimeout(CanductorError):  # noqa: N818
    """A node did not answer a query, however often it was asked."""


class Query(NamedTuple):
    """A command without arguments and the response to it."""

    command: str
    response: str


@dataclass(frozen=True, slots=True)
class Answer:
    """A message, when it was requested and when it was received (HostTime; sent_ns 0: not known)."""

    message: Message
    sent_ns: int
    received_ns: int
    asked_bytes: int
    """Content of the query's block and of the answer's."""
    answered_bytes: int


@dataclass(frozen=True, slots=True, eq=False)
class _Waiter:
    name: str
    asked_bytes: int
    matching: Mapping[str, Value]
    answered: "asyncio.Future[Answer | None]"
    """None: there was none in time."""
    survives_shutdown: bool

    def wants(self, message: Message) -> bool:
        return message.name == self.name and all(
            message.params.get(param) == value for param, value in self.matching.items()
        )


class _Exchange:
    """Sends CONTENT on LINK until WAITERS have their answers, up to TRIES times, TIMEOUT_S apart.

    A timer does this, not a task that waits: an answer wakes only the task that asked.
    """

    def __init__(
        self, link: LinkInterface, content: bytes, waiters: Sequence[_Waiter], timeout_s: float, tries: int
    ) -> None:
        self._link = link
        self._content = content
        self._answers = [waiter.answered for waiter in waiters]
        self._timeout_s = timeout_s
        self._left = tries
        self._timer: asyncio.TimerHandle | None = None

    def send(self) -> None:
        """Send, and again after the time-out."""
        self._left -= 1
        self._link.send(self._content)
        self._timer = asyncio.get_running_loop().call_later(self._timeout_s, self._expire)

    def _expire(self) -> None:
        try:
            self._link.take()  # an answer that came in time may still wait
        finally:
            self._repeat()

    def _repeat(self) -> None:
        pending = [answer for answer in self._answers if not answer.done()]
        if self._left and pending:
            try:
                self.send()
            except CanductorError as error:  # the link is lost
                for answer in pending:
                    answer.set_exception(error)
            return
        for answer in pending:
            answer.set_result(None)

    def close(self) -> None:
        """Send no more; answers come too late from now on."""
        if self._timer is not None:
            self._timer.cancel()
        for answer in self._answers:
            if not answer.cancel() and not answer.cancelled():
                answer.exception()  # one of several failures is raised


Callback = Callable[[Message], None]


class RequestReply:
    """The messages to and from node NAME over the link it is given by ``attach``."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.dictionary: Dictionary = BOOTSTRAP
        self.undecodable = 0
        """Responses that no format of the dictionary fits: damaged, or from other firmware."""
        self.bugs = BugReports()
        """Of what listens to the node."""
        self._link: LinkInterface | None = None
        self._waiters: list[_Waiter] = []
        self._listeners: dict[tuple[str, int | None], list[Callback]] = {}
        self._patience_s: dict[str, float] = {}
        """How long responses may wait for others while nobody is in a hurry."""
        self._hurried = 0
        """Exchanges whose answers are wanted at once."""

    # ------------------------------------------------------------------------------------------------ link

    def attach(self, link: LinkInterface) -> None:
        """Use LINK from now on, with only the messages that identify a node."""
        self._link = link
        self._patience_s.clear()
        self.dictionary = BOOTSTRAP

    def detach(self) -> LinkInterface | None:
        """Stop using the link and return it; the caller closes it."""
        link, self._link = self._link, None
        return link

    @property
    def connected(self) -> bool:
        """Whether there is a link."""
        return self._link is not None

    @property
    def link(self) -> LinkInterface:
        """The link; QueryTimeout when there is none."""
        if self._link is None:
            raise QueryTimeout(f"node {self.name} has no connection")
        return self._link

    def let_wait(self, response: str, seconds: float, *, in_step: bool = False) -> None:
        """Let RESPONSE, if the firmware has it, wait for others up to SECONDS while nobody is in a hurry.

        IN_STEP: until there is one of each oid that somebody listens for, which send it at the same time. A
        program that is woken for each single one does little else. Ends with the link.
        """
        known = self.dictionary.responses.get(response)
        if known is not None and self._patience_s.get(response, 0.0) != seconds:
            self._patience_s[response] = seconds
            together = self._senders(response) if in_step else 0
            self.link.let_wait(known.prefix, seconds, together)

    def _senders(self, response: str) -> int:
        """Return of how many oids somebody listens for RESPONSE now."""
        return sum(
            name == response and oid is not None and bool(callbacks)
            for (name, oid), callbacks in self._listeners.items()
        )

    @contextmanager
    def _hurrying(self) -> Iterator[None]:
        """Let no response wait meanwhile."""
        self._hurried += 1
        try:
            self._tell_hurry()
            yield
        finally:
            self._hurried -= 1
            with suppress(CanductorError):  # the link is lost
                self._tell_hurry()

    def _tell_hurry(self) -> None:
        if self._patience_s:
            self.link.hurry(hurry=self._hurried > 0)

    # ------------------------------------------------------------------------------------------------ send

    def send(
        self, name: str, args: Mapping[str, Value | str] = _NO_ARGS, *, min_clock: int = 0, req_clock: int = 0
    ) -> None:
        """Send a command with ARGS; clocks as in ``nodes/link/core/batch.h``. Raises MessageError."""
        link = self._link or self.link
        link.send(self.encode(name, args), min_clock=min_clock, req_clock=req_clock)

    def send_text(self, command: str) -> None:
        """Send a command written as text; raises MessageError."""
        try:
            self.link.send(self.dictionary.encode_text(command))
        except MessageError as error:
            raise MessageError(f"node {self.name}: {error}") from None

    def encode(self, name: str, args: Mapping[str, Value | str] = _NO_ARGS) -> bytes:
        """Encode a command with ARGS; the MessageError names the node."""
        try:
            return encode_values(self.dictionary, self.dictionary.command(name), args)
        except MessageError as error:
            raise MessageError(f"node {self.name}: {error}") from None

    async def ask(
        self,
        name: str,
        response: str,
        args: Mapping[str, Value | str] = _NO_ARGS,
        *,
        matching: Mapping[str, Value] | None = None,
        timeout_s: float = QUERY_TIMEOUT_S,
        tries: int = QUERY_TRIES,
        survives_shutdown: bool = False,
        patient: bool = False,
    ) -> Answer:
        """Send a command with ARGS until its RESPONSE arrives with the values of MATCHING (the oid, if None).

        Raises QueryTimeout after TRIES times TIMEOUT_S, MessageError when the firmware lacks either message,
        and any error given to ``fail`` meanwhile. With SURVIVES_SHUTDOWN a shutdown does not end the wait. A
        PATIENT question has time: its answer may come as late as those of ``let_wait``.
        """
        content = self.encode(name, args)
        format_ = self._response_to(name, response)
        if matching is None:
            matching = {"oid": args["oid"]} if "oid" in args and "oid" in format_.names else {}  # type: ignore[dict-item]
        waiter = self._waiter(response, len(content), matching, survives_shutdown=survives_shutdown)
        with self._asking(content, [waiter], timeout_s, tries, patient=patient):
            answer = await waiter.answered
        if answer is None:
            raise QueryTimeout(f"node {self.name} did not answer {name} within {tries * timeout_s:g} s")
        return answer

    async def ask_together(self, queries: Sequence[tuple[str, str]]) -> list[Answer | None]:
        """Send QUERIES, commands without arguments and their responses, once and in one block.

        Return the answers; None for one that does not arrive in QUERY_TIMEOUT_S. A shutdown of the node does
        not end the wait. The question is patient. Raises as ``ask``, but for QueryTimeout.
        """
        content = b"".join(self.encode(name) for name, _ in queries)
        for name, response in queries:
            self._response_to(name, response)
        waiters = [self._waiter(r, len(content), {}, survives_shutdown=True) for _, r in queries]
        with self._asking(content, waiters, QUERY_TIMEOUT_S, tries=1, patient=True):
            return [await waiter.answered for waiter in waiters]

    def _response_to(self, name: str, response: str) -> MessageFormat:
        format_ = self.dictionary.responses.get(response)
        if format_ is None:
            raise MessageError(f"node {self.name}: its firmware has no response {response!r} to {name}")
        return format_

    @staticmethod
    def _waiter(
        response: str, asked_bytes: int, matching: Mapping[str, Value], *, survives_shutdown: bool
    ) -> _Waiter:
        answered = asyncio.get_running_loop().create_future()
        return _Waiter(response, asked_bytes, matching, answered, survives_shutdown)

    @contextmanager
    def _asking(
        self, content: bytes, waiters: Sequence[_Waiter], timeout_s: float, tries: int, *, patient: bool
    ) -> Iterator[None]:
        """Send CONTENT, up to TRIES times, TIMEOUT_S apart; WAITERS without an answer get None at the end."""
        if len(self._waiters) + len(waiters) > MAX_WAITERS:
            raise QueryTimeout(
                f"node {self.name}: {len(self._waiters)} queries are unanswered; one more was not sent"
            )
        if patient:
            timeout_s = max(timeout_s, *(self._patience_s.get(waiter.name, 0.0) for waiter in waiters))
        exchange = _Exchange(self.link, content, waiters, timeout_s, tries)
        self._waiters += waiters
        try:
            with nullcontext() if patient else self._hurrying():
                exchange.send()
                yield
        finally:
            exchange.close()
            for waiter in waiters:
                self._waiters.remove(waiter)

    # --------------------------------------------------------------------------------------------- receive

    def on(self, response: str, oid: int | None, callback: Callback) -> Callable[[], None]:
        """Call CALLBACK for every RESPONSE (of OID, unless None); return a function that ends it.

        What CALLBACK raises is reported as a bug; nobody else's calls depend on it.
        """
        callbacks = self._listeners.setdefault((response, oid), [])
        callbacks.append(callback)

        def end() -> None:
            if callback in callbacks:
                callbacks.remove(callback)

        return end

    def receive(self, responses: Sequence[Response]) -> None:
        """Handle the responses that the link received."""
        for response in responses:
            message = self.dictionary.decode(response.content)
            if message is None:
                self.undecodable += 1
            else:
                self._deliver(message, response)

    def _deliver(self, message: Message, response: Response) -> None:
        for waiter in self._waiters:
            if waiter.wants(message) and not waiter.answered.done():
                times = response.sent_ns, response.received_ns
                waiter.answered.set_result(Answer(message, *times, waiter.asked_bytes, len(response.content)))
                break
        callbacks = [*self._listeners.get((message.name, None), ())]
        oid = message.params.get("oid")
        if isinstance(oid, int):
            callbacks[:0] = self._listeners.get((message.name, oid), ())
        for callback in callbacks:
            try:
                callback(message)
            except Exception as bug:  # noqa: BLE001 (other listeners and nodes get theirs all the same)
                self.bugs.add(f"node {self.name}: {message.name}", bug)

    def fail(self, error: CanductorError, *, shutdown: bool = False) -> None:
        """End all queries with ERROR; after a SHUTDOWN, only those that do not survive it."""
        for waiter in self._waiters:
            if not waiter.answered.done() and not (shutdown and waiter.survives_shutdown):
                waiter.answered.set_exception(error)
