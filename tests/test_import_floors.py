"""Each room of the house imports only rooms below it (docs/architecture.md)."""

import ast
import functools
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = {
    "nodes": (
        *("support", "dictionary", "link", "transport", "clock", "virtual", "node", "bus", "devices", "mt"),
    ),
    "canbus_tools": (
        *("support", "protocol", "dissector", "inject", "recordings", "bus", "console", "discovery"),
        *("monitor", "doctor", "tables", "tools"),
    ),
    "coordinator": (
        *("support", "drivers", "motion", "heat", "kinematics", "ipc", "config", "gcode", "web", "metrics"),
        *("tables", "dnc", "runtime", "modules", "assembly", "streaming", "planning", "virtual_machine"),
        *("service", "verification", "klippy_api", "serial_host", "simulate", "front_ends", "demo", "cli"),
    ),
}
"""The rooms of each package: a room imports itself and those before it."""
BELOW = {"nodes": (), "canbus_tools": ("nodes",), "coordinator": ("nodes",)}
"""Packages below each package."""
JOINS_TOOLS = "coordinator.cli"
"""The one room that joins the tools to the coordinator."""
CIRCLE_MAX = 3
"""Files that may import one another, inside one room."""


def module_name(source: Path) -> str:
    """Return the dotted name of the module in SOURCE."""
    return ".".join(source.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def exists(module: str) -> bool:
    path = ROOT.joinpath(*module.split("."))
    return path.with_suffix(".py").exists() or path.with_suffix(".pyi").exists() or path.is_dir()


@functools.cache
def imports() -> dict[str, set[str]]:
    """Return what each of our modules imports of ours: anywhere in it, also for type checking alone."""
    found: dict[str, set[str]] = {}
    for package in ROOMS:
        for source in (ROOT / package).rglob("*.py"):
            names = found.setdefault(module_name(source), set())
            for node in ast.walk(ast.parse(source.read_text())):
                if isinstance(node, ast.Import):
                    names |= {alias.name for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
                    longer = (f"{node.module}.{alias.name}" for alias in node.names)
                    names |= {name if exists(name) else node.module for name in longer}
    return {name: {n for n in names if n.split(".")[0] in ROOMS} - {name} for name, names in found.items()}


def room_of(module: str) -> str:
    """Return the room that MODULE is in, such as ``nodes.link``; a package's own ``__init__`` is in none."""
    return ".".join(module.split(".")[:2]) if "." in module else ""


def is_below(room: str, other: str) -> bool:
    """Tell whether ROOM may import OTHER."""
    (package, name), (other_package, other_name) = room.split("."), other.split(".")
    if package != other_package:
        return other_package in BELOW[package] or (room == JOINS_TOOLS and other_package == "canbus_tools")
    return ROOMS[package].index(other_name) <= ROOMS[package].index(name)


def test_every_module_is_in_a_room_that_is_listed() -> None:
    rooms = {room_of(name) for name in imports()} - {""}
    assert rooms == {f"{package}.{name}" for package, names in ROOMS.items() for name in names}


def test_rooms_import_only_rooms_below_them() -> None:
    upwards = [
        f"{name} imports {other}"
        for name, others in imports().items()
        for other in others
        if room_of(name) and room_of(other) and not is_below(room_of(name), room_of(other))
    ]
    assert not upwards, "\n".join(upwards)


def test_few_files_import_one_another() -> None:
    circles = [sorted(circle) for circle in circles_of(imports()) if len(circle) > 1]
    assert all(len({room_of(name) for name in circle}) == 1 for circle in circles), circles
    assert all(len(circle) <= CIRCLE_MAX for circle in circles), circles


def circles_of(graph: dict[str, set[str]]) -> list[set[str]]:
    """Return the sets of modules of GRAPH that reach one another."""
    reached = {name: reach(graph, name) for name in graph}
    left, found = set(graph), []
    while left:
        name = left.pop()
        circle = {name} | {other for other in reached[name] & left if name in reached[other]}
        left -= circle
        found.append(circle)
    return found


def reach(graph: dict[str, set[str]], start: str) -> set[str]:
    """Return all modules that START imports, directly or by way of others."""
    found: set[str] = set()
    waiting = [start]
    while waiting:
        new = graph.get(waiting.pop(), set()) - found
        found |= new
        waiting += new
    return found


@pytest.mark.parametrize(
    ("folder", "floors_above"),
    [
        ("firmware/wire", ("core/", "objects/", "net/", "plant/", "boards/", "nodes/", "coordinator/")),
        (
            "firmware/core",
            ("plant/", "objects/", "net/", "boards/linux", "boards/sim", "nodes/", "coordinator/"),
        ),
        ("firmware/objects", ("plant/", "net/", "boards/linux", "boards/sim", "nodes/", "coordinator/")),
        ("firmware/net", ("plant/", "boards/linux", "boards/sim", "nodes/", "coordinator/")),
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
