"""Messages to and from one node: queries matched with their answers, and listeners for unsolicited responses.

Used on the control loop only. Responses can get lost, so a query is repeated.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from nodes.dictionary.dictionary import BOOTSTRAP, Dictionary
from nodes.dictionary.message_format import Message, MessageError, Value
from nodes.link.interfaces import LinkInterface
from nodes.link.types import Response
from nodes.support.errors import CanductorError

QUERY_TIMEOUT_S: Final = 0.25
QUERY_TRIES: Final = 6
MAX_WAITERS: Final = 256
"""Most queries in flight at once; more is a programming error, not load."""


class QueryTimeout(CanductorError):  # noqa: N818
    """A node did not answer a query, however often it was asked."""


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
    answered: asyncio.Future[Answer]
    survives_shutdown: bool

    def wants(self, message: Message) -> bool:
        return message.name == self.name and all(
            message.params.get(param) == value for param, value in self.matching.items()
        )


Callback = Callable[[Message], None]


class RequestReply:
    """The messages to and from node NAME over the link it is given by ``attach``."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.dictionary: Dictionary = BOOTSTRAP
        self.undecodable = 0
        """Responses that no format of the dictionary fits: damaged, or from other firmware."""
        self.heard = 0
        """All responses received."""
        self._link: LinkInterface | None = None
        self._waiters: list[_Waiter] = []
        self._listeners: dict[tuple[str, int | None], list[Callback]] = {}

    # ------------------------------------------------------------------------------------------------ link

    def attach(self, link: LinkInterface) -> None:
        """Use LINK from now on, with only the messages that identify a node."""
        self._link = link
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

    # ------------------------------------------------------------------------------------------------ send

    def send(self, name: str, /, *, min_clock: int = 0, req_clock: int = 0, **args: Value | str) -> None:
        """Send a command; clocks as in ``nodes/link/batch.h``. Raises MessageError."""
        self.link.send(self.encode(name, **args), min_clock=min_clock, req_clock=req_clock)

    def send_text(self, command: str) -> None:
        """Send a command written as text; raises MessageError."""
        try:
            self.link.send(self.dictionary.encode_text(command))
        except MessageError as error:
            raise MessageError(f"node {self.name}: {error}") from None

    def encode(self, name: str, /, **args: Value | str) -> bytes:
        """Encode a command; the MessageError names the node."""
        try:
            return self.dictionary.encode(name, **args)
        except MessageError as error:
            raise MessageError(f"node {self.name}: {error}") from None

    async def ask(
        self,
        name: str,
        response: str,
        args: Mapping[str, Value | str] | None = None,
        *,
        matching: Mapping[str, Value] | None = None,
        timeout_s: float = QUERY_TIMEOUT_S,
        tries: int = QUERY_TRIES,
        survives_shutdown: bool = False,
    ) -> Answer:
        """Send a command with ARGS until its RESPONSE arrives with the values of MATCHING (the oid, if None).

        Raises QueryTimeout after TRIES times TIMEOUT_S, MessageError when the firmware lacks either message,
        and any error given to ``fail`` meanwhile. With SURVIVES_SHUTDOWN a shutdown does not end the wait.
        """
        args = args or {}
        content = self.encode(name, **args)
        format_ = self.dictionary.responses.get(response)
        if format_ is None:
            raise MessageError(f"node {self.name}: its firmware has no response {response!r} to {name}")
        if matching is None:
            matching = {"oid": args["oid"]} if "oid" in args and "oid" in format_.names else {}  # type: ignore[dict-item]
        if len(self._waiters) >= MAX_WAITERS:
            raise QueryTimeout(f"node {self.name}: {MAX_WAITERS} queries are unanswered; {name} was not sent")
        answered: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        waiter = _Waiter(response, len(content), matching, answered, survives_shutdown)
        self._waiters.append(waiter)
        try:
            for _ in range(tries):
                self.link.send(content)
                done, _pending = await asyncio.wait([answered], timeout=timeout_s)
                if done:
                    return answered.result()
        finally:
            self._waiters.remove(waiter)
            answered.cancel()
        raise QueryTimeout(f"node {self.name} did not answer {name} within {tries * timeout_s:g} s")

    # --------------------------------------------------------------------------------------------- receive

    def on(self, response: str, oid: int | None, callback: Callback) -> Callable[[], None]:
        """Call CALLBACK for every RESPONSE (of OID, unless None); return a function that ends it."""
        callbacks = self._listeners.setdefault((response, oid), [])
        callbacks.append(callback)

        def end() -> None:
            if callback in callbacks:
                callbacks.remove(callback)

        return end

    def receive(self, responses: Sequence[Response]) -> None:
        """Handle the responses that the link received."""
        self.heard += len(responses)
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
        oid = message.params.get("oid")
        for key in dict.fromkeys(((message.name, oid), (message.name, None))):
            for callback in tuple(self._listeners.get(key, ())):  # type: ignore[arg-type]
                callback(message)

    def fail(self, error: CanductorError, *, shutdown: bool = False) -> None:
        """End all queries with ERROR; after a SHUTDOWN, only those that do not survive it."""
        for waiter in self._waiters:
            if not waiter.answered.done() and not (shutdown and waiter.survives_shutdown):
                waiter.answered.set_exception(error)
