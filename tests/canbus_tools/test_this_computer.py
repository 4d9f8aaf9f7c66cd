"""The real computer: the tools on a virtual bus with a node process, and any backend of python-can."""

import asyncio
from contextlib import closing
from pathlib import Path

import can
import pytest

from canbus_tools.bus.computer import Computer, FrameLine
from canbus_tools.bus.open_bus import BusOptions
from nodes.link import Frame
from nodes.support.errors import CanductorError
from nodes.transport import CanFrame
from nodes.virtual.hub import VirtualBus
from nodes.virtual.processes import NodeProcess
from tests.canbus_tools.command import Command

WAIT_S = 60.0
MAIN = "90a4ae022dfc"


def test_a_node_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with VirtualBus(tmp_path / "bus") as bus, NodeProcess("mainboard", uuid=MAIN, can=bus.path) as node:
        node.wait_ready()
        tool = Command(None, capsys, ("-i", "canductor", "-c", str(bus.path)))
        assert [(n["uuid"], n["several_boards"]) for n in tool("query", "--json").json["nodes"]] == [
            (MAIN, False)
        ]
        assert tool("assign", MAIN, 9, "--listen", "0.1").status == 0
        assert f"canbus_uuid={MAIN}" in tool.console("--node", 9, "--force", "-e", "get_canbus_id").out
        assert "listened 0.2 s" in tool("doctor", "--quiet-bus", "--listen", "0.2").out


def test_a_node_on_a_serial_line_is_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with NodeProcess("uart", uuid=MAIN, uart=tmp_path / "tty") as node:
        node.wait_ready()
        said = Command(None, capsys).run("console", "--uart", tmp_path / "tty", "-e", "get_uptime")
        assert "uptime high=" in said.out


def test_any_backend_of_python_can_serves() -> None:
    options = BusOptions(interface="virtual", channel="this computer")
    computer = Computer()
    came: list[int] = []
    with can.Bus(interface="virtual", channel=options.channel) as other:
        bus: FrameLine
        with closing(computer.open_frames(options)) as bus:
            bus.send(CanFrame(0x123, b"there"))
            message = other.recv(WAIT_S)
            assert message is not None
            assert (message.arbitration_id, bytes(message.data)) == (0x123, b"there")
            other.send(can.Message(arbitration_id=0x7FF, data=b"back", is_extended_id=False))
            assert bus.receive(WAIT_S) == CanFrame(0x7FF, b"back")

        async def link() -> None:
            port = computer.open_can(options)
            heard = asyncio.Event()

            def note(frame: Frame) -> None:
                came.append(frame.can_id)
                heard.set()

            io = port.start_io(on_frame=note)
            other.send(can.Message(arbitration_id=0x7FE, is_extended_id=False))
            await heard.wait()
            io.close()
            port.close()

        computer.run(link())
        assert came == [0x7FE]


@pytest.mark.parametrize("interface", ["canductor", "no such backend"])
def test_a_bus_that_is_not_there_is_one_sentence(interface: str, tmp_path: Path) -> None:
    options = BusOptions(interface=interface, channel=str(tmp_path / "none"))
    for open_it in (Computer().open_can, Computer().open_frames, Computer().listen):
        with pytest.raises(CanductorError, match="none"):
            open_it(options)
