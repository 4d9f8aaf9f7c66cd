"""The options of one ``canductor dnc`` command."""

from dataclasses import dataclass, field
from pathlib import Path

from coordinator.dnc.options import DncOptions
from coordinator.ipc.client.target import Target


@dataclass(frozen=True, slots=True, kw_only=True)
class DncJob:
    """One command: the serial line, the files, and what is done with them."""

    port: str
    options: DncOptions
    paced: bool | None = None
    """Whether the port keeps to the baud rate; None: detected."""
    rtscts: bool = False
    peripheral: bool = False
    """This side is the peripheral."""
    code: str = "D"
    name: str = ""
    file: Path | None = None
    """The file to send; ``-``: standard input."""
    folder: Path | None = None
    overwrite: bool = False
    newline: bytes = b"\n"
    read_only: bool = False
    once: bool = False
    start: bool = False
    """Print what was received, or as it is received."""
    numbered: bool = False
    """N words increase by the same step."""
    verify: bool = False
    """Transfer the file a second time and compare."""
    machine: Target = field(default_factory=Target)
    """The machine that prints."""
    json: bool = False
