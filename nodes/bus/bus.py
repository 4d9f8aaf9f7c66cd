"""One bus or UART with its nodes: node ids, links, start and close with a clean unwind on failure."""

import asyncio
from collections.abc import Callable, Sequence

from nodes.dictionary.cache import DictionaryCache
from nodes.link import LinkError, LinkSettings
from nodes.link.interfaces import IoFactory, LinkInterface, LinkIoInterface, OnFrame, OnLost, OnResponses
from nodes.node.absence import BACK_WITHIN_S, DEAF_S, LOST_IN_START, RETRY_S, Absence
from nodes.node.board_reset import ResetMethod, SerialPort, power_cycle, pulse, reset_methods
from nodes.node.connector import BuildConfig
from nodes.node.errors import NodeLost
from nodes.node.node import Node, OnClock, OnState
from nodes.node.request_reply import QueryTimeout
from nodes.node.states import NodeState
from nodes.support.errors import CanductorError

_ENDED = (NodeState.LOST, NodeState.SHUTDOWN)


def ignore(*_: object) -> None:
    """Do nothing: the default of an optional callback."""


class BusBase:
    """Base of a CAN bus and a UART: the I/O, and the nodes that depend on it.

    START_IO opens the transport; it is called again when a closed bus is reopened. The nodes share CACHE for
    their dictionaries. ON_NOTICE gets sentences about what the user should fix.
    """

    def __init__(
        self,
        name: str,
        start_io: IoFactory,
        *,
        cache: DictionaryCache | None = None,
        on_notice: Callable[[str], None] = ignore,
    ) -> None:
        self.name = name
        self.nodes: list[Node] = []
        self.closed_because: str | None = None
        self._start_io = start_io
        self._cache = cache if cache is not None else DictionaryCache()
        self._on_notice = on_notice
        self._may_be_absent: set[Node] = set()
        self._io: LinkIoInterface | None = None
        self._outage_until_s = float("-inf")

    @property
    def is_open(self) -> bool:
        """Whether ``io`` is there."""
        return self._io is not None and self.closed_because is None

    @property
    def io(self) -> LinkIoInterface:
        """The I/O of the bus; NodeLost when it is not open."""
        if self._io is None or not self.is_open:
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
            await self._open_at_start()
        except CanductorError as error:
            if len(self._may_be_absent) < len(self.nodes):
                raise
            self._io_closed(str(error))
            return
        await self._prepare()
        async with asyncio.TaskGroup() as group:
            for node in self.nodes:
                group.create_task(self._start_node(node))
        for node in self.nodes:  # the bus may have closed when one that was ready already had no part in it
            if node.state is NodeState.LOST and self.outage_s() > 0:
                await self._start_node(node)

    async def _open_at_start(self) -> None:
        """Open the bus; wait for its device when nodes are restarted, which may have made it disappear."""
        restarted = [node.name for node in self.nodes if node.reset_first]
        limit_s = BACK_WITHIN_S if restarted else 0.0
        why = next((node.reset_first for node in self.nodes if node.reset_first), "")
        absence = Absence(", ".join(restarted), limit_s, why, self._on_notice)
        while True:
            try:
                self._open()
            except CanductorError as error:
                if not absence.goes_on(str(error)):
                    raise absence.error(str(error), error) from None
                await asyncio.sleep(RETRY_S)
            else:
                absence.ended()
                return

    async def _start_node(self, node: Node) -> None:
        try:
            await self.bring_up(node)
            self._node_started(node)
        except CanductorError:
            if node not in self._may_be_absent:
                raise

    async def bring_up(self, node: Node) -> None:
        """Start the node, or start it again; raises like ``Node.start``.

        It is started again if the bus closes because another node on it is being reset, and once more, with a
        reset, if it was lost after it had been reached: a start that leaves its configuration as it is must
        not fail where one that clears it would do.
        """
        was_lost = False
        while True:
            try:
                await (node.restart() if node.state in _ENDED else node.start())
            except (NodeLost, QueryTimeout, LinkError) as error:
                if self.outage_s() > 0:
                    continue
                if not node.was_reached or was_lost:
                    raise
                was_lost = True
                node.reset_first = LOST_IN_START
                self._on_notice(f"{error}; the node is reset and started once more")
            else:
                return

    def expect_outage(self) -> None:
        """Record that a node is being reset, which may be the host's adapter to this bus."""
        self._outage_until_s = asyncio.get_running_loop().time() + BACK_WITHIN_S

    def outage_s(self) -> float:
        """Return how long the bus may yet be closed because a node was reset, in s."""
        return max(0.0, self._outage_until_s - asyncio.get_running_loop().time())

    def ensure_open(self) -> None:
        """Reopen the bus if it closed, so that its nodes can be restarted; raises CanductorError."""
        if self.closed_because is not None:
            self._close_io()
            self._open()
            self.closed_because = None

    def _close_io(self) -> None:
        io, self._io = self._io, None
        if io is not None:
            io.close()

    def _open(self) -> None:
        self._io = self._start_io(on_frame=self._frame_handler(), on_closed=self._io_closed)

    async def close(self) -> None:
        """Close all nodes and the bus; nothing is left running."""
        for node in self.nodes:
            await node.close()
        self._close_io()

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

    def _frame_handler(self) -> OnFrame | None:
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
    """A UART with its one node, which is only reset by commands unless ``resets_by`` was called."""

    _port: SerialPort | None = None
    restart_method = ResetMethod.COMMAND

    def resets_by(self, method: ResetMethod, port: SerialPort) -> None:
        """Have the node be reset by METHOD; PORT: its device."""
        self.restart_method, self._port = method, port

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
            name,
            _UartConnector(self),
            build_config,
            on_state=on_state,
            on_clock=on_clock,
            on_notice=self._on_notice,
            cache=self._cache,
        )
        return self._add(node, may_be_absent=may_be_absent)

    def close_device(self) -> None:
        """Close the device: only then can a board on USB that is reset get its name again."""
        self._close_io()
        if self._port is not None:
            self._port.close()
        self.closed_because = "its node was reset"

    async def reset(self, method: ResetMethod) -> bool:
        """Reset the board from outside; False when the device or the computer cannot do that."""
        port = self._port
        try:
            if method is ResetMethod.RPI_USB and port is not None and port.set_power is not None:
                self.close_device()
                await power_cycle(port.set_power)
                return True
            if method is not ResetMethod.RPI_USB and port is not None and port.set_lines is not None:
                await pulse(method, port.set_lines)
                return True
        except CanductorError as error:
            self._on_notice(f"restart_method {method} failed: {error}")
        return False


class _UartConnector:
    def __init__(self, bus: UartBus) -> None:
        self._bus = bus

    async def connect(self, on_responses: OnResponses, on_lost: OnLost) -> LinkInterface:
        self._bus.ensure_open()
        return self._bus.io.open_link(
            LinkSettings(None),
            on_responses=on_responses,
            on_lost=on_lost,
        )

    def wire_ns(self, content_bytes: int, bitrate: int, *, answer: bool) -> int:  # noqa: ARG002
        return 0  # a device file does not show whether its baud rate is real (USB, pseudo-terminals)

    @property
    def reset_methods(self) -> Sequence[ResetMethod]:
        return reset_methods(self._bus.restart_method)

    async def reset(self, method: ResetMethod) -> bool:
        return await self._bus.reset(method)

    def absence_s(self) -> float:
        return DEAF_S

    def missing(self, error: CanductorError) -> str:
        # Why the device cannot be opened is known; a device that is open has a board that does not answer.
        return f"nothing answers on {self._bus.name}" if self._bus.is_open else str(error)

    def expect_reset(self) -> None:
        pass

    def forget(self) -> None:
        self._bus.close_device()

    def why_silent(self) -> CanductorError:
        return NodeLost(
            f"no answer on {self._bus.name}; check its wiring and power, the baud rate, "
            "and that the firmware is built for this port"
        )

    def check_identity(self, found: bytes) -> None:
        pass  # the board at the other end of the cable is the node, whichever it is

    def suspect(self) -> None:
        pass  # a node that restarts on a UART reports it itself
