"""Builds distributions of the checkout; what is built goes to the folder the caller names."""

import subprocess
import sys
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]


def setup(folder: Path, *commands: str | Path) -> None:
    """Run setup.py's COMMANDS; FOLDER gets its egg-info, so that no earlier list of files is used again.

    Raises CalledProcessError, with what setuptools printed.
    """
    words = [sys.executable, "setup.py", "-q", "egg_info", "--egg-base", str(folder), *map(str, commands)]
    subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True)


def unpack(archive: Path) -> Path:
    """Unpack a source distribution in its folder; return the folder that was in it."""
    subprocess.run(["tar", "-xf", archive], cwd=archive.parent, check=True)
    return archive.parent / archive.name.removesuffix(".gz").removesuffix(".tar")
