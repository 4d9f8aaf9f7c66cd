"""What an engine tells its owner."""

from coordinator.dnc.blocks import Header
from nodes.support.records import record


@record
class Asked:
    """Peripheral: the control's header came; answer with ``accept`` or ``refuse``."""

    header: Header


@record
class DirectoryAsked:
    """Peripheral: the control wants the directory; answer with ``give_directory``."""


@record
class Line:
    """A line came, without CR LF; ``line_taken`` acknowledges it and lets the next one come."""

    text: bytes


@record
class LineWanted:
    """The line before was taken: ``give_line`` or ``give_end``, at any time."""


@record
class Ended:
    """All lines came. Keep the file, then call ``file_kept`` or ``fail``."""


@record
class Sent:
    """All lines were taken. CONFIRMED: the other side said so at the end, as it does for input only."""

    confirmed: bool


@record
class Directory:
    """Control: the peripheral's directory came, as text."""

    text: bytes


@record
class Failed:
    """The transfer is over without a file; a sentence says why."""

    sentence: str


Event = Asked | DirectoryAsked | Line | LineWanted | Ended | Sent | Directory | Failed
