"""Builds ``nodes.virtual._sim``: the simulated world.

That is the node firmware on the simulated board, with its generated dictionary, the host's core of a bus, and
the wires between them.
"""

import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent.parent))

from nodes.support.link_sources import CORE_HEADERS, CORE_SOURCES
from nodes.support.native_build import ROOT, builder

TABLES = Path("build/sim/tables.c")
FOLDERS = ("wire", "core", "objects", "net", "plant", "boards/virtual", "boards/sim")
SOURCES = [
    path.relative_to(ROOT) for folder in FOLDERS for path in sorted((ROOT / "firmware" / folder).glob("*.c"))
]


def generate() -> None:
    """Write the tables; mark them as new when a header is newer, as setuptools checks sources only."""
    generator = "firmware/tools/gen_dictionary.py"
    options = ["--version", "0.1.0", "--build-versions", "sim", "-I", "firmware"]
    subprocess.run(
        [sys.executable, generator, "--output", str(TABLES), *options, *map(str, SOURCES)],
        cwd=ROOT,
        check=True,
    )
    tables = ROOT / TABLES
    if any(header.stat().st_mtime > tables.stat().st_mtime for header in (ROOT / "firmware").rglob("*.h")):
        tables.touch()


generate()
WORLD = [
    *("nodes/support/can_bits.c", "nodes/virtual/world/agenda.c", "nodes/virtual/world/clock.c"),
    *(f"nodes/virtual/world/{name}.c" for name in ("can_wire", "controller", "uart", "nodes", "node_world")),
    *(f"nodes/virtual/world/{name}.c" for name in ("host", "world")),
]

ffibuilder = builder(
    "nodes.virtual._sim",
    headers=[
        *CORE_HEADERS,
        *("nodes/support/can_bits.h", "firmware/objects/mt.h", "firmware/boards/sim/sim.h"),
        *("nodes/virtual/world/can_wire.h", "nodes/virtual/world/world.h"),
    ],
    # The wire codec is in both lists; it is linked once.
    sources=list(dict.fromkeys([*map(str, SOURCES), str(TABLES), *CORE_SOURCES, *WORLD])),
)
