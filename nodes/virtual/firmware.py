"""The project's firmware built for virtual nodes: executables and their dictionaries."""

from pathlib import Path
from typing import Final

from nodes.dictionary.dictionary import Dictionary
from nodes.support.errors import CanductorError

BIN: Final = Path(__file__).parent / "bin"
MAINBOARD: Final = "canductor-node-mainboard"
TOOLHEAD: Final = "canductor-node-toolhead"
UART: Final = "canductor-node-uart"


def firmware_path(build: str) -> Path:
    """Return the executable of BUILD; raises CanductorError when it is missing."""
    path = BIN / build
    if not path.is_file():
        raise CanductorError(f"the firmware {path} is missing; install the project again (make setup)")
    return path


def firmware_dictionary(build: str) -> Dictionary:
    """Return the dictionary of BUILD without running it."""
    try:
        return Dictionary.from_json((firmware_path(build).with_suffix(".json")).read_bytes())
    except OSError as error:
        raise CanductorError(
            f"the dictionary of {build} cannot be read ({error.strerror}); install the project again"
        ) from None
