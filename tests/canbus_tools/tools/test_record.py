"""``canductor can record``: complete files, however it ends."""

import errno
import json
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.frame import Frame
from canbus_tools.recordings.mcap_file import COUNTERS, FRAMES, MESSAGES
from canbus_tools.recordings.recordings import read_frames
from canbus_tools.tools.record import DRAIN_S
from coordinator.cli.main import main
from nodes.transport import CanFrame
from tests.canbus_tools.command import Command
from tests.canbus_tools.talk_twin import Talk, download, identify_pieces
from tests.stages.can_stage import CanStage

Output = pytest.CaptureFixture[str]


def session() -> list[Frame]:
    talk = Talk().frame(0x3F0, b"\x01" + bytes.fromhex("90a4ae022dfc") + b"\x04")
    return download(talk, identify_pieces()).command(1, "get_clock").response(2, "clock", clock=77).frames


def contents(frames: list[Frame]) -> list[tuple[int, bytes]]:
    return [(frame.can_id, frame.data) for frame in frames]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_mcap_has_frames_messages_and_counters(
    stage: CanStage, can_tool: Command, tmp_path: Path, number: signal.Signals
) -> None:
    path = tmp_path / "some.mcap"
    frames = session()
    stage.replay(frames)
    began_s = stage.computer.unix_s()
    stage.press(number, after_s=5.0)
    said = can_tool("record", "-o", path, "--json")
    assert (said.status, said.json["ok"], said.json["frames"]) == (0, True, len(frames))
    assert said.json["dropped_frames"] == 0
    found = list(read_frames(path))
    assert contents(found) == contents(frames)
    assert all(began_s < frame.time_s < began_s + 5.0 for frame in found)
    check_mcap(path, len(frames))


def check_mcap(path: Path, frames: int) -> None:
    found: dict[str, list[dict[str, Any]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            values = json.loads(message.data)
            assert values.keys() <= json.loads(schema.data)["properties"].keys()
            found.setdefault(channel.topic, []).append(values)
    assert len(found[FRAMES]) == frames
    assert found[MESSAGES][-1]["text"] == "clock clock=77"
    assert found[MESSAGES][0]["params"] == {"uuid": "90a4ae022dfc", "nodeid": 4}
    [node] = found[COUNTERS][-1]["nodes"]
    assert (node["mcu"], node["from_node"]["messages"]) == ("twin", len(identify_pieces()) + 1)
    assert found[COUNTERS][-1]["frames"] == frames


def test_candump_log(stage: CanStage, can_tool: Command, tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    frames = session()
    stage.replay(frames)
    said = can_tool("record", "-o", path, "--json", "--duration", "5")
    assert (said.status, said.json["frames"], said.json["bytes"]) == (0, len(frames), path.stat().st_size)
    assert contents(list(read_frames(path))) == contents(frames)


def test_what_is_on_its_way_when_the_user_stops_is_recorded(
    stage: CanStage, can_tool: Command, tmp_path: Path
) -> None:
    path = tmp_path / "some.log"
    frames = session()  # a millisecond apart
    stage.replay(frames, after_s=0.1)
    stage.press(signal.SIGINT, after_s=0.1 + len(frames) / 2 * 0.001)
    assert can_tool("record", "-o", path).status == 0
    assert contents(list(read_frames(path))) == contents(frames)


def test_a_bus_that_is_never_quiet_ends_soon_all_the_same(
    stage: CanStage, can_tool: Command, tmp_path: Path
) -> None:
    path = tmp_path / "some.log"
    with stage.repeating(CanFrame(0x555, b"12345678"), 0.005):
        began_ns = stage.world.now_ns
        assert can_tool("record", "-o", path, "--duration", "0.5").status == 0
        assert 0.5e9 <= stage.world.now_ns - began_ns <= (0.5 + DRAIN_S + 0.1) * 1e9
    assert 0.5 / 0.005 <= len(list(read_frames(path))) <= (0.5 + DRAIN_S) / 0.005 + 1


def test_it_ends_after_its_duration(stage: CanStage, can_tool: Command, tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    began_ns = stage.world.now_ns
    said = can_tool("record", "-o", path, "--duration", "0.1")
    assert said.out == f"0 frames of canductor:can0 recorded to '{path}' (0 bytes)\n"
    assert said.err == f"recording canductor:can0 to '{path}'; Ctrl-C ends it\n"
    assert 0.1e9 <= stage.world.now_ns - began_ns < 0.2e9


@pytest.mark.parametrize("suffix", ["log", "mcap"])
def test_a_full_disk_is_one_sentence(stage: CanStage, can_tool: Command, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"full.{suffix}"
    path.symlink_to("/dev/full")
    # A log is written all the time, and the first failure ends it; so little MCAP is written at the end.
    stage.replay(session() * 20 if suffix == "log" else session())
    said = can_tool("record", "-o", path, "--json", "--force", "--duration", "5")
    assert said.status == 1
    assert said.json["error"].startswith(f"writing '{path}' failed after ")
    assert said.json["error"].endswith(
        " frames: No space left on device; free some space, or record elsewhere"
    )


@pytest.mark.parametrize("suffix", ["log", "mcap"])
def test_a_bus_that_goes_away(stage: CanStage, can_tool: Command, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"some.{suffix}"
    stage.replay(session()[:3])
    stage.world.at(stage.world.now_ns + 2_000_000_000, lambda: stage.computer.unplug(errno.ENODEV))
    said = can_tool("record", "-o", path, "--json")
    assert said.status == 1
    assert said.json["error"].startswith("CAN bus canductor:can0: can0: the connection ended")
    assert contents(list(read_frames(path))) == contents(session()[:3])


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["-o", "some.txt"],
            "--output is 'some.txt', must be a file that ends in .mcap or .log",
        ),
        (["-o", "some.log", "--duration", "x"], "--duration is 'x', must be a number from 0.1 to 1e+07 s"),
    ],
)
def test_wrong_words(capsys: Output, words: list[str], sentence: str) -> None:
    assert main(["can", "record", *words]) == 2
    assert capsys.readouterr().err.startswith(f"canductor: {sentence}")


def test_a_file_is_not_overwritten_by_mistake(capsys: Output, tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    path.write_text("precious")
    assert main(["can", "record", "-o", str(path)]) == 2
    assert f"'{path}' exists already; give --force to overwrite it" in capsys.readouterr().err
    assert path.read_text() == "precious"


def test_what_the_decoder_holds_does_not_grow() -> None:
    talk = Talk().command(1, "get_clock").response(2, "clock", clock=77).command(2, "get_uptime")
    decoder = BusDecoder()

    def decode(rounds: int) -> int:
        for n in range(rounds):
            for frame in talk.frames:
                decoder.feed(frame._replace(time_s=frame.time_s + n * 0.01))
        return sys.getallocatedblocks()

    before = decode(2500)
    assert decode(2500) - before < 1000
