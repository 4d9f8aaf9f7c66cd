"""Talking to nodes from a tool: a bus opened for questions, and a conversation with one node on it.

Everything goes through the project's own link, over one handle of the bus: many adapters can be opened only
once. A node and its host number their blocks; a second host's blocks would break that numbering. So nobody
is talked to whom another host talks to: frames to the node's data id within LISTEN_S show one, as hosts ask
every node for its clock about once a second. Where other nodes have a host, this one's dictionary is read
with long pauses: what goes to a node with a low id would go before the host's motion.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from typing import Any, Final, Protocol, TypeVar

from canbus_tools.bus.computer import Computer, Port
from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.protocol.protocol import Direction, data_id, owner_of
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.message_format import Message, Value
from nodes.dictionary.parts import DictionaryError
from nodes.link import Frame, LinkIO, LinkSettings, LinkStats, Response
from nodes.link.interfaces import LinkInterface
from nodes.mt.download import SLOW_BITRATE
from nodes.node.errors import NodeLost
from nodes.node.identify import identify
from nodes.node.request_reply import QUERY_TIMEOUT_S, QUERY_TRIES, Answer, RequestReply
from nodes.support.errors import CanductorError

LISTEN_S: Final = 1.2
"""How long a node's id must be silent before it is talked to; hosts ask for clocks every 0.98 s."""
LOST_AFTER_S: Final = 2.0
ASK_TRIES: Final = 2 * QUERY_TRIES
"""Tools ask where frames get lost; that a node is not there the link tells sooner."""
PIECE_S: Final = 0.01
"""Waits are cut into such: a computer that gives turns late, to whoever is waited for too, spoils but one."""
GENTLE_SHARE: Final = 0.2
"""Of the time, while a host uses the bus: a dictionary read at full speed takes up to 70 % of 1 Mbit/s."""
T = TypeVar("T")
FrameCallback = Callable[[Frame], None]
MessageCallback = Callable[[Message, int], None]
"""Gets a message and when it was received (HostTime, ns)."""


class TalkError(CanductorError):
    """A node cannot be talked to, or should not."""


def on_bus(computer: Computer, options: BusOptions, job: "Callable[[BusTalk], Awaitable[T]]") -> T:
    """Open a bus of COMPUTER, run JOB on it and return its result; raises CanductorError."""

    async def run() -> T:
        async with BusTalk.open(computer, options) as bus:
            return await job(bus)

    return computer.run(run())


class BusTalk:
    """A bus, opened for questions; from ``BusTalk.open``. For one event loop."""

    def __init__(self, options: BusOptions, port: Port, cache: DictionaryCache) -> None:
        self.options = options
        self.cache = cache
        self.closed_because: str | None = None
        self.hosted: set[int] = set()
        """Node ids to which another host sent something, since the bus was opened."""
        self.talking: set[int] = set()
        """Node ids from which something came that was not meant for us."""
        self._callbacks: list[FrameCallback] = []
        self._closed = asyncio.Event()
        self._open_nodes: set[NodeTalk] = set()
        self._io = port.start_io(on_frame=self._frame_came, on_closed=self._ended)

    @classmethod
    @contextlib.asynccontextmanager
    async def open(
        cls, computer: Computer, options: BusOptions, cache: DictionaryCache | None = None
    ) -> "AsyncIterator[BusTalk]":
        """Open a bus of COMPUTER; raises CanductorError.

        Dictionaries come from and go to CACHE, the user's if None.
        """
        port = computer.open_can(options)
        try:
            bus = cls(options, port, cache if cache is not None else DictionaryCache.of_user())
            try:
                yield bus
            finally:
                bus._io.close()
        finally:
            # A python-can backend may take its time; nothing else is left to be done meanwhile.
            await asyncio.to_thread(port.close)

    @property
    def name(self) -> str:
        """How messages call the bus."""
        return self.options.name

    @property
    def bitrate(self) -> int:
        """Bit/s; a low one if it is not known."""
        return self._io.stats().bitrate or SLOW_BITRATE

    @property
    def load(self) -> float:
        """Share of the bit rate that was used in the last second."""
        return self._io.stats().load.total

    def send_frame(self, can_id: int, data: bytes) -> None:
        """Send one frame that belongs to no node's conversation; raises CanductorError."""
        self._io.send_frame(can_id, data)

    def on_frame(self, callback: FrameCallback) -> Callable[[], None]:
        """Call CALLBACK for every frame that belongs to no conversation; returns what ends it."""
        self._callbacks.append(callback)
        return lambda: self._callbacks.remove(callback)

    async def wait(self, seconds: float) -> None:
        """Let frames come for SECONDS; raises TalkError when the bus ends meanwhile."""
        await _wait_for(self._closed, seconds)
        if self.closed_because is not None:
            raise TalkError(self.closed_because)

    async def has_host(self, nodeid: int, listen_s: float = LISTEN_S) -> bool:
        """Listen for another host; return whether one talks to NODEID, as soon as that is known."""
        heard = asyncio.Event()

        def came(frame: Frame) -> None:
            if frame.can_id == data_id(nodeid, Direction.TO_NODE):
                heard.set()

        end = self.on_frame(came)
        try:
            await _wait_for(heard, listen_s)
        finally:
            end()
        await self.wait(0)
        return heard.is_set()

    @contextlib.asynccontextmanager
    async def node(self, nodeid: int) -> "AsyncIterator[NodeTalk]":
        """Talk to node NODEID, whose dictionary is read first; nobody else may talk to it.

        Raises CanductorError, with what to do.
        """
        talk = NodeTalk(self, nodeid)
        if self.hosted:
            talk.be_gentle()
        self._open_nodes.add(talk)
        try:
            talk.connect(self._io)
            await talk.identify(self.cache)
            yield talk
        finally:
            self._open_nodes.discard(talk)
            talk.close()

    def _frame_came(self, frame: Frame) -> None:
        if owner := owner_of(frame.can_id):
            (self.hosted if owner[1] is Direction.TO_NODE else self.talking).add(owner[0])
        for callback in tuple(self._callbacks):
            callback(frame)

    def _ended(self, sentence: str) -> None:
        self.closed_because = sentence
        self._closed.set()
        for talk in self._open_nodes:
            talk.lost(sentence)


async def _wait_for(event: asyncio.Event, seconds: float) -> None:
    """Wait for EVENT, SECONDS at most: not by the clock, but of turns that this program had."""
    while not event.is_set():
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(event.wait(), min(seconds, PIECE_S))
        seconds -= PIECE_S
        if seconds <= 0:
            return


class Line(Protocol):
    """What a conversation has to know of what carries it: a bus, or a UART."""

    closed_because: str | None
    """One sentence, once it has ended."""

    @property
    def name(self) -> str:
        """How messages call it."""


class NodeTalk:
    """A connection to one node whose dictionary is known; from ``BusTalk.node`` or ``open_uart_talk``.

    NODEID is None on a UART, which has one node.
    """

    def __init__(self, bus: Line, nodeid: int | None) -> None:
        self.bus = bus
        self.nodeid = nodeid
        self.name = f"on {bus.name}" if nodeid is None else f"{nodeid} on {bus.name}"
        self._talk = RequestReply(self.name)
        self._observers: list[MessageCallback] = []
        self._lost: str | None = None

    @property
    def dictionary(self) -> Dictionary:
        """What the node understands and says."""
        return self._talk.dictionary

    @property
    def link(self) -> LinkInterface:
        """The way to the node, for what is encoded already."""
        return self._talk.link

    @property
    def stats(self) -> LinkStats:
        """The link's counters: round trips, repeats, invalid bytes."""
        stats: LinkStats = self._talk.link.stats()
        return stats

    @property
    def undecodable(self) -> int:
        """Responses that the dictionary does not know."""
        return self._talk.undecodable

    def send_text(self, command: str) -> None:
        """Send a command written as ``name parameter=value …``; MessageError, LinkError."""
        self._talk.send_text(command)

    def send(self, name: str, args: Mapping[str, Value | str]) -> None:
        """Send a command with ARGS; MessageError, LinkError."""
        self._talk.link.send(self._talk.encode(name, **args))

    async def ask(
        self,
        name: str,
        response: str,
        args: Mapping[str, Value | str] | None = None,
        *,
        timeout_s: float = QUERY_TIMEOUT_S,
        tries: int = ASK_TRIES,
    ) -> Answer:
        """Send a command until its RESPONSE comes (``RequestReply.ask``); raises CanductorError."""
        return await self._talk.ask(
            name, response, args, timeout_s=timeout_s, tries=tries, survives_shutdown=True
        )

    async def query(
        self,
        name: str,
        response: str,
        /,
        *,
        timeout_s: float = QUERY_TIMEOUT_S,
        tries: int = QUERY_TRIES,
        **args: Value | str,
    ) -> Message:
        """Do as ``ask``, but return only the response (``nodes.mt.table.TableNode``)."""
        return (await self.ask(name, response, args, timeout_s=timeout_s, tries=tries)).message

    def knows(self, command: str, response: str) -> bool:
        """Tell whether the node's firmware has COMMAND and its RESPONSE."""
        return command in self.dictionary.commands and response in self.dictionary.responses

    def on_message(self, callback: MessageCallback) -> Callable[[], None]:
        """Call CALLBACK for every message the node sends, answers too; returns what ends it."""
        self._observers.append(callback)
        return lambda: self._observers.remove(callback)

    async def drained(self) -> None:
        """Wait until the node has acknowledged everything that was sent; raises LinkError."""
        await self._talk.link.drained()

    # --------------------------------------------------------------------------------- called by BusTalk

    def be_gentle(self) -> None:
        """Leave the bus to others for most of the time; before ``connect``."""
        self._talk = _GentleRequestReply(self.name)

    def connect(self, io: LinkIO) -> None:
        """Open the link."""
        settings = LinkSettings(self.nodeid, lost_after_s=LOST_AFTER_S)
        self._talk.attach(io.open_link(settings, on_responses=self._receive, on_lost=self.lost))

    async def identify(self, cache: DictionaryCache) -> None:
        """Learn the node's dictionary."""
        dictionary = await identify(self._talk, cache, self._why_silent)
        try:
            self._talk.link.set_receive_window(dictionary.receive_window)
        except DictionaryError as error:
            raise DictionaryError(f"node {self.name}: {error}") from None
        self._talk.dictionary = dictionary

    def lost(self, sentence: str) -> None:
        """End all waiting: the link or the bus is gone."""
        self._lost = sentence
        self._talk.fail(NodeLost(sentence))

    def close(self) -> None:
        """End the conversation; the node stays as it is."""
        link = self._talk.detach()
        if link is not None:
            link.close()

    def _receive(self, responses: Sequence[Response]) -> None:
        if self._observers:
            for response in responses:
                message = self.dictionary.decode(response.content)
                if message is not None:
                    for callback in tuple(self._observers):
                        callback(message, response.received_ns)
        self._talk.receive(responses)

    def _why_silent(self) -> Exception | None:
        if self.bus.closed_because is not None or self.stats.blocks_received:
            return None  # what the link says of it tells more
        if self.nodeid is None:
            return TalkError(
                f"no answer on {self.bus.name}; check its wiring and power, the baud rate, that the firmware "
                "is built for this port, and that no other program uses it"
            )
        return TalkError(
            f"no node answers on id {self.nodeid} of bus {self.bus.name}; 'canductor can nodes' lists those "
            "that are there, and 'canductor can assign' gives one that waits its id"
        )


class _GentleRequestReply(RequestReply):
    """Pauses between questions."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._next_s = 0.0

    async def ask(self, *args: Any, **kwargs: Any) -> Answer:
        loop = asyncio.get_running_loop()
        await asyncio.sleep(max(0.0, self._next_s - loop.time()))
        began_s = loop.time()
        answer = await super().ask(*args, **kwargs)
        took_s = loop.time() - began_s
        self._next_s = loop.time() + took_s * (1 / GENTLE_SHARE - 1)
        return answer


async def refuse_if_in_use(bus: BusTalk, nodeid: int, listen_s: float = LISTEN_S) -> None:
    """Raise TalkError when another host talks to the node."""
    if await bus.has_host(nodeid, listen_s):
        raise TalkError(in_use(bus.name, nodeid))


def in_use(bus: str, nodeid: int) -> str:
    """Return the sentence for a node that another host talks to."""
    return (
        f"node {nodeid} on bus {bus} is in use: another program talks to it, and a second one would break "
        "their numbering of blocks; stop that program first (the coordinator, Klipper), or give --force if "
        "nothing depends on the node now"
    )
