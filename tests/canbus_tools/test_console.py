"""``canductor console`` with real firmware: on CAN by id and uuid, on a UART, scripts, prompt."""

import asyncio
import json
import os
import pty
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from prompt_toolkit.application import create_app_session
from prompt_toolkit.completion import CompleteEvent
from prompt_toolkit.document import Document
from prompt_toolkit.input import create_pipe_input
from prompt_toolkit.output import DummyOutput

from canbus_tools.console_prompt import SessionCompleter, prompt
from canbus_tools.console_session import Session
from canbus_tools.talk import NodeTalk
from coordinator.cli import main
from nodes.transport import CanFrame
from nodes.virtual.processes import NodeProcess
from tests.canbus_tools.stage import BED, MAIN, MAIN_ID, PATIENCE_S, TOOL, TOOL_ID, Place, Stage, set_nodeid

Captured = pytest.CaptureFixture[str]


@pytest.fixture
def node(place: Place) -> Iterator[Place]:
    """One node of our firmware with id 4."""
    with place.start_node("mainboard", MAIN) as process:
        process.wait_ready()
        host = place.open()
        set_nodeid(host, MAIN, MAIN_ID)
        host.close()
        yield place


def console(place: Place, *words: str) -> int:
    return main(["console", *place.words, *words])


def on_4(place: Place, *lines: str, json_: bool = False) -> int:
    words = [word for line in lines for word in ("-e", line)]
    return console(place, "--node", str(MAIN_ID), "--force", *words, *(["--json"] if json_ else []))


def objects(captured: Captured) -> list[dict[str, Any]]:
    return [json.loads(line) for line in captured.readouterr().out.splitlines()]


def test_questions_and_arithmetic_on_clocks(node: Place, capsys: Captured) -> None:
    lines = (
        "get_canbus_id",
        "/set before clock",
        "/repeat 3 1ms get_clock",
        "/eval clock-before",
        "/eval 2s",
    )
    assert on_4(node, *lines, json_=True) == 0
    identity, *clocks, passed, two_s, last = [o for o in objects(capsys) if o.get("message") != "stats"]
    assert (identity["asked"], identity["params"]) == (
        "get_canbus_id",
        {"canbus_uuid": str(MAIN), "canbus_nodeid": MAIN_ID},
    )
    assert [c["message"] for c in clocks] == ["clock"] * 3
    ticks = [c["params"]["clock"] for c in clocks]
    freq_hz = two_s["value"] // 2
    assert all(freq_hz // 2000 < (b - a) % 2**32 < 20 * freq_hz for a, b in pairwise(ticks))
    assert freq_hz // 500 < passed["value"] < 20 * freq_hz
    assert last["ok"]
    assert last["commands"] == 4


def test_a_machine_is_set_up_by_a_script(node: Place, tmp_path: Path, capsys: Captured) -> None:
    script = tmp_path / "setup"
    script.write_text(
        "# an output that goes on and off by itself\n"
        "allocate_oids count=2\n"
        "config_digital_out oid=1 pin=PA3 value=0 default_value=0 max_duration=0\n"
        "finalize_config crc=7*6\n"
        "\n"
        "get_config\n"
        "queue_digital_out oid=1 clock=clock+1s on_ticks=1\n"  # a busy computer may take a part of it
        "/delay 1100ms\n"
        "get_config\n"
    )
    assert console(node, "--node", str(MAIN), "--force", "--script", str(script)) == 0
    configs = [line for line in capsys.readouterr().out.splitlines() if line.startswith("config ")]
    assert len(configs) == 2
    assert all(line.startswith("config is_config=1 crc=42 is_shutdown=0") for line in configs)


def test_what_comes_unasked_is_shown(node: Place, capsys: Captured) -> None:
    assert on_4(node, "emergency_stop", "get_config") == 0
    out = capsys.readouterr().out
    assert 'static_string_id="Command request"' in out
    assert "is_shutdown=1" in out


def test_an_error_ends_a_script_with_its_line(node: Place, tmp_path: Path, capsys: Captured) -> None:
    script = tmp_path / "bad"
    script.write_text("get_clock\n\nget_clok\nget_uptime\n")
    assert console(node, "--node", str(MAIN_ID), "--force", "--script", str(script)) == 1
    said = capsys.readouterr()
    assert said.err.startswith(f"canductor: {script}:3: ")
    assert "did you mean" not in said.out
    assert "uptime" not in said.out
    script.write_bytes(b"get_clock\n\xff\xfe\n")
    assert console(node, "--node", str(MAIN_ID), "--force", "--script", str(script)) == 1
    assert "no text in UTF-8" in capsys.readouterr().err


def test_quit_ends_a_script(node: Place, capsys: Captured) -> None:
    assert on_4(node, "/quit", "get_nothing") == 0
    assert capsys.readouterr().out == ""


def test_figures_names_and_lists(node: Place, capsys: Captured) -> None:
    lines = ("/set n 3", "/set", "/stats", "/list canbus", "/hide stats", "/help", "/eval n/2")
    assert on_4(node, *lines) == 0
    out = capsys.readouterr().out
    assert "n = 3" in out
    assert "0 bytes invalid" in out
    assert "  canbus_id canbus_uuid=%.*s canbus_nodeid=%u" in out
    assert "  canbus_bus_state: " in out
    assert "/repeat N [INTERVAL] COMMAND" in out
    assert "1.5, sent as 2" in out


def test_standard_input_is_a_script(node: Place) -> None:
    command = [sys.executable, "-m", "coordinator.cli", "console", *node.words, "--node", "4", "--force"]
    ended = subprocess.run(
        command, input="get_canbus_id\nnonsense=1\n", capture_output=True, text=True, timeout=60, check=False
    )
    assert ended.returncode == 1
    assert f"canbus_uuid={MAIN}" in ended.stdout
    assert ended.stderr.startswith("canductor: standard input:2: ")


def test_a_node_by_its_uuid(stage: Stage, capsys: Captured) -> None:
    assert (
        console(stage.place, "--node", str(TOOL), "-e", "get_canbus_id") == 0
    )  # Klipper-type: found by asking
    assert f"canbus_nodeid={TOOL_ID}" in capsys.readouterr().out
    assert console(stage.place, "--node", str(BED), "-e", "get_clock") == 1
    assert "waits for an id" in capsys.readouterr().err
    assert console(stage.place, "--node", "0" * 12, "-e", "get_clock") == 1
    assert "no node on bus" in capsys.readouterr().err


def test_a_node_that_another_host_uses_is_left_alone(node: Place, capsys: Captured) -> None:
    ending = threading.Event()

    def host() -> None:
        bus = node.open()
        while not ending.wait(0.05):
            bus.send(CanFrame(MAIN_ID * 2 + 0x100, b"\x7e"))
        bus.close()

    other = threading.Thread(target=host)
    other.start()
    try:
        assert console(node, "--node", "4", "-e", "get_clock") == 1
    finally:
        ending.set()
        other.join()
    assert "is in use: another program talks to it" in capsys.readouterr().err


def test_on_a_uart(tmp_path: Path, capsys: Captured) -> None:
    with NodeProcess("uart", uuid="0123456789ab", uart=tmp_path / "tty") as process:
        process.wait_ready()
        assert main(["console", "--uart", str(tmp_path / "tty"), "-e", "get_uptime", "--json"]) == 0
        uptime, last = [o for o in objects(capsys) if o.get("message") != "stats"]
        assert uptime["message"] == "uptime"
        assert last["node"] == f"on UART {tmp_path / 'tty'}"


def test_nobody_on_a_uart(capsys: Captured) -> None:
    ours, theirs = pty.openpty()
    try:
        assert main(["console", "--uart", os.ttyname(theirs), "-e", "get_uptime"]) == 1
    finally:
        os.close(theirs)
        os.close(ours)
    assert "no answer on UART" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "either --node, on a CAN bus, or --uart"),
        (["--node", "4", "--uart", "/dev/x"], "either --node"),
        (["--uart", "/dev/x", "-c", "can1"], "does not go with"),
        (["--node", "4", "--baud", "9600"], "--baud goes with --uart"),
        (["--node", "256"], "--node is '256'"),
        (["--node", "90a4"], "--node is '90a4'"),
        (["--node", "4", "-e", "x", "--script", "y"], "either --execute or --script"),
        (["--uart", "/dev/x", "--baud", "0"], "--baud is '0'"),
    ],
)
def test_words_that_make_no_command(words: list[str], said: str, capsys: Captured) -> None:
    assert main(["console", *words]) == 2
    assert said in capsys.readouterr().err


def typed(place: Place, keys: str, history: Path, session_type: type[Session] = Session) -> list[str]:
    """Type KEYS at a prompt; return what was shown."""
    said: list[str] = []

    async def run() -> None:
        async with NodeTalk.open(place.options, MAIN_ID, force=True) as talk:
            session = session_type(talk, said.append)
            with create_pipe_input() as pipe, create_app_session(input=pipe, output=DummyOutput()):
                pipe.send_text(keys)
                await asyncio.wait_for(prompt(session, history), PATIENCE_S)
            session.close()

    asyncio.run(run())
    return [line for line in said if not line.startswith("stats ")]


def test_the_prompt(node: Place, tmp_path: Path) -> None:
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


def test_the_prompt_completes(node: Place) -> None:
    async def run() -> list[str]:
        async with NodeTalk.open(node.options, MAIN_ID, force=True) as talk:
            completer = SessionCompleter(Session(talk, print))
            found = completer.get_completions(Document("get_canbus_i"), CompleteEvent())
            return [f"{completion.text} {completion.start_position}" for completion in found]

    assert asyncio.run(run()) == ["get_canbus_id -12"]


def test_ctrl_c_ends_what_runs_and_not_the_session(node: Place, tmp_path: Path) -> None:
    class Interrupting(Session):
        async def run(self, text: str) -> None:
            if text.startswith("/delay"):
                os.kill(os.getpid(), signal.SIGINT)
            await super().run(text)

    (said,) = typed(node, "/delay 1000s\rget_uptime\r/quit\r", tmp_path / "history", Interrupting)
    assert said.startswith("uptime high=")
