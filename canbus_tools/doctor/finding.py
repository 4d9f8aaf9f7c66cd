"""Findings of the doctor."""

from dataclasses import dataclass
from enum import StrEnum
from functools import partial


class Severity(StrEnum):
    """Severity of a finding."""

    PROBLEM = "problem"
    """The bus does not work, or will fail soon."""
    WARNING = "warning"
    """The bus works, but may fail under load."""
    NOTE = "note"
    """Information; does not affect the exit status."""


@dataclass(frozen=True, slots=True)
class Finding:
    """An observation, its meaning and its cure."""

    severity: Severity
    name: str
    """Short and fixed, for scripts: ``interface-down``."""
    seen: str
    means: str
    do: str
    """Including the command to use, if there is one."""


problem = partial(Finding, Severity.PROBLEM)
warning = partial(Finding, Severity.WARNING)
note = partial(Finding, Severity.NOTE)
