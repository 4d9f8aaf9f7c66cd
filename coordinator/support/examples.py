"""The example machines, and machines by name."""

from pathlib import Path
from typing import Final

from nodes.support.errors import CanductorError
from nodes.support.file_kind import is_regular


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
    if is_regular(name):
        return Path(name)
    examples = {machine_name(path): path for path in sorted(EXAMPLES.rglob("*.cfg"))}
    if name in examples:
        return examples[name]
    raise CanductorError(
        f"there is no machine '{name}': neither a file nor an example; examples are {', '.join(examples)}"
    )


def machine_name(path: Path) -> str:
    """Return a machine's name: ``demo`` for demo/machine.cfg, and the file's stem for all others."""
    return path.parent.name if path.stem == "machine" else path.stem
