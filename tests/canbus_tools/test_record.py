"""``canductor can record``: complete files, however it ends."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest
from mcap.reader import make_reader

from canbus_tools.decoder import BusDecoder
from canbus_tools.frame import Frame
from canbus_tools.mcap_file import COUNTERS, FRAMES, MESSAGES
from canbus_tools.recordings import read_frames
from coordinator.cli import main
from nodes.virtual.hub import VirtualBus
from tests.canbus_tools.talk_twin import Talk, identify_pieces

Output = pytest.CaptureFixture[str]
BusName = tuple[str, str]


@pytest.fixture(autouse=True)
def no_users_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(params=["canductor", "socketcan"])
def bus(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[BusName]:
    """Yield interface and channel of a bus: virtual, and the kernel's where it has one."""
    if request.param == "socketcan":
        if not Path("/sys/class/net/vcan0").exists():
            pytest.skip("this kernel has no vcan0; 'make vcan' runs this where there is one")
        yield "socketcan", "vcan0"
        return
    path = tmp_path / "bus.sock"
    with VirtualBus(path, bitrate=None):
        yield "canductor", str(path)


class Recorder:
    """The tool as a process; recording once it is constructed."""

    def __init__(self, bus: BusName, path: Path, *options: str) -> None:
        interface, channel = bus
        words = ["can", "record", "-i", interface, "-c", channel, "-o", str(path), "--json", *options]
        command = [sys.executable, "-u", "-m", "coordinator.cli", *words]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stderr is not None
        self.first_line = self.process.stderr.readline()

    def end(self, number: int = signal.SIGINT) -> tuple[dict[str, Any], int]:
        if number:
            os.kill(self.process.pid, number)
        out, _ = self.process.communicate(timeout=60)
        return json.loads(out.splitlines()[-1]), self.process.returncode


def session() -> list[Frame]:
    talk = Talk().frame(0x3F0, b"\x01" + bytes.fromhex("90a4ae022dfc") + b"\x04")
    for n, (offset, data) in enumerate(identify_pieces()):
        talk.response(n, "identify_response", offset=offset, data=data)
    return talk.command(1, "get_clock").response(2, "clock", clock=77).frames


def send(bus: BusName, frames: list[Frame]) -> None:
    """Send FRAMES, and wait until a second client has received them all."""
    interface, channel = bus
    with (
        can.Bus(interface=interface, channel=channel) as sender,
        can.Bus(interface=interface, channel=channel) as listener,
    ):
        for frame in frames:
            sender.send(frame.to_message(), timeout=20)
            assert listener.recv(20) is not None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_mcap_has_frames_messages_and_counters(bus: BusName, tmp_path: Path, number: int) -> None:
    path = tmp_path / "some.mcap"
    recorder = Recorder(bus, path)
    frames = session()
    send(bus, frames)
    report, status = recorder.end(number)
    assert (status, report["ok"], report["frames"]) == (0, True, len(frames))
    assert [(f.can_id, f.data) for f in read_frames(path)] == [(f.can_id, f.data) for f in frames]
    found: dict[str, list[dict[str, Any]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            values = json.loads(message.data)
            assert values.keys() <= json.loads(schema.data)["properties"].keys()
            found.setdefault(channel.topic, []).append(values)
    assert len(found[FRAMES]) == len(frames)
    assert found[MESSAGES][-1]["text"] == "clock clock=77"
    assert found[MESSAGES][0]["params"] == {"uuid": "90a4ae022dfc", "nodeid": 4}
    [node] = found[COUNTERS][-1]["nodes"]
    assert (node["mcu"], node["from_node"]["messages"]) == ("twin", len(identify_pieces()) + 1)
    assert found[COUNTERS][-1]["frames"] == len(frames)


def test_candump_log(bus: BusName, tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    recorder = Recorder(bus, path)
    frames = session()
    send(bus, frames)
    report, status = recorder.end()
    assert (status, report["frames"], report["bytes"]) == (0, len(frames), path.stat().st_size)
    assert [(f.can_id, f.data) for f in read_frames(path)] == [(f.can_id, f.data) for f in frames]


def test_it_ends_after_its_duration(bus: BusName, tmp_path: Path, capsys: Output) -> None:
    interface, channel = bus
    path = tmp_path / "some.log"
    words = ["can", "record", "-i", interface, "-c", channel, "-o", str(path), "--duration", "0.1"]
    assert main(words) == 0
    name = channel if interface == "socketcan" else f"{interface}:{channel}"
    assert capsys.readouterr().out == f"0 frames of {name} recorded to '{path}' (0 bytes)\n"


@pytest.mark.parametrize("suffix", ["log", "mcap"])
def test_a_full_disk_is_one_sentence(bus: BusName, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"full.{suffix}"
    path.symlink_to("/dev/full")
    recorder = Recorder(bus, path, "--force")
    send(bus, session() * 20)
    # A log is written all the time, and the first failure ends it; so little MCAP is written at the end.
    report, status = recorder.end(0 if suffix == "log" else signal.SIGINT)
    assert status == 1
    assert report["error"].startswith(f"'{path}' cannot be written: No space left on device, after ")
    assert report["error"].endswith(" frames; make room, or record elsewhere")


@pytest.mark.parametrize("suffix", ["log", "mcap"])
def test_a_bus_that_goes_away(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"some.{suffix}"
    socket = tmp_path / "bus.sock"
    with VirtualBus(socket, bitrate=None):
        recorder = Recorder(("canductor", str(socket)), path)
        send(("canductor", str(socket)), session()[:3])
    report, status = recorder.end(0)
    assert status == 1
    assert report["error"].startswith(f"CAN bus canductor:{socket}: receiving failed")
    assert len(list(read_frames(path))) == 3


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["-o", "some.txt"],
            "--output is 'some.txt', must end in .mcap (for Foxglove) or .log (a candump log)",
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
    assert f"'{path}' is there already; --force overwrites it" in capsys.readouterr().err
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
