"""One session with six nodes: recorded and watched while the tools talk, then decoded and measured."""

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import pytest

from canbus_tools.frame import Frame
from canbus_tools.recordings import read_frames
from coordinator.cli import main
from nodes.virtual.firmware import MAINBOARD, firmware_path
from tests.canbus_tools.command import Command
from tests.canbus_tools.stage import BED, BOOT, MAIN, MAIN_ID, PATIENCE_S, TOOL, TOOL_ID, TWIN, Place, Stage
from tests.nodes.wire_bits import bits_on_wire

QUICK = ("--listen", "0.2")
BED_ID = 17


@dataclass
class Tool:
    """A tool that runs beside the others, until Ctrl-C."""

    process: "subprocess.Popen[str]"
    lines: list[str] = field(default_factory=list)
    _news: threading.Condition = field(default_factory=threading.Condition)

    def read(self, pipe: IO[str]) -> None:
        for line in pipe:
            with self._news:
                self.lines.append(line.rstrip("\n"))
                self._news.notify_all()

    def wait_for(self, words: str) -> None:
        """Wait until it has said WORDS."""
        with self._news:
            assert self._news.wait_for(lambda: any(words in line for line in self.lines), PATIENCE_S), (
                words,
                self.lines[-5:],
            )


@contextmanager
def running(place: Place, *words: str) -> Iterator[Tool]:
    command = [sys.executable, "-u", "-m", "coordinator.cli", "can", *words, *place.words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        tool = Tool(process)
        reader = threading.Thread(target=tool.read, args=(process.stdout,))
        reader.start()
        try:
            yield tool
            process.send_signal(signal.SIGINT)
            assert process.wait(PATIENCE_S) == 0, tool.lines[-5:]
        finally:
            process.kill()
            reader.join(PATIENCE_S)


def test_a_session_is_watched_recorded_decoded_and_measured(
    stage: Stage, can_tool: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "session.mcap"
    place = stage.place
    with running(place, "record", "-o", str(path)) as recorder, running(place, "monitor") as monitor:
        recorder.wait_for("recording")
        while not any("node_is_here" in line for line in monitor.lines):  # it may begin to listen later
            query = can_tool("query", "--json").json
        assert can_tool("assign", str(BED), str(BED_ID), *QUICK).status == 0
        nodes = can_tool("nodes", "--json", *QUICK).json["nodes"]
        asked = ("-e", "get_uptime", "-e", "get_canbus_id")
        assert main(["console", *place.words, "--node", str(MAIN_ID), "--force", *asked]) == 0
        monitor.wait_for(f"canbus_id canbus_uuid={MAIN} canbus_nodeid={MAIN_ID}")
        assert can_tool("release", str(BED_ID), *QUICK).status == 0

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
    frames = list(read_frames(path))
    check_decoded(capsys, path, len(frames))
    check_load(capsys, path, frames)


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
