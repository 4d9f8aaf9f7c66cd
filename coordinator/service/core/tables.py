"""The machine's axis tables while it runs: accepted, kept, brought to the nodes and put to use there.

What is accepted is kept in the machine's folder. Whenever a node gets ready it is asked what it has: what it
misses is sent, so that restarts of coordinator and nodes are survived. A table comes into use on all nodes of
an axis at one moment, and only while the machine stands.
"""

import asyncio
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

from coordinator.config.model import MachineDescription
from coordinator.ipc.server.state import StateTree
from coordinator.runtime.machine import Machine
from coordinator.streaming.compensation import WHICH_AXES, Compensation, corrected_axes, why_not_corrected
from coordinator.tables.axis_table import AxisTable, TableError, figures, notes
from coordinator.tables.axle_map import StepperTables
from coordinator.tables.store import TableStore
from nodes.clock.clock import HostTime
from nodes.mt.download import DownloadOutcome, DownloadReport, DownloadTarget, download
from nodes.mt.mt import MtStatus, Pair
from nodes.mt.table import ActiveTable, AxleTable, TableState
from nodes.node.node import Node
from nodes.node.states import NodeState
from nodes.support.errors import CanductorError

CARE_S: Final = 0.5
"""How often the nodes are looked at for one that came back, and tables for one that is not in use yet."""
RETRY_S: Final = 10.0
"""Until what did not arrive is sent again."""
ACTIVATE_IN_S: Final = 0.2
ACTIVATED_S: Final = 0.05
"""After the moment itself, until the nodes are asked."""

OnChange = Callable[[str, AxisTable | None], None]


class TableService:
    """The tables of one machine: kept in STORE (None: only as long as this lives), shown in TREE.

    SAY gets sentences for the log. ``on_change`` are called with an axis and its new table, or None, after a
    table was accepted or removed: who compensates takes it from there.
    """

    def __init__(self, store: TableStore | None, tree: StateTree, say: Callable[[str], None]) -> None:
        self.on_change: list[OnChange] = []
        self._store = store
        self._tree = tree
        self._say = say
        self._tables: dict[str, AxisTable] = {}
        self._at: dict[AxleTable, _Side] = {}
        self._one_at_a_time = asyncio.Lock()
        self._compensation: Compensation | None = None
        self._description: MachineDescription | None = None

    def read(self) -> None:
        """Read the kept tables. Not done by the constructor: SAY may need more than there is yet."""
        if self._store is not None:
            self._tables, problems = self._store.load()
            for problem in problems:
                self._say(problem)

    @property
    def tables(self) -> dict[str, AxisTable]:
        """The accepted tables by axis."""
        return dict(self._tables)

    def compensation_of(self, machine: Machine) -> Compensation | None:
        """Return what has MACHINE's axes corrected by their tables; None where axes have none."""
        self._description = machine.description
        self._compensation = Compensation(machine.description.limits) if machine.devices.tables else None
        for axis, table in self._tables.items():
            self._compensate(axis, table)
        return self._compensation

    def _compensate(self, axis: str, table: AxisTable | None) -> None:
        if self._compensation is None or self._description is None:
            return
        if table is not None and (why := why_not_corrected(self._description, table)):
            self._say(why)
            table = None
        self._compensation.want(axis, table)

    def show_corrections(self) -> None:
        """Show in the state tree what is corrected now."""
        if self._compensation is not None:
            for axis in self._compensation.states:
                if axis in self._tables or self._tree.latest(f"tables.{axis}.active") is not None:
                    self._tree.update(f"tables.{axis}", self._correction(axis))

    def _correction(self, axis: str) -> dict[str, Any]:
        """Return what the coordinator does with the table of AXIS."""
        state = None if self._compensation is None else self._compensation.states.get(axis)
        if state is None:
            return {"active": False, "side": "", "correction_um": 0.0, "taking_up_um": 0.0}
        return {
            "active": state.applied and axis in self._tables,
            "side": state.side,
            "correction_um": round(1000 * state.offset_mm, 3),
            "taking_up_um": round(1000 * state.lag_mm, 3),
        }

    # ------------------------------------------------------------------------------------------- asked for

    async def send(
        self, table: AxisTable, machine: Machine, *, stands: Callable[[], bool]
    ) -> tuple[list[str], list[DownloadReport]]:
        """Accept TABLE and bring it to its nodes; returns notes, and what that cost.

        TableError when it cannot be accepted.
        """
        notes = self._check(table, machine)
        if self._store is not None:
            await asyncio.to_thread(self._store.save, table)
        self._tables[table.axis] = table
        self._changed(table.axis, table)
        reports = await self.bring(machine, [table.axis])
        await self.put_to_use(machine, stands)
        return notes, reports

    async def remove(
        self, axis: str, machine: Machine, *, stands: Callable[[], bool]
    ) -> list[DownloadReport]:
        """Forget the table of AXIS, here and on its nodes; returns what that cost. Raises TableError."""
        self._of(machine, axis)
        if axis not in self._tables:
            raise TableError(f"axis {axis} has no table; 'canductor table status' lists those that have")
        if self._store is not None:
            await asyncio.to_thread(self._store.remove, axis)
        del self._tables[axis]
        self._changed(axis, None)
        reports = await self.bring(machine, [axis])
        await self.put_to_use(machine, stands)
        return reports

    def status(self, machine: Machine | None) -> list[dict[str, Any]]:
        """Return each axis that may have a table, with what is known of its nodes."""
        places = [] if machine is None else machine.devices.tables
        axes = list(dict.fromkeys((*(place.axis for place in places), *self._tables)))
        return [self._status(axis, [place for place in places if place.axis == axis]) for axis in axes]

    # --------------------------------------------------------------------------------------------- the nodes

    async def bring(self, machine: Machine, axes: Iterable[str]) -> list[DownloadReport]:
        """Make sure that the nodes of AXES keep their tables, or none; ``status`` has the result.

        Equal tables go to all their axles in one transmission. Returns what each cost.
        """
        reports = []
        async with self._one_at_a_time:
            missing: dict[tuple[Pair, ...], list[DownloadTarget]] = {}
            for place, pairs in self._wanted(machine, set(axes)):
                side = self._at.setdefault(place.table, _Side())
                if not await side.look(place):
                    continue
                if side.has(pairs):
                    side.problem = ""
                else:
                    missing.setdefault(tuple(pairs), []).append(place)
            for table, places in missing.items():
                report = await self._send(table, places, machine)
                if report is not None:
                    reports.append(report)
            self._show(machine)
        return reports

    async def _send(
        self, pairs: Sequence[Pair], places: Sequence[DownloadTarget], machine: Machine
    ) -> DownloadReport | None:
        try:
            report = await download(pairs, places, now_ns=machine.host.now)
        except CanductorError as error:  # kept from when there was more room
            for place in places:
                self._tell_once(self._at[place.table], str(error))
            return None
        for outcome in report.outcomes:
            side = self._at[outcome.place.table]
            side.took(outcome)
            self._tell_once(side, outcome.problem)
        return report

    def _tell_once(self, side: "_Side", problem: str) -> None:
        if problem and problem != side.problem:
            self._say(f"a table did not arrive: {problem}")
        side.problem = problem

    async def put_to_use(self, machine: Machine, stands: Callable[[], bool]) -> None:
        """Have the nodes use what they keep, all at one moment, if the machine STANDS; else it waits."""
        async with self._one_at_a_time:
            waiting = [
                (place, self._at[place.table])
                for place, pairs in self._wanted(machine, self._axes(machine))
                if place.table in self._at and self._at[place.table].waits(pairs)
            ]
            if not waiting or not stands():
                return
            at_ns = HostTime(machine.host.now() + round(ACTIVATE_IN_S * 1e9))
            for place, side in waiting:
                side.activate(place, at_ns)
            await asyncio.sleep(ACTIVATE_IN_S + ACTIVATED_S)
            for place, side in waiting:
                await side.look_active(place)
            self._show(machine)

    async def care(self, machine: Machine, stands: Callable[[], bool]) -> None:
        """Bring what nodes miss when they get ready, until cancelled; returns where no axis has tables."""
        if not machine.devices.tables:
            return
        ready: set[Node] = set()
        retry_s = float("-inf")
        while True:
            now = {node for node in machine.nodes.values() if node.state is NodeState.READY}
            fresh, ready = now - ready, now
            self._forget(machine, fresh)
            now_s = asyncio.get_running_loop().time()
            behind = self._behind(machine)
            if behind and (fresh or now_s >= retry_s):
                await self.bring(machine, behind)
                retry_s = now_s + RETRY_S
            await self.put_to_use(machine, stands)
            await asyncio.sleep(CARE_S)

    # ------------------------------------------------------------------------------------------- inside

    def _forget(self, machine: Machine, nodes: set["Node"]) -> None:
        """Forget what was known of NODES: they may have lost it."""
        for place in machine.devices.tables:
            if machine.nodes[place.node] in nodes:
                for table in place.sides.values():
                    self._at.pop(table, None)

    def _behind(self, machine: Machine) -> set[str]:
        """Return the axes of which not every node is known to keep what it should."""
        wanted = {stepper.axis: self._wanted(machine, {stepper.axis}) for stepper in machine.devices.tables}
        return {
            axis
            for axis, places in wanted.items()
            if not all(p.table in self._at and self._at[p.table].has(pairs) for p, pairs in places)
        }

    def _check(self, table: AxisTable, machine: Machine) -> list[str]:
        places = self._of(machine, table.axis)
        room = min(side.capacity for place in places for side in place.sides.values())
        if len(table.positions) > room:
            raise TableError(
                f"the table of axis {table.axis} has {len(table.positions)} points, and there is room for "
                f"{room}; thin it out, or raise 'points' of [axis_tables]"
            )
        if why := why_not_corrected(machine.description, table):
            raise TableError(why)
        rail = next(rail for rail in machine.description.rails if rail.axis == table.axis)
        return notes(table, rail.position_min, rail.position_max)

    def _of(self, machine: Machine, axis: str) -> list[StepperTables]:
        found = [place for place in machine.devices.tables if place.axis == axis]
        if not found:
            raise TableError(f"axis {axis} cannot have a table; {self._advice(machine)}")
        return found

    def _advice(self, machine: Machine) -> str:
        """Return the sentence that names the axes that can have tables."""
        with_places = self._axes(machine)
        if not with_places:
            return "add [axis_tables] to the configuration"
        axes = [axis for axis in corrected_axes(machine.description) if axis in with_places]
        return f"axes with tables are {', '.join(axes)}" if axes else f"tables are for {WHICH_AXES}"

    @staticmethod
    def _axes(machine: Machine) -> set[str]:
        return {place.axis for place in machine.devices.tables}

    def _wanted(self, machine: Machine, axes: set[str]) -> list[tuple[DownloadTarget, list[Pair]]]:
        """Return every place of AXES on nodes that keep tables, with what is to be there."""
        found = []
        for stepper in machine.devices.tables:
            node = machine.nodes[stepper.node]
            if stepper.axis not in axes or not stepper.on_node or node.state is not NodeState.READY:
                continue
            table = self._tables.get(stepper.axis)
            for direction, side in stepper.sides.items():
                pairs = [] if table is None else table.pairs(direction)
                found.append((DownloadTarget(side, node, machine.can_bus(node)), pairs))
        return found

    def _changed(self, axis: str, table: AxisTable | None) -> None:
        self._compensate(axis, table)
        for changed in self.on_change:
            changed(axis, table)

    def _status(self, axis: str, places: Sequence[StepperTables]) -> dict[str, Any]:
        table = self._tables.get(axis)
        nodes = [
            {"stepper": place.stepper, "node": place.node, "direction": str(direction), "axle": side.axle}
            | (self._at[side].status() if side in self._at else {"status": _unknown(place)})
            for place in places
            for direction, side in place.sides.items()
        ]
        summary = None if table is None else figures(table)
        return {"axis": axis, "table": summary, "nodes": nodes, **self._correction(axis)}

    def _show(self, machine: Machine) -> None:
        for found in self.status(machine):
            axis, sides = found["axis"], found["nodes"]
            problems = [side["problem"] for side in sides if side.get("problem")]
            self._tree.update(
                f"tables.{axis}",
                {
                    "points": 0 if found["table"] is None else found["table"]["points"],
                    "nodes_ok": sum(side["status"] == "ok" for side in sides),
                    "nodes_active": sum(bool(side.get("active")) for side in sides),
                    "nodes_all": sum(side["status"] != _NOT_KEPT for side in sides),
                    "problem": problems[0] if problems else "",
                    **self._correction(axis),
                },
            )


_NOT_KEPT: Final = "kept by the coordinator only"


def _unknown(place: StepperTables) -> str:
    return "not known" if place.on_node else _NOT_KEPT


class _Side:
    """What is known of one table on a node."""

    def __init__(self) -> None:
        self._state: TableState | None = None
        self._active: ActiveTable | None = None
        self.problem = ""

    async def look(self, place: DownloadTarget) -> bool:
        """Ask the node; whether it answered."""
        try:
            self._state = await place.table.state(place.node)
            self._active = await place.table.active(place.node)
        except CanductorError as error:
            self._state, self.problem = None, str(error)
        return self._state is not None

    async def look_active(self, place: DownloadTarget) -> None:
        try:
            self._active = await place.table.active(place.node)
        except CanductorError as error:
            self.problem = str(error)

    def took(self, outcome: DownloadOutcome) -> None:
        """Record a download."""
        if outcome.state is not None:
            self._state = outcome.state

    def has(self, pairs: Sequence[Pair]) -> bool:
        """Return whether the node keeps PAIRS, or none where there are none."""
        state = self._state
        if state is None or state.status is not MtStatus.OK:
            return False
        return state.holds(pairs) or (not pairs and state.length == 0)

    def waits(self, pairs: Sequence[Pair]) -> bool:
        """Return whether PAIRS are kept and not in use yet."""
        return self.has(pairs) and self._active is not None and self._wanted() != self._active.generation

    def _wanted(self) -> int:
        assert self._state is not None
        return self._state.generation if self._state.length else 0

    def activate(self, place: DownloadTarget, at_ns: HostTime) -> None:
        """Start or end its use at AT_NS."""
        assert isinstance(place.node, Node), "one of the machine's"
        try:
            clock = int(place.node.best_clock.ticks_at(at_ns))
            place.table.activate(place.node, clock=clock, generation=self._wanted())
        except CanductorError as error:
            self.problem = str(error)

    def status(self) -> dict[str, Any]:
        """Return it for front ends."""
        if self._state is None:
            return {"status": "not known", "problem": self.problem}
        active = self._active is not None and self._active.generation == self._wanted()
        return {
            "status": self._state.status.name.lower(),
            "generation": self._state.generation,
            "points": self._state.length,
            "active": active,
            "problem": self.problem,
        }
