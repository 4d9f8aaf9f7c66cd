"""Talking to nodes from a tool: a bus opened for questions, and a conversation with one node on it.

Everything goes through the project's own link, over one handle of the bus: many adapters can be opened only
once. A node and its host number their blocks; a second host's blocks would break that numbering. So nobody
is talked to whom another host talks to: frames to the node's data id within LISTEN_S show one, as hosts ask
every node for its clock about once a second.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from typing import Any, Final, Protocol

from canbus_tools.open_bus import BusOptions, open_bus
from nodes.conversation import QUERY_TIMEOUT_S, QUERY_TRIES, Answer, Conversation
from nodes.dictionary import Dictionary
from nodes.dictionary_cache import DictionaryCache
from nodes.dictionary_parts import DictionaryError
from nodes.errors import CanductorError
from nodes.identify import identify
from nodes.link import Frame, LinkIO, LinkSettings, LinkStats, Response
from nodes.message_format import Message, Value
from nodes.node_errors import NodeLost
from nodes.transport import CanTransport
from nodes.transport.python_can_bridge import PythonCanBridge
from nodes.transport.socketcan import SocketCanTransport
from nodes.transport.virtual import VirtualTransport

LISTEN_S: Final = 1.2
"""How long a node's id must be silent before it is talked to; hosts ask for clocks every 0.98 s."""
LOST_AFTER_S: Final = 1.0
FrameCallback = Callable[[Frame], None]
MessageCallback = Callable[[Message, int], None]
"""Gets a message and when it was received (HostTime, ns)."""


class TalkError(CanductorError):
    """A node cannot be talked to, or should not."""


def data_ids(nodeid: int) -> tuple[int, int]:
    """Return the CAN ids to and from a node."""
    return nodeid * 2 + 0x100, nodeid * 2 + 0x101


def open_transport(options: BusOptions) -> CanTransport:
    """Open the bus for a link: natively where that is possible. Raises CanductorError."""
    if options.interface == "socketcan":
        return SocketCanTransport(options.channel, bitrate=options.bitrate)
    if options.interface == "canductor":
        return VirtualTransport(options.channel, bitrate=options.bitrate)
    return PythonCanBridge(open_bus(options), options.name, bitrate=options.bitrate)


class BusTalk:
    """A bus, opened for questions; from ``BusTalk.open``. For one event loop."""

    def __init__(self, options: BusOptions, transport: CanTransport, cache: DictionaryCache) -> None:
        self.options = options
        self.cache = cache
        self.closed_because: str | None = None
        self._callbacks: list[FrameCallback] = []
        self._closed = asyncio.Event()
        self._open_nodes: set[NodeTalk] = set()
        self._io = LinkIO(
            transport, asyncio.get_running_loop(), on_frame=self._frame_came, on_closed=self._ended
        )

    @classmethod
    @contextlib.asynccontextmanager
    async def open(
        cls, options: BusOptions, cache: DictionaryCache | None = None
    ) -> "AsyncIterator[BusTalk]":
        """Open the bus; dictionaries come from and go to CACHE, the user's if None. CanductorError."""
        transport = open_transport(options)
        try:
            bus = cls(options, transport, cache if cache is not None else DictionaryCache.of_user())
            try:
                yield bus
            finally:
                bus._io.close()
        finally:
            # A python-can backend may take its time; nothing else is left to be done meanwhile.
            await asyncio.to_thread(transport.close)

    @property
    def name(self) -> str:
        """How messages call the bus."""
        return self.options.name

    def send_frame(self, can_id: int, data: bytes) -> None:
        """Send one frame that belongs to no node's conversation; raises CanductorError."""
        self._io.send_frame(can_id, data)

    def on_frame(self, callback: FrameCallback) -> Callable[[], None]:
        """Call CALLBACK for every frame that belongs to no conversation; returns what ends it."""
        self._callbacks.append(callback)
        return lambda: self._callbacks.remove(callback)

    async def wait(self, seconds: float) -> None:
        """Let frames come for SECONDS; raises TalkError when the bus ends meanwhile."""
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._closed.wait(), seconds)
        if self.closed_because is not None:
            raise TalkError(self.closed_because)

    async def host_of(self, nodeids: Iterable[int], listen_s: float = LISTEN_S) -> int | None:
        """Listen for another host; return the first of NODEIDS that it talks to, None if none."""
        wanted = {data_ids(nodeid)[0]: nodeid for nodeid in nodeids}
        heard: asyncio.Future[int] = asyncio.get_running_loop().create_future()

        def came(frame: Frame) -> None:
            if frame.can_id in wanted and not heard.done():
                heard.set_result(wanted[frame.can_id])

        end = self.on_frame(came)
        waiting = asyncio.ensure_future(self.wait(listen_s))
        try:
            either: list[asyncio.Future[Any]] = [heard, waiting]
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            if heard.done():
                return heard.result()
            waiting.result()
            return None
        finally:
            end()
            heard.cancel()
            waiting.cancel()

    @contextlib.asynccontextmanager
    async def node(self, nodeid: int) -> "AsyncIterator[NodeTalk]":
        """Talk to node NODEID, whose dictionary is read first; nobody else may talk to it.

        Raises CanductorError, with what to do.
        """
        talk = NodeTalk(self, nodeid)
        self._open_nodes.add(talk)
        try:
            talk.connect(self._io)
            await talk.identify(self.cache)
            yield talk
        finally:
            self._open_nodes.discard(talk)
            talk.close()

    def _frame_came(self, frame: Frame) -> None:
        for callback in tuple(self._callbacks):
            callback(frame)

    def _ended(self, sentence: str) -> None:
        self.closed_because = sentence
        self._closed.set()
        for talk in self._open_nodes:
            talk.lost(sentence)


class Line(Protocol):
    """What a conversation has to know of what carries it: a bus, or a UART."""

    closed_because: str | None
    """One sentence, once it has ended."""

    @property
    def name(self) -> str:
        """How messages call it."""


class NodeTalk:
    """A conversation with one node whose dictionary is known; from ``NodeTalk.open`` or ``BusTalk.node``.

    NODEID is None on a UART, which has one node.
    """

    def __init__(self, bus: Line, nodeid: int | None) -> None:
        self.bus = bus
        self.nodeid = nodeid
        self.name = f"on {bus.name}" if nodeid is None else f"{nodeid} on {bus.name}"
        self._talk = Conversation(self.name)
        self._observers: list[MessageCallback] = []
        self._lost: str | None = None

    @classmethod
    @contextlib.asynccontextmanager
    async def open(
        cls, options: BusOptions, nodeid: int, *, force: bool = False, listen_s: float = LISTEN_S
    ) -> "AsyncIterator[NodeTalk]":
        """Open the bus and talk to node NODEID, after LISTEN_S of silence to it.

        Raises CanductorError: no such bus or node, or another host talks to it; FORCE does not listen.
        """
        async with BusTalk.open(options) as bus:
            if not force:
                await refuse_if_in_use(bus, nodeid, listen_s)
            async with bus.node(nodeid) as talk:
                yield talk

    @property
    def dictionary(self) -> Dictionary:
        """What the node understands and says."""
        return self._talk.dictionary

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
        tries: int = QUERY_TRIES,
    ) -> Answer:
        """Send a command until its RESPONSE comes (``Conversation.ask``); raises CanductorError."""
        return await self._talk.ask(
            name, response, args, timeout_s=timeout_s, tries=tries, survives_shutdown=True
        )

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


async def refuse_if_in_use(bus: BusTalk, nodeid: int, listen_s: float = LISTEN_S) -> None:
    """Raise TalkError when another host talks to the node."""
    if await bus.host_of([nodeid], listen_s) is not None:
        raise TalkError(in_use(bus.name, nodeid))


def in_use(bus: str, nodeid: int) -> str:
    """Return the sentence for a node that another host talks to."""
    return (
        f"node {nodeid} on bus {bus} is in use: another program talks to it, and a second one would break "
        "their numbering of blocks; stop that program first (the coordinator, Klipper), or give --force if "
        "nothing depends on the node now"
    )
