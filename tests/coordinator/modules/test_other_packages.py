"""Modules of third parties: the example package as a user installs it, and packages that do not work."""

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from coordinator.assembly.check import check_config
from coordinator.gcode.errors import GCodeError
from coordinator.modules import registry
from coordinator.support.examples import EXAMPLES
from tests.stages.program_stage import ProgramStage

ROOT = EXAMPLES.parent
EXAMPLE = ROOT / "docs" / "examples" / "chime"


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
def known(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """Let the packages on sys.path be looked for again, now and afterwards."""
    modules = set(sys.modules)
    registry._others.cache_clear()
    yield monkeypatch
    registry._others.cache_clear()
    for name in set(sys.modules) - modules:
        if name.startswith(("canductor_chime", "other_bell")):
            del sys.modules[name]


def test_its_mistakes_are_reported_like_ours(
    tmp_path: Path, installed: Path, known: pytest.MonkeyPatch
) -> None:
    known.syspath_prepend(str(installed))
    stage = ProgramStage(tmp_path, "[chime]\npin: toolhead:PC5\n")
    assert check_config(stage.path) == []
    with pytest.raises(GCodeError, match=r"part\.gcode:2: LENGTH of CHIME"):
        stage.run("G28", "CHIME LENGTH=7")
    config = Path(stage.path)
    config.write_text(config.read_text().replace("[chime]", "[chmie]"))
    (problem,) = check_config(stage.path)
    assert "there is no section [chmie]; did you mean [chime]?" in str(problem)


def test_its_own_tests_pass(installed: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", str(EXAMPLE / "tests")]
    environment = {"PYTHONPATH": str(installed), "PATH": "/usr/bin:/bin"}
    ended = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "6 passed" in ended.stdout


BROKEN = {
    "missing": (None, r"cannot be loaded: No module named 'other_bell'; update or remove that package"),
    "raises": ("raise RuntimeError('too old')", r"cannot be loaded: too old; update or remove that package"),
    "no module": ("class Bell: pass", r"is no module for \[bell\]: it must be a subclass of"),
    "in building": (
        """
from coordinator.config.options import SectionSpec
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
    tmp_path: Path, known: pytest.MonkeyPatch, case: str
) -> None:
    source, sentence = BROKEN[case]
    info = tmp_path / "other_bell-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-bell\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[canductor.modules]\nbell = other_bell:Bell\n")
    if source is not None:
        (tmp_path / "other_bell.py").write_text(source)
    config = tmp_path / "printer.cfg"
    config.write_text((EXAMPLES / "cartesian.cfg").read_text() + "\n[bell]\n")
    known.syspath_prepend(str(tmp_path))
    (problem,) = map(str, check_config(str(config)))
    assert problem.startswith(f"{config}:{len(config.read_text().splitlines())}: ")
    assert re.search(sentence, problem), problem
