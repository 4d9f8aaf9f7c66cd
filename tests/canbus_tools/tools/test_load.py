"""``canductor can load``: on recorded traffic of real nodes, live, and what it refuses."""

import signal
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from canbus_tools.bus.talk import BusTalk
from canbus_tools.protocol.frame import Frame
from canbus_tools.recordings.candump import candump_line
from canbus_tools.recordings.recordings import read_frames
from canbus_tools.tools.load import find_bitrate
from coordinator.cli.main import main
from nodes.transport import CanFrame
from tests.canbus_tools.command import Command, Said
from tests.nodes.wire_bits import bits_on_wire
from tests.stages.can_stage import MAIN, MAIN_ID, CanStage

BITRATE = "1000000"
QUESTIONS = 200


@pytest.fixture
def recording(stage: CanStage, tmp_path: Path) -> Path:
    """What a real node and a host say to each other: id, dictionary, questions and answers."""

    async def talk() -> None:
        async with BusTalk.open(stage.computer, stage.options) as bus, bus.node(MAIN_ID) as node:
            for _ in range(QUESTIONS):
                await node.ask("get_uptime", "uptime")

    path = tmp_path / "session.log"
    with stage.computer.listen(stage.options) as listener:
        stage.add_node(MAIN, MAIN_ID)
        stage.computer.run(talk())
        path.write_text("".join(map(candump_line, listener.take())))
    return path


def run(capsys: pytest.CaptureFixture[str], *words: object) -> Said:
    capsys.readouterr()
    status = main(["can", "load", *map(str, words)])
    said = capsys.readouterr()
    return Said(status, said.out, said.err)


def test_agrees_with_an_independent_count_of_bits(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = list(read_frames(recording))
    assert len(frames) > 2 * QUESTIONS
    counted = sum(bits_on_wire(frame.can_id, frame.data) for frame in frames)
    seconds = frames[-1].time_s - frames[0].time_s
    said = run(capsys, recording, "--bitrate", BITRATE, "--window", "0.1", "--json")
    assert said.status == 0
    assert said.json["frames"] == len(frames)
    assert said.json["bits"] == counted  # not within 1 %: to the bit
    assert said.json["mean"] == pytest.approx(counted / (seconds * int(BITRATE)), rel=0.01)
    windows = said.json["windows"]
    assert sum(sum(window["bits"].values()) for window in windows) == counted
    of_classes = {name: part["frames"] for name, part in said.json["classes"].items()}
    assert of_classes["admin"] == 1
    assert of_classes["to nodes"] >= QUESTIONS
    assert of_classes["from nodes"] >= QUESTIONS
    to_node = [f for f in frames if f.can_id == 2 * MAIN_ID + 0x100]
    assert said.json["ids"]["108"]["bits"] == sum(bits_on_wire(f.can_id, f.data) for f in to_node)


def test_as_tables_with_a_plot(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plot = tmp_path / "load.svg"
    said = run(capsys, recording, "--bitrate", BITRATE, "--window", "0.05", "--plot", plot)
    assert said.status == 0
    for words in ("of 1000000 bit/s in", "from node 4", "to node 4", "admin, host", f"plot: {plot}"):
        assert words in said.out
    picture = ET.fromstring(plot.read_text())  # noqa: S314 (our own)
    assert len(picture.findall("{*}polygon")) == 3
    assert "load of" in plot.read_text()


def test_live(stage: CanStage, can_tool: Command) -> None:
    with stage.repeating(CanFrame(0x555, b"12345678"), 0.005):
        said = can_tool("load", "--bitrate", "250000", "--duration", "1", "--window", "0.1", "--json")
    assert said.status == 0
    frames = said.json["frames"]
    assert 199 <= frames <= 200
    assert said.json["duration_s"] == pytest.approx(1.0)
    bits = frames * bits_on_wire(0x555, b"12345678")
    assert said.json["mean"] == pytest.approx(bits / 250_000, rel=1e-3)
    assert list(said.json["ids"]) == ["555"]
    assert [19 <= window["frames"] <= 21 for window in said.json["windows"][:10]] == [True] * 10


def test_watch_until_ctrl_c_still_reports(stage: CanStage, can_tool: Command) -> None:
    stage.press(signal.SIGINT, after_s=3.5)
    with stage.repeating(CanFrame(0x555, b"12345678"), 0.001):
        said = can_tool("load", "--bitrate", BITRATE, "--watch")
    assert said.status == 0
    assert said.out.count("mean") == 4, "one line at once and each second"
    assert "of 1000000 bit/s in 3.5 s" in said.out
    assert "555" in said.out


def test_a_silent_bus_is_said_to_be_silent(can_tool: Command) -> None:
    said = can_tool("load", "--bitrate", BITRATE, "--duration", "0.1")
    assert (said.status, "no frame in 0.1 s" in said.out) == (0, True)


def test_bit_rate_must_be_known(stage: CanStage, can_tool: Command) -> None:
    assert "--bitrate 1000000" in can_tool("load", "--duration", "0.1").sentence
    with pytest.raises(Exception, match="--bitrate 1000000"):
        find_bitrate(stage.options)


def test_recordings_of_several_buses_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "two.log"
    path.write_text("(1.000000) can0 123#00\n(2.000000) can1 123#00\n")
    assert "frames of several buses (can0, can1)" in run(capsys, path, "--bitrate", BITRATE).sentence


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["x.log"], "--bitrate is missing"),
        (["x.log", "-b", "5"], "--bitrate is '5'"),
        (["x.log", "-b", BITRATE, "--watch"], "do not apply"),
        (["--window", "0"], "--window is '0'"),
        (["--duration", "0"], "--duration is '0'"),
        (["--plot", "x.pdf"], "must be a file that ends in .svg or .png"),
    ],
)
def test_usage(words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]) -> None:
    said = run(capsys, *words)
    assert said.status == 2
    assert complaint in said.err


def test_a_plot_that_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "one.log"
    path.write_text("(1.000000) can0 123#00\n")
    assert Frame(1.0, 0x123, b"\0", channel="can0") == next(read_frames(path))
    said = run(capsys, path, "--bitrate", BITRATE, "--plot", tmp_path / "none" / "x.svg")
    assert "cannot be written" in said.sentence
