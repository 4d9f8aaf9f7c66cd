"""The source distribution has what a build reads, the wheel what an installation reads."""

import re
import shutil
import subprocess
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

import pytest

from tests.package.build import ROOT, setup, unpack

PACKAGES = ("canbus_tools", "coordinator", "nodes")
BUILT = ("*.so", "*.o", "*.d", "*.py[cod]", "*/build/*", "*/bin/*", "*.egg-info/*", "*/_*.c")
"""What a checkout may have and no source distribution."""
BUILD_ONLY = ("*.c", "*.h", "*/build_*.py", "nodes/support/native_build.py", "nodes/support/link_sources.py")
"""What a package's folder has for the build alone."""
INCLUDE = re.compile(r'^#include "([^"]+)"', re.MULTILINE)
C_PATH = re.compile(r'"((?:firmware|nodes|coordinator)/[\w/]+\.[ch])"')


@dataclass(frozen=True)
class Built:
    """What setuptools makes of the checkout without compiling."""

    source: Path
    """The unpacked source distribution."""
    library: Path
    """What a wheel has, without compiled files."""


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    folder = tmp_path_factory.mktemp("built")
    library = folder / "library"
    left = library / "coordinator" / "left_by_an_earlier_build.py"
    left.parent.mkdir(parents=True)
    left.touch()
    setup(folder, "sdist", "--formats=tar", f"--dist-dir={folder}", "build_py", f"--build-lib={library}")
    (archive,) = folder.glob("canductor-*.tar")
    return Built(unpack(archive), library)


def files(root: Path, *folders: str) -> set[str]:
    """Return the paths, from ROOT, of all files in FOLDERS of it but what was built."""
    found = (path for folder in folders for path in (root / folder).rglob("*") if path.is_file())
    return {name for path in found if not matches(name := path.relative_to(root).as_posix(), BUILT)}


def matches(name: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatch(name, pattern) for pattern in patterns)


def test_the_source_distribution_is_the_project(built: Built) -> None:
    if not shutil.which("git") or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout: nothing says what belongs to the project")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True)
    tracked = {name for name in listed.stdout.splitlines() if (ROOT / name).is_file()}
    shipped = {
        path.relative_to(built.source).as_posix() for path in built.source.rglob("*") if path.is_file()
    }
    assert tracked - shipped == {".gitignore"}
    assert {name for name in shipped if matches(name, BUILT) and ".egg-info/" not in name} == set()


def test_the_source_distribution_has_every_c_file_that_a_build_reads(built: Built) -> None:
    root = built.source
    sources = [root / name for name in files(root, "firmware", "nodes", "coordinator")]
    for source in sources:
        if source.suffix in {".c", ".h"}:
            for included in INCLUDE.findall(source.read_text()):
                places = (root, root / "firmware", source.parent)
                assert any((place / included).is_file() for place in places), f"{source} includes {included}"
        elif source.name.startswith("build_"):
            for named in C_PATH.findall(source.read_text()):
                assert (root / named).is_file(), f"{source} names {named}"
    assert len(sources) > 500


def test_the_wheel_has_every_module_and_data_file_and_the_example_machines(built: Built) -> None:
    library = built.library
    shipped = {path.relative_to(library).as_posix() for path in library.rglob("*") if path.is_file()}
    needed = {name for name in files(built.source, *PACKAGES) if not matches(name, BUILD_ONLY)}
    config = files(built.source, "config")
    machines = {name.replace("config/", "coordinator/example_machines/", 1) for name in config}
    assert shipped == needed | machines
    assert {"coordinator/example_machines/demo/machine.cfg", "coordinator/web/page/index.html"} <= shipped
