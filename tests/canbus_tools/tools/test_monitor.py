"""``canductor can monitor``: lines, filters, dictionaries, how it ends."""

import errno
import io
import os
import signal
import sys

import pytest

from canbus_tools.bus.bus_load import LoadMeter
from canbus_tools.bus.computer import Listener, now_s
from canbus_tools.monitor.bus_watch import SPAN_S, BusWatch, MonitorOptions
from canbus_tools.protocol.decoder import BusDecoder
from canbus_tools.protocol.frame import Frame
from canbus_tools.tools.monitor import Lines, fetch
from nodes.support.errors import CanductorError
from nodes.virtual.firmware import MAINBOARD, firmware_path
from tests.canbus_tools.command import Command
from tests.stages.can_stage import (
    MAIN,
    MAIN_ID,
    QUESTIONS,
    TOOL_ID,
    CanStage,
    SixNodes,
    conversation,
    set_nodeid,
)

DICTIONARY = f"{MAIN_ID}={firmware_path(MAINBOARD).with_suffix('.json')}"
Captured = pytest.CaptureFixture[str]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_lines_learn_the_dictionary_and_end_in_order(
    stage: CanStage, can_tool: Command, number: signal.Signals
) -> None:
    stage.replay(conversation())
    began_s = stage.computer.unix_s()
    stage.press(number, after_s=5.0)
    said = can_tool("monitor")
    assert (said.status, said.err) == (0, "")
    lines = said.out.splitlines()
    [line] = [line for line in lines if "canbus_id canbus_uuid" in line]
    time_s, bus, way, nodeid, text = line.split(maxsplit=4)
    assert began_s < float(time_s) < began_s + 5.0
    assert (bus, way, nodeid) == ("can0", "from", "4")
    assert text == f"canbus_id canbus_uuid={MAIN} canbus_nodeid=4"
    assert [any(f"  {name}" in line for line in lines) for name, _ in QUESTIONS] == [True] * len(QUESTIONS)
    assert not any("  ack" in line for line in lines)


def test_json_and_filters(stage: CanStage, can_tool: Command) -> None:
    stage.replay(conversation())
    options = ("--dictionary", DICTIONARY, "--node", "4", "--direction", "from", "--message", "uptime")
    said = can_tool("monitor", "--json", "--duration", "2", *options)
    *lines, last = said.objects
    assert [(s["name"], s["nodeid"], s["direction"]) for s in lines] == [("uptime", 4, "from")] * 2
    assert last["ok"]
    assert last["lines"] == 2
    assert (last["frames"], last["dropped_frames"]) == (len(conversation()), 0)
    assert (last["nodes"][0]["dictionary"], last["nodes"][0]["uuid"]) == ("given", str(MAIN))


def test_a_closed_pipe_ends_it_quietly(
    stage: CanStage, can_tool: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage.replay(conversation())
    reader, writer = os.pipe()
    os.close(reader)
    begin_ns = stage.world.now_ns
    with os.fdopen(writer, "w") as pipe, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", pipe)
        said = can_tool("monitor", "--duration", "3600")
    assert (said.status, said.err) == (141, "")
    assert stage.world.now_ns < begin_ns + 60_000_000_000, "it ended with the first line"


def test_a_bus_that_ends_is_told(stage: CanStage, can_tool: Command) -> None:
    stage.replay(conversation())
    stage.world.at(stage.world.now_ns + 2_000_000_000, lambda: stage.computer.unplug(errno.ENODEV))
    said = can_tool("monitor")
    assert said.status == 1
    assert "uptime high" in said.out
    assert said.err.startswith("canductor: CAN bus canductor:can0: can0: the connection ended")


def test_dictionaries_are_fetched_when_asked(six: SixNodes, can_tool: Command) -> None:
    stage = six.stage

    def fetched(*nodes: str) -> dict[int, str]:
        words = stage.computer.run(fetch(stage.computer, stage.options, nodes))
        return {nodeid: dictionary.str_constant("MCU") for nodeid, dictionary in words.items()}

    assert fetched("all") == {MAIN_ID: "virtual-mainboard", TOOL_ID: "virtual-toolhead"}
    assert fetched(str(TOOL_ID)) == {TOOL_ID: "virtual-toolhead"}
    with pytest.raises(CanductorError, match="no node answers on id 9"):
        fetched("9")
    with stage.asking_host(MAIN_ID, every_s=0.5):
        said = can_tool("monitor", "--fetch", "all", "--duration", "2")
    assert "canductor: node 4 was not queried: another host uses it\n" in said.err
    assert "no node" not in said.out


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
def test_words_that_make_no_command(can_tool: Command, words: list[str], said: str) -> None:
    tried = can_tool("monitor", *words)
    assert tried.status == 2
    assert said in tried.err


# ----------------------------------------------------------------------------------------------------- inside


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


def lines_of(stage: CanStage, queue: Listener, duration_s: float) -> int:
    """Write what QUEUE receives as lines; return how many were counted."""
    options = MonitorOptions(
        bus=stage.options,
        bitrate=1_000_000,
        bitrate_is_known=False,
        dictionaries={},
        duration_s=duration_s,
    )
    watch = BusWatch(BusDecoder(), LoadMeter(1_000_000), now_s(stage.computer))
    return Lines(stage.computer, options, watch, queue).run()


def test_dropped_frames_are_told_now_and_then(stage: CanStage, capsys: Captured) -> None:
    with stage.computer.listen(stage.options, limit=5) as queue:
        with stage.user() as host:
            set_nodeid(host, MAIN, MAIN_ID, times=50)
            stage.world.run_for(0.1)
        assert lines_of(stage, queue, 0.2) == 5
    said = capsys.readouterr()
    assert said.out.count("set_nodeid") == 5
    assert said.err == "canductor: dropped 45 frames so far: lines are read too slowly\n"


class Interrupted(io.StringIO):
    """An output whose reader presses Ctrl-C when it sees the second line, before the write has returned."""

    def flush(self) -> None:
        if self.getvalue().count("\n") == 2:
            signal.raise_signal(signal.SIGINT)


def test_a_line_that_was_written_when_ctrl_c_came_is_counted(
    stage: CanStage, monkeypatch: pytest.MonkeyPatch
) -> None:
    with stage.computer.listen(stage.options) as queue:
        with stage.user() as host:
            set_nodeid(host, MAIN, MAIN_ID, times=5)
            stage.world.run_for(0.1)
        output = Interrupted()
        monkeypatch.setattr(sys, "stdout", output)
        assert lines_of(stage, queue, 60.0) == output.getvalue().count("\n") == 2
