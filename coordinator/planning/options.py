"""The options of ``canductor plan``."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanOptions:
    """What to plan, and what to write."""

    config: Path
    gcode: Path
    """``-``: standard input."""
    output: Path | None = None
    """Folder for each node's command stream, the report and its plot; None: only the report."""
    plot: Path | None = None
    """SVG of velocity, flow and bus load."""
    can_bitrate: int = 1_000_000
    """Bit/s of every CAN bus."""
    json: bool = False
    """Show no progress."""
    dictionaries: Mapping[str, Path] = field(default_factory=dict)
    """By node: its data dictionary as JSON; for others see ``node_dictionaries``."""
    tables: Mapping[str, Path] = field(default_factory=dict)
    """By axis: its compensation table, a CSV or a COMP_FILE of type 0 in mm."""
