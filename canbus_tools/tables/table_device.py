"""Tables to drives and nodes at a device, without a coordinator: sends them, and tells who confirmed.

``canductor table send --device`` and its kin; coordinator/cli/commands/table_device.py has the options.
"""

import asyncio
import contextlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

from canbus_tools.bus.computer import Computer
from canbus_tools.bus.link_facts import read_link
from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.bus.talk import BusTalk, TalkError, refuse_if_in_use
from canbus_tools.bus.uart_talk import open_uart_talk
from canbus_tools.tables.table_nodes import (
    Said,
    TableTalk,
    TalkBus,
    ask_states,
    judged,
    loop_ns,
    send_slowly,
    tables_on,
    write_register,
)
from canbus_tools.tables.table_ways import Sent, send_blind
from nodes.mt.cost import SerialCost
from nodes.mt.device_job import DeviceJob, DeviceKind, Load
from nodes.mt.download import DownloadOutcome, DownloadReport, DownloadTarget, download
from nodes.mt.mt import WORD_BYTES
from nodes.mt.table import AxleTable
from nodes.support.errors import CanductorError

_VIRTUAL: Final = "virtual"
SLOW_TRIES: Final = 3
"""Word by word, for axles whose nodes say that they missed some."""


@dataclass(frozen=True, slots=True)
class DeviceReport:
    """What was sent, and who says what."""

    job: DeviceJob
    sent: tuple[Sent, ...]
    """Where nobody confirms, and through registers."""
    downloads: tuple[tuple[Load, DownloadReport], ...]
    """To nodes, by broadcast or link."""
    said: tuple[Said, ...]
    """By axle and node; empty where nobody confirms."""

    @property
    def ok(self) -> bool:
        """Whether nothing is known to have failed."""
        return all(said.ok for said in self.said)

    @property
    def confirmed(self) -> bool | None:
        """Whether every axle has its table; None: nobody can tell."""
        return self.ok if self.said else None

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
            "axles": [_said_json(said) for said in self.said],
        }

    def to_text(self) -> str:
        """Return the same for a reader."""
        lines = [
            f"{_load_text(sent.load)}: {sent.words} words in {sent.elapsed_s:.3f} s; the bound is "
            f"{sent.cost.bound_s:.3f} s: {sent.cost.text()}"
            for sent in self.sent
        ]
        lines += [
            f"{_load_text(load)}: {report.text()}{self._line_text(report)}" for load, report in self.downloads
        ]
        lines += [_said_text(said) for said in self.said]
        if self.confirmed is None:
            lines.append(
                f"nobody confirmed it: what only listens on {self.job.device} cannot answer. Look at the "
                "drive: its status must be 0 (ok), its length as many points as were sent"
                if self.sent
                else f"no node of {self.job.device} has a table for these axles"
            )
        return "\n".join(lines)


def _load_json(load: Load) -> Mapping[str, object]:
    return {"axles": list(load.axles), "points": len(load.pairs)}


def _load_text(load: Load) -> str:
    axles = ", ".join(map(str, load.axles))
    return f"{'axle' if len(load.axles) == 1 else 'axles'} {axles}: {len(load.pairs)} points"


def _said_json(said: Said) -> Mapping[str, object]:
    told: dict[str, object] = {"axle": said.axle, "node": said.node, "ok": said.ok, "problem": said.problem}
    if said.state is not None:
        told |= {
            "status": said.state.status.name.lower(),
            "generation": said.state.generation,
            "points": said.state.length,
        }
    return told


def _said_text(said: Said) -> str:
    text = f"  axle {said.axle}" + (f" on node {said.node}" if said.node else "")
    if said.state is not None:
        status = said.state.status.name.lower()
        text += f": {status}, generation {said.state.generation}, {said.state.length} points"
    return text + (("; " if said.state else ": ") + said.problem if said.problem else "")


# ------------------------------------------------------------------------------------------------ carry out


def carry_out(computer: Computer, job: DeviceJob) -> DeviceReport:
    """Do JOB; raises CanductorError when nothing of it can be done."""
    options = None
    if job.kind is DeviceKind.CAN:
        options = _bus_options(job)
        job = replace(job, bitrate=job.bitrate or _known_bitrate(options))
    if not job.nodes and not job.link:
        if not job.loads:
            raise TalkError(
                "only nodes can be asked: give --node ID for those on a CAN bus, --link on a serial line"
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
    """Return what the kernel knows of an interface; None: a slow one is assumed."""
    if options.interface != "socketcan":
        return None
    try:
        return read_link(options.channel).bitrate
    except CanductorError:
        return None  # the bus itself says what is wrong, when it is opened


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
        nodes = [TableTalk(talk) for talk in talks]
        places = [(node, await tables_on(node, job.axles, points)) for node in nodes]
        if not job.loads:
            return await _ask(job, places)
        if job.delay_s is None:
            return await _download(job, places, None if bus is None else TalkBus(bus))
        return await _slowly(job, places, bus)


_Tables = Sequence[tuple[TableTalk, Sequence[AxleTable]]]


async def _ask(job: DeviceJob, places: _Tables) -> DeviceReport:
    said = [one for node, tables in places for one in await ask_states(node, tables)]
    return DeviceReport(job, (), (), tuple(said))


async def _download(job: DeviceJob, places: _Tables, bus: TalkBus | None) -> DeviceReport:
    downloads: list[tuple[Load, DownloadReport]] = []
    said: list[Said] = []
    for load in job.loads:
        meant = [
            DownloadTarget(t, node, bus) for node, tables in places for t in tables if t.axle in load.axles
        ]
        said += _missing(load, (place.table.axle for place in meant))
        if meant:
            report = await download(load.pairs, meant, now_ns=loop_ns, share=job.share)
            downloads.append((load, report))
            said += [_of(outcome) for outcome in report.outcomes]
    return DeviceReport(job, (), tuple(downloads), tuple(said))


def _of(outcome: DownloadOutcome) -> Said:
    place = outcome.place
    return Said(place.table.axle, place.node.name, outcome.state, outcome.problem)


def _missing(load: Load, axles: Iterable[int]) -> list[Said]:
    """Return those of LOAD that are not among AXLES, which some node has."""
    here = set(axles)
    return [
        Said(axle, "", None, "none of the nodes has a table for it: is it another node's, or not configured?")
        for axle in load.axles
        if axle not in here
    ]


async def _slowly(job: DeviceJob, places: _Tables, bus: BusTalk | None) -> DeviceReport:
    """Send word by word, T apart: by frames, or through the register of a node on a serial line."""
    sent: list[Sent] = []
    said: list[Said] = []
    for load in job.loads:
        found, left = {}, load
        for _ in range(SLOW_TRIES):
            meant = [(node, [t for t in tables if t.axle in left.axles]) for node, tables in places]
            before = [one for node, tables in meant for one in await ask_states(node, tables)]
            if not before:
                break
            sent.append(await _send_slowly(job, left, places[0][0], bus))
            after = [one for node, tables in meant for one in await ask_states(node, tables)]
            told = [judged(now, then, load) for now, then in zip(after, before, strict=True)]
            found.update({(one.axle, one.node): one for one in told})
            left = Load(tuple(dict.fromkeys(one.axle for one in told if not one.ok)), load.pairs)
            if not left.axles:
                break
        said += [*_missing(load, (axle for axle, _ in found)), *found.values()]
    return DeviceReport(job, tuple(sent), (), tuple(said))


async def _send_slowly(job: DeviceJob, load: Load, node: TableTalk, bus: BusTalk | None) -> Sent:
    assert job.delay_s is not None
    if bus is None:
        return await write_register(node, load, job.delay_s)
    return await send_slowly(load, job.delay_s, partial(_write_frame, bus, job.can_id))


async def _write_frame(bus: BusTalk, can_id: int, word: int) -> None:
    bus.send_frame(can_id, word.to_bytes(WORD_BYTES, "little"))
