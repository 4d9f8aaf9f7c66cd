"""A tool that is interrupted, and a bus that ends below it."""

import errno
import signal

import pytest

from canbus_tools.bus.talk import BusTalk
from canbus_tools.discovery.ask_bus import discover_nodes
from nodes.link import Frame
from nodes.support.can_protocol import ADMIN_ID, BUS_OFF
from nodes.support.errors import CanductorError
from nodes.transport import CanFrame
from tests.canbus_tools.command import Command
from tests.stages.can_stage import CanStage


@pytest.mark.parametrize(
    ("number", "status", "name"),
    [(signal.SIGINT, 130, "Ctrl-C"), (signal.SIGTERM, 143, "SIGTERM"), (signal.SIGHUP, 129, "SIGHUP")],
)
def test_a_signal_ends_a_tool_in_order(
    stage: CanStage, can_tool: Command, number: signal.Signals, status: int, name: str
) -> None:
    with stage.user() as host:
        stage.press(number, after_s=5.0)
        said = can_tool("nodes", "--listen", "60")
        assert CanFrame(ADMIN_ID, b"\x00") in host.frames
    assert (said.status, said.out, said.err) == (status, "", f"canductor: stopped by {name}\n")
    assert can_tool("query").status == 0, "the bus is free again"


def test_a_controller_that_goes_off_the_bus_ends_the_question(stage: CanStage) -> None:
    async def ask() -> None:
        async with BusTalk.open(stage.computer, stage.options) as bus:
            # The simulated adapter makes no error reports: the kernel's is put where it would arrive.
            at_ns = stage.world.now_ns + 20_000_000
            stage.world.at(at_ns, lambda: bus._frame_came(Frame(BUS_OFF, bytes(8), 0)))
            await discover_nodes(bus)

    with pytest.raises(CanductorError, match=r"left the bus \(bus-off\).*bit rate.*canductor can doctor"):
        stage.computer.run(ask())


def test_a_bus_that_ends_ends_the_question_in_a_sentence(stage: CanStage) -> None:
    async def ask() -> None:
        async with BusTalk.open(stage.computer, stage.options) as bus:
            stage.world.at(stage.world.now_ns + 20_000_000, lambda: stage.computer.unplug(errno.ENODEV))
            await discover_nodes(bus)

    with pytest.raises(CanductorError, match=r"can0: the connection ended \(No such device\)"):
        stage.computer.run(ask())
