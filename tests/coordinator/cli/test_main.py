"""The command line: words become options, every end is one sentence, with --json one object."""

import argparse
import asyncio
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from coordinator.cli import main as cli
from coordinator.cli.commands.run import RunOptions
from coordinator.cli.parser import build_parser
from coordinator.demo.run import DemoOptions
from coordinator.planning.options import PlanOptions
from coordinator.support.examples import DEMO_MACHINE
from coordinator.support.interrupts import run_to_end
from nodes.support.errors import CanductorError


@dataclass
class PlainReport:
    ok: bool = True
    figures: Mapping[str, object] = field(default_factory=dict)

    def to_json(self) -> Mapping[str, object]:
        return self.figures

    def to_text(self) -> str:
        return f"figures: {self.figures}"


class Runners:
    """Takes the place of the parts the command line starts; keeps what it was asked for."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked: list[object] = []
        self.answer: Callable[[], PlainReport] = PlainReport
        for function in ("demo.run_demo", "run.run_machine", "plan.plan_file"):
            monkeypatch.setattr(f"coordinator.cli.commands.{function}", self._run)

    def _run(self, options: object) -> PlainReport:
        self.asked.append(options)
        return self.answer()


@pytest.fixture
def runners(monkeypatch: pytest.MonkeyPatch) -> Runners:
    return Runners(monkeypatch)


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in a folder with a configuration, a g-code file and a dictionary."""
    for name in ("my.cfg", "part.gcode", "dict.json"):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_demo_options(runners: Runners, files: Path) -> None:
    words = (
        "demo --machine my.cfg --gcode part.gcode --json --no-web --loss 1% --seed 7 --rate-ppm toolhead=200"
        " --rate-ppm zboard=-3.5 --start-clock zboard=4294967295 --keep out"
    )
    assert cli.main(words.split()) == 0
    assert runners.asked == [
        DemoOptions(
            machine=Path("my.cfg"),
            gcode=Path("part.gcode"),
            json=True,
            loss=0.01,
            seed=7,
            rate_ppm={"toolhead": 200.0, "zboard": -3.5},
            start_clock={"zboard": 2**32 - 1},
            keep=Path("out"),
        )
    ]


@pytest.mark.parametrize(
    ("words", "interfaces"),
    [
        ("--socketcan vcan0", {"": "vcan0"}),
        ("--socketcan can0=vcan0 --socketcan can1=vcan1", {"can0": "vcan0", "can1": "vcan1"}),
        ("--socketcan can0=vcan0 --socketcan vcan1", {"can0": "vcan0", "": "vcan1"}),
    ],
)
def test_demo_on_interfaces(runners: Runners, words: str, interfaces: dict[str, str]) -> None:
    assert cli.main(["demo", *words.split()]) == 0
    assert runners.asked == [DemoOptions(socketcan=interfaces)]


def test_demo_defaults(runners: Runners) -> None:
    assert cli.main(["demo"]) == 0
    assert runners.asked == [DemoOptions()]
    assert DemoOptions().machine == DEMO_MACHINE
    assert DEMO_MACHINE.is_file()


def test_run_and_plan_options(runners: Runners, files: Path) -> None:
    assert cli.main(["run", "my.cfg"]) == 0
    assert cli.main(["run", "my.cfg", "--gcode", "part.gcode", "--json"]) == 0
    assert cli.main(["plan", "my.cfg", "part.gcode"]) == 0
    assert (
        cli.main(["plan", "my.cfg", "part.gcode", "-o", "out", "--json", "--dictionary", "mcu=dict.json"])
        == 0
    )
    assert runners.asked == [
        RunOptions(config=Path("my.cfg")),
        RunOptions(config=Path("my.cfg"), gcode=Path("part.gcode"), json=True),
        PlanOptions(config=Path("my.cfg"), gcode=Path("part.gcode")),
        PlanOptions(
            config=Path("my.cfg"),
            gcode=Path("part.gcode"),
            output=Path("out"),
            json=True,
            dictionaries={"mcu": Path("dict.json")},
        ),
    ]


def test_a_report_is_shown_and_decides_the_status(
    runners: Runners, files: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runners.answer = lambda: PlainReport(ok=True, figures={"steps": 5})
    assert cli.main(["plan", "my.cfg", "part.gcode"]) == 0
    assert capsys.readouterr() == ("figures: {'steps': 5}\n", "")
    runners.answer = lambda: PlainReport(ok=False, figures={"steps": 5})
    assert cli.main(["plan", "my.cfg", "part.gcode", "--json"]) == 1
    assert capsys.readouterr() == ('{"ok": false, "steps": 5}\n', "")


def raising(error: BaseException) -> Callable[[], PlainReport]:
    def fail() -> PlainReport:
        raise error

    return fail


def test_every_exit_status_is_documented_once() -> None:
    """Failed before: four of them were in the page of the CAN tools only, two nowhere."""
    page = (Path(__file__).parents[3] / "docs" / "run.md").read_text(encoding="utf-8")
    section = page.partition("## Exit status\n")[2].partition("\n## ")[0]
    plain = [cli.EXIT_OK, cli.EXIT_FAILED, cli.EXIT_USAGE, cli.EXIT_BUG]
    known = [*map(str, plain), f"{cli.EXIT_SIGNAL} + n", str(cli.EXIT_BROKEN_PIPE)]
    assert re.findall(r"^\| (\d[^|]*) \|", section, re.MULTILINE) == known


FAILURES: list[tuple[BaseException, int, str]] = [
    (CanductorError("node 'mcu' is silent; check its power"), 1, "node 'mcu' is silent; check its power"),
    (KeyboardInterrupt(), 130, "stopped by Ctrl-C"),
]


@pytest.mark.parametrize("failure", FAILURES)
def test_failures_end_in_one_sentence(
    runners: Runners,
    files: Path,
    capsys: pytest.CaptureFixture[str],
    failure: tuple[BaseException, int, str],
) -> None:
    error, status, sentence = failure
    runners.answer = raising(error)
    assert cli.main(["run", "my.cfg"]) == status
    assert capsys.readouterr() == ("", f"canductor: {sentence}\n")
    assert cli.main(["run", "my.cfg", "--json"]) == status
    out, err = capsys.readouterr()
    assert err == f"canductor: {sentence}\n"
    assert json.loads(out.splitlines()[-1]) == {"ok": False, "error": sentence}


@pytest.fixture
def hangup() -> Iterator[None]:
    """Leave SIGHUP as it was."""
    before = signal.getsignal(signal.SIGHUP)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("hangup")
@pytest.mark.parametrize("on_loop", [False, True], ids=["as it calculates", "on a loop"])
def test_a_terminal_that_is_closed_ends_a_command_but_not_under_nohup(
    runners: Runners, files: Path, capsys: pytest.CaptureFixture[str], *, on_loop: bool
) -> None:
    """It ended at once, without a sentence, and its sockets remained."""

    async def close_and_wait() -> PlainReport:
        signal.raise_signal(signal.SIGHUP)
        for _ in range(3):
            await asyncio.sleep(0)
        return PlainReport()

    def close() -> PlainReport:
        signal.raise_signal(signal.SIGHUP)
        return PlainReport()

    runners.answer = (lambda: run_to_end(close_and_wait)) if on_loop else close
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert cli.main(["run", "my.cfg"]) == 0
    capsys.readouterr()
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    assert cli.main(["run", "my.cfg"]) == 129
    assert capsys.readouterr() == ("", "canductor: stopped by SIGHUP\n")
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_DFL


@pytest.mark.parametrize("error", [ZeroDivisionError("by\nzero"), BrokenPipeError("a node's socket")])
def test_a_bug_leaves_its_traceback_in_a_file(
    runners: Runners,
    files: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(files))
    runners.answer = raising(error)
    assert cli.main(["run", "my.cfg", "--json"]) == 70
    out, err = capsys.readouterr()
    match = re.fullmatch(r"canductor: internal error: (\w+): (.*); please report it with (.*)\n", err)
    assert match
    assert match[1] == type(error).__name__
    assert match[2] == " ".join(str(error).split())
    log = Path(match[3]).read_text()
    assert Path(match[3]).parent == files
    assert "Traceback" in log
    assert "Traceback" not in out + err
    assert json.loads(out) == {"ok": False, "error": err.removeprefix("canductor: ").rstrip("\n")}


USAGE = {
    "plam": "invalid choice: 'plam' (choose from 'demo', 'run', 'plan', 'simulate', 'config', ",
    "plan": "the following arguments are required: config, gcode",
    "demo --sed 1": "unrecognized arguments: --sed 1",
    "demo --seed x": "--seed is 'x', must be a whole number of at least 0",
    "plan my.cfg part.gcode --plot a.gif": "--plot is 'a.gif', must be a file that ends in .svg",
    "plan my.cfg - --bitrate 5": "--bitrate is '5', must be a whole number from 10000 to 8000000",
    "simulate --seed 1 --seeds 1:2": "--seed and --seeds exclude each other",
    "simulate --jobs 257": "--jobs is '257', must be a whole number from 0 to 256",
    "demo --loss 60%": "--loss is '60%', must be a ratio from 0 to 0.5, or a percentage such as 1%",
    "demo --loss nan": "--loss is 'nan', must be a ratio from 0 to 0.5, or a percentage such as 1%",
    "demo --loss much": "--loss is 'much', must be a ratio from 0 to 0.5, or a percentage such as 1%",
    "demo --socketcan vcan0 --socketcan vcan1": "--socketcan is given twice for all buses",
    "demo --socketcan can0=a --socketcan can0=b": "--socketcan is given twice for 'can0'",
    "demo --socketcan =vcan0": "--socketcan takes NAME=VALUE, not '=vcan0'",
    "demo --socketcan vcan0 --loss 1%": "--loss is for virtual buses; to lose frames of an interface, use",
    "demo --rate-ppm 5": "--rate-ppm takes NAME=VALUE, not '5'",
    "demo --rate-ppm a=b": "--rate-ppm for 'a' is 'b', must be a number in ppm, from -10000 to 10000",
    "demo --rate-ppm a=nan": "--rate-ppm for 'a' is 'nan', must be a number in ppm, from -10000 to 10000",
    "demo --rate-ppm a=1 --rate-ppm a=2": "--rate-ppm is given twice for 'a'",
    "demo --start-clock a=-1": "--start-clock for 'a' is '-1', must be a whole number of ticks",
    "demo --start-clock a=18446744073709551616": "must be a whole number of ticks, from 0 to 2^64 - 1",
}


def help_of(words: str) -> str:
    command = words.split(maxsplit=1)[0]
    return "canductor --help" if command == "plam" else f"canductor {command} --help"


@pytest.mark.parametrize("words", USAGE)
def test_a_mistaken_command_line(
    runners: Runners, files: Path, capsys: pytest.CaptureFixture[str], words: str
) -> None:
    assert cli.main(words.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("canductor: ")
    assert err.endswith(f" (see '{help_of(words)}')\n")
    assert err.count("\n") == 1
    assert USAGE[words] in err
    assert runners.asked == []


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("run no.cfg", "there is no file 'no.cfg'"),
        ("run .", "'.' is a folder, not a file"),
        ("plan my.cfg no.gcode", "there is no file 'no.gcode'"),
        ("plan my.cfg part.gcode --dictionary mcu=no.json", "there is no file 'no.json'"),
        ("demo --gcode no.gcode", "there is no file 'no.gcode'"),
        ("demo --machine no", "there is no machine 'no': neither a file nor an example; examples are "),
    ],
)
def test_files_that_are_not_there(
    runners: Runners, files: Path, capsys: pytest.CaptureFixture[str], words: str, sentence: str
) -> None:
    assert cli.main(words.split()) == 1
    assert capsys.readouterr().err.startswith(f"canductor: {sentence}")
    assert runners.asked == []


LONG = "x" * 256


@pytest.mark.parametrize(
    "words",
    [
        "run {}",
        "run my.cfg --gcode {}",
        "run my.cfg --jobs {}",
        "run my.cfg --tls-key {}",
        "plan {} part.gcode",
        "plan my.cfg {}",
        "plan my.cfg part.gcode --dictionary mcu={}",
        "demo --machine {}",
        "demo --gcode {}",
        "config check {}",
        "send {} --at none",
        "status --token-file {}",
        "status --certificate {}",
        "table check {}",
        "can decode {}",
        "can record -o {}.log",
        "dnc drip {} -p none",
        "dnc send {} -p none",
    ],
)
def test_a_name_that_is_too_long_is_no_bug(
    runners: Runners, files: Path, capsys: pytest.CaptureFixture[str], words: str
) -> None:
    """As a file in another user's folder: what looked at it raised OSError."""
    assert cli.main(words.format(LONG).split()) == 1
    name = LONG + (".log" if "record" in words else "")
    assert capsys.readouterr().err == f"canductor: '{name}' cannot be looked at: file name too long\n"
    assert runners.asked == []


@pytest.mark.parametrize("host", ["a..b", "x" * 64, ".local", f"a.{LONG}"])
def test_a_host_that_cannot_be_is_no_bug(host: str, capsys: pytest.CaptureFixture[str]) -> None:
    for scheme in ("tcp", "tls"):
        assert cli.main(["status", "--at", f"{scheme}://{host}:80"]) == 1
        answer = f"{scheme}://{host}:80 does not answer: nothing can have this name; correct it"
        assert capsys.readouterr().err == f"canductor: {answer}\n"


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert re.fullmatch(r"canductor \d+\.\d+\.\d+\n", capsys.readouterr().out)
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(word in text for word in ("demo", "run", "plan", "--version"))
    assert cli.main([]) == 2
    assert capsys.readouterr() == (text, "")


LONG_REPORT = """
import sys
from coordinator.cli import main as cli
from coordinator.cli.commands import run

class Report:
    ok = True
    def to_text(self):
        return "line\\n" * 100_000

run.run_machine = lambda options: Report()
sys.exit(cli.main(["run", __file__, "--gcode", __file__]))
"""


def test_a_closed_reader_is_no_error(tmp_path: Path) -> None:
    script = tmp_path / "long_report.py"
    script.write_text(LONG_REPORT)
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, script], stdout=writer, stderr=subprocess.PIPE, timeout=60, check=False
    )
    os.close(writer)
    assert done.stderr == b""
    assert done.returncode == cli.EXIT_BROKEN_PIPE


THAT_SAY_SOMETHING = ["--version", "", "config reference", "completion bash", "config check no.cfg --json"]


def shell(command: str, words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run COMMAND of a shell, in which $canductor stands for the command with WORDS."""
    script = command.replace("$canductor", f"{sys.executable} -m coordinator.cli.main {words}")
    environment = {**os.environ, "TMPDIR": str(folder)}
    return subprocess.run(
        ["/bin/sh", "-c", script], env=environment, capture_output=True, text=True, timeout=60, check=False
    )


@pytest.mark.parametrize("words", THAT_SAY_SOMETHING)
def test_without_standard_output_a_command_does_what_it_does(tmp_path: Path, words: str) -> None:
    closed = shell("$canductor >&-", words, tmp_path)
    usual = shell("$canductor", words, tmp_path)
    assert (closed.stdout, closed.stderr) == ("", usual.stderr)
    assert closed.returncode == usual.returncode
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", THAT_SAY_SOMETHING)
def test_output_to_a_full_disk_is_a_failure(tmp_path: Path, words: str) -> None:
    done = shell("$canductor >/dev/full", words, tmp_path)
    last = done.stderr.splitlines()[-1]
    assert last == "canductor: cannot write the output: no space left on device"
    assert "Traceback" not in done.stderr
    assert done.returncode == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("where", ["2>&-", "2>/dev/full"])
def test_a_sentence_that_nobody_takes_goes_nowhere_else(tmp_path: Path, where: str) -> None:
    done = shell(f"$canductor {where}", "config check no.cfg", tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "")


@pytest.mark.parametrize("words", ["run {0}", "plan {0} -", "can decode -"])
def test_without_standard_input_there_is_nothing_to_read(tmp_path: Path, words: str) -> None:
    done = shell("$canductor <&-", words.format(DEMO_MACHINE), tmp_path)
    assert done.stderr == "canductor: standard input is closed, so there is nothing to read; name a file\n"
    assert done.returncode == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("can query --rounds x", "canductor can query --help"),
        ("can bogus", "canductor can --help"),
        ("can", "canductor can --help"),
        ("console --node zz", "canductor console --help"),
    ],
)
def test_a_mistaken_tool_line_names_the_tools_own_help(
    capsys: pytest.CaptureFixture[str], words: str, told: str
) -> None:
    assert cli.main(words.split()) == 2
    assert capsys.readouterr().err.endswith(f" (see '{told}')\n")


def test_every_command_has_a_help(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each option is explained, and what argparse puts into the text fits."""
    monkeypatch.setenv("COLUMNS", "120")
    commands = list(leaf_commands(build_parser()))
    assert len(commands) > 30
    for command in commands:
        assert cli.main([*command.prog.split()[1:], "--help"]) == 0
        assert capsys.readouterr().out == command.format_help()
        assert all(action.help for action in command._actions), command.prog


def leaf_commands(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    groups = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    if not groups:
        yield parser
    for group in groups:
        for command in group.choices.values():
            yield from leaf_commands(command)
