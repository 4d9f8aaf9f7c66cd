"""``printer.print_stats``: the state of the job, for macros and front ends; SET_PRINT_STATS_INFO.

A service reports it; without one nothing is ever printed.
"""

from collections.abc import Mapping
from typing import Final

from coordinator.gcode.commands import Call, Immediate, Reading
from coordinator.gcode.parameters import bounded
from coordinator.modules.base import Build, Module
from coordinator.support.values import Value

_LAYERS_MAX: Final = 1e6
NOTHING: Final[Mapping[str, Value]] = {
    "state": "standby",
    "filename": "",
    "total_duration": 0.0,
    "print_duration": 0.0,
    "filament_used": 0.0,
    "message": "",
}


class PrintStats(Module):
    """What is known of the job; shared by all that look at it."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.name = "print_stats"
        self.job: Mapping[str, Value] = NOTHING
        """What the service reports of the job; replaced, never changed."""
        self._total: int | None = None
        self._current: int | None = None
        build.add_command(
            "SET_PRINT_STATS_INFO",
            "Set TOTAL_LAYER and CURRENT_LAYER of the job",
            self._set,
            while_printing=True,
        )

    @property
    def state(self) -> str:
        """standby, printing, paused, complete, cancelled or error."""
        return str(self.job["state"])

    def job_begins(self) -> None:
        """Forget layers."""
        self._total = self._current = None

    def forget(self) -> None:
        """Forget a job that has ended; one that has not, the service reports again."""
        self.job = NOTHING
        self.job_begins()

    def status(self) -> Mapping[str, Value]:
        """Report all."""
        layers: dict[str, Value] = {"total_layer": self._total, "current_layer": self._current}
        return {**self.job, "info": layers}

    def _set(self, call: Call) -> Reading:
        values = call.parameters("TOTAL_LAYER", "CURRENT_LAYER")
        total = bounded(call.command, values, "TOTAL_LAYER", None, low=0, high=_LAYERS_MAX)
        current = bounded(call.command, values, "CURRENT_LAYER", None, low=0, high=_LAYERS_MAX)

        def act() -> None:
            if total is not None and total != self._total:
                self._total = int(total) or None
                self._current = None if self._total is None else 0
            if current is not None:
                self._current = int(current) if self._total is None else min(int(current), self._total)

        return Immediate(act=act)
