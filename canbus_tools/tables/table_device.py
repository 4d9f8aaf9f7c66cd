"""Sends tables to drives and nodes at a device, without a coordinator, and reports who confirmed them.

For ``canductor table send --device`` and similar commands (coordinator/cli/commands/table_device.py).
"""

import asyncio
import contextlib
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from canbus_tools.bus.computer import Computer
from canbus_tools.bus.link_facts import read_link
from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.bus.talk import BusTalk, TalkError, open_uart_talk, refuse_if_in_use
from canbus_tools.tables.table_nodes import (
    NodeTables,
    TableReport,
    judged,
    loop_ns,
    send_slowly,
    tables_on,
    write_register,
)
from canbus_tools.tables.table_ways import Sent, send_blind
from nodes.mt.cost import SerialCost
from nodes.mt.device_job import DeviceJob, DeviceKind, Load
from nodes.mt.download import DownloadReport, DownloadTarget, download
from nodes.mt.mt import WORD_BYTES
from nodes.support.errors import CanductorError

_VIRTUAL: Final = "virtual"
SLOW_TRIES: Final = 3
"""Transmissions word by word, for axles whose nodes report missing words."""


@dataclass(frozen=True, slots=True)
class DeviceReport:
    """What was sent, and what the nodes report."""

    job: DeviceJob
    sent: tuple[Sent, ...]
    """Without confirmation, and through registers."""
    downloads: tuple[tuple[Load, DownloadReport], ...]
    """To nodes, by broadcast or link."""
    reports: tuple[TableReport, ...]
    """By axle and node; empty if no node was queried."""

    @property
    def ok(self) -> bool:
        """Whether nothing is known to have failed."""
        return all(report.ok for report in self.reports)

    @property
    def confirmed(self) -> bool | None:
        """Whether every axle has its table; None: not known."""
        return self.ok if self.reports else None

    def _bound_s(self, report: DownloadReport) -> float:
        return self._serial(report).bound_s if self.job.link else report.bound_s

    def _serial(self, report: DownloadReport) -> SerialCost:
        return SerialCost(report.words * WORD_BYTES, self.job.baud)

    def _line_text(self, report: DownloadReport) -> str:
        if not self.job.link:
            return ""
        return f"; the words alone take {self._serial(report).text()}"

    def to_json(self) -> Mapping[str, object]:
        """Return all of it."""
        return {
            "device": self.job.device,
            "confirmed": self.confirmed,
            "sent": [
                {
                    **_load_json(sent.load),
                    "words": sent.words,
                    "elapsed_s": round(sent.elapsed_s, 6),
                    "bound_s": round(sent.cost.bound_s, 6),
                }
                for sent in self.sent
            ]
            + [
                {
                    **_load_json(load),
                    "words": report.words,
                    "elapsed_s": round(report.elapsed_s, 6),
                    "bound_s": round(self._bound_s(report), 6),
                    "broadcasts": sum(cast.times for cast in report.casts),
                }
                for load, report in self.downloads
            ],
            "axles": [_report_json(report) for report in self.reports],
        }

    def to_text(self) -> str:
        """Return the same as text."""
        lines = [
            f"{_load_text(sent.load)}: {sent.words} words in {sent.elapsed_s:.3f} s; the bound is "
            f"{sent.cost.bound_s:.3f} s: {sent.cost.text()}"
            for sent in self.sent
        ]
        lines += [
            f"{_load_text(load)}: {report.text()}{self._line_text(report)}" for load, report in self.downloads
        ]
        lines += [_report_text(report) for report in self.reports]
        if self.confirmed is None:
            lines.append(
                f"not confirmed: receivers that only listen on {self.job.device} cannot answer. Check the "
                "drive: its status must be 0 (ok), its length the number of points that were sent"
                if self.sent
                else f"no node of {self.job.device} has a table for these axles"
            )
        return "\n".join(lines)


def _load_json(load: Load) -> Mapping[str, object]:
    return {"axles": list(load.axles), "points": len(load.pairs)}


def _load_text(load: Load) -> str:
    axles = ", ".join(map(str, load.axles))
    return f"{'axle' if len(load.axles) == 1 else 'axles'} {axles}: {len(load.pairs)} points"


def _report_json(report: TableReport) -> Mapping[str, object]:
    values: dict[str, object] = {
        "axle": report.axle,
        "node": report.node,
        "ok": report.ok,
        "problem": report.problem,
    }
    if (state := report.state) is not None:
        values |= {
            "status": state.status.name.lower(),
            "generation": state.generation,
            "points": state.length,
        }
    return values


def _report_text(report: TableReport) -> str:
    text = f"  axle {report.axle}" + (f" on node {report.node}" if report.node else "")
    if (state := report.state) is not None:
        text += f": {state.status.name.lower()}, generation {state.generation}, {state.length} points"
    return text + (("; " if state else ": ") + report.problem if report.problem else "")


# ------------------------------------------------------------------------------------------------ carry out


def carry_out(computer: Computer, job: DeviceJob) -> DeviceReport:
    """Do JOB; raises CanductorError if nothing of it can be done."""
    options = None
    if job.kind is DeviceKind.CAN:
        options = _bus_options(job)
        job = replace(job, bitrate=job.bitrate or _known_bitrate(options))
    if not job.nodes and not job.link:
        if not job.loads:
            raise TalkError(
                "only nodes can be queried: give --node ID on a CAN bus, or --link on a serial line"
            )
        return DeviceReport(job, send_blind(computer, job, options), (), ())
    return computer.run(_with_nodes(computer, job, options))


def _bus_options(job: DeviceJob) -> BusOptions:
    interface, colon, channel = job.device.partition(":")
    if not colon:
        return BusOptions(channel=interface, bitrate=job.bitrate)
    name = "canductor" if interface == _VIRTUAL else interface
    return BusOptions(interface=name, channel=channel, bitrate=job.bitrate)


def _known_bitrate(options: BusOptions) -> int | None:
    """Return the bit rate of an interface from the kernel; None: unknown, a low one is assumed."""
    if options.interface != "socketcan":
        return None
    try:
        return read_link(options.channel).bitrate
    except CanductorError:
        return None  # opening the bus will report what is wrong


async def _with_nodes(computer: Computer, job: DeviceJob, options: BusOptions | None) -> DeviceReport:
    async with contextlib.AsyncExitStack() as stack:
        if options is None:
            bus = None
            talks = [await stack.enter_async_context(open_uart_talk(computer, job.device, job.baud))]
        else:
            bus = await stack.enter_async_context(BusTalk.open(computer, options))
            if not job.force:
                await asyncio.gather(*(refuse_if_in_use(bus, nodeid) for nodeid in job.nodes))
            talks = [await stack.enter_async_context(bus.node(nodeid)) for nodeid in job.nodes]
        points = max((len(load.pairs) for load in job.loads), default=0)
        places = [await tables_on(talk, job.axles, points) for talk in talks]
        if not job.loads:
            return DeviceReport(job, (), (), tuple(await _states(places, job.axles)))
        if job.delay_s is None:
            return await _download(job, places, bus)
        return await _slowly(job, places, bus)


async def _states(places: Sequence[NodeTables], axles: Container[int]) -> list[TableReport]:
    return [report for place in places for report in await place.states(axles)]


async def _download(job: DeviceJob, places: Sequence[NodeTables], bus: BusTalk | None) -> DeviceReport:
    downloads: list[tuple[Load, DownloadReport]] = []
    reports: list[TableReport] = []
    for load in job.loads:
        targets = [
            DownloadTarget(table, place.node, bus)
            for place in places
            for table in place.tables
            if table.axle in load.axles
        ]
        reports += _missing(load, (target.table.axle for target in targets))
        if targets:
            result = await download(load.pairs, targets, now_ns=loop_ns, share=job.share)
            downloads.append((load, result))
            reports += [
                TableReport(o.place.table.axle, o.place.node.name, o.state, o.problem)
                for o in result.outcomes
            ]
    return DeviceReport(job, (), tuple(downloads), tuple(reports))


def _missing(load: Load, axles: Iterable[int]) -> list[TableReport]:
    """Return a report for each axle of LOAD that is not among AXLES."""
    problem = "none of the nodes has a table for it: add its node by --node, or configure that node"
    here = set(axles)
    return [TableReport(axle, "", None, problem) for axle in load.axles if axle not in here]


async def _slowly(job: DeviceJob, places: Sequence[NodeTables], bus: BusTalk | None) -> DeviceReport:
    """Send word by word, T apart: by frames, or through the register of a node on a serial line."""
    sent: list[Sent] = []
    reports: list[TableReport] = []
    for load in job.loads:
        found, left = {}, load
        for _ in range(SLOW_TRIES):
            before = await _states(places, left.axles)
            if not before:
                break
            sent.append(await _send_slowly(job, left, places[0], bus))
            after = await _states(places, left.axles)
            judgements = [judged(now, then, load) for now, then in zip(after, before, strict=True)]
            found.update({(one.axle, one.node): one for one in judgements})
            left = Load(tuple(dict.fromkeys(one.axle for one in judgements if not one.ok)), load.pairs)
            if not left.axles:
                break
        reports += [*_missing(load, [axle for axle, _ in found]), *found.values()]
    return DeviceReport(job, tuple(sent), (), tuple(reports))


async def _send_slowly(job: DeviceJob, load: Load, place: NodeTables, bus: BusTalk | None) -> Sent:
    assert job.delay_s is not None
    if bus is None:
        return await write_register(place, load, job.delay_s)

    async def write_frame(word: int) -> None:
        bus.send_frame(job.can_id, word.to_bytes(WORD_BYTES, "little"))

    return await send_slowly(load, job.delay_s, write_frame)
