"""Each floor of the house imports only floors below it (docs/architecture.md)."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ALLOWED = {
    "nodes": {"nodes"},
    "canbus_tools": {"nodes", "canbus_tools"},
    "coordinator": {"nodes", "coordinator"},
}
# The command line is the one place that joins the tools to the coordinator.
EXCEPTIONS = {("coordinator/cli/parser.py", "canbus_tools")}


def imported_packages(source: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(source.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.split(".")[0])
    return names & ALLOWED.keys()


@pytest.mark.parametrize("package", ALLOWED)
def test_python_imports_stay_on_their_floor(package: str) -> None:
    for source in sorted((ROOT / package).rglob("*.py")):
        path = source.relative_to(ROOT).as_posix()
        beyond = {p for p in imported_packages(source) - ALLOWED[package] if (path, p) not in EXCEPTIONS}
        assert not beyond, f"{path} imports {beyond}"


@pytest.mark.parametrize(
    ("folder", "floors_above"),
    [
        ("firmware/wire", ("core/", "objects/", "net/", "boards/", "nodes/", "coordinator/")),
        ("firmware/core", ("objects/", "net/", "boards/linux", "boards/sim", "nodes/", "coordinator/")),
        ("firmware/objects", ("net/", "boards/linux", "boards/sim", "nodes/", "coordinator/")),
        ("firmware/net", ("boards/linux", "boards/sim", "nodes/", "coordinator/")),
        ("firmware", ("nodes/", "coordinator/")),
        ("nodes", ("coordinator/",)),
    ],
)
def test_c_includes_stay_on_their_floor(folder: str, floors_above: tuple[str, ...]) -> None:
    for source in sorted((ROOT / folder).rglob("*.[ch]")):
        for line in source.read_text(errors="replace").splitlines():
            if line.startswith('#include "'):
                included = line.split('"')[1]
                assert not included.startswith(floors_above), f"{source.relative_to(ROOT)}: {line}"
