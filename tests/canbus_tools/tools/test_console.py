"""``canductor console`` with real firmware: on CAN by id and uuid, on a UART, scripts, prompt."""

import asyncio
import io
import os
import signal
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from prompt_toolkit.application import create_app_session
from prompt_toolkit.completion import CompleteEvent
from prompt_toolkit.document import Document
from prompt_toolkit.input import create_pipe_input
from prompt_toolkit.output import DummyOutput

from canbus_tools.console.prompt import SessionCompleter, prompt
from canbus_tools.console.session import Session
from tests.canbus_tools.command import Command, Said
from tests.stages.can_stage import BED, MAIN, MAIN_ID, TOOL, TOOL_ID, CanStage, SixNodes
from tests.stages.terminal_loop import TerminalLoop


@pytest.fixture
def node(stage: CanStage) -> CanStage:
    """Return a bus with one node of our firmware with id 4."""
    stage.add_node(MAIN, MAIN_ID)
    return stage


@pytest.fixture
def on_4(node: CanStage, can_tool: Command) -> "OnNode":
    """Return what runs lines on that node."""
    del node
    return OnNode(can_tool)


class OnNode:
    """Runs lines on node 4."""

    def __init__(self, tool: Command) -> None:
        self._tool = tool

    def __call__(self, *lines: str) -> Said:
        words = [word for line in lines for word in ("-e", line)]
        return self._tool.console("--node", MAIN_ID, *words)

    def json(self, *lines: str) -> list[dict[str, Any]]:
        """Return what was said, but for statistics that come by themselves."""
        said = self._tool.console(
            "--node", MAIN_ID, "--json", *(word for line in lines for word in ("-e", line))
        )
        assert (said.status, said.err) == (0, "")
        return [value for value in said.objects if value.get("message") != "stats"]


def test_questions_and_arithmetic_on_clocks(on_4: OnNode) -> None:
    lines = (
        "get_canbus_id",
        "/set before clock",
        "/repeat 3 1ms get_clock",
        "/eval clock-before",
        "/eval 2s",
    )
    identity, *clocks, passed, two_s, last = on_4.json(*lines)
    assert (identity["asked"], identity["params"]) == (
        "get_canbus_id",
        {"canbus_uuid": str(MAIN), "canbus_nodeid": MAIN_ID},
    )
    assert [c["message"] for c in clocks] == ["clock"] * 3
    ticks = [c["params"]["clock"] for c in clocks]
    freq_hz = two_s["value"] // 2
    assert all((b - a) / freq_hz == pytest.approx(1e-3, abs=2e-4) for a, b in pairwise(ticks))
    assert passed["value"] / freq_hz == pytest.approx(3e-3, abs=1e-3)
    assert last["ok"]
    assert last["commands"] == 4


def test_a_machine_is_set_up_by_a_script(node: CanStage, can_tool: Command, tmp_path: Path) -> None:
    script = tmp_path / "setup"
    script.write_text(
        "# an output that goes on and off by itself\n"
        "allocate_oids count=2\n"
        "config_digital_out oid=1 pin=PA3 value=0 default_value=0 max_duration=0\n"
        "finalize_config crc=7*6\n"
        "\n"
        "get_config\n"
        "queue_digital_out oid=1 clock=clock+50ms on_ticks=1\n"
        "/delay 100ms\n"
        "get_config\n"
    )
    said = can_tool.console("--node", MAIN, "--script", script)
    assert said.status == 0
    configs = [line for line in said.out.splitlines() if line.startswith("config ")]
    assert len(configs) == 2
    assert all(line.startswith("config is_config=1 crc=42 is_shutdown=0") for line in configs)
    assert not node.is_shut_down(MAIN_ID)


def test_what_comes_unasked_is_shown(on_4: OnNode) -> None:
    said = on_4("emergency_stop", "get_config")
    assert said.status == 0
    assert 'static_string_id="Command request"' in said.out
    assert "is_shutdown=1" in said.out


def test_a_full_disk_is_not_the_nodes_silence(on_4: OnNode, monkeypatch: pytest.MonkeyPatch) -> None:
    """What failed where messages come gave a traceback for each, and the node "did not answer"."""
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        said = on_4("get_canbus_id", "get_config")
    assert (said.status, said.err) == (
        1,
        "canductor: cannot write the output: no space left on device\n",
    )


def test_without_standard_input_and_commands_there_is_nothing_to_do(
    on_4: OnNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    assert on_4().err == "canductor: standard input is closed, so there is nothing to read; name a file\n"
    assert on_4("get_canbus_id").status == 0


def test_an_error_ends_a_script_with_its_line(node: CanStage, can_tool: Command, tmp_path: Path) -> None:
    del node
    script = tmp_path / "bad"
    script.write_text("get_clock\n\nget_clok\nget_uptime\n")
    said = can_tool.console("--node", MAIN_ID, "--script", script)
    assert said.status == 1
    assert said.err.startswith(f"canductor: {script}:3: ")
    assert "did you mean" not in said.out
    assert "uptime" not in said.out
    script.write_bytes(b"get_clock\n\xff\xfe\n")
    said = can_tool.console("--node", MAIN_ID, "--script", script)
    assert said.status == 1
    assert "is not UTF-8 text" in said.err


def test_quit_ends_a_script(on_4: OnNode) -> None:
    said = on_4("/quit", "get_nothing")
    assert (said.status, said.out) == (0, "")


def test_figures_names_and_lists(on_4: OnNode) -> None:
    lines = ("/set n 3", "/set", "/stats", "/list canbus", "/hide stats", "/help", "/eval n/2")
    said = on_4(*lines)
    assert said.status == 0
    assert "n = 3" in said.out
    assert "0 bytes invalid" in said.out
    assert "  canbus_id canbus_uuid=%.*s canbus_nodeid=%u" in said.out
    assert "  canbus_bus_state: " in said.out
    assert "/repeat N [INTERVAL] COMMAND" in said.out
    assert "1.5, sent as 2" in said.out


def test_standard_input_is_a_script(
    node: CanStage, can_tool: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    del node
    monkeypatch.setattr(sys, "stdin", io.StringIO("get_canbus_id\nnonsense=1\n"))
    said = can_tool.console("--node", "4")
    assert said.status == 1
    assert f"canbus_uuid={MAIN}" in said.out
    assert said.err.startswith("canductor: standard input:2: ")


def test_a_node_by_its_uuid(six: SixNodes, can_tool: Command) -> None:
    del six
    said = can_tool.console("--node", TOOL, "-e", "get_canbus_id")  # Klipper-type: found by asking
    assert said.status == 0
    assert f"canbus_nodeid={TOOL_ID}" in said.out
    assert "waits for an id" in can_tool.console("--node", BED, "-e", "get_clock").sentence
    assert "no node on bus" in can_tool.console("--node", "0" * 12, "-e", "get_clock").sentence


def test_a_node_that_another_host_uses_is_left_alone(node: CanStage, can_tool: Command) -> None:
    with node.other_host(MAIN_ID, every_s=0.98):
        said = can_tool.console("--node", "4", "-e", "get_clock")
        assert "is in use: another program talks to it" in said.sentence
        assert can_tool.console("--node", "4", "--force", "-e", "get_clock").status == 0


def test_on_a_uart(stage: CanStage, can_tool: Command) -> None:
    stage.add_node(MAIN, uart=True)
    said = can_tool.run("console", "--uart", "/dev/tty0", "-e", "get_uptime", "--json")
    assert said.status == 0
    uptime, last = [value for value in said.objects if value.get("message") != "stats"]
    assert uptime["message"] == "uptime"
    assert last["node"] == "on UART /dev/tty0"


def test_nobody_on_a_uart(can_tool: Command) -> None:
    said = can_tool.run("console", "--uart", "/dev/tty0", "-e", "get_uptime")
    assert "no answer on UART" in said.sentence


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "either --node, on a CAN bus, or --uart"),
        (["--node", "4", "--uart", "/dev/x"], "either --node"),
        (["--uart", "/dev/x", "-c", "can1"], "does not go with"),
        (["--node", "4", "--baud", "9600"], "--baud goes with --uart"),
        (["--node", "256"], "--node is '256'"),
        (["--node", "90a4"], "--node is '90a4'"),
        (["--node", "4", "-e", "x", "--script", __file__], "either --execute or --script"),
        (["--uart", "/dev/x", "--baud", "0"], "--baud is '0'"),
    ],
)
def test_words_that_make_no_command(can_tool: Command, words: list[str], said: str) -> None:
    tried = can_tool.run("console", *words)
    assert tried.status == 2
    assert said in tried.err


def typed(stage: CanStage, keys: str, history: Path, session_type: type[Session] = Session) -> list[str]:
    """Type KEYS at a prompt; return what was shown."""
    said: list[str] = []

    async def run() -> None:
        async with stage.talk(MAIN_ID) as talk:
            session = session_type(talk, said.append)
            with create_pipe_input() as pipe, create_app_session(input=pipe, output=DummyOutput()):
                pipe.send_text(keys)
                await prompt(session, history)
            session.close()

    with asyncio.Runner(loop_factory=lambda: TerminalLoop(stage.world)) as runner:
        runner.run(run())
    return [line for line in said if not line.startswith("stats ")]


def test_the_prompt(node: CanStage, tmp_path: Path) -> None:
    history = tmp_path / "state" / "history"
    # Ctrl-C drops a line; an error does not end the session; Ctrl-D does.
    said = typed(node, "get_canbus_id\rget_nothing\rget_up\x03get_uptime\r\x04", history)
    assert said[0] == f"canbus_id canbus_uuid={MAIN} canbus_nodeid={MAIN_ID}"
    assert said[1].startswith("uptime high=")
    assert len(said) == 2
    assert history.stat().st_mode & 0o777 == 0o600
    assert [line[1:] for line in history.read_text().splitlines() if line.startswith("+")] == [
        "get_canbus_id",
        "get_nothing",
        "get_uptime",
    ]


def test_the_prompt_completes(node: CanStage) -> None:
    async def run() -> list[str]:
        async with node.talk(MAIN_ID) as talk:
            completer = SessionCompleter(Session(talk, print))
            found = completer.get_completions(Document("get_canbus_i"), CompleteEvent())
            return [f"{completion.text} {completion.start_position}" for completion in found]

    assert node.computer.run(run()) == ["get_canbus_id -12"]


def test_ctrl_c_ends_what_runs_and_not_the_session(node: CanStage, tmp_path: Path) -> None:
    class Interrupting(Session):
        async def run(self, text: str) -> None:
            if text.startswith("/delay"):
                os.kill(os.getpid(), signal.SIGINT)
            await super().run(text)

    (said,) = typed(node, "/delay 1000s\rget_uptime\r/quit\r", tmp_path / "history", Interrupting)
    assert said.startswith("uptime high=")
