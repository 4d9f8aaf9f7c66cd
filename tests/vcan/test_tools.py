"""The CAN tools on the kernel's CAN: one discovery, one recording, and what an interface cannot do."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from canbus_tools.recordings.candump import candump_line
from canbus_tools.recordings.recordings import read_frames
from nodes.transport import CanFrame, open_can
from nodes.virtual.processes import NodeProcess
from tests.canbus_tools.command import Command
from tests.vcan.kernel import INTERFACE, set_nodeid, why_no_socketcan

pytestmark = pytest.mark.skipif(bool(why_no_socketcan()), reason=why_no_socketcan())

MAIN, TOOL, BED = "90a4ae022dfc", "5e1ec7ab1e02", "bed000000001"
WAIT_S = 60.0
COUNT = 300


@pytest.fixture
def nodes() -> Iterator[None]:
    """Two nodes with ids, one of them Klipper-type, and one that waits for an id."""
    with ExitStack() as stack:
        started = [
            stack.enter_context(process)
            for process in (
                NodeProcess("mainboard", uuid=MAIN, socketcan=INTERFACE),
                NodeProcess("toolhead", uuid=TOOL, socketcan=INTERFACE, legacy=True),
                NodeProcess("mainboard", uuid=BED, socketcan=INTERFACE),
            )
        ]
        for process in started:
            process.wait_ready()
        set_nodeid(MAIN, 4)
        set_nodeid(TOOL, 5)
        yield


@pytest.fixture
def tool(capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(None, capsys, ("-c", INTERFACE))


@pytest.mark.usefixtures("nodes")
def test_discovery(tool: Command) -> None:
    found = tool("nodes", "--json").json["nodes"]
    assert [(n["uuid"], n["nodeid"], n["application"], n["state"]) for n in found] == [
        (MAIN, 4, "canductor", "idle"),
        (TOOL, 5, "klipper-type", "idle"),
        (BED, None, "klipper-type", "waiting"),
    ]


def test_recording(tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    words = [sys.executable, "-m", "coordinator.cli.main", "can", "record", "-c", INTERFACE, "-o", str(path)]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as recorder:
        assert recorder.stderr is not None
        assert recorder.stderr.readline().startswith(f"recording {INTERFACE} to ")
        with closing(open_can(INTERFACE)) as sender:
            for number in range(COUNT):
                sender.send(CanFrame(0x108, number.to_bytes(8)))
        recorder.send_signal(signal.SIGTERM)
        assert recorder.wait(WAIT_S) == 0
    frames = list(read_frames(path))
    assert [int.from_bytes(frame.data) for frame in frames] == list(range(COUNT))
    assert path.read_text() == "".join(map(candump_line, frames))
    assert {(frame.can_id, frame.channel) for frame in frames} == {(0x108, INTERFACE)}


def test_an_interface_without_a_bit_rate(tool: Command) -> None:
    assert f"CAN bus {INTERFACE}: a vcan interface has no bit rate" in tool("load").sentence


def test_an_interface_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    tool = Command(None, capsys, ("-c", "vcan7"))
    assert "vcan7: cannot open: there is no such interface" in tool("query").sentence
    said = tool.run("demo", "--no-web", "--socketcan", "vcan7")
    assert "vcan7: cannot open: there is no such interface" in said.sentence
