"""Six nodes of three kinds on one bus, in the states that a bus in trouble has them in.

On the project's virtual bus, or on vcan0 where the kernel has one (``make vcan``): tests are written once.
"""

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from canbus_tools.open_bus import BusOptions
from nodes.assign import ADMIN_ID, SET_NODEID, Uuid
from nodes.transport import CanFrame, CanTransport, open_can
from nodes.virtual.firmware import TOOLHEAD, firmware_dictionary
from nodes.virtual.hub import VirtualBus
from nodes.virtual.processes import Flavour, NodeProcess
from tests import wire_twin
from tests.canbus_tools.katapult import Katapult
from tests.vcan.kernel import INTERFACE, why_no_socketcan

PATIENCE_S = 60.0
"""Only something broken makes anyone wait so long."""


@dataclass(frozen=True)
class Place:
    """A bus to test on, in python-can's words."""

    interface: str
    channel: str

    @property
    def is_virtual(self) -> bool:
        return self.interface == "canductor"

    @property
    def spec(self) -> str:
        """As ``open_can`` wants it."""
        return f"virtual:{self.channel}" if self.is_virtual else self.channel

    @property
    def words(self) -> list[str]:
        """As a tool's command line wants it."""
        return ["--interface", self.interface, "--channel", self.channel]

    @property
    def options(self) -> BusOptions:
        return BusOptions(interface=self.interface, channel=self.channel)

    def open(self) -> CanTransport:
        return open_can(self.spec)

    def start_node(
        self, flavour: Flavour, uuid: Uuid, *, legacy: bool = False, seed: int | None = None
    ) -> NodeProcess:
        name = f"{'Klipper-type' if legacy else 'our'} {flavour} {uuid}"
        if self.is_virtual:
            path = Path(self.channel)
            return NodeProcess(flavour, uuid=str(uuid), can=path, legacy=legacy, seed=seed, name=name)
        return NodeProcess(
            flavour, uuid=str(uuid), socketcan=self.channel, legacy=legacy, seed=seed, name=name
        )


@contextmanager
def any_place(folder: Path, *, bitrate: int | None = 1_000_000) -> Iterator[Place]:
    """Yield vcan0 where there is one, else a virtual bus of BITRATE in FOLDER."""
    if not why_no_socketcan():
        yield Place("socketcan", INTERFACE)
        return
    with VirtualBus(folder / "bus", bitrate=bitrate) as bus:
        yield Place("canductor", str(bus.path))


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


@dataclass(frozen=True)
class Stage:
    """The six nodes."""

    place: Place
    main: NodeProcess
    tool: NodeProcess
    bed: NodeProcess
    twins: tuple[NodeProcess, NodeProcess]
    boot: Katapult


@contextmanager
def six_nodes(place: Place) -> Iterator[Stage]:
    """Start the six nodes on PLACE and bring them into their states."""
    with ExitStack() as stack:
        main, tool, bed, *twins = [
            stack.enter_context(process)
            for process in (
                place.start_node("mainboard", MAIN),
                place.start_node("toolhead", TOOL, legacy=True),
                place.start_node("mainboard", BED, legacy=True),
                place.start_node("toolhead", TWIN, seed=1),
                place.start_node("toolhead", TWIN, seed=2),
            )
        ]
        boot = stack.enter_context(Katapult(stack.enter_context(closing(place.open())), BOOT))
        for process in (main, tool, bed, *twins):
            process.wait_ready()
        with closing(place.open()) as host:  # not for longer: the virtual bus waits for who does not read
            for _ in range(3):  # a bus may be told to lose frames
                set_nodeid(host, MAIN, MAIN_ID)
                set_nodeid(host, TOOL, TOOL_ID)
            shut_down(host, TOOL_ID)
        yield Stage(place, main, tool, bed, (twins[0], twins[1]), boot)


def set_nodeid(host: CanTransport, uuid: Uuid, nodeid: int) -> None:
    host.send(CanFrame(ADMIN_ID, bytes([SET_NODEID, *uuid.raw, nodeid])))


def shut_down(host: CanTransport, nodeid: int, build: str = TOOLHEAD) -> None:
    """Tell a node that nobody talked to yet to stop, until it acknowledges that."""
    block = wire_twin.block(0, firmware_dictionary(build).encode("emergency_stop"))
    deadline_s = time.monotonic() + PATIENCE_S
    stream = b""
    while all(found.sequence != 1 for found in wire_twin.blocks(stream)[0]):
        assert time.monotonic() < deadline_s, f"node {nodeid} does not take a command"
        for at in range(0, len(block), 8):
            host.send(CanFrame(nodeid * 2 + 0x100, block[at : at + 8]))
        while (frame := host.receive(0.05)) is not None:
            stream += frame.data if frame.id == nodeid * 2 + 0x101 else b""
