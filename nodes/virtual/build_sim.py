"""Builds ``nodes.virtual._sim``: the node firmware on the simulated board, with its generated dictionary."""

import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent.parent))

from nodes.native_build import ROOT, builder

TABLES = Path("build/sim/tables.c")
FOLDERS = ("wire", "core", "objects", "net", "boards/virtual", "boards/sim")
SOURCES = [
    path.relative_to(ROOT) for folder in FOLDERS for path in sorted((ROOT / "firmware" / folder).glob("*.c"))
]


def generate() -> None:
    """Write the tables; they count as new when a header is, as setuptools looks at sources only."""
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
ffibuilder = builder(
    "nodes.virtual._sim",
    headers=["firmware/boards/sim/sim.h"],
    sources=[*map(str, SOURCES), str(TABLES)],
)
