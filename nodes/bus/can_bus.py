"""A CAN bus with its nodes: ids, links, sync pulses, the bus-wide stop, and boards not configured here."""

import asyncio
import contextlib
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from nodes.bus.assign import Assignment, IdAssignment, Uuid, number_nodes, waiting_uuid
from nodes.bus.bus import BusBase, ignore
from nodes.clock.clock import HostTime
from nodes.clock.sync_pulse import CONSTANT, PulseKeeper
from nodes.clock.wire_time import can_wire_ns
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.vocabulary import KNOWS_BUS_STOP
from nodes.link import Frame, LinkSettings
from nodes.link.interfaces import IoFactory, LinkInterface, OnFrame, OnLost, OnResponses
from nodes.node.absence import DEAF_S
from nodes.node.board_reset import ResetMethod
from nodes.node.connector import BuildConfig
from nodes.node.errors import NodeError, NodeLost
from nodes.node.node import Node, OnClock, OnState
from nodes.node.states import NodeState
from nodes.support.can_protocol import (
    ADMIN_ID,
    ADMIN_RESPONSE_ID,
    BUS_OFF,
    BUS_STOP,
    BUS_STOP_ID,
    FIRST_DATA_ID,
    QUERY_UNASSIGNED,
)
from nodes.support.errors import CanductorError

SUSPECT_INTERVAL_S: Final = 0.1
"""Least interval between queries for nodes that wait for an id."""
BUS_STOP_FRAMES: Final = 3
"""Repeats of the stop frame: it is not acknowledged, and a bus that must be stopped may lose frames."""

_IN_USE: Final = (NodeState.IDENTIFYING, NodeState.CONFIGURING, NodeState.READY)


class CanBus(BusBase):
    """A CAN bus; its nodes get their ids 4, 5, 6, … in the order in which they are added."""

    def __init__(
        self,
        name: str,
        start_io: IoFactory,
        *,
        cache: DictionaryCache | None = None,
        on_notice: Callable[[str], None] = ignore,
    ) -> None:
        super().__init__(name, start_io, cache=cache, on_notice=on_notice)
        self._nodeids: dict[Uuid, int] = {}
        self._by_uuid: dict[Uuid, Node] = {}
        self._to_nodes: dict[int, Node] = {}
        self._connectors: list[_CanConnector] = []
        self._assigning = asyncio.Lock()
        self._assignment: IdAssignment | None = None
        self._asked_s = float("-inf")
        self._doubts: dict[Uuid, asyncio.Task[None]] = {}
        self._pulses: asyncio.Task[None] | None = None
        self._said: set[Uuid] = set()

    def add_node(
        self,
        name: str,
        uuid: Uuid,
        build_config: BuildConfig,
        *,
        may_be_absent: bool = False,
        on_state: OnState = ignore,
        on_clock: OnClock = ignore,
    ) -> Node:
        """Add a node, before ``start``; raises AssignError when its uuid is there already."""
        self._nodeids = number_nodes([*self._nodeids, uuid])
        connector = _CanConnector(self, uuid)
        self._connectors.append(connector)
        node = Node(
            name,
            connector,
            build_config,
            on_state=on_state,
            on_clock=on_clock,
            on_notice=self._on_notice,
            cache=self._cache,
        )
        self._by_uuid[uuid] = node
        self._to_nodes = {
            FIRST_DATA_ID + 2 * self._nodeids[uuid]: node for uuid, node in self._by_uuid.items()
        }
        return self._add(node, may_be_absent=may_be_absent)

    async def close(self) -> None:
        """Close all nodes and the bus; nothing is left running."""
        tasks = [*self._doubts.values(), *([self._pulses] if self._pulses is not None else [])]
        self._pulses = None
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)  # _report_bug has reported what is a bug
        await super().close()

    def emergency_stop(self) -> None:
        """Stop every node that can be reached: by frames that our firmware obeys at once, and one by one."""
        # No look-up that may raise: what one node says keeps the stop from no other.
        if any(node.dictionary.constants.get(KNOWS_BUS_STOP) for node in self.nodes):
            with contextlib.suppress(CanductorError):  # the bus may be what failed
                for _ in range(BUS_STOP_FRAMES):
                    self.io.send_frame(BUS_STOP_ID, bytes(BUS_STOP.size))
        super().emergency_stop()

    async def assign(self, uuids: Iterable[Uuid]) -> Assignment:
        """Assign ids to UUIDS; ``Assignment.check_node`` reports whether a node can be used for certain."""
        async with self._assigning:
            self._assignment = IdAssignment({uuid: self._nodeids[uuid] for uuid in uuids})
            try:
                result = await self._run(self._assignment)
            finally:
                self._assignment = None
        for stranger, nodeid in result.displaced.items():
            self._say(
                stranger,
                f"board {stranger} on bus {self.name} is not configured here and had node id {nodeid}, which "
                "was taken from it; it has shut down: let only one host assign ids on a bus",
            )
        return result

    def suspect(self) -> None:
        """Query the nodes that wait for an id, as a restarted node does. The answers arrive as frames."""
        now_s = asyncio.get_running_loop().time()
        if now_s - self._asked_s >= SUSPECT_INTERVAL_S:
            self._asked_s = now_s
            with contextlib.suppress(CanductorError):  # the bus may be gone: that is reported elsewhere
                self.io.send_frame(ADMIN_ID, bytes((QUERY_UNASSIGNED,)))

    def _node_started(self, node: Node) -> None:
        # Boards are built for one bit rate, and this one has just been received at it.
        self.io.learn_bitrate(node.dictionary.int_constant("CANBUS_FREQUENCY", 0))

    def send_frame(self, can_id: int, data: bytes) -> None:
        """Send a frame of no node ahead of all data; raises CanductorError when it cannot be queued."""
        self.io.send_frame(can_id, data)

    @property
    def bitrate(self) -> int:
        """Bit/s; 0 while it is not known."""
        return self.io.stats().bitrate

    @property
    def load(self) -> float:
        """Share of the bit rate used in the last second by all senders; 0 while it is unknown."""
        return self.io.stats().load.total

    def patience_s(self, uuid: Uuid) -> float:
        """Return how long a start goes on although nothing is heard of UUID; others do not wait for long."""
        return 0.0 if self._by_uuid[uuid] in self._may_be_absent else DEAF_S

    def nodeid(self, uuid: Uuid) -> int:
        """Return the id that UUID has or will get."""
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
        loop = asyncio.get_running_loop()
        keeper = PulseKeeper(
            lambda: [node for node in self.nodes if _knows_pulses(node)],
            self.send_frame,
            lambda: HostTime(_ns(loop.time())),
        )
        # From the start, so that the clocks agree when the nodes are ready.
        self._pulses = loop.create_task(keeper.run())
        self._pulses.add_done_callback(self._report_bug)

    def _frame_handler(self) -> OnFrame:
        return self._handle_frame

    def _handle_frame(self, frame: Frame) -> None:
        if self._assignment is not None:
            self._assignment.frame(frame.can_id, frame.data, _ns(asyncio.get_running_loop().time()))
        if frame.can_id == BUS_STOP_ID and len(frame.data) == BUS_STOP.size:
            self._bus_stopped(*BUS_STOP.unpack(frame.data))
        elif frame.can_id == ADMIN_RESPONSE_ID:
            self._doubt(waiting_uuid(frame.data))
        elif frame.can_id == BUS_OFF:
            self._went_bus_off()
        elif frame.can_id in self._to_nodes:
            self._has_another_host(self._to_nodes[frame.can_id], frame.can_id)

    def _bus_stopped(self, reason: int, nodeid: int, clock: int) -> None:
        """Record that a node stopped the bus: later reports of the other nodes are consequences."""
        for uuid, node in self._by_uuid.items():
            if self._nodeids[uuid] == nodeid:
                node.stopped_the_bus(reason, clock)

    def _has_another_host(self, node: Node, can_id: int) -> None:
        """Stop and lose NODE, because a frame to it was received, and a host does not receive its own frames.

        The node counts a block of that host as one of ours, and takes our next one for a repeat: commands go
        missing, and nothing but this frame shows it. So may the stop; the bus-wide stop that follows has no
        number. A node without it carries out what it has (up to the lead) and stops then.
        """
        if not node.talks or node.state not in _IN_USE:
            return
        node.emergency_stop()
        node.lose(
            f"another host sends to it, with id 0x{can_id:03X} on bus {self.name}, so that commands go"
            " missing; let only one host drive a node, and look for a second one, or a program, on this bus"
        )

    def _went_bus_off(self) -> None:
        cause = (
            f"the controller of {self.name} left the bus after too many errors (bus-off); check "
            "cables, termination and bit rates, and let it return by itself: while the interface is down, "
            f"'ip link set {self.name} type can restart-ms 100'"
        )
        for node in self.nodes:
            node.lose(cause)

    def _doubt(self, uuid: Uuid | None) -> None:
        """Find out why a board whose node has an id requests one: it restarted, or there are two."""
        node = self._by_uuid.get(uuid) if uuid is not None else None
        if uuid is None or node is None or uuid in self._doubts:
            return
        if node.state in (NodeState.READY, NodeState.SHUTDOWN):
            task = asyncio.get_running_loop().create_task(self._resolve(uuid, node))
            self._doubts[uuid] = task
            task.add_done_callback(lambda _: self._doubts.pop(uuid, None))
            task.add_done_callback(self._report_bug)

    async def _resolve(self, uuid: Uuid, node: Node) -> None:
        if await node.lives():
            self._say(uuid, f"{_twins(uuid, self.name)}; the second one waits for an id and is not used")
        else:
            node.restarted("its uuid requests an id again")

    def _report_bug(self, task: asyncio.Task[None]) -> None:
        """Report why TASK ended, which is only cancelled and handles every expected error."""
        bug = None if task.cancelled() else task.exception()
        if bug is not None:
            self._on_notice(f"watching bus {self.name} failed ({bug!r}); this is a bug, please report it")
            task.get_loop().call_exception_handler({"message": "watching a bus failed", "exception": bug})

    def _say(self, uuid: Uuid, sentence: str) -> None:
        """Notify the user, once for each board."""
        if uuid not in self._said:
            self._said.add(uuid)
            self._on_notice(sentence)


class _CanConnector:
    """Connects one node of a CAN bus; after a reset its id has to be assigned again."""

    def __init__(self, bus: CanBus, uuid: Uuid) -> None:
        self._bus = bus
        self._uuid = uuid
        self.assignment: Assignment | None = None

    async def connect(self, on_responses: OnResponses, on_lost: OnLost) -> LinkInterface:
        self._bus.ensure_open()
        if self.assignment is None:
            self.assignment = await self._bus.assign([self._uuid])
        self.assignment.check_node(self._uuid, self._bus.name)
        settings = LinkSettings(self._bus.nodeid(self._uuid))
        return self._bus.io.open_link(settings, on_responses=on_responses, on_lost=on_lost)

    def wire_ns(self, content_bytes: int, bitrate: int, *, answer: bool) -> int:
        return can_wire_ns(content_bytes, bitrate, answer=answer) if bitrate > 0 else 0

    @property
    def reset_methods(self) -> Sequence[ResetMethod]:
        return (ResetMethod.COMMAND,)

    async def reset(self, method: ResetMethod) -> bool:  # noqa: ARG002
        return False

    def absence_s(self) -> float:
        return max(self._bus.outage_s(), self._bus.patience_s(self._uuid))

    def missing(self, error: CanductorError) -> str:
        assignment, self.assignment = self.assignment, None  # the next attempt asks for the id again
        if assignment is not None and self._uuid in assignment.in_bootloader:
            return f"it is in its boot loader (Katapult) on bus {self._bus.name}, its firmware not started"
        if assignment is not None and self._uuid in assignment.unheard:
            return f"its uuid {self._uuid} is not heard on bus {self._bus.name}"
        return str(error)

    def expect_reset(self) -> None:
        self._bus.expect_outage()

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

    def check_identity(self, found: bytes) -> None:
        if found != self._uuid.raw:
            raise NodeError(
                f"two boards answer on node id {self._bus.nodeid(self._uuid)} of bus {self._bus.name}: "
                f"{self._uuid}, and one that reports {found.hex()}; switch both off and on again, and let "
                "only one host assign ids on this bus"
            )

    def suspect(self) -> None:
        self._bus.suspect()


def _knows_pulses(node: Node) -> bool:
    return node.talks and bool(node.dictionary.constants.get(CONSTANT))


def _twins(uuid: Uuid, bus: str) -> str:
    return f"two boards on bus {bus} have the uuid {uuid} (cloned chips?); take one of them off"


def _ns(loop_time_s: float) -> int:
    return round(loop_time_s * 1e9)
