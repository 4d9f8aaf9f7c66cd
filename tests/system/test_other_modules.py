"""Modules of third parties: the example package as a user installs it, and packages that do not work."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.stages.processes import ROOT, Command, Hardware, canductor

EXAMPLE = ROOT / "docs" / "examples" / "chime"
CHIME = "\n[chime]\npin: toolhead:PC5\n"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder into which the example is installed."""
    folder = tmp_path_factory.mktemp("example")
    source, target = folder / "source", folder / "target"
    shutil.copytree(EXAMPLE, source, ignore=shutil.ignore_patterns("__pycache__", ".*"))
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    offline = ["--no-index", "--no-deps", "--no-build-isolation", "--target", str(target), str(source)]
    ended = subprocess.run([*pip, *offline], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return target


@pytest.fixture
def package(installed: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Let commands find it."""
    monkeypatch.setenv("PYTHONPATH", str(installed))
    return installed


def with_section(machine: Hardware, text: str) -> Path:
    path = machine.folder / "with.cfg"
    path.write_text(machine.config.read_text() + text)
    return path


def test_a_program_uses_it_on_nodes(package: Path, machine: Hardware) -> None:
    config = with_section(machine, CHIME)
    checked = canductor("config", "check", config)
    assert (checked.status, checked.stdout.splitlines()[-1]) == (0, f"{config}: no mistakes")
    with Command("run", config, "--json") as command:
        command.type("G28", "G1 X5 F6000", "CHIME LENGTH=0.05", "G1 X10", "CHIME", "M400", "M114")
        command.stdout.wait_for("X:10.00")
        ended = command.end()
    assert ended.status == 0, ended
    assert "unknown command" not in ended.stdout + ended.stderr
    assert not any(node["is_shutdown"] for node in machine.stop())


def test_its_mistakes_are_told_like_ours(package: Path, machine: Hardware) -> None:
    config = with_section(machine, "\n[chmie]\npin: PC0\n")
    told = canductor("config", "check", config)
    assert told.status == 1
    assert "there is no section [chmie]; did you mean [chime]?" in told.stdout
    config = with_section(machine, CHIME)
    gcode = machine.folder / "bad.gcode"
    gcode.write_text("G28\nCHIME LENGTH=7\n")
    assert "bad.gcode:2: LENGTH of CHIME" in canductor("run", config, "--gcode", gcode).sentence()


def test_its_own_tests_pass(package: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", str(EXAMPLE / "tests")]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "6 passed" in ended.stdout


BROKEN = {
    "missing": (None, r"cannot be loaded: No module named 'other_bell'; update or remove that package"),
    "raises": ("raise RuntimeError('too old')", r"cannot be loaded: too old; update or remove that package"),
    "no module": ("class Bell: pass", r"is no module for \[bell\]: it must be a subclass of"),
    "in building": (
        """
from coordinator.machine.options import SectionSpec
from coordinator.modules.base import Module
class Bell(Module):
    SPEC = SectionSpec("A bell", ())
    def __init__(self, build):
        super().__init__(build)
        {}["x"]
""",
        r"the module other_bell\.Bell failed: KeyError: 'x'; update or remove its package",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_package_that_is_broken_is_named_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    source, sentence = BROKEN[case]
    info = tmp_path / "other_bell-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-bell\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[canductor.modules]\nbell = other_bell:Bell\n")
    if source is not None:
        (tmp_path / "other_bell.py").write_text(source)
    config = tmp_path / "printer.cfg"
    config.write_text((ROOT / "config" / "cartesian.cfg").read_text() + "\n[bell]\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    told = canductor("config", "check", config)
    assert told.status == 1
    assert "Traceback" not in told.stdout + told.stderr
    problem, count = told.stdout.splitlines()
    assert count == f"{config}: 1 mistake"
    assert problem.startswith(f"{config}:{len(config.read_text().splitlines())}: ")
    assert re.search(sentence, problem), problem
