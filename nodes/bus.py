"""One bus or UART with its nodes: node ids, links, starting and closing, each unwinding cleanly."""

import asyncio
from collections.abc import Callable, Iterable
from typing import Final

from nodes.assign import Assignment, IdAssignment, Uuid, number_nodes
from nodes.errors import CanductorError
from nodes.link import LinkSettings
from nodes.node import Node, OnClock, OnState
from nodes.node_errors import NodeLost
from nodes.seams import (
    BuildConfig,
    FrameLike,
    IoFactory,
    LinkIOLike,
    LinkLike,
    OnLost,
    OnResponses,
)

LOST_AFTER_S: Final = 1.0


def _ignore(*_: object) -> None:
    pass


class _Base:
    """What a CAN bus and a UART have in common: the I/O, and nodes that live and die with it."""

    def __init__(self, name: str, start_io: IoFactory) -> None:
        self.name = name
        self.nodes: list[Node] = []
        self.closed_because: str | None = None
        self._start_io = start_io
        self._io: LinkIOLike | None = None

    @property
    def io(self) -> LinkIOLike:
        """The I/O of the bus; NodeLost when it is not open."""
        if self._io is None or self.closed_because is not None:
            cause = self.closed_because or "it is not open"
            raise NodeLost(f"bus {self.name} cannot be used: {cause}")
        return self._io

    async def start(self) -> None:
        """Open the bus and bring all its nodes to READY, together. What fails is raised with all closed."""
        try:
            self._io = self._start_io(on_frame=self._frame_handler(), on_closed=self._io_closed)
            await self._prepare()
            async with asyncio.TaskGroup() as group:
                for node in self.nodes:
                    group.create_task(node.start())
        except BaseException as error:
            await self.close()
            cause = _cause(error)
            if cause is None:
                raise
            raise cause from None

    async def close(self) -> None:
        """Close all nodes and the bus; nothing is left running."""
        for node in self.nodes:
            await node.close()
        io, self._io = self._io, None
        if io is not None:
            io.close()

    def emergency_stop(self) -> None:
        """Stop every node that can be reached."""
        for node in self.nodes:
            node.emergency_stop()

    async def _prepare(self) -> None:
        pass

    def _frame_handler(self) -> Callable[[FrameLike], None] | None:
        return None

    def _io_closed(self, cause: str) -> None:
        self.closed_because = cause
        for node in self.nodes:
            node.lose(cause)


def _cause(error: BaseException) -> CanductorError | None:
    """Return the failure that began it, or None when ERROR holds anything else than failures.

    Nodes that only went down with their bus say less than what took it down.
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


class UartBus(_Base):
    """A UART with its one node."""

    def add_node(
        self,
        name: str,
        build_config: BuildConfig,
        *,
        on_state: OnState = _ignore,
        on_clock: OnClock = _ignore,
    ) -> Node:
        """Add the node, before ``start``."""
        assert not self.nodes
        self.nodes.append(
            Node(name, _UartConnector(self), build_config, on_state=on_state, on_clock=on_clock)
        )
        return self.nodes[0]


class _UartConnector:
    def __init__(self, bus: UartBus) -> None:
        self._bus = bus

    async def connect(self, on_responses: OnResponses, on_lost: OnLost) -> LinkLike:
        return self._bus.io.open_link(
            LinkSettings(None, lost_after_s=LOST_AFTER_S), on_responses=on_responses, on_lost=on_lost
        )

    def forget(self) -> None:
        pass

    def why_silent(self) -> CanductorError:
        return NodeLost(
            f"no answer on {self._bus.name}; check its wiring and power, the baud rate, "
            "and that the firmware is built for this port"
        )


class CanBus(_Base):
    """A CAN bus; its nodes get their ids 4, 5, 6, … in the order in which they are added."""

    def __init__(self, name: str, start_io: IoFactory) -> None:
        super().__init__(name, start_io)
        self._nodeids: dict[Uuid, int] = {}
        self._connectors: list[_CanConnector] = []
        self._assigning = asyncio.Lock()
        self._assignment: IdAssignment | None = None

    def add_node(
        self,
        name: str,
        uuid: Uuid,
        build_config: BuildConfig,
        *,
        on_state: OnState = _ignore,
        on_clock: OnClock = _ignore,
    ) -> Node:
        """Add a node, before ``start``; raises AssignError when its uuid is there already."""
        self._nodeids = number_nodes([*self._nodeids, uuid])
        connector = _CanConnector(self, uuid)
        self._connectors.append(connector)
        self.nodes.append(Node(name, connector, build_config, on_state=on_state, on_clock=on_clock))
        return self.nodes[-1]

    async def assign(self, uuids: Iterable[Uuid]) -> Assignment:
        """Give UUIDS their ids; raises AssignError when one cannot be had for certain."""
        async with self._assigning:
            self._assignment = IdAssignment({uuid: self._nodeids[uuid] for uuid in uuids})
            try:
                result = await self._run(self._assignment)
            finally:
                self._assignment = None
        result.check(self.name)
        return result

    def nodeid(self, uuid: Uuid) -> int:
        """Return the id UUID has, or gets."""
        return self._nodeids[uuid]

    async def _run(self, assignment: IdAssignment) -> Assignment:
        loop = asyncio.get_running_loop()
        assignment.start(_ns(loop.time()))
        while assignment.result is None:
            for frame in assignment.frames_to_send():
                self.io.send_frame(frame.can_id, frame.data)
            if assignment.deadline_ns is not None:
                await asyncio.sleep(max(0.0, assignment.deadline_ns * 1e-9 - loop.time()))
            assignment.timer(max(_ns(loop.time()), assignment.deadline_ns or 0))
        for frame in assignment.frames_to_send():
            self.io.send_frame(frame.can_id, frame.data)
        return assignment.result

    async def _prepare(self) -> None:
        assignment = await self.assign(self._nodeids)
        for connector in self._connectors:
            connector.assignment = assignment

    def _frame_handler(self) -> Callable[[FrameLike], None]:
        def received(frame: FrameLike) -> None:
            if self._assignment is not None:
                self._assignment.frame(frame.can_id, frame.data, _ns(asyncio.get_running_loop().time()))

        return received


class _CanConnector:
    """Connects one node of a CAN bus; after a reset it has to get its id again."""

    def __init__(self, bus: CanBus, uuid: Uuid) -> None:
        self._bus = bus
        self._uuid = uuid
        self.assignment: Assignment | None = None

    async def connect(self, on_responses: OnResponses, on_lost: OnLost) -> LinkLike:
        if self.assignment is None:
            self.assignment = await self._bus.assign([self._uuid])
        settings = LinkSettings(self._bus.nodeid(self._uuid), lost_after_s=LOST_AFTER_S)
        return self._bus.io.open_link(settings, on_responses=on_responses, on_lost=on_lost)

    def forget(self) -> None:
        self.assignment = None

    def why_silent(self) -> CanductorError | None:
        if self.assignment is None:
            return None
        if self._uuid in self.assignment.unheard:
            return self.assignment.not_found(self._uuid, self._bus.name)
        return NodeLost(
            f"node {self._uuid} on bus {self._bus.name} took id {self._bus.nodeid(self._uuid)} but does not "
            "answer on it; check the bus for errors and for another host"
        )


def _ns(loop_time_s: float) -> int:
    return round(loop_time_s * 1e9)
