"""``canductor can decode``: what it prints, and what it says when something is wrong."""

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from canbus_tools.protocol.frame import Frame
from canbus_tools.recordings.candump import candump_line
from canbus_tools.recordings.mcap_file import McapWriter
from coordinator.cli.main import main
from tests.canbus_tools import recorded
from tests.canbus_tools.talk_twin import DICTIONARY_JSON, Talk, identify_pieces

Output = pytest.CaptureFixture[str]
SET_NODEID = "set_nodeid uuid=90a4ae022dfc nodeid=4"
DIGITAL = "set_digital_out pin=PA1 value=1"
UPTIME = ("get_uptime", "uptime high=1 clock=2")


@pytest.fixture(autouse=True)
def no_users_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    talk = Talk(start_s=1000.0).frame(0x3F0, b"\x01" + bytes.fromhex("90a4ae022dfc") + b"\x04")
    talk.command(1, "get_clock", "set_digital_out pin=PA1 value=1").response(2, "clock", clock=77).ack(2)
    talk.command(1, "get_clock", "set_digital_out pin=PA1 value=1").ack(2)
    talk.frame(0x321, b"\x01\x02")
    other = Talk(nodeid=9, start_s=1002.0).command(1, "get_uptime").response(2, "uptime", high=1, clock=2)
    return written(tmp_path / "some.log", talk.frames + other.frames)


@pytest.fixture
def dictionary(tmp_path: Path) -> Path:
    path = tmp_path / "dictionary.json"
    path.write_bytes(DICTIONARY_JSON)
    return path


def written(path: Path, frames: list[Frame]) -> Path:
    path.write_text("".join(map(candump_line, frames)))
    return path


def decode(output: Output, *words: str | Path, status: int = 0) -> tuple[list[str], str]:
    """Return the lines of standard output, and standard error."""
    assert main(["can", "decode", *map(str, words)]) == status
    said = output.readouterr()
    return said.out.splitlines(), said.err


def test_lines(capsys: Output, log: Path, dictionary: Path) -> None:
    lines, errors = decode(capsys, log, "--dictionary", f"4={dictionary}", "--dictionary", f"9={dictionary}")
    assert errors == ""
    assert lines == [
        "1000.000000  can0  to 4      set_nodeid uuid=90a4ae022dfc nodeid=4",
        "1000.002000  can0  to 4      get_clock",
        "1000.002000  can0  to 4      set_digital_out pin=PA1 value=1",
        "1000.003000  can0  from 4    clock clock=77",
        "1000.006000  can0  to 4      get_clock  (repeated)",
        "1000.006000  can0  to 4      set_digital_out pin=PA1 value=1  (repeated)",
        "1000.008000  can0  -         frame id=0x321 data=01 02",
        "1002.000000  can0  to 9      get_uptime",
        "1002.001000  can0  from 9    uptime high=1 clock=2",
    ]


@pytest.mark.parametrize(
    ("options", "texts"),
    [
        (["--node", "9"], [*UPTIME]),
        (["--message", "*_clock", "--message", "uptime"], ["get_clock", "get_clock  (repeated)", UPTIME[1]]),
        (["--direction", "from"], ["clock clock=77", UPTIME[1]]),
        (["--kind", "ack"], ["ack next=2", "ack next=2"]),
        (["--kind", "admin", "--kind", "other"], [SET_NODEID, "frame id=0x321 data=01 02"]),
        (["--since", "+1.5"], [*UPTIME]),
        (["--until", "1000.0025"], [SET_NODEID, "get_clock", DIGITAL]),
        (
            ["--since", "1000.003", "--until", "+0.006"],
            ["clock clock=77", "get_clock  (repeated)", f"{DIGITAL}  (repeated)"],
        ),
    ],
)
def test_filters(capsys: Output, log: Path, dictionary: Path, options: list[str], texts: list[str]) -> None:
    given = ["--dictionary", f"4={dictionary}", "--dictionary", f"9={dictionary}"]
    lines, _ = decode(capsys, log, *given, *options)
    assert [line.split("  ", 3)[3].strip() for line in lines] == texts


def test_json(capsys: Output, log: Path, dictionary: Path) -> None:
    lines, _ = decode(
        capsys, log, "--json", "--dictionary", f"4={dictionary}", "--kind", "message", "--node", "4"
    )
    *items, summary = map(json.loads, lines)
    assert items[2] == {
        "time_s": 1000.003,
        "bus": "can0",
        "nodeid": 4,
        "direction": "from",
        "kind": "message",
        "name": "clock",
        "seq": 2,
        "repeated": False,
        "params": {"clock": 77},
        "text": "clock clock=77",
    }
    assert (summary["ok"], summary["frames"], summary["lines"]) == (True, 11, 5)
    four, nine = summary["buses"]["can0"]["nodes"]
    assert (four["uuid"], four["mcu"], four["repeated_blocks"]) == ("90a4ae022dfc", "twin", 1)
    assert (four["to_node"]["messages"], four["from_node"]["blocks"]) == (2, 3)
    assert four["rtt"]["count"] == 1
    assert nine["to_node"]["unknown_messages"] == 1
    assert summary["buses"]["can0"]["other_frames"] == 1
    assert "give it by --dictionary 9=FILE" in summary["hints"][0]


def test_a_node_without_dictionary_is_told(capsys: Output, log: Path, dictionary: Path) -> None:
    _, errors = decode(capsys, log, "--dictionary", f"4={dictionary}")
    assert errors == (
        "canductor: node 9: 2 of its blocks could not be read, as its dictionary is not in the recording;"
        " give it by --dictionary 9=FILE\n"
    )


def test_summary(capsys: Output, log: Path, dictionary: Path) -> None:
    lines, _ = decode(capsys, log, "--summary", "--dictionary", f"4={dictionary}")
    assert lines[0] == "11 frames"
    assert lines[2] == "bus can0: 1 frames of other protocols, 0 error frames"
    assert lines[3].split()[:6] == ["node", "uuid", "mcu", "frames", "to", "from"]
    assert lines[4].split()[:8] == ["4", "90a4ae022dfc", "twin", "7", "2", "1", "1", "0"]


def test_names_in_a_recording_do_not_reach_the_terminal_as_they_are(capsys: Output, tmp_path: Path) -> None:
    path = tmp_path / "some.log"
    path.write_text("(1.0) can\x1b[2J0 3F0#00\n")
    assert decode(capsys, path)[0] == ["1.000000  can?[2J0  to all    query_unassigned"]
    assert "\x1b" not in "".join(decode(capsys, path, "--summary")[0])


def test_several_files_are_one_recording(capsys: Output, tmp_path: Path) -> None:
    talk = Talk()
    for n, (offset, data) in enumerate(identify_pieces()):
        talk.response(n, "identify_response", offset=offset, data=data)
    talk.response(1, "clock", clock=5)
    whole = written(tmp_path / "whole.log", talk.frames)
    first, second = (tmp_path / name for name in ("1.log", "2.mcap"))
    written(first, talk.frames[:50])
    with second.open("wb") as file:
        writer = McapWriter(file)
        for frame in talk.frames[50:]:
            writer.frame(frame)
        writer.finish()
    wanted, _ = decode(capsys, whole)
    assert wanted[-1].endswith("clock clock=5")
    assert decode(capsys, first, second)[0] == wanted


def test_the_recorded_session(capsys: Output, tmp_path: Path) -> None:
    path = written(tmp_path / "session.log", recorded.frames())
    lines, errors = decode(capsys, path, "--kind", "all")
    assert errors == ""
    expected = recorded.messages()
    names = [line.split("  ", 3)[3].split()[0] for line in lines]
    assert names == [name if name != "(ack/nak)" else names[i] for i, (_, _, name, _) in enumerate(expected)]


# ----------------------------------------------------------------------------------------------------- faults


def test_what_is_readable_of_a_broken_file_is_shown(capsys: Output, log: Path) -> None:
    text = log.read_text().splitlines(keepends=True)
    log.write_text("".join([*text[:3], "garbage\n", *text[3:]]))
    lines, errors = decode(capsys, log, "--kind", "admin", "--kind", "other", status=1)
    assert len(lines) == 2
    assert f"canductor: {log}: line 4 'garbage' is no frame of a candump log; the rest was read\n" in errors
    *_, summary = map(json.loads, decode(capsys, log, "--json", status=1)[0])
    assert (summary["ok"], summary["error"]) == (False, errors.splitlines()[0].removeprefix("canductor: "))


@pytest.mark.parametrize(
    ("words", "status", "sentence"),
    [
        (["nowhere.log"], 1, "there is no file 'nowhere.log'"),
        (["-", "--dictionary", "4=nowhere.json"], 1, "there is no file 'nowhere.json'"),
        (["-", "--dictionary", "nowhere.json"], 2, "--dictionary takes NAME=VALUE, not 'nowhere.json'"),
        (
            ["-", "--dictionary", "300=x"],
            2,
            "--dictionary NODE is '300', must be a whole number from 1 to 255",
        ),
        (["-", "--node", "x"], 2, "--node is 'x', must be a whole number from 1 to 255"),
        (["-", "--since", "soon"], 2, "--since is 'soon', must be seconds such as"),
        (["-", "--message", ""], 2, "--message is '', must be a message's name"),
    ],
)
def test_wrong_words(capsys: Output, words: list[str], status: int, sentence: str) -> None:
    _, errors = decode(capsys, *words, status=status)
    assert errors.startswith(f"canductor: {sentence}")
    assert errors.count("\n") == 1


def test_a_file_that_is_no_dictionary(capsys: Output, log: Path, tmp_path: Path) -> None:
    path = tmp_path / "wrong.json"
    path.write_text("hello")
    _, errors = decode(capsys, log, "--dictionary", f"4={path}", status=1)
    assert errors.startswith(f"canductor: '{path}': dictionary: not zlib data")


# ------------------------------------------------------------------------------------------------- live pipes


def test_a_piped_log_is_followed_and_ctrl_c_ends_it_in_order() -> None:
    command = [sys.executable, "-m", "coordinator.cli.main", "can", "decode", "-", "--json"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        for n in range(3):  # each is shown although nothing follows it yet
            process.stdin.write(f"({n}.5) can0 3F0#00\n".encode())
            process.stdin.flush()
            assert json.loads(process.stdout.readline())["time_s"] == n + 0.5
        os.kill(process.pid, signal.SIGINT)
        summary = json.loads(process.stdout.readline())
        process.stdin.close()
        assert process.wait(60) == 0
    assert (summary["ok"], summary["stopped"], summary["frames"]) == (True, True, 3)


@pytest.mark.timeout(60)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_pipe_is_read_as_it_comes_and_left_when_asked(tmp_path: Path, number: signal.Signals) -> None:
    """Nothing could end it while it waited for the pipe, but SIGKILL."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    command = [sys.executable, "-m", "coordinator.cli.main", "can", "decode", str(pipe), "--json"]
    writer = os.open(pipe, os.O_RDWR)  # waits for no reader, and never lets the pipe end
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        os.write(writer, b"(1.5) can0 3F0#00\n")
        assert json.loads(process.stdout.readline())["time_s"] == 1.5
        os.kill(process.pid, number)
        summary = json.loads(process.stdout.readline())
        assert process.wait(60) == 0
    os.close(writer)
    assert (summary["ok"], summary["stopped"], summary["frames"]) == (True, True, 1)


def test_candump_of_a_screen(capsys: Output, monkeypatch: pytest.MonkeyPatch) -> None:
    piped = io.TextIOWrapper(
        io.BytesIO(b"  can0  3F0   [1]  00\n  can0  3F1   [8]  20 90 A4 AE 02 2D FC 01\n")
    )
    monkeypatch.setattr(sys, "stdin", piped)
    lines, _ = decode(capsys, "-")
    assert [line.split("  ", 3)[3].strip() for line in lines] == [
        "query_unassigned",
        "need_nodeid uuid=90a4ae022dfc set_command=application",
    ]
