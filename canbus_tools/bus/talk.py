"""Connections of tools to nodes: a bus opened for queries, and a connection to one node on it.

All use the project's own link, over one handle of the bus, as many adapters can be opened only once. A node
and its host number their blocks; the blocks of a second host would break that numbering. A node that another
host uses is therefore not contacted: frames to its data id within LISTEN_S show one, as hosts query the clock
of every node about once a second. If other nodes have a host, a dictionary is read with long pauses: frames
to a node with a low id would delay the host's motion.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from canbus_tools.bus.computer import Computer, Port
from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.protocol.protocol import Direction, data_id, owner_of
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.message_format import Message, Value
from nodes.dictionary.parts import DictionaryError
from nodes.link import Frame, LinkIO, LinkSettings, LinkStats
from nodes.link.types import Response
from nodes.mt.download import SLOW_BITRATE
from nodes.node.errors import NodeLost
from nodes.node.identify import identify
from nodes.node.request_reply import QUERY_TIMEOUT_S, QUERY_TRIES, Answer, RequestReply
from nodes.support.errors import CanductorError
from nodes.transport import BAUD_DEFAULT

LISTEN_S: Final = 1.2
"""How long a node's id must be silent before it is used; hosts query clocks every 0.98 s."""
LOST_AFTER_S: Final = 2.0
ASK_TRIES: Final = 2 * QUERY_TRIES
"""Tools are used on buses that lose frames; the link detects a missing node earlier."""
PIECE_S: Final = 0.01
"""Waits are divided into such pieces: when this process is scheduled late, only one piece is wrong."""
GENTLE_SHARE: Final = 0.2
"""Share of the time while a host uses the bus: at full speed a dictionary takes up to 70 % of 1 Mbit/s."""
T = TypeVar("T")
FrameCallback = Callable[[Frame], None]
MessageCallback = Callable[[Message, int], None]
"""Called with a message and the time of its reception (HostTime, ns)."""


class TalkError(CanductorError):
    """A node cannot be used, or should not."""


def on_bus(computer: Computer, options: BusOptions, job: "Callable[[BusTalk], Awaitable[T]]") -> T:
    """Open a bus of COMPUTER, run JOB on it and return its result; raises CanductorError."""

    async def run() -> T:
        async with BusTalk.open(computer, options) as bus:
            return await job(bus)

    return computer.run(run())


class BusTalk:
    """A bus, opened for queries; from ``BusTalk.open``. For one event loop."""

    def __init__(self, options: BusOptions, port: Port, cache: DictionaryCache) -> None:
        self.options = options
        self.cache = cache
        self.closed_because: str | None = None
        self.hosted: set[int] = set()
        """Node ids to which another host sent something, since the bus was opened."""
        self.talking: set[int] = set()
        """Node ids from which frames came that were not for this program."""
        self._callbacks: list[FrameCallback] = []
        self._closed = asyncio.Event()
        self._open_nodes: set[NodeTalk] = set()
        self._io = port.start_io(on_frame=self._frame_came, on_closed=self._ended)

    @classmethod
    @contextlib.asynccontextmanager
    async def open(
        cls, computer: Computer, options: BusOptions, cache: DictionaryCache | None = None
    ) -> "AsyncIterator[BusTalk]":
        """Open a bus of COMPUTER; raises CanductorError. CACHE of dictionaries: the user's if None."""
        port = computer.open_can(options)
        try:
            bus = cls(options, port, cache if cache is not None else DictionaryCache.of_user())
            try:
                yield bus
            finally:
                bus._io.close()
        finally:
            # A python-can backend may take seconds.
            await asyncio.to_thread(port.close)

    @property
    def name(self) -> str:
        """Name in messages."""
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
        """Send one frame outside of all links; raises CanductorError."""
        self._io.send_frame(can_id, data)

    def on_frame(self, callback: FrameCallback) -> Callable[[], None]:
        """Call CALLBACK for every frame outside of all links; return a function that ends it."""
        self._callbacks.append(callback)
        return lambda: self._callbacks.remove(callback)

    async def wait(self, seconds: float) -> None:
        """Wait SECONDS for frames; raises TalkError if the bus ends meanwhile."""
        await _wait_for(self._closed, seconds)
        if self.closed_because is not None:
            raise TalkError(self.closed_because)

    async def has_host(self, nodeid: int, listen_s: float = LISTEN_S) -> bool:
        """Listen for LISTEN_S at most; return whether another host uses NODEID."""
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
        """Connect to node NODEID, which no other host may use, and read its dictionary.

        Raises CanductorError, with what to do.
        """
        talk = NodeTalk(self, nodeid, gentle=bool(self.hosted))
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
    """Wait for EVENT, SECONDS at most; time for which this process was not scheduled does not count."""
    while not event.is_set():
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(event.wait(), min(seconds, PIECE_S))
        seconds -= PIECE_S
        if seconds <= 0:
            return


class UartLine:
    """An open UART."""

    def __init__(self, name: str) -> None:
        self.name = f"UART {name}"
        """Name in messages."""
        self.closed_because: str | None = None
        """Sentence with the cause, once it has ended."""


class NodeTalk(RequestReply):
    """A connection to one node whose dictionary is known; from ``BusTalk.node`` or ``open_uart_talk``.

    NODEID is None on a UART, which has one node. GENTLE: use a small share of the bus's time only.
    """

    def __init__(self, bus: BusTalk | UartLine, nodeid: int | None, *, gentle: bool = False) -> None:
        super().__init__(f"on {bus.name}" if nodeid is None else f"{nodeid} on {bus.name}")
        self.bus = bus
        self.nodeid = nodeid
        self._gentle = gentle
        self._next_s = 0.0
        self._observers: list[MessageCallback] = []

    @property
    def stats(self) -> LinkStats:
        """The link's counters: round trips, repeats, invalid bytes."""
        stats: LinkStats = self.link.stats()
        return stats

    async def ask(self, *args: Any, tries: int = ASK_TRIES, **options: Any) -> Answer:
        """Send a command until its response comes (``RequestReply.ask``); raises CanductorError."""
        loop = asyncio.get_running_loop()
        if self._gentle:
            await asyncio.sleep(max(0.0, self._next_s - loop.time()))
        began_s = loop.time()
        answer = await super().ask(*args, tries=tries, **options)
        self._next_s = loop.time() + (loop.time() - began_s) * (1 / GENTLE_SHARE - 1)
        return answer

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
        """Return whether the node's firmware has COMMAND and its RESPONSE."""
        return command in self.dictionary.commands and response in self.dictionary.responses

    def on_message(self, callback: MessageCallback) -> Callable[[], None]:
        """Call CALLBACK for every message of the node, also answers; return a function that ends it."""
        self._observers.append(callback)
        return lambda: self._observers.remove(callback)

    async def drained(self) -> None:
        """Wait until the node has acknowledged everything that was sent; raises LinkError."""
        await self.link.drained()

    # --------------------------------------------------------------------------------- called by BusTalk

    def connect(self, io: LinkIO) -> None:
        """Open the link."""
        settings = LinkSettings(self.nodeid, lost_after_s=LOST_AFTER_S)
        self.attach(io.open_link(settings, on_responses=self.receive, on_lost=self.lost))

    async def identify(self, cache: DictionaryCache) -> None:
        """Read the node's dictionary."""
        dictionary = await identify(self, cache, self._why_silent)
        try:
            self.link.set_receive_window(dictionary.receive_window)
        except DictionaryError as error:
            raise DictionaryError(f"node {self.name}: {error}") from None
        self.dictionary = dictionary

    def lost(self, sentence: str) -> None:
        """End all waiting: the link or the bus is gone."""
        self.fail(NodeLost(sentence))

    def close(self) -> None:
        """Close the link; the node keeps its state."""
        link = self.detach()
        if link is not None:
            link.close()

    def receive(self, responses: Sequence[Response]) -> None:
        """Handle the responses that the link received."""
        if self._observers:
            for response in responses:
                message = self.dictionary.decode(response.content)
                if message is not None:
                    for callback in tuple(self._observers):
                        callback(message, response.received_ns)
        super().receive(responses)

    def _why_silent(self) -> Exception | None:
        if self.bus.closed_because is not None or self.stats.blocks_received:
            return None  # the link's own error says more
        if self.nodeid is None:
            return TalkError(
                f"no answer on {self.bus.name}; check its wiring and power, the baud rate, that the firmware "
                "is built for this port, and that no other program uses it"
            )
        return TalkError(
            f"no node answers on id {self.nodeid} of bus {self.bus.name}; 'canductor can nodes' lists all "
            "nodes, and 'canductor can assign' assigns an id to a waiting node"
        )


@contextlib.asynccontextmanager
async def open_uart_talk(
    computer: Computer, path: str | Path, baud: int = BAUD_DEFAULT, cache: DictionaryCache | None = None
) -> AsyncIterator[NodeTalk]:
    """Open the serial device at PATH for this program alone, and connect to its node.

    Raises CanductorError.
    """
    with contextlib.closing(computer.open_uart(path, baud)) as port:
        line = UartLine(port.name)
        talk = NodeTalk(line, None)

        def ended(sentence: str) -> None:
            line.closed_because = sentence
            talk.lost(sentence)

        with contextlib.closing(port.start_io(on_closed=ended)) as io:
            try:
                talk.connect(io)
                await talk.identify(cache if cache is not None else DictionaryCache.of_user())
                yield talk
            finally:
                talk.close()


async def refuse_if_in_use(bus: BusTalk, nodeid: int, listen_s: float = LISTEN_S) -> None:
    """Raise TalkError if another host uses the node."""
    if await bus.has_host(nodeid, listen_s):
        raise TalkError(in_use(bus.name, nodeid))


def in_use(bus: str, nodeid: int) -> str:
    """Return the message for a node that another host uses."""
    return (
        f"node {nodeid} on bus {bus} is in use: another program talks to it, and a second one would disturb "
        "their connection; stop that program first (the coordinator, Klipper), or give --force if nothing "
        "depends on the node now"
    )
