"""Methods about axis tables."""

from collections.abc import Iterator, Sequence
from typing import Any, Final

from coordinator.ipc.protocol.methods import ApiError, Caller, Kind, Method, Param, Scope
from coordinator.runtime.machine import Machine
from coordinator.service.core.machine_service import MachineService
from coordinator.support.values import Value
from coordinator.tables.axis_table import POINTS, AxisTable, TableError, Unit
from nodes.mt.download import DownloadReport

_AXIS_MAX: Final = 64
_AXIS: Final = Param("axis", Kind.STR, "x, y or z, also in capitals", high=_AXIS_MAX)
_AXES: Final = Param(
    "axes",
    Kind.LIST,
    "maps: axis; table (its figures, or null); nodes: maps of stepper, node, direction, axle, status, "
    "generation, points, active, problem; active: whether the axis is corrected, on which side, by how much "
    "(correction_um) and how much of that will still fade (taking_up_um)",
)


_DOWNLOADS: Final = Param(
    "downloads",
    Kind.LIST,
    "what was sent to nodes; maps: axles, words, broadcasts, elapsed_s, bound_s (what one broadcast takes at "
    "least, within its share of the bus and what others leave), summary (a sentence)",
)


class _Tables:
    """What the methods do."""

    def __init__(self, service: MachineService) -> None:
        self._service = service

    async def send(self, caller: Caller, params: dict[str, Any]) -> Value:
        machine = self._idle_machine()
        try:
            columns = {name: _numbers(name, params[name]) for name in ("positions", "forward", "reverse")}
            table = AxisTable(axis=params["axis"].lower(), unit=Unit(params["unit"]), **columns)
            notes, cost = await self._service.tables.send(table, machine, stands=self._service.stands)
        except TableError as error:
            raise ApiError("bad_params", str(error)) from None
        self._service.log.add("notice", f"{caller.name} sent a table for axis {table.axis}")
        return {"notes": list(notes), "downloads": _downloads(cost), **self._status([table.axis])}

    async def remove(self, caller: Caller, params: dict[str, Any]) -> Value:
        machine = self._idle_machine()
        axis = params["axis"].lower()
        try:
            cost = await self._service.tables.remove(axis, machine, stands=self._service.stands)
        except TableError as error:
            raise ApiError("bad_params", str(error)) from None
        self._service.log.add("notice", f"{caller.name} removed the table of axis {axis}")
        return {"downloads": _downloads(cost), **self._status([axis])}

    def status(self, _caller: Caller, _params: dict[str, Any]) -> Value:
        return self._status(None)

    def _status(self, axes: list[str] | None) -> dict[str, Any]:
        found = self._service.tables.status(self._service.machine)
        return {"axes": [one for one in found if axes is None or one["axis"] in axes]}

    def _idle_machine(self) -> Machine:
        """Return the machine; a table changes only while it stands."""
        self._service.ready_motion()
        if not self._service.stands():
            raise ApiError("busy", "the machine moves; tables change only while it stands and no job runs")
        return self._service.up_machine()


def table_methods(service: MachineService) -> Iterator[Method]:
    """Return them."""
    tables = _Tables(service)
    yield Method(
        "table.send",
        Scope.OPERATE,
        "Give an axis a compensation table: it is checked, kept, and brought to the axis's nodes.",
        tables.send,
        params=(
            _AXIS,
            Param("positions", Kind.LIST, "ascending", high=POINTS[-1]),
            Param("forward", Kind.LIST, "what is to be added to each, travelling up", high=POINTS[-1]),
            Param("reverse", Kind.LIST, "likewise, travelling down", high=POINTS[-1]),
            Param("unit", Kind.STR, "of all numbers", required=False, default="mm", choices=tuple(Unit)),
        ),
        returns=(Param("notes", Kind.LIST, "sentences about what one should know"), _DOWNLOADS, _AXES),
    )
    yield Method(
        "table.remove",
        Scope.OPERATE,
        "Take the compensation table of an axis away.",
        tables.remove,
        params=(_AXIS,),
        returns=(_DOWNLOADS, _AXES),
    )
    yield Method(
        "table.status",
        Scope.WATCH,
        "Return the axes that may have tables, and what each node keeps.",
        tables.status,
        returns=(_AXES,),
    )


def _downloads(reports: Sequence[DownloadReport]) -> list[dict[str, Any]]:
    return [
        {
            "axles": [outcome.place.table.axle for outcome in report.outcomes],
            "words": report.words,
            "broadcasts": sum(cast.times for cast in report.casts),
            "elapsed_s": round(report.elapsed_s, 6),
            "bound_s": round(report.bound_s, 6),
            "summary": report.text(),
        }
        for report in reports
    ]


def _numbers(name: str, values: list[Any]) -> tuple[float, ...]:
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in values):
        raise TableError(f"{name} must be numbers")
    try:
        return tuple(map(float, values))
    except OverflowError:
        raise TableError(f"{name} has a number that is too large") from None
