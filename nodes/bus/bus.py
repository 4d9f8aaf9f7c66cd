"""One bus or UART with its nodes: node ids, links, start and close with a clean unwind on failure."""

import asyncio
from collections.abc import Callable
from typing import Final

from nodes.dictionary.cache import DictionaryCache
from nodes.link import LinkSettings
from nodes.link.interfaces import FrameLike, IoFactory, LinkInterface, LinkIoInterface, OnLost, OnResponses
from nodes.node.connector import BuildConfig
from nodes.node.errors import NodeLost
from nodes.node.node import Node, OnClock, OnState
from nodes.support.errors import CanductorError

LOST_AFTER_S: Final = 1.0


def ignore(*_: object) -> None:
    """Do nothing: the default of an optional callback."""


class BusBase:
    """Base of a CAN bus and a UART: the I/O, and the nodes that depend on it.

    START_IO opens the transport; it is called again when a closed bus is reopened. The nodes share CACHE for
    their dictionaries. ON_NOTICE gets sentences about what the user should fix.
    A node that acknowledges nothing for LOST_AFTER_S is lost.
    """

    def __init__(
        self,
        name: str,
        start_io: IoFactory,
        *,
        cache: DictionaryCache | None = None,
        on_notice: Callable[[str], None] = ignore,
        lost_after_s: float = LOST_AFTER_S,
    ) -> None:
        self.name = name
        self.nodes: list[Node] = []
        self.closed_because: str | None = None
        self._start_io = start_io
        self._cache = cache if cache is not None else DictionaryCache()
        self._on_notice = on_notice
        self.lost_after_s = lost_after_s
        self._may_be_absent: set[Node] = set()
        self._io: LinkIoInterface | None = None

    @property
    def io(self) -> LinkIoInterface:
        """The I/O of the bus; NodeLost when it is not open."""
        if self._io is None or self.closed_because is not None:
            cause = self.closed_because or "it is not open"
            raise NodeLost(f"bus {self.name} cannot be used: {cause}")
        return self._io

    async def start(self) -> None:
        """Open the bus and bring its nodes to READY, concurrently. On a failure, close all and raise it.

        Nodes that may be absent become LOST when they are; so do all nodes of a bus that has only such nodes
        and cannot be opened.
        """
        try:
            await self._start()
        except BaseException as error:
            await self.close()
            cause = _cause(error)
            if cause is None:
                raise
            raise cause from None

    async def _start(self) -> None:
        try:
            self._open()
        except CanductorError as error:
            if len(self._may_be_absent) < len(self.nodes):
                raise
            self._io_closed(str(error))
            return
        await self._prepare()
        async with asyncio.TaskGroup() as group:
            for node in self.nodes:
                group.create_task(self._start_node(node))

    async def _start_node(self, node: Node) -> None:
        try:
            await node.start()
            self._node_started(node)
        except CanductorError:
            if node not in self._may_be_absent:
                raise

    def ensure_open(self) -> None:
        """Reopen the bus if it closed, so that its nodes can be restarted; raises CanductorError."""
        if self.closed_because is not None:
            io, self._io = self._io, None
            if io is not None:
                io.close()
            self._open()
            self.closed_because = None

    def _open(self) -> None:
        self._io = self._start_io(on_frame=self._frame_handler(), on_closed=self._io_closed)

    async def close(self) -> None:
        """Close all nodes and the bus; nothing is left running."""
        for node in self.nodes:
            await node.close()
        io, self._io = self._io, None
        if io is not None:
            io.close()

    def emergency_stop(self) -> None:
        """Stop every node that can be reached; from any thread."""
        for node in self.nodes:
            node.emergency_stop()

    def _add(self, node: Node, *, may_be_absent: bool) -> Node:
        self.nodes.append(node)
        if may_be_absent:
            self._may_be_absent.add(node)
        return node

    async def _prepare(self) -> None:
        pass

    def _node_started(self, node: Node) -> None:
        pass

    def _frame_handler(self) -> Callable[[FrameLike], None] | None:
        return None

    def _io_closed(self, cause: str) -> None:
        self.closed_because = cause
        for node in self.nodes:
            node.lose(cause)


def _cause(error: BaseException) -> CanductorError | None:
    """Return the first cause among the failures, or None when ERROR holds anything other than failures.

    The failure of a node that went down with its bus is less informative than that of the bus.
    """
    if isinstance(error, CanductorError):
        return error
    if not isinstance(error, BaseExceptionGroup):
        return None
    causes = [_cause(inner) for inner in error.exceptions]
    known = [cause for cause in causes if cause is not None]
    if len(known) < len(causes):
        return None
    return next((cause for cause in known if not isinstance(cause, NodeLost)), known[0])


class UartBus(BusBase):
    """A UART with its one node."""

    def add_node(
        self,
        name: str,
        build_config: BuildConfig,
        *,
        may_be_absent: bool = False,
        on_state: OnState = ignore,
        on_clock: OnClock = ignore,
    ) -> Node:
        """Add the node, before ``start``."""
        assert not self.nodes
        node = Node(
            name, _UartConnector(self), build_config, on_state=on_state, on_clock=on_clock, cache=self._cache
        )
        return self._add(node, may_be_absent=may_be_absent)


class _UartConnector:
    def __init__(self, bus: UartBus) -> None:
        self._bus = bus

    async def connect(self, on_responses: OnResponses, on_lost: OnLost) -> LinkInterface:
        return self._bus.io.open_link(
            LinkSettings(None, lost_after_s=self._bus.lost_after_s),
            on_responses=on_responses,
            on_lost=on_lost,
        )

    def wire_ns(self, content_bytes: int, bitrate: int, *, answer: bool) -> int:  # noqa: ARG002
        return 0  # a device file does not show whether its baud rate is real (USB, pseudo-terminals)

    def forget(self) -> None:
        pass

    def why_silent(self) -> CanductorError:
        return NodeLost(
            f"no answer on {self._bus.name}; check its wiring and power, the baud rate, "
            "and that the firmware is built for this port"
        )

    def check_identity(self, found: bytes) -> None:
        pass  # the board at the other end of the cable is the node, whichever it is

    def suspect(self) -> None:
        pass  # a node that restarts on a UART reports it itself
