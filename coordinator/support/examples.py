"""The example machines, and machines by name."""

from pathlib import Path
from typing import Final

from nodes.support.errors import CanductorError


def _examples() -> Path:
    """Return the folder of the example machines: inside an installed package, or config/ of a checkout."""
    package = Path(__file__).parents[1]
    installed = package / "example_machines"
    return installed if installed.is_dir() else package.parent / "config"


EXAMPLES: Final = _examples()
DEMO_MACHINE: Final = EXAMPLES / "demo" / "machine.cfg"
DEMO_GCODE: Final = EXAMPLES / "demo" / "part.gcode"


def find_machine(name: str) -> Path:
    """Return the configuration file of a path or of an example's name; raises CanductorError."""
    path = Path(name)
    try:
        if path.is_file():
            return path
        examples = {machine_name(p): p for p in sorted(EXAMPLES.rglob("*.cfg"))}
    except (OSError, ValueError):  # a name too long, or with a NUL
        examples = {}
    if name in examples:
        return examples[name]
    known = f"; examples are {', '.join(examples)}" if examples else ""
    raise CanductorError(f"there is no machine '{name}': neither a file nor an example{known}")


def machine_name(path: Path) -> str:
    """Return a machine's name: ``demo`` for demo/machine.cfg, and the file's stem for all others."""
    return path.parent.name if path.stem == "machine" else path.stem
