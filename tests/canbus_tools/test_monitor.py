"""``canductor can monitor`` on a real bus: lines, filters, dictionaries, how it ends, a full bus."""

import asyncio
import contextlib
import io
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from canbus_tools.bus_load import LoadMeter
from canbus_tools.bus_watch import SPAN_S, BusWatch
from canbus_tools.decoder import BusDecoder
from canbus_tools.filters import Filter
from canbus_tools.frame import Frame
from canbus_tools.frame_queue import FrameQueue
from canbus_tools.monitor import Lines, MonitorOptions, fetch
from canbus_tools.open_bus import BusOptions, open_bus
from coordinator.cli import main
from nodes.errors import CanductorError
from nodes.transport import CanFrame
from nodes.virtual.firmware import MAINBOARD, firmware_path
from nodes.virtual.hub import VirtualBus
from tests.canbus_tools.stage import MAIN, MAIN_ID, PATIENCE_S, TOOL_ID, Place, Stage, set_nodeid

DICTIONARY = f"{MAIN_ID}={firmware_path(MAINBOARD).with_suffix('.json')}"
Captured = pytest.CaptureFixture[str]


@pytest.fixture
def node(place: Place) -> Iterator[Place]:
    """One node of our firmware with id 4."""
    with place.start_node("mainboard", MAIN) as process:
        process.wait_ready()
        with closing(place.open()) as host:
            set_nodeid(host, MAIN, MAIN_ID)
        yield place


def ask(place: Place, *lines: str) -> None:
    words = [word for line in lines for word in ("-e", line)]
    assert main(["console", *place.words, "--node", str(MAIN_ID), "--force", *words]) == 0


@contextlib.contextmanager
def monitor(place: Place, *words: str) -> Iterator["subprocess.Popen[str]"]:
    """Run the tool as a process."""
    entry = "import sys; from coordinator.entry import main; sys.exit(main())"
    command = [sys.executable, "-c", entry, "can", "monitor", *place.words, *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def talk_until(place: Place, process: "subprocess.Popen[str]", wanted: str, times: int = 1) -> list[str]:
    """Ask the node again and again until the monitor has shown WANTED so often; return its lines so far.

    What it has shown twice had both answers between.
    """
    seen: list[str] = []
    found = threading.Event()

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            seen.append(line)
            if sum(wanted in line for line in seen) == times:
                found.set()
                return

    reader = threading.Thread(target=read)
    reader.start()
    end_s = time.monotonic() + PATIENCE_S
    while not found.is_set() and time.monotonic() < end_s and process.poll() is None:
        ask(place, "get_uptime", "get_canbus_id")
    reader.join(PATIENCE_S)
    assert found.is_set(), (seen[-5:], process.stderr and process.poll())
    return seen


def wait_until(true: Callable[[], bool]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.001)


def test_lines_learn_the_dictionary_and_end_in_order(node: Place) -> None:
    with monitor(node) as process:
        seen = talk_until(node, process, f"canbus_id canbus_uuid={MAIN}")
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, errors) == (0, "")
    time_s, bus, way, nodeid, text = seen[-1].split(maxsplit=4)
    assert abs(float(time_s) - time.time()) < 60
    assert bus == node.channel.rpartition("/")[2]
    assert (way, nodeid) == ("from", "4")
    assert text == f"canbus_id canbus_uuid={MAIN} canbus_nodeid=4\n"
    assert not any("  ack" in line for line in seen)


def test_json_and_filters(node: Place) -> None:
    words = (
        "--json",
        "--dictionary",
        DICTIONARY,
        "--node",
        "4",
        "--direction",
        "from",
        "--message",
        "uptime",
    )
    with monitor(node, *words) as process:
        seen = talk_until(node, process, '"uptime"', times=2)
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=PATIENCE_S)
    lines: list[dict[str, Any]] = [json.loads(line) for line in [*seen, *rest.splitlines()]]
    *said, last = lines
    assert {(s["name"], s["nodeid"], s["direction"]) for s in said} == {("uptime", 4, "from")}
    assert last["ok"]
    assert last["lines"] == len(said)
    assert last["dropped_frames"] == 0
    assert (last["nodes"][0]["dictionary"], last["nodes"][0]["uuid"]) == ("given", str(MAIN))


def test_a_closed_pipe_ends_it_quietly(node: Place) -> None:
    with monitor(node) as process:
        talk_until(node, process, "uptime")
        assert process.stdout is not None
        process.stdout.close()
        end_s = time.monotonic() + PATIENCE_S
        while process.poll() is None and time.monotonic() < end_s:
            ask(node, "get_uptime")
        assert process.stderr is not None
        assert (process.wait(PATIENCE_S), process.stderr.read()) == (141, "")


def test_a_bus_that_ends_is_told(tmp_path: Path, capsys: Captured) -> None:
    bus = VirtualBus(tmp_path / "bus")
    bus.start()
    place = Place("canductor", str(bus.path))
    with monitor(place) as process, closing(place.open()) as host:
        set_nodeid(host, MAIN, MAIN_ID)
        assert process.stdout is not None
        sender = threading.Event()
        told = threading.Thread(target=lambda: _send_until(host, sender))
        told.start()
        assert "set_nodeid" in process.stdout.readline()
        sender.set()
        told.join()
        bus.close()
        _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert errors.startswith("canductor: CAN bus bus: it cannot be listened to any more: ")


def _send_until(host: Any, ending: threading.Event) -> None:
    while not ending.wait(0.05):
        set_nodeid(host, MAIN, MAIN_ID)


def test_dictionaries_are_fetched_when_asked(stage: Stage) -> None:
    every = asyncio.run(fetch(stage.place.options, ("all",)))
    assert {nodeid: words.str_constant("MCU") for nodeid, words in every.items()} == {
        MAIN_ID: "virtual-mainboard",
        TOOL_ID: "virtual-toolhead",
    }
    one = asyncio.run(fetch(stage.place.options, (str(TOOL_ID),)))
    assert list(one) == [TOOL_ID]
    with pytest.raises(CanductorError, match="no node answers on id 9"):
        asyncio.run(fetch(stage.place.options, ("9",)))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--fetch", "x"], "--fetch NODE is 'x'"),
        (["--duration", "0"], "--duration is '0'"),
        (["--node", "300"], "--node is '300'"),
        (["--dictionary", "4"], "--dictionary takes NAME=VALUE"),
        (["--bitrate", "3"], "--bitrate is '3'"),
    ],
)
def test_words_that_make_no_command(words: list[str], said: str, capsys: Captured) -> None:
    assert main(["can", "monitor", *words]) == 2
    assert said in capsys.readouterr().err


# ----------------------------------------------------------------------------------------------------- inside


def opened(bus: VirtualBus) -> BusOptions:
    return BusOptions(interface="canductor", channel=str(bus.path))


def test_a_full_bus_is_received_whole(tmp_path: Path) -> None:
    frames = 20_000
    with (
        VirtualBus(tmp_path / "bus", bitrate=None) as bus,
        FrameQueue(open_bus(opened(bus)), "bus") as queue,
        closing(Place("canductor", str(bus.path)).open()) as host,
    ):
        for n in range(frames):
            host.send(CanFrame(0x108, n.to_bytes(8, "little")), PATIENCE_S)
        got: list[Frame] = []
        while len(got) < frames:
            new = queue.take(PATIENCE_S)
            assert new, f"only {len(got)} came"
            got += new
        assert [int.from_bytes(frame.data, "little") for frame in got] == list(range(frames))
        assert queue.dropped == 0
        assert got[0].channel == "bus"


def test_what_waits_too_long_gives_way_and_is_counted(tmp_path: Path) -> None:
    with (
        VirtualBus(tmp_path / "bus", bitrate=None) as bus,
        FrameQueue(open_bus(opened(bus)), "bus", limit=10) as queue,
        closing(Place("canductor", str(bus.path)).open()) as host,
    ):
        for n in range(25):
            host.send(CanFrame(0x108, bytes([n])))
        got: list[Frame] = []
        wait_until(lambda: queue.dropped >= 15)
        got = queue.take()
        assert [frame.data[0] for frame in got] == list(range(15, 25))
        assert queue.take() == []


def test_rates_are_of_the_last_seconds() -> None:
    watch = BusWatch(BusDecoder(), LoadMeter(1_000_000), 0.0)
    ack = bytes.fromhex("0511 8f08 7e".replace(" ", ""))
    for second in range(5):
        for n in range(100):
            watch.feed(Frame(second + n / 100, 0x109, ack))
        rates = watch.update(second + 1.0)
    (of_node,) = rates.nodes
    assert of_node.node.nodeid == 4
    assert rates.frames_per_s == pytest.approx(100)
    assert of_node.bytes_from == pytest.approx(500)
    assert rates.load == pytest.approx(of_node.load)
    assert 0.0087 <= rates.load <= 0.0111  # 5 bytes: 87 bits, at worst 18 stuff bits more
    later = watch.update(5.0 + SPAN_S + 1)
    assert watch.update(5.0 + 2 * SPAN_S + 1).frames_per_s == 0
    assert later.frames_per_s < 100
    assert len(watch.loads) == 7


def shown_of(bus: VirtualBus, queue: FrameQueue, duration_s: float) -> int:
    options = MonitorOptions(
        bus=opened(bus),
        bitrate=1_000_000,
        bitrate_is_known=False,
        filter_=Filter(),
        dictionaries={},
        duration_s=duration_s,
    )
    return Lines(options, BusWatch(BusDecoder(), LoadMeter(1_000_000), time.monotonic()), queue).run()


def test_dropped_frames_are_told_now_and_then(tmp_path: Path, capsys: Captured) -> None:
    with (
        VirtualBus(tmp_path / "bus", bitrate=None) as bus,
        FrameQueue(open_bus(opened(bus)), "bus", limit=5) as queue,
        closing(Place("canductor", str(bus.path)).open()) as host,
    ):
        for _ in range(50):
            set_nodeid(host, MAIN, MAIN_ID)
        wait_until(lambda: queue.dropped >= 45)
        assert shown_of(bus, queue, 0.2) == 5
    said = capsys.readouterr()
    assert said.out.count("set_nodeid") == 5
    assert said.err == "canductor: 45 frames were dropped until now: lines are read too slowly\n"


class Interrupted(io.StringIO):
    """An output whose reader presses Ctrl-C when it sees the second line, before the write has returned."""

    def flush(self) -> None:
        if self.getvalue().count("\n") == 2:
            signal.raise_signal(signal.SIGINT)


def test_a_line_that_was_written_when_ctrl_c_came_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        VirtualBus(tmp_path / "bus", bitrate=None) as bus,
        FrameQueue(open_bus(opened(bus)), "bus") as queue,
        closing(Place("canductor", str(bus.path)).open()) as host,
    ):
        for _ in range(5):
            set_nodeid(host, MAIN, MAIN_ID)
        output = Interrupted()
        monkeypatch.setattr(sys, "stdout", output)
        assert shown_of(bus, queue, PATIENCE_S) == output.getvalue().count("\n") == 2
