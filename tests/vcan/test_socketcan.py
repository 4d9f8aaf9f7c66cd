"""Firmware processes and the host on a real kernel's CAN: SocketCAN over vcan0."""

import asyncio
import socket
import struct
from collections import Counter
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from typing import Any

import pytest

from nodes.bus.assign import Uuid
from nodes.bus.can_bus import CanBus
from nodes.dictionary.message_format import Message
from nodes.link import Link, LinkIO, LinkSettings
from nodes.node.config import NodeConfig
from nodes.node.node import Node
from nodes.node.states import NodeState
from nodes.support.can_protocol import ADMIN_ID, ADMIN_RESPONSE_ID
from nodes.support.errors import CanductorError
from nodes.transport import CanFrame, CanTransport, TransportBusyError, TransportClosedError, open_can
from nodes.transport.socketcan import SocketCanTransport
from nodes.virtual.processes import Flavour, NodeProcess
from tests.nodes.machine import make_config, stepper_x
from tests.vcan.kernel import (
    INTERFACE,
    bad_wire,
    control,
    netem_dropped,
    set_down,
    tiny_queue,
    why_no_control,
    why_no_netem,
    why_no_socketcan,
)

pytestmark = pytest.mark.skipif(bool(why_no_socketcan()), reason=why_no_socketcan())
controls_interface = pytest.mark.skipif(bool(why_no_control()), reason=why_no_control())

WAIT_S = 60.0
UUIDS = (Uuid.parse("90a4ae022dfc"), Uuid.parse("5e1ec7ab1e02"))
RECORD = struct.Struct("=IB3x8s")


@pytest.fixture
def processes() -> Iterator[list[NodeProcess]]:
    boards: tuple[tuple[Flavour, Uuid], ...] = (("mainboard", UUIDS[0]), ("toolhead", UUIDS[1]))
    with ExitStack() as stack:
        started = [
            stack.enter_context(NodeProcess(flavour, uuid=str(uuid), socketcan=INTERFACE))
            for flavour, uuid in boards
        ]
        for process in started:
            process.wait_ready()
        yield started


class PatientIO(LinkIO):
    """All of it shares one CPU: a node that stands still for a second is not lost for that."""

    def open_link(self, settings: LinkSettings, **handlers: Any) -> Link:
        return super().open_link(replace(settings, lost_after_s=WAIT_S / 2), **handlers)


class Bench:
    """A bus on vcan0 with two nodes."""

    def __init__(self, transport: SocketCanTransport) -> None:
        self.transport = transport
        self.io: LinkIO | None = None
        self.bus = CanBus(INTERFACE, self._start_io)
        self.nodes = [
            self.bus.add_node(f"node{i}", uuid, make_config(stepper_x())) for i, uuid in enumerate(UUIDS)
        ]
        self.timeouts = [0] * len(UUIDS)
        """Of each link, once all was answered: a node counts what is sent before such a repeat as lost."""

    def _start_io(self, **handlers: Any) -> LinkIO:
        self.io = PatientIO(self.transport, asyncio.get_running_loop(), **handlers)
        return self.io

    def run(self, test: Callable[[], Coroutine[object, object, None]]) -> None:
        """Start the bus, run TEST, close the bus."""

        async def main() -> None:
            async with asyncio.timeout(WAIT_S):
                await self.bus.start()
                try:
                    await test()
                    self.timeouts = [
                        node.link.stats().timeouts for node in self.nodes if node.state is NodeState.READY
                    ]
                finally:
                    await self.bus.close()

        asyncio.run(main())


@pytest.fixture
def bench() -> Iterator[Bench]:
    with closing(SocketCanTransport(INTERFACE)) as transport:
        yield Bench(transport)


async def ping(node: Node, count: int) -> list[bytes]:
    """Have NODE echo 0..COUNT-1, sent without waiting for answers; return what came, in order."""
    echoed: list[bytes] = []
    complete = asyncio.Event()

    def came(pong: Message) -> None:
        echoed.append(pong.data("data"))
        if len(echoed) >= count:
            complete.set()

    end = node.on("pong", None, came)
    for number in range(count):
        node.send("debug_ping", data=number.to_bytes(2) * 4)
    try:
        await asyncio.wait_for(complete.wait(), WAIT_S / 2)
    except TimeoutError:
        raise AssertionError(f"{len(echoed)} of {count} came; {node.state}, {node.failure}") from None
    end()
    return echoed


def expected_echo(count: int) -> list[bytes]:
    return [number.to_bytes(2) * 4 for number in range(count)]


class Witness:
    """Sees every frame that the kernel took from anybody."""

    def __init__(self) -> None:
        self.transport = SocketCanTransport(INTERFACE)

    def close(self) -> None:
        self.transport.close()

    def frames(self) -> list[CanFrame]:
        assert self.transport.dropped == 0
        return list(iter(lambda: self.transport.receive(0), None))


def stop_and_check(witness: Witness, bench: Bench, processes: list[NodeProcess]) -> list[CanFrame]:
    """Check that the kernel took every frame that was made and no block has a hole; return the frames."""
    assert bench.io is not None
    ends = [process.stop() for process in processes]
    frames = witness.frames()
    seen = Counter(frame.id for frame in frames)
    ids = {4: 0x108, 5: 0x10A}
    assert seen.keys() == {ADMIN_ID, ADMIN_RESPONSE_ID, *ids.values(), *(i + 1 for i in ids.values())}
    from_host = seen[ADMIN_ID] + sum(seen[i] for i in ids.values())
    assert bench.io.stats().frames_sent == from_host
    assert sum(end["frames_out"] for end in ends) == seen.total() - from_host
    assert all(end["lost"] <= timeouts for end, timeouts in zip(ends, bench.timeouts, strict=True))
    bad = ("overflow_bytes", "tx_dropped", "is_shutdown")
    assert [{name: end[name] for name in bad} for end in ends] == [dict.fromkeys(bad, 0)] * 2
    return frames


def raw_socket() -> socket.socket:
    """Open the bus past everything that is ours."""
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sock.bind((INTERFACE,))
    sock.settimeout(WAIT_S)
    return sock


def test_nodes_are_assigned_identified_configured_and_queried(
    processes: list[NodeProcess], bench: Bench
) -> None:
    async def check() -> None:
        assert [node.state for node in bench.nodes] == [NodeState.READY] * 2
        assert [bench.bus.nodeid(uuid) for uuid in UUIDS] == [4, 5]
        for node in bench.nodes:
            found = await node.query("get_config", "config")
            wanted = NodeConfig("mainboard", node.dictionary)
            stepper_x().configure(wanted)
            assert (found.integer("is_config"), found.integer("crc")) == (1, wanted.crc)
            assert await ping(node, 50) == expected_echo(50)

    with closing(Witness()) as witness:
        bench.run(check)
        frames = stop_and_check(witness, bench, processes)
    assert bench.transport.dropped == 0
    # Asked for, named by themselves, and given their ids, for everybody on the bus to see.
    assert CanFrame(ADMIN_ID, b"\x00") in frames
    for nodeid, uuid in zip((4, 5), UUIDS, strict=True):
        assert any(f.id == ADMIN_RESPONSE_ID and f.data[:7] == b"\x20" + uuid.raw for f in frames)
        assert CanFrame(ADMIN_ID, b"\x01" + uuid.raw + bytes([nodeid])) in frames


@pytest.mark.skipif(bool(why_no_netem()), reason=why_no_netem())
def test_nodes_get_ids_and_answer_in_spite_of_lost_and_late_frames(
    processes: list[NodeProcess], bench: Bench
) -> None:
    """Ids, dictionaries, configuration and answers come through."""

    async def check() -> None:
        assert [bench.bus.nodeid(uuid) for uuid in UUIDS] == [4, 5]
        for node in bench.nodes:
            for _ in range(20):
                assert (await node.query("get_config", "config")).integer("is_config") == 1
        assert sum(node.link.stats().blocks_repeated for node in bench.nodes) > 0

    with bad_wire("loss 3%", "delay 2ms"):
        bench.run(check)
        assert netem_dropped() > 5
    ends = [process.stop() for process in processes]
    assert [(end["is_shutdown"], end["tx_dropped"]) for end in ends] == [(False, 0)] * 2


def test_frames_of_other_protocols_on_the_bus_disturb_nobody(
    processes: list[NodeProcess], bench: Bench
) -> None:
    others = (socket.CAN_EFF_FLAG | 0x108, socket.CAN_RTR_FLAG | 0x108, 0x7FF)

    async def check() -> None:
        before = [node.link.stats().bytes_invalid for node in bench.nodes]
        with raw_socket() as stranger:
            for _ in range(50):
                for can_id in others:
                    stranger.send(RECORD.pack(can_id, 8, bytes(8)))
                assert await ping(bench.nodes[0], 3) == expected_echo(3)
        assert bench.io is not None
        # Those with eleven bits are no node's either, but might be; the other kinds do not even arrive.
        assert bench.io.stats().frames_malformed == 0
        assert [node.link.stats().bytes_invalid for node in bench.nodes] == before

    bench.run(check)
    ends = [process.stop() for process in processes]
    assert all(end["lost"] <= timeouts for end, timeouts in zip(ends, bench.timeouts, strict=True))


def test_transport_drops_what_is_no_plain_frame() -> None:
    with closing(SocketCanTransport(INTERFACE)) as transport, raw_socket() as stranger:
        for can_id in (socket.CAN_EFF_FLAG | 1, socket.CAN_RTR_FLAG | 2, 3):
            stranger.send(RECORD.pack(can_id, 1, b"x"))
        assert transport.receive(WAIT_S) == CanFrame(3, b"x")
        assert transport.receive(0) is None


def test_frames_nobody_reads_in_time_are_counted() -> None:
    with closing(SocketCanTransport(INTERFACE)) as transport, raw_socket() as stranger:
        frames = [CanFrame(1, number.to_bytes(4)) for number in range(10_000)]
        sent = 0
        while transport.dropped == 0:
            stranger.send(frames[sent].to_record())
            sent += 1
        room = sent - 1
        assert room > 5_000  # half a second of a full bus
        assert [transport.receive(0) for _ in range(room)] == frames[:room]
        assert transport.receive(0) is None
        assert transport.dropped == 1


@controls_interface
def test_full_interface_queue_costs_time_and_no_frame(processes: list[NodeProcess], bench: Bench) -> None:
    """ENOBUFS on both sides: the host and a node share the two places of the queue."""
    count = 30

    async def check() -> None:
        assert bench.io is not None
        before = bench.io.stats().waits
        with tiny_queue(rate_kbit=256):
            echoes = [await ping(node, count) for node in bench.nodes]
        assert echoes == [expected_echo(count)] * 2
        assert bench.io.stats().waits > before
        assert {node.link.stats().bytes_invalid for node in bench.nodes} == {0}

    with closing(Witness()) as witness:
        bench.run(check)
        stop_and_check(witness, bench, processes)


@controls_interface
def test_send_waits_for_room_in_a_full_queue_as_long_as_it_may() -> None:
    with closing(open_can(INTERFACE)) as sender, closing(open_can(INTERFACE)) as receiver:
        frames = [CanFrame(0x108, number.to_bytes(2)) for number in range(200)]
        with tiny_queue():
            for frame in frames:
                sender.send(frame, WAIT_S)
            assert [receiver.receive(WAIT_S) for _ in frames] == frames
        with tiny_queue(rate_kbit=1):
            taken = send_until_busy(sender, frames)
        # Those that waited in the queue went with it, if vcan passes frames on behind it (echo=1).
        arrived = list(iter(lambda: receiver.receive(0), None))
        assert taken - 2 <= len(arrived) <= taken
        assert arrived == frames[: len(arrived)]


def send_until_busy(sender: CanTransport, frames: list[CanFrame]) -> int:
    for taken, frame in enumerate(frames):
        try:
            sender.send(frame, 0)
        except TransportBusyError as error:
            assert "frames are not accepted" in str(error)  # noqa: PT017
            return taken
    pytest.fail("a full queue took frames without end")


@controls_interface
def test_interface_set_down_is_told_in_a_sentence_and_used_again_when_up() -> None:
    with closing(open_can(INTERFACE)) as transport:
        with set_down():
            with pytest.raises(TransportClosedError, match=rf"is down; .*'ip link set {INTERFACE} up"):
                transport.receive(WAIT_S)
            with pytest.raises(TransportClosedError, match="the interface is down"):
                transport.send(CanFrame(1, b""))
            with pytest.raises(CanductorError, match=f"{INTERFACE}: cannot open: the interface is down"):
                open_can(INTERFACE)
        with closing(open_can(INTERFACE)) as other:
            other.send(CanFrame(1, b"up"))
        assert transport.receive(WAIT_S) == CanFrame(1, b"up")


@controls_interface
def test_bus_learns_that_its_interface_was_set_down_and_nodes_live_on(
    processes: list[NodeProcess], bench: Bench
) -> None:
    async def check() -> None:
        for node in bench.nodes:
            for number in range(200):
                node.send("debug_ping", data=number.to_bytes(2))
        with set_down():
            lost = [node.state is NodeState.LOST for node in bench.nodes]
            while not all(lost):
                await asyncio.sleep(0)
                lost = [node.state is NodeState.LOST for node in bench.nodes]
        said = str(bench.nodes[0].failure)
        assert f"{INTERFACE}: the connection ended (Network is down); the interface was set down" in said
        assert "\n" not in said

    bench.run(check)
    # The boards kept their power: the next host finds them.
    with closing(SocketCanTransport(INTERFACE)) as transport:
        Bench(transport).run(lambda: asyncio.sleep(0))
    for process in processes:
        assert not process.stop()["is_shutdown"]


@controls_interface
def test_node_tells_when_its_interface_is_removed() -> None:
    control("ip", "link", "add", "dev", "vcan9", "type", "vcan")
    control("ip", "link", "set", "vcan9", "up")
    node = NodeProcess("mainboard", uuid=str(UUIDS[0]), socketcan="vcan9")
    node.wait_ready()
    with closing(open_can("vcan9")) as transport:
        control("ip", "link", "del", "vcan9")
        with pytest.raises(TransportClosedError, match="CAN interface vcan9: cannot continue to use it: "):
            transport.receive(WAIT_S)
    with pytest.raises(CanductorError, match="status 1: cannot go on without the CAN interface vcan9: "):
        node.wait_end(WAIT_S)  # by itself: it sees the interface down first, and tries it again later
