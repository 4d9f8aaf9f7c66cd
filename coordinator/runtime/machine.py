"""The connected machine, assembled in one place; and what happens to it when a part fails."""

import asyncio
import contextlib
import functools
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from coordinator.config.model import (
    CanConnection,
    MachineDescription,
    NodeDescription,
    NodePolicy,
    UartConnection,
)
from coordinator.config.pins import PinRegistry
from coordinator.config.saved import PendingConfig
from coordinator.config.sections.nodes import check_distinct
from coordinator.gcode.commands import Vocabulary
from coordinator.motion.specs import NodeStreamSpec
from coordinator.runtime.bus_overload import BusOverloadDetector
from coordinator.runtime.devices import MachineDevices, stream_specs
from coordinator.runtime.filament_forecast import FilamentForecast
from coordinator.runtime.host import Host
from coordinator.runtime.module_runner import Runner
from coordinator.runtime.node_recovery import NodeRecovery, PausableJob
from coordinator.runtime.stepper_positions import StepperPositions
from coordinator.runtime.timebase import ClockMap, TimeBase
from coordinator.runtime.wire import Wire
from coordinator.support.file_writer import FileWriter
from coordinator.support.values import Value
from nodes.bus.assign import Uuid
from nodes.bus.bus import UartBus
from nodes.bus.can_bus import CanBus
from nodes.clock.clock import ClockEstimate
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.dictionary import Dictionary
from nodes.link import IOStats, Link
from nodes.node.absence import REQUESTED
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.node.states import NodeState
from nodes.support.errors import CanductorError

M = TypeVar("M")


class MachineStopped(CanductorError):  # noqa: N818
    """The machine was stopped for safety; the sentence states the cause."""


CONFIRM_STOP_S = 0.5
"""How long the nodes have to confirm an emergency stop before the host gives up on them."""


@dataclass(frozen=True, slots=True)
class _OpenBus:
    bus: CanBus | UartBus
    wire: Wire
    watch: BusOverloadDetector


class Modules(Protocol):
    """All modules of one machine; ``coordinator/modules/module_set.py`` implements it."""

    config: Mapping[str, Mapping[str, str]]
    """The configuration as text: options by section."""
    settings: Mapping[str, Mapping[str, object]]
    """As it was read: values and defaults."""
    notes: list[str]
    """Sentences about what is no mistake."""
    pins: PinRegistry
    files: FileWriter
    """Writes what they keep."""

    @property
    def vocabulary(self) -> Vocabulary: ...  # noqa: D102
    @property
    def command_help(self) -> Mapping[str, str]: ...  # noqa: D102
    def configure(self, config: NodeConfig) -> None: ...  # noqa: D102
    def node_started(self, node: Node) -> None: ...  # noqa: D102
    async def connect(self, machine: "Machine", say: Callable[[str], None]) -> None: ...  # noqa: D102
    def before_motion(self, steppers: Collection[str]) -> None: ...  # noqa: D102
    @property
    def controls(self) -> bool: ...  # noqa: D102
    def job_begins(self) -> None: ...  # noqa: D102
    def stopped(self, cause: str) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102
    def status(self) -> Mapping[str, Mapping[str, Value]]: ...  # noqa: D102
    def knows(self, command: str) -> bool: ...  # noqa: D102
    def names(self, kind: type[Any]) -> list[str]: ...  # noqa: D102
    def find(self, name: str, kind: type[M]) -> M | None: ...  # noqa: D102
    def of(self, kind: type[M]) -> Iterator[M]: ...  # noqa: D102
    def is_left_out(self, name: str) -> bool: ...  # noqa: D102


def _ignore(_: str) -> None:
    pass


class Machine:
    """All nodes of DESCRIPTION as one machine with MODULES, on the ports and in the time of HOST.

    It lives on one event loop.

    Call ``start``, then ``close`` whatever happened. When a node with the policy fatal is lost or shuts down,
    all others are stopped at once and ``stopped`` has the cause; nodes with another policy are brought back
    (NodeRecovery). ON_NOTICE gets sentences for the user; CACHE keeps dictionaries. RESET_NODES: also reset
    nodes that are configured correctly. PREPARE_RESTART returns a function that restarts the machine (and
    resets nodes if called with True), or raises CanductorError when that is not possible; None: the machine
    cannot be restarted.
    """

    def __init__(
        self,
        description: MachineDescription,
        host: Host,
        modules: Modules,
        *,
        on_notice: Callable[[str], None] = _ignore,
        cache: DictionaryCache | None = None,
        reset_nodes: bool = False,
        prepare_restart: Callable[[], Callable[[bool], None]] | None = None,
    ) -> None:
        self.description = description
        self.host = host
        self.policies = {node.name: node.policy for node in description.nodes}
        self.modules = modules
        self.devices = MachineDevices(description, modules.configure)
        self.stepper_positions = StepperPositions(description)
        self.nodes: dict[str, Node] = {}
        self.stopped: MachineStopped | None = None
        self.announced_stop: Callable[[], None] | None = None
        """Set by another thread that stops the nodes: what the loop does before they report that to it."""
        self.runner: Runner | None = None
        """The service that runs it; None: a program is all there is."""
        self.filament = FilamentForecast()
        """What moves that are planned are going to push; heaters ask."""
        self.unsaved = PendingConfig(description.source)
        self.prepare_restart = prepare_restart
        self._reset_nodes = reset_nodes
        self._on_notice = on_notice
        self._cache = cache if cache is not None else DictionaryCache()
        self._open: list[_OpenBus] = []
        self._bus_of: dict[Node, CanBus | UartBus] = {}
        self._recovery = NodeRecovery(
            self.policies, bring_back=self._bring_back, on_notice=on_notice, now_s=lambda: host.now() * 1e-9
        )
        self._job: PausableJob | None = None
        self._jumps: dict[str, int] = {}
        """By node: how often its clock has jumped."""
        self._waking: set[Node] = set()
        self._failed = asyncio.Event()
        self._stopped_at_ns = 0
        self._all_down = asyncio.Event()
        self._confirmed_s: dict[str, float] = {}
        self._ready = False

    @property
    def busy(self) -> bool:
        """Whether a job has the machine."""
        return self._job is not None

    # ------------------------------------------------------------------------------------------ life

    async def start(self) -> None:
        """Open every bus and bring every node to READY; raises CanductorError with all closed."""
        try:
            self._open_buses()
            async with asyncio.TaskGroup() as group:
                for opened in self._open:
                    group.create_task(opened.bus.start())
        except BaseException as error:
            await self.close()
            if isinstance(error, BaseExceptionGroup):
                raise _first_cause(error) from None
            raise
        self._ready = True
        try:
            await self._begin()
        except BaseException:
            await self.close()
            raise

    async def _begin(self) -> None:
        if self.stopped is not None:
            raise self.stopped
        for node in self.nodes.values():  # one may have failed while others still started
            if node.failure is not None and self.policies[node.name] is NodePolicy.FATAL:
                raise node.failure.with_traceback(None)
            self._check_gone(node)
        await self.modules.connect(self, self._on_notice)

    async def close(self) -> None:
        """Leave the nodes as they are and release everything."""
        self._ready = False
        self.modules.close()
        await self._recovery.close()
        for opened in self._open:
            await opened.bus.close()
            opened.wire.close()
        self._open.clear()

    def stop(self, cause: str) -> None:
        """Stop every node that can be reached, ahead of everything queued; the first CAUSE is kept."""
        if self.stopped is not None:
            return
        self.stopped = MachineStopped(cause)
        self._stopped_at_ns = self.host.now()
        self._recovery.halt()
        self.stop_nodes()
        self._failed.set()
        self.modules.stopped(cause)

    def stop_nodes(self) -> None:
        """Send the emergency stop to every node that can be reached; from any thread.

        What else a stop is (``stop``) is up to the loop, when it can.
        """
        for opened in tuple(self._open):
            with contextlib.suppress(CanductorError):  # the other buses must not miss it
                opened.bus.emergency_stop()

    def stop_as_announced(self) -> None:
        """Do what was announced, unless that was done."""
        announced, self.announced_stop = self.announced_stop, None
        if announced is not None:
            announced()

    async def sleep(self, name: str) -> None:
        """Disconnect node NAME, so that its power can be switched off; it is not missed until ``wake``.

        Raises CanductorError when it is needed.
        """
        node = self._node(name)
        if self._job is not None and self.policies[name] is NodePolicy.FATAL:
            if node is self.primary:
                raise CanductorError(
                    f"node {name} cannot sleep while a job runs: its clock is the job's time"
                )
            if node in self.moving:
                raise CanductorError(f"node {name} cannot sleep while a job runs: it carries steppers")
        await self._recovery.cancel(name)
        await node.sleep()

    async def wake(self, name: str) -> None:
        """Reconnect a sleeping node whose power is on again; raises CanductorError, leaving it asleep."""
        node = self._node(name)
        self._waking.add(node)
        try:
            await node.wake()
        except CanductorError:
            if node.state in (NodeState.LOST, NodeState.SHUTDOWN):
                await node.sleep()
            raise
        finally:
            self._waking.discard(node)

    def _node(self, name: str) -> Node:
        if name not in self.nodes:
            raise CanductorError(f"there is no node {name!r}; there are {', '.join(self.nodes)}")
        return self.nodes[name]

    def _clock_estimated(self, node: Node, _: ClockEstimate) -> None:
        jumps = self._jumps.get(node.name, 0)
        self._jumps[node.name] = node.clock.jumps
        if node.clock.jumps > jumps and self._job is not None:
            self._job.call()  # it looks for jumps in every cycle; none of its moves must go on

    @contextlib.contextmanager
    def job(self, gate: PausableJob) -> Iterator[None]:
        """Run a job inside: GATE is held while a node is out whose policy is pause."""
        self._job = gate
        self._recovery.begin_job(gate)
        try:
            yield
        finally:
            self._job = None
            self._recovery.end_job()

    async def wait_stopped(self) -> MachineStopped:
        """Wait until the machine is stopped; return why."""
        await self._failed.wait()
        assert self.stopped is not None
        return self.stopped

    async def confirm_stop(self) -> dict[str, float]:
        """Wait until every node that can be reached has reported its shutdown, but not longer than a moment.

        Returns for each that did how long after ``stop`` that was, in s.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CONFIRM_STOP_S):
                await self._all_down.wait()
        return dict(self._confirmed_s)

    def describe(self, description: MachineDescription) -> None:
        """Take the motors to follow what DESCRIPTION says from now on; at standstill, on the control loop.

        Nothing else of it may be new.
        """
        self.description = self.devices.description = description
        self.stepper_positions.describe(description)

    # ------------------------------------------------------------------------------------------ parts

    @property
    def primary(self) -> Node:
        """The node whose clock is print time."""
        return self.nodes[self.description.nodes[0].name]

    @property
    def moving(self) -> list[Node]:
        """The nodes that carry steppers, in the order in which motion counts them."""
        return [self.nodes[name] for name in self.devices.moving_nodes]

    def time_base(self) -> TimeBase:
        """Return print time as the primary node's clock gives it."""
        return TimeBase(self.primary.clock, self.primary.dictionary.clock_freq_hz)

    def stream_specs(self) -> list[NodeStreamSpec]:
        """Return how the moving nodes take step commands."""
        return stream_specs((node.name, node.dictionary, node.step_slots) for node in self.moving)

    def clock_map(self, time_base: TimeBase, node: Node, print_time: float) -> ClockMap:
        """Return the map from print time to NODE's ticks, beginning at PRINT_TIME."""
        if node is self.primary:
            return time_base.primary_map(print_time)
        return time_base.secondary_map(node.best_clock, node.dictionary.clock_freq_hz, print_time)

    def address(self, node: Node) -> tuple[str, int | None, str | None]:
        """Return the name of NODE's bus and, on CAN, the id that it has there and its uuid."""
        bus = self._bus_of[node]
        described = next(found for found in self.description.nodes if found.name == node.name)
        if isinstance(bus, CanBus) and isinstance(described.connection, CanConnection):
            uuid = Uuid.parse(described.connection.uuid)
            return bus.name, bus.nodeid(uuid), str(uuid)
        return bus.name, None, None

    def can_bus(self, node: Node) -> CanBus | None:
        """Return the CAN bus of NODE; None when it is on a serial line."""
        bus = self._bus_of[node]
        return bus if isinstance(bus, CanBus) else None

    def bus_stats(self) -> dict[str, IOStats]:
        """Return the counters of every bus that is open, by its name."""
        return {o.bus.name: o.bus.io.stats() for o in self._open if o.bus.is_open}

    def check_load(self) -> bool:
        """Raise BusOverload when a bus will not carry the motion queued on it in time.

        Return whether one may not: call it again soon, also if nothing more is sent.
        """
        doubtful = False
        for opened in self._open:
            if opened.bus.is_open:
                doubtful |= opened.watch.look(
                    opened.bus.io.forecast(),
                    self.host.now(),
                    functools.partial(_repeated, opened.bus),
                    functools.partial(_taken, opened.bus),
                )
        return doubtful

    def let_reports_wait(self, *, rests: bool) -> None:
        """Let what nodes report wait where nothing depends on it; call it again and again.

        What sensors measure while nothing acts on it, and their state while the machine RESTS, too. The clock
        of a node that is the only one need not agree with any other's.
        """
        wait = not self.modules.controls
        alone = len(self.nodes) == 1
        for node in self.nodes.values():
            node.let_reports_wait(measurements=wait, state=wait and rests, clock=alone or (wait and rests))

    def is_busy(self, load: float) -> bool:
        """Return whether a bus has carried more than LOAD lately, a share of its time."""
        return any(o.bus.is_open and o.bus.io.load().total > load for o in self._open)

    async def query_stepper_counts(self) -> dict[str, int]:
        """Ask every node where its steppers stand: steps from where they began, positive as motion counts."""
        return {
            stepper.name: (-1 if stepper.dir_pin.invert else 1)
            * await self.devices.steppers[stepper.name].position(self.nodes[stepper.node])
            for stepper in self.description.steppers
        }

    # ------------------------------------------------------------------------------------------ assembly

    def _open_buses(self) -> None:
        check_distinct(self.description.nodes, UartConnection)
        can: dict[str, CanBus] = {}
        for node in self.description.nodes:
            connection = node.connection
            if isinstance(connection, UartConnection):
                self._add_uart(node, connection)
                continue
            if connection.interface not in can:
                can[connection.interface] = self._add_can(connection)
            bus = can[connection.interface]
            self._add(
                bus,
                bus.add_node(
                    node.name,
                    Uuid.parse(connection.uuid),
                    self._build_config(node),
                    may_be_absent=node.policy is NodePolicy.OPTIONAL,
                    on_state=self._node_changed,
                    on_clock=self._clock_estimated,
                ),
            )

    def _add_can(self, connection: CanConnection) -> CanBus:
        wire = Wire(lambda: self.host.open_can(connection))
        bus = CanBus(connection.interface, wire.start_io, cache=self._cache, on_notice=self._on_notice)
        self._open.append(_OpenBus(bus, wire, BusOverloadDetector(bus.name)))
        return bus

    def _add_uart(self, node: NodeDescription, connection: UartConnection) -> None:
        wire = Wire(lambda: self.host.open_uart(connection), self.host.usb_power())
        bus = UartBus(connection.path, wire.start_io, cache=self._cache, on_notice=self._on_notice)
        bus.resets_by(connection.restart_method, wire)
        self._open.append(_OpenBus(bus, wire, BusOverloadDetector(bus.name)))
        self._add(
            bus,
            bus.add_node(
                node.name,
                self._build_config(node),
                may_be_absent=node.policy is NodePolicy.OPTIONAL,
                on_state=self._node_changed,
                on_clock=self._clock_estimated,
            ),
        )

    def _add(self, bus: CanBus | UartBus, node: Node) -> None:
        node.reset_first = REQUESTED if self._reset_nodes else ""
        self.nodes[node.name] = node
        self._bus_of[node] = bus

    def _build_config(self, node: NodeDescription) -> Callable[[Dictionary], NodeConfig]:
        def build(dictionary: Dictionary) -> NodeConfig:
            self._cache.remember(node.connection.address, dictionary)
            return self.devices.build_config(node.name, dictionary)

        return build

    async def _bring_back(self, node: Node) -> None:
        await self._bus_of[node].bring_up(node)

    def _node_changed(self, node: Node) -> None:
        if node.state is NodeState.READY and self.stopped is not None and not self._ready:
            node.emergency_stop()  # it was not connected yet when the machine was stopped
        elif node.state is NodeState.READY:
            self.modules.node_started(node)
        self._check_gone(node)

    def _check_gone(self, node: Node) -> None:
        gone = node.state in (NodeState.LOST, NodeState.SHUTDOWN)
        if not self._ready or not gone or node in self._waking:
            return
        self.stop_as_announced()
        if self.policies[node.name] is not NodePolicy.FATAL and self.stopped is None:
            self._recovery.start(node)
            return
        self.stop(f"{node.failure}; all other nodes were stopped")
        if node.state is NodeState.SHUTDOWN:
            self._confirmed_s[node.name] = (self.host.now() - self._stopped_at_ns) * 1e-9
        if all(other.state in _NOT_RUNNING for other in self.nodes.values()):
            self._all_down.set()


_NOT_RUNNING = (NodeState.LOST, NodeState.SHUTDOWN, NodeState.SLEEPING)


def _repeated(bus: CanBus | UartBus) -> float:
    """Return the share of the blocks sent on BUS that were repeats."""
    stats = [link_of(node).stats() for node in bus.nodes if node.talks]
    return sum(s.blocks_repeated for s in stats) / max(1, sum(s.blocks_sent for s in stats))


def _taken(bus: CanBus | UartBus) -> float:
    """Return the share of the time of BUS that received frames took lately which nothing here outranks."""
    return bus.io.load().data if isinstance(bus, CanBus) else 0.0


def _first_cause(group: BaseExceptionGroup[BaseException]) -> BaseException:
    for error in group.exceptions:
        if not isinstance(error, BaseExceptionGroup):
            return error
        return _first_cause(error)
    return group


def link_of(node: Node) -> Link:
    """Return the node's link with its counters."""
    link = node.link
    assert isinstance(link, Link)
    return link
