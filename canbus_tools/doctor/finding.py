"""One thing that the doctor has to say."""

from dataclasses import dataclass
from enum import Enum


class Severity(Enum):
    """How bad it is."""

    PROBLEM = "problem"
    """It does not work, or will not for long."""
    WARNING = "warning"
    """It works, and will fail on a worse day."""
    NOTE = "note"
    """Good to know; no reason for a bad exit status."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What was seen, what it means, what to do."""

    name: str
    """Short and fixed, for scripts: ``interface-down``."""
    severity: Severity
    seen: str
    means: str
    do: str
    """With the command that does it, where there is one."""


def problem(name: str, seen: str, means: str, do: str) -> Finding:
    """Return a finding of that severity."""
    return Finding(name=name, severity=Severity.PROBLEM, seen=seen, means=means, do=do)


def warning(name: str, seen: str, means: str, do: str) -> Finding:
    """Return a finding of that severity."""
    return Finding(name=name, severity=Severity.WARNING, seen=seen, means=means, do=do)


def note(name: str, seen: str, means: str, do: str) -> Finding:
    """Return a finding of that severity."""
    return Finding(name=name, severity=Severity.NOTE, seen=seen, means=means, do=do)
