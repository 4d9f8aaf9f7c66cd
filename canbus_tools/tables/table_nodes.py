"""Nodes of this project's firmware that take tables from a tool, and tell what became of them.

A node that a coordinator configured has its tables already: they are found by axle. One that nobody has
configured gets tables for the axles that are meant, and a register that it polls; both last until it is
configured otherwise.
"""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Final

from canbus_tools.bus.talk import BusTalk, NodeTalk, TalkError
from canbus_tools.tables.table_ways import Sent, register_cost
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.message_format import Message, Value
from nodes.link.interfaces import LinkInterface
from nodes.mt.device_job import Load
from nodes.mt.download import SLOW_BITRATE
from nodes.mt.mt import MtStatus, transmission
from nodes.mt.pace import NS_PER_S, PacedWords
from nodes.mt.table import CONSTANT, AxleTable, TableState
from nodes.node.config import NodeConfig
from nodes.node.request_reply import QUERY_TIMEOUT_S, QUERY_TRIES

NO_TABLE: Final = 255
POLLS_PER_WORD: Final = 4
"""Of the register, so that words that come a little early or late are seen all the same."""
START_S: Final = 0.25
"""From the answer with a node's clock to its first poll: a later command than that stops the node."""
_REGISTER_OID: Final = 0


def loop_ns() -> int:
    """Return the running event loop's time (HostTime)."""
    return round(asyncio.get_running_loop().time() * NS_PER_S)


class TableTalk:
    """A node that a tool talks to, as ``nodes.mt.table.TableNode``."""

    def __init__(self, talk: NodeTalk) -> None:
        self._talk = talk
        self.register_oid: int | None = None
        """Of a register that the node polls; None: its configuration is another's."""

    @property
    def name(self) -> str:
        """How messages call it."""
        return self._talk.name

    @property
    def dictionary(self) -> Dictionary:
        """What it understands and says."""
        return self._talk.dictionary

    @property
    def link(self) -> LinkInterface:
        """The way to it."""
        return self._talk.link

    async def query(
        self,
        name: str,
        response: str,
        /,
        *,
        timeout_s: float = QUERY_TIMEOUT_S,
        tries: int = QUERY_TRIES,
        **args: Value | str,
    ) -> Message:
        """Ask until the RESPONSE comes; raises CanductorError."""
        return (await self._talk.ask(name, response, args, timeout_s=timeout_s, tries=tries)).message

    async def drained(self) -> None:
        """Wait until it has acknowledged everything."""
        await self._talk.drained()


class TalkBus:
    """The bus, as ``nodes.mt.download.Bus``."""

    def __init__(self, bus: BusTalk) -> None:
        self._bus = bus
        self.name = bus.name

    @property
    def bitrate(self) -> int:
        """Bit/s."""
        return self._bus.io.stats().bitrate or SLOW_BITRATE

    @property
    def load(self) -> float:
        """Share of the bit rate within the last second."""
        return self._bus.io.stats().load.total

    def send_frame(self, can_id: int, data: bytes) -> None:
        """Send one frame."""
        self._bus.send_frame(can_id, data)


async def tables_on(node: TableTalk, axles: Sequence[int], points: int) -> list[AxleTable]:
    """Return the tables that NODE has for AXLES; one that is not configured gets them, with room for POINTS.

    Raises CanductorError.
    """
    if not node.dictionary.int_constant(CONSTANT, 0):
        raise TalkError(
            f"node {node.name} runs firmware that keeps no tables; leave it out, and nobody confirms"
        )
    tables = [AxleTable(f"axle {axle}", axle, max(points, 1)) for axle in axles]
    config = _configuration(node, tables)
    found = await node.query("get_config", "config")
    if not found.integer("is_config") and points:
        if found.integer("is_shutdown"):
            raise TalkError(f"node {node.name} is shut down, and cannot be configured; restart it first")
        for command in config.config_commands:
            node.link.send(node.dictionary.encode_text(command))
        node.link.send(node.dictionary.encode("finalize_config", crc=config.crc))
        found = await node.query("get_config", "config")
        if found.integer("is_shutdown") or not found.integer("is_config"):
            raise TalkError(
                f"node {node.name} did not take {len(tables)} tables with room for {points} points each; has "
                "it so much memory? Send to fewer axles at a time, or thin the table out"
            )
    if found.integer("is_config") and found.integer("crc") == config.crc:
        node.register_oid = _REGISTER_OID
    return await _found(node, tables)


def _configuration(node: TableTalk, tables: Sequence[AxleTable]) -> NodeConfig:
    config = NodeConfig(node.name, node.dictionary)
    config.create_oid()
    config.add_config("a polled register", f"config_table_register oid={_REGISTER_OID}")
    for table in tables:
        table.configure(config)
    return config


async def _found(node: TableTalk, tables: Sequence[AxleTable]) -> list[AxleTable]:
    if "table_find" not in node.dictionary.commands:
        if node.register_oid is not None:
            return list(tables)
        raise TalkError(
            f"node {node.name} runs firmware that cannot tell which tables it has; flash a newer one, or "
            "leave it out"
        )
    here = []
    for table in tables:
        answer = await node.query("table_find", "table_found", axle=table.axle)
        if answer.integer("oid") != NO_TABLE:
            here.append(AxleTable(table.name, table.axle, answer.integer("capacity")))
            here[-1].oid = answer.integer("oid")
    return here


# --------------------------------------------------------------------------------------- polled register


@dataclass(frozen=True, slots=True)
class Said:
    """What a node says of one axle's table, after it was sent or only asked."""

    axle: int
    node: str
    state: TableState | None
    problem: str = ""

    @property
    def ok(self) -> bool:
        """Whether there is nothing to be done about it."""
        return not self.problem


async def ask_states(node: TableTalk, tables: Sequence[AxleTable]) -> list[Said]:
    """Return what NODE keeps in TABLES; raises CanductorError."""
    return [Said(table.axle, node.name, await table.state(node)) for table in tables]


def judged(said: Said, before: Said, load: Load) -> Said:
    """Return SAID with what is wrong with it: LOAD shall have arrived since BEFORE."""
    assert said.state is not None
    assert before.state is not None
    fresh = said.state.generation != before.state.generation
    if fresh and said.state.status is MtStatus.OK and said.state.holds(load.pairs):
        return said
    heard = (said.state.words - before.state.words) & 0xFFFFFFFF
    why = f"it heard {heard} of {len(transmission(load.pairs, load.axles))} words"
    status = said.state.status.name.lower()
    return Said(
        said.axle,
        said.node,
        said.state,
        f"not kept: {why} ({status}); send it again, perhaps with a longer --delay",
    )


async def write_register(node: TableTalk, load: Load, delay_s: float) -> Sent:
    """Send LOAD through the register that NODE polls; raises CanductorError."""
    if node.register_oid is None:
        raise TalkError(
            f"node {node.name} polls no register: it was configured for something else; leave --delay out, "
            "and the table goes through its link"
        )
    oid, freq_hz = node.register_oid, node.dictionary.clock_freq_hz
    clock = (await node.query("get_clock", "clock")).integer("clock")
    rest_ticks = max(1, int(freq_hz * delay_s / POLLS_PER_WORD))
    begin = (clock + int(freq_hz * START_S)) & 0xFFFFFFFF
    poll = node.dictionary.encode("table_register_poll", oid=oid, clock=begin, rest_ticks=rest_ticks)
    node.link.send(poll)
    await node.drained()
    await asyncio.sleep(START_S)

    async def write(word: int) -> None:
        node.link.send(node.dictionary.encode("table_register_write", oid=oid, value=word))
        await node.drained()  # from now on it stands there for T, however long it was under way

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
