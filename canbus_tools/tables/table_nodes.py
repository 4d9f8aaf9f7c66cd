"""Nodes with this project's firmware that receive tables from a tool, and report the result.

A node that a coordinator configured has its tables already: they are found by axle. One without a
configuration gets tables for the axles that are addressed, and a register that it polls; both last until it
is configured again.
"""

import asyncio
from collections.abc import Awaitable, Callable, Container, Sequence
from dataclasses import dataclass, replace
from typing import Final

from canbus_tools.bus.talk import NodeTalk, TalkError
from canbus_tools.tables.table_ways import Sent, register_cost
from nodes.mt.device_job import Load
from nodes.mt.mt import MtStatus, transmission
from nodes.mt.pace import NS_PER_S, PacedWords
from nodes.mt.table import CONSTANT, AxleTable, TableState
from nodes.node.config import NodeConfig

NO_TABLE: Final = 255
POLLS_PER_WORD: Final = 4
"""Polls of the register, so that words that come a little early or late are seen too."""
START_S: Final = 0.25
"""Time from the answer with a node's clock to its first poll; a command that arrives later stops the node."""
_REGISTER_OID: Final = 0


@dataclass(frozen=True, slots=True)
class TableReport:
    """State of one axle's table on a node, as the node reports it."""

    axle: int
    node: str
    state: TableState | None
    problem: str = ""

    @property
    def ok(self) -> bool:
        """Whether there is no problem."""
        return not self.problem


def loop_ns() -> int:
    """Return the running event loop's time (HostTime)."""
    return round(asyncio.get_running_loop().time() * NS_PER_S)


@dataclass(frozen=True, slots=True)
class NodeTables:
    """The tables of one node."""

    node: NodeTalk
    tables: Sequence[AxleTable]
    polls_register: bool
    """Whether it was configured by this module, with a register that it polls."""

    async def states(self, axles: Container[int]) -> list[TableReport]:
        """Query the state of the tables for AXLES; raises CanductorError."""
        return [
            TableReport(table.axle, self.node.name, await table.state(self.node))
            for table in self.tables
            if table.axle in axles
        ]


async def tables_on(node: NodeTalk, axles: Sequence[int], points: int) -> NodeTables:
    """Return the tables that NODE has for AXLES; one without configuration gets them, with room for POINTS.

    Raises CanductorError.
    """
    if not node.dictionary.int_constant(CONSTANT, 0):
        raise TalkError(
            f"the firmware of node {node.name} keeps no tables; omit the node, and send without confirmation"
        )
    tables = [AxleTable(f"axle {axle}", axle, max(points, 1)) for axle in axles]
    config = _configuration(node, tables)
    found = await node.query("get_config", "config")
    if not found.integer("is_config") and points:
        if found.integer("is_shutdown"):
            raise TalkError(f"node {node.name} is shut down and cannot be configured; restart it first")
        for command in config.config_commands:
            node.link.send(node.dictionary.encode_text(command))
        node.link.send(node.dictionary.encode("finalize_config", crc=config.crc))
        found = await node.query("get_config", "config")
        if found.integer("is_shutdown") or not found.integer("is_config"):
            raise TalkError(
                f"node {node.name} refused {len(tables)} tables of {points} points each, perhaps for lack of "
                "memory; send to fewer axles at a time, or use fewer points"
            )
    ours = bool(found.integer("is_config") and found.integer("crc") == config.crc)
    return NodeTables(node, await _found(node, tables, ours=ours), ours)


def _configuration(node: NodeTalk, tables: Sequence[AxleTable]) -> NodeConfig:
    config = NodeConfig(node.name, node.dictionary)
    config.create_oid()
    config.add_config("a polled register", f"config_table_register oid={_REGISTER_OID}")
    for table in tables:
        table.configure(config)
    return config


async def _found(node: NodeTalk, tables: Sequence[AxleTable], *, ours: bool) -> Sequence[AxleTable]:
    if "table_find" not in node.dictionary.commands:
        if ours:
            return tables
        raise TalkError(
            f"the firmware of node {node.name} cannot report which tables it has; flash a newer one, or "
            "omit the node"
        )
    here = []
    for table in tables:
        answer = await node.query("table_find", "table_found", axle=table.axle)
        if answer.integer("oid") != NO_TABLE:
            here.append(AxleTable(table.name, table.axle, answer.integer("capacity")))
            here[-1].oid = answer.integer("oid")
    return here


# --------------------------------------------------------------------------------------- polled register


def judged(report: TableReport, before: TableReport, load: Load) -> TableReport:
    """Return REPORT, with its problem if LOAD did not arrive since BEFORE."""
    assert report.state is not None
    assert before.state is not None
    fresh = report.state.generation != before.state.generation
    if fresh and report.state.status is MtStatus.OK and report.state.holds(load.pairs):
        return report
    received = (report.state.words - before.state.words) & 0xFFFFFFFF
    why = f"the node received {received} of {len(transmission(load.pairs, load.axles))} words"
    status = report.state.status.name.lower()
    problem = f"not accepted: {why} ({status}); send it again, perhaps with a longer --delay"
    return replace(report, problem=problem)


async def write_register(place: NodeTables, load: Load, delay_s: float) -> Sent:
    """Send LOAD through the register that the node polls; raises CanductorError."""
    node = place.node
    if not place.polls_register:
        raise TalkError(
            f"node {node.name} polls no register, as another program configured it; omit --delay to send the "
            "table through its link"
        )
    oid, freq_hz = _REGISTER_OID, node.dictionary.clock_freq_hz
    clock = (await node.query("get_clock", "clock")).integer("clock")
    rest_ticks = max(1, int(freq_hz * delay_s / POLLS_PER_WORD))
    begin = (clock + int(freq_hz * START_S)) & 0xFFFFFFFF
    poll = node.dictionary.encode("table_register_poll", oid=oid, clock=begin, rest_ticks=rest_ticks)
    node.link.send(poll)
    await node.drained()
    await asyncio.sleep(START_S)

    async def write(word: int) -> None:
        node.link.send(node.dictionary.encode("table_register_write", oid=oid, value=word))
        await node.drained()  # from here on the register keeps the word for T

    sent = await send_slowly(load, delay_s, write)
    node.link.send(node.dictionary.encode("table_register_poll", oid=oid, clock=0, rest_ticks=0))
    return sent


async def send_slowly(load: Load, delay_s: float, write: Callable[[int], Awaitable[None]]) -> Sent:
    """Write one word of LOAD after the other, DELAY_S apart; the last one has its time too."""
    words = transmission(load.pairs, load.axles)
    began_ns = loop_ns()
    paced = PacedWords(words, round(delay_s * NS_PER_S), began_ns)
    while paced.deadline_ns is not None:
        await asyncio.sleep(max(0, paced.deadline_ns - loop_ns()) / NS_PER_S)
        word = paced.take(loop_ns())
        if word is not None:
            began_word_ns = loop_ns()
            await write(word)
            paced.delay(loop_ns() - began_word_ns)
    await asyncio.sleep(delay_s)
    elapsed_s = (loop_ns() - began_ns) / NS_PER_S
    return Sent(load, len(words), elapsed_s, register_cost(load, words, delay_s))
