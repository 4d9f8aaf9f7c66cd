"""What an engine tells its owner."""

from dataclasses import dataclass

from coordinator.dnc.blocks import Header


@dataclass(frozen=True, slots=True)
class Asked:
    """Peripheral: the control's header came; answer with ``accept`` or ``refuse``."""

    header: Header


@dataclass(frozen=True, slots=True)
class DirectoryAsked:
    """Peripheral: the control wants the directory; answer with ``give_directory``."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line came, without CR LF; ``line_taken`` acknowledges it and lets the next one come."""

    text: bytes


@dataclass(frozen=True, slots=True)
class LineWanted:
    """The line before was taken: ``give_line`` or ``give_end``, at any time."""


@dataclass(frozen=True, slots=True)
class Ended:
    """All lines came. Keep the file, then call ``file_kept`` or ``fail``."""


@dataclass(frozen=True, slots=True)
class Sent:
    """All lines were taken. CONFIRMED: the other side said so at the end, as it does for input only."""

    confirmed: bool


@dataclass(frozen=True, slots=True)
class Directory:
    """Control: the peripheral's directory came, as text."""

    text: bytes


@dataclass(frozen=True, slots=True)
class Failed:
    """The transfer is over without a file; a sentence says why."""

    sentence: str


Event = Asked | DirectoryAsked | Line | LineWanted | Ended | Sent | Directory | Failed
