"""A CAN bus in virtual time: nodes with the real firmware, other programs, and the computer of the tools."""

import signal
import zlib
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, closing, contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Final

from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.bus.talk import BusTalk, NodeTalk, refuse_if_in_use
from canbus_tools.protocol.frame import Frame
from coordinator.simulate.script import ScriptedWorld
from nodes.bus.assign import Uuid
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.message_format import Message
from nodes.link import LinkSettings
from nodes.support.can_protocol import (
    ADMIN_ID,
    ADMIN_RESPONSE_ID,
    NEED_NODEID,
    QUERY_UNASSIGNED,
    SET_NODEID,
    SET_NODEID_BOOTLOADER,
)
from nodes.transport import CanFrame
from nodes.virtual.firmware import MAINBOARD, TOOLHEAD, firmware_dictionary, firmware_path
from nodes.virtual.world import NodeSettings, WorldNode
from tests import wire_twin
from tests.stages.simulated_computer import SimulatedComputer, WireListener, WireUser

CHANNEL: Final = "can0"
BOOT_S: Final = 0.01
"""Longer than a simulated node takes to start."""
REPEAT_S: Final = 0.02
"""Between two frames of a host that drives a node."""

MAIN: Final = Uuid.parse("90a4ae022dfc")
"""Our firmware, has id 4."""
TOOL: Final = Uuid.parse("5e1ec7ab1e02")
"""Klipper-type, has id 5, in shutdown."""
BED: Final = Uuid.parse("bed000000001")
"""Klipper-type, waits for an id."""
TWIN: Final = Uuid.parse("777777777777")
"""Two boards of our firmware with this uuid wait for an id."""
BOOT: Final = Uuid.parse("b007b007b007")
"""In the bootloader Katapult, waits for an id."""
MAIN_ID, TOOL_ID = 4, 5


QUESTIONS: Final = (
    ("get_uptime", "uptime"),
    ("get_canbus_id", "canbus_id"),
    ("get_canbus_status", "canbus_status"),
    ("get_uptime", "uptime"),
)
"""What the host of ``conversation`` asks, with the answers' names."""


class CanStage:
    """A bus with nobody on it."""

    def __init__(self, *, bitrate: int = 1_000_000, loss: float = 0.0, seed: int = 1) -> None:
        """LOSS: share of frames that each receiver does not see; SEED decides which."""
        self.world = ScriptedWorld(seed)
        self.wire = self.world.add_can(CHANNEL, bitrate=bitrate)
        self.uart = self.world.add_uart("tty")
        self.computer = SimulatedComputer(
            self.world, {CHANNEL: self.wire}, {"/dev/tty0": self.uart}, loss=loss
        )
        self.options = BusOptions(interface="canductor", channel=CHANNEL)
        self.words = ("--interface", "canductor", "--channel", CHANNEL)
        """As a tool's command line names the bus."""
        self._loss = loss
        self._nodes = 0

    def add_node(
        self,
        uuid: Uuid,
        nodeid: int | None = None,
        *,
        build: str = MAINBOARD,
        legacy: bool = False,
        uart: bool = False,
    ) -> WorldNode:
        """Add a node and let it start; NODEID: give it this id. LEGACY: firmware without our extensions."""
        self._nodes += 1
        node = self.world.add_node(
            self.uart if uart else self.wire,
            str(uuid),
            settings=NodeSettings(ppm=17.0 * self._nodes),
            start_clock=self._nodes << 20,
            clock_freq=round(_dictionary(build).clock_freq_hz),
            dictionary=_compressed(build),
            legacy=legacy,
        )
        if node.controller is not None:
            node.controller.set_faults(loss=self._loss)
        self.world.run_for(BOOT_S)
        if nodeid is not None:
            with self.user() as host:
                set_nodeid(host, uuid, nodeid, times=10 if self._loss else 1)
            self.world.run_for(BOOT_S)
        return node

    def user(self, answer: Callable[[CanFrame], CanFrame | None] | None = None) -> WireUser:
        """Return somebody else on the bus; ANSWER returns what to send when a frame came, if anything."""
        return WireUser(self.computer, self.options, answer)

    @contextmanager
    def other_host(self, nodeid: int, data: bytes = b"\x7e", *, every_s: float = REPEAT_S) -> Iterator[None]:
        """Have a host send DATA to node NODEID again and again."""
        with self.repeating(CanFrame(nodeid * 2 + 0x100, data), every_s):
            yield

    @contextmanager
    def repeating(self, frame: CanFrame, every_s: float) -> Iterator[WireUser]:
        """Have somebody send FRAME every EVERY_S."""
        lasting = True

        def again() -> None:
            if lasting:
                sender.send(frame)
                self.world.at(self.world.now_ns + round(every_s * 1e9), again, wakes=True)

        with self.user() as sender:
            again()
            try:
                yield sender
            finally:
                lasting = False

    @contextmanager
    def asking_host(self, nodeid: int, *, every_s: float = 0.01) -> Iterator[None]:
        """Have a host with a link of its own ask node NODEID for its uptime again and again."""
        question = _dictionary(MAINBOARD).encode("get_uptime")
        port = self.computer.open_can(self.options)
        with closing(port.start_io()) as io:
            settings = LinkSettings(nodeid, lost_after_s=3600.0)
            link = io.open_link(settings, on_responses=lambda _: None, on_lost=lambda _: None)
            lasting = True

            def again() -> None:
                if lasting:
                    link.send(question)
                    self.world.at(self.world.now_ns + round(every_s * 1e9), again)

            again()
            try:
                yield
            finally:
                lasting = False
        port.close()

    def replay(self, frames: Sequence[Frame], *, after_s: float = 0.1) -> None:
        """Have somebody send FRAMES, as far apart as they were recorded, from AFTER_S from now on."""
        sender = self.user()
        begin_ns = self.world.now_ns + round(after_s * 1e9)
        for frame in frames:
            at_ns = begin_ns + round((frame.time_s - frames[0].time_s) * 1e9)
            self.world.at(at_ns, partial(sender.send, CanFrame(frame.can_id, frame.data)))

    def press(self, number: signal.Signals, *, after_s: float) -> None:
        """Let a signal reach this process AFTER_S from now: Ctrl-C is SIGINT."""
        self.world.at(self.world.now_ns + round(after_s * 1e9), lambda: signal.raise_signal(number))

    @contextmanager
    def babbling(self, can_id: int, data: bytes = b"\x55" * 8) -> Iterator[None]:
        """Have a broken board send frames back to back."""
        sender = self.world.add_node(self.wire, "bab000000000")
        assert sender.controller is not None
        self.world.run_for(BOOT_S)
        sender.controller.babble(can_id, data, 3600.0)
        try:
            yield
        finally:
            sender.power_off()

    @asynccontextmanager
    async def talk(self, nodeid: int, *, force: bool = False) -> AsyncIterator[NodeTalk]:
        """Open the bus and connect to a node, as the tools do; FORCE: although another host may use it."""
        async with BusTalk.open(self.computer, self.options) as bus:
            if not force:
                await refuse_if_in_use(bus, nodeid)
            async with bus.node(nodeid) as node:
                yield node

    def ask(self, nodeid: int, question: str, answer: str, *, force: bool = False) -> Message:
        """Ask a node by the tools' own way."""

        async def talk() -> Message:
            async with self.talk(nodeid, force=force) as node:
                return (await node.ask(question, answer)).message

        return self.computer.run(talk())

    def is_shut_down(self, nodeid: int) -> bool:
        """Return whether a node is in shutdown."""
        return bool(self.ask(nodeid, "get_config", "config").integer("is_shutdown"))

    def boot_loader(self, uuid: Uuid = BOOT) -> "Katapult":
        """Add a board in its bootloader."""
        return Katapult(self, uuid)

    def squatter(self, uuid: Uuid, nodeid: int) -> WireUser:
        """Add a board that answers, without having been given it, that it has id NODEID.

        It stands for a board that missed whose id that is: a node gives its id up when it hears so.
        """
        answer = CanFrame(ADMIN_RESPONSE_ID, bytes([0x21, *uuid.raw, nodeid]))
        return self.user(lambda frame: answer if frame == CanFrame(ADMIN_ID, b"\x41") else None)


class Katapult:
    """A board in its bootloader, as far as it shows on a CAN bus: it waits for an id with its own command.

    Only what the protocol says of it: QUERY_UNASSIGNED, and SET_NODEID with the bootloader's own command;
    the application's command does not reach it. Its flashing protocol is not played.
    """

    def __init__(self, stage: CanStage, uuid: Uuid) -> None:
        self.uuid = uuid
        self.nodeid = 0
        self.addressed_as_application = False
        """Somebody took it for an application."""
        self._user = stage.user(self._answer)

    def close(self) -> None:
        """Leave the bus."""
        self._user.close()

    def _answer(self, frame: CanFrame) -> CanFrame | None:
        data = frame.data
        if frame.id != ADMIN_ID:
            return None
        if data[:1] == bytes([QUERY_UNASSIGNED]) and not self.nodeid:
            return CanFrame(ADMIN_RESPONSE_ID, bytes([NEED_NODEID, *self.uuid.raw, SET_NODEID_BOOTLOADER]))
        if len(data) == 8 and data[1:7] == self.uuid.raw:
            if data[0] == SET_NODEID_BOOTLOADER:
                self.nodeid = data[7]
            else:
                self.addressed_as_application = True
        return None


@dataclass(frozen=True)
class SixNodes:
    """Six nodes of three kinds, in the states that a bus in trouble has them in."""

    stage: CanStage
    main: WorldNode
    tool: WorldNode
    bed: WorldNode
    twins: tuple[WorldNode, WorldNode]
    boot: Katapult


def six_nodes(stage: CanStage) -> SixNodes:
    """Add the six nodes to STAGE and bring them into their states."""
    nodes = SixNodes(
        stage,
        main=stage.add_node(MAIN, MAIN_ID),
        tool=stage.add_node(TOOL, TOOL_ID, build=TOOLHEAD, legacy=True),
        bed=stage.add_node(BED, legacy=True),
        twins=(stage.add_node(TWIN, build=TOOLHEAD), stage.add_node(TWIN, build=TOOLHEAD)),
        boot=stage.boot_loader(),
    )
    with stage.user() as host:
        shut_down(host, TOOL_ID, TOOLHEAD)
    return nodes


@lru_cache
def conversation_parts() -> tuple[tuple[Frame, ...], ...]:
    """Return what a host and MAIN say: first its dictionary is read, then come the QUESTIONS, one each."""
    stage = CanStage()
    stage.add_node(MAIN, MAIN_ID)
    parts = []

    async def talk(listener: WireListener) -> None:
        async with (
            BusTalk.open(stage.computer, stage.options, DictionaryCache()) as bus,
            bus.node(MAIN_ID) as node,
        ):
            parts.append(tuple(listener.take()))
            for question, answer in QUESTIONS:
                await node.ask(question, answer)
                await node.drained()
                await bus.wait(BOOT_S)  # for the answer's acknowledgement
                parts.append(tuple(listener.take()))

    with stage.computer.listen(stage.options) as listener:
        stage.computer.run(talk(listener))
    return tuple(parts)


def conversation() -> list[Frame]:
    """Return all frames of ``conversation_parts``."""
    return [frame for part in conversation_parts() for frame in part]


def set_nodeid(host: WireUser, uuid: Uuid, nodeid: int, *, times: int = 1) -> None:
    """Give UUID the id NODEID; TIMES: on a bus that loses frames."""
    for _ in range(times):
        host.send(CanFrame(ADMIN_ID, bytes([SET_NODEID, *uuid.raw, nodeid])))


def shut_down(host: WireUser, nodeid: int, build: str) -> None:
    """Tell a node that nobody talked to yet to stop, until it acknowledges that."""
    block = wire_twin.block(0, _dictionary(build).encode("emergency_stop"))
    stream = b""
    for _ in range(100):
        for at in range(0, len(block), 8):
            host.send(CanFrame(nodeid * 2 + 0x100, block[at : at + 8]))
        while (frame := host.receive(0.05)) is not None:
            stream += frame.data if frame.id == nodeid * 2 + 0x101 else b""
        if any(found.sequence == 1 for found in wire_twin.blocks(stream)[0]):
            return
    raise AssertionError(f"node {nodeid} does not take a command")


_dictionary = lru_cache(firmware_dictionary)


@lru_cache
def _compressed(build: str) -> bytes:
    return zlib.compress(firmware_path(build).with_suffix(".json").read_bytes(), 9)
