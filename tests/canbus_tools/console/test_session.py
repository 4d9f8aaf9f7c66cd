"""One session with six nodes: the tools talk, what was on the bus is recorded, decoded and measured."""

import json
from pathlib import Path

import pytest

from canbus_tools.protocol.frame import Frame
from canbus_tools.recordings.recordings import read_frames
from coordinator.cli.main import main
from nodes.virtual.firmware import MAINBOARD, firmware_path
from tests.canbus_tools.command import Command
from tests.nodes.wire_bits import bits_on_wire
from tests.stages.can_stage import BED, BOOT, MAIN, MAIN_ID, TOOL, TOOL_ID, TWIN, CanStage, SixNodes

BED_ID = 17


def test_a_session_is_recorded_decoded_and_measured(
    six: SixNodes, can_tool: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stage = six.stage
    with stage.computer.listen(stage.options) as listener:
        query = can_tool("query", "--json").json
        assert can_tool("assign", str(BED), str(BED_ID)).status == 0
        nodes = can_tool("nodes", "--json").json["nodes"]
        asked = ("-e", "get_uptime", "-e", "get_canbus_id")
        said = can_tool.console("--node", MAIN_ID, *asked)
        assert f"canbus_id canbus_uuid={MAIN} canbus_nodeid={MAIN_ID}" in said.out
        assert can_tool("release", str(BED_ID)).status == 0
        session = listener.take()

    assert {n["uuid"] for n in query["nodes"]} == {str(u) for u in (BED, TWIN, BOOT)}
    assert sorted((n["uuid"], n["nodeid"], n["state"], n["several_boards"]) for n in nodes) == sorted(
        [
            (str(MAIN), MAIN_ID, "idle", False),
            (str(TOOL), TOOL_ID, "shutdown", False),
            (str(BED), BED_ID, "idle", False),
            (str(TWIN), None, "waiting", True),
            (str(BOOT), None, "bootloader", False),
        ]
    )
    path = record(session, capsys, tmp_path)
    frames = list(read_frames(path))
    assert [frame[1:3] for frame in frames] == [frame[1:3] for frame in session]
    check_decoded(capsys, path, len(frames))
    check_load(capsys, path, frames)


def record(session: list[Frame], capsys: pytest.CaptureFixture[str], folder: Path) -> Path:
    """Have the frames of SESSION recorded from another bus; return the file."""
    path = folder / "session.mcap"
    stage = CanStage()
    stage.replay(session)
    tool = Command(stage.computer, capsys, stage.words)
    seconds = session[-1].time_s - session[0].time_s
    said = tool("record", "-o", path, "--duration", seconds + 1, "--json")
    assert (said.status, said.json["frames"]) == (0, len(session))
    return path


def check_decoded(capsys: pytest.CaptureFixture[str], path: Path, frames: int) -> None:
    capsys.readouterr()
    dictionary = f"{BED_ID}={firmware_path(MAINBOARD).with_suffix('.json')}"
    assert main(["can", "decode", str(path), "--json", "--dictionary", dictionary]) == 0
    *lines, last = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert last["frames"] == frames
    # Noise there is: asked who has an id, 'can nodes' sends blocks that only make a node say what it expects.
    assert not [line for line in lines if line["kind"] in {"error", "other"}]
    said = [(line.get("nodeid"), line.get("direction"), line["text"]) for line in lines]
    story = [
        (None, "from", f"need_nodeid uuid={BOOT} set_command=bootloader"),
        (MAIN_ID, "from", f"node_is_here uuid={MAIN} nodeid={MAIN_ID}"),
        (BED_ID, "to", f"set_nodeid uuid={BED} nodeid={BED_ID}"),
        (MAIN_ID, "to", "get_uptime"),
        (MAIN_ID, "from", f"canbus_id canbus_uuid={MAIN} canbus_nodeid={MAIN_ID}"),
        (BED_ID, "to", "reset"),
        (None, "from", f"need_nodeid uuid={BED} set_command=application"),
    ]
    at = 0
    for wanted in story:
        assert wanted in said[at:]
        at = said.index(wanted, at)


def check_load(capsys: pytest.CaptureFixture[str], path: Path, frames: list[Frame]) -> None:
    assert main(["can", "load", str(path), "--bitrate", "1000000", "--json"]) == 0
    load = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert load["frames"] == len(frames)
    assert load["bits"] == sum(bits_on_wire(frame.can_id, frame.data) for frame in frames)
