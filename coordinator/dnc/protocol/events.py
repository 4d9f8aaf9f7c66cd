"""Events of an engine for its owner."""

from dataclasses import dataclass

from coordinator.dnc.protocol.blocks import Header


@dataclass(frozen=True, slots=True)
class Asked:
    """Peripheral: the control's header was received; answer with ``accept`` or ``refuse``."""

    header: Header


@dataclass(frozen=True, slots=True)
class DirectoryAsked:
    """Peripheral: the control requests the directory; answer with ``give_directory``."""


@dataclass(frozen=True, slots=True)
class Line:
    """A line was received, without CR LF; ``line_taken`` acknowledges it, so that the next one can follow."""

    text: bytes


@dataclass(frozen=True, slots=True)
class LineWanted:
    """The previous line was accepted: call ``give_line`` or ``give_end``, at any time."""


@dataclass(frozen=True, slots=True)
class Ended:
    """All lines were received. Store the file, then call ``file_kept`` or ``fail``."""


@dataclass(frozen=True, slots=True)
class Sent:
    """All lines were accepted. CONFIRMED: by the other side at the end, which happens only for input."""

    confirmed: bool


@dataclass(frozen=True, slots=True)
class Directory:
    """Control: the peripheral's directory was received, as text."""

    text: bytes


@dataclass(frozen=True, slots=True)
class Failed:
    """The transfer failed; SENTENCE gives the reason."""

    sentence: str


Event = Asked | DirectoryAsked | Line | LineWanted | Ended | Sent | Directory | Failed
