"""What macros see as ``printer``: the status of all modules, the configuration, and the moves read so far.

Macros are rendered where programs are read, in another thread than the control loop of the modules. So the
loop is asked for the status of all, once for each rendering that uses one; a loop that is late gets no more
than PATIENCE_S, and the status it gave last is used.
"""

import asyncio
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

from coordinator.gcode.commands import Call
from coordinator.gcode.templates.renderer import template_renderer
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.status.absent_status import absent_statuses
from coordinator.modules.status.config_view import config_view, config_warnings
from coordinator.modules.status.machine_view import machine_view
from coordinator.modules.status.print_stats import PrintStats
from coordinator.runtime.module_context import ModuleContext

PATIENCE_S: Final = 0.2
Shown = Mapping[str, Mapping[str, object]]


class PrinterStatus(Module):
    """Gathers the status; shared by all templates."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        build.shared(PrintStats)
        self._modules: Modules | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._loop_thread = 0
        self._last: Shown = {}
        self._templates: list[str] = []

    def add_template(self, text: str) -> None:
        """Have TEXT compiled by the time it is needed."""
        self._templates.append(text)

    def link(self, modules: Modules) -> None:
        """Remember the modules."""
        self._modules = modules

    async def connect(self, live: "ModuleContext") -> None:
        """Start asking the loop."""
        await super().connect(live)
        self._loop, self._loop_thread = asyncio.get_running_loop(), threading.get_ident()
        if self._templates:
            template_renderer().prepare(self._templates)

    def close(self) -> None:
        """Stop asking the loop."""
        self._loop = self._live = None

    def call_remote(self, name: str, values: Mapping[str, object]) -> bool:
        """Call clients that registered the method NAME; return whether there are any. From any thread."""
        live = self._live
        runner = None if live is None else live.machine.runner
        if live is None or runner is None or name not in runner.remote_methods:
            return False
        live.soon_on_loop(lambda: runner.call_remote(name, values))
        return True

    def view(self, call: Call) -> "PrinterView":
        """Return ``printer`` for a rendering of CALL."""
        return PrinterView(self._look, call.figures)

    def _look(self) -> Shown:
        modules, loop = self._modules, self._loop
        if modules is None:
            return {}
        if loop is None or threading.get_ident() == self._loop_thread:
            return self._every(modules)
        seen = threading.Event()

        def take() -> None:
            self._last = self._every(modules)
            seen.set()

        try:
            loop.call_soon_threadsafe(take)
        except RuntimeError:  # it has ended meanwhile
            return self._last
        seen.wait(PATIENCE_S)
        return self._last

    def _every(self, modules: Modules) -> Shown:
        found: dict[str, Mapping[str, object]] = dict(machine_view(modules, self._live))
        # A section without a status is there nevertheless: macros ask whether sections exist.
        found.update(absent_statuses(modules.config))
        found.update((name, {}) for name in modules.names(Module) if name in modules.config)
        found.update((name, self._for_macros(status)) for name, status in modules.status().items())
        found["configfile"] = config_view(
            modules.config, modules.settings, found.get("configfile", {}), self._warnings(modules)
        )
        return found

    def _warnings(self, modules: Modules) -> list[dict[str, str]]:
        if self._live is None:
            return []
        described = self._live.machine.description
        return config_warnings(described.unsupported, (*described.notes, *modules.notes))

    def _for_macros(self, status: Mapping[str, object]) -> Mapping[str, object]:
        """Return STATUS with numbers that macros can compare, also where nothing was measured yet.

        A program that is only planned takes it for granted that all is hot.
        """
        if "temperature" not in status:
            return status
        planned = {"can_extrude": True} if self._live is None and "can_extrude" in status else {}
        celsius = status["temperature"]
        return {**status, **planned, "temperature": 0.0 if celsius is None else celsius}


class PrinterView(Mapping[str, Any]):
    """The status by name, looked at when it is first asked for; then it stays as it is."""

    def __init__(self, look: Callable[[], Shown], figures: Callable[[], Shown]) -> None:
        self._look = look
        self._figures = figures
        self._all: Shown | None = None

    def __getitem__(self, name: str) -> Mapping[str, object]:
        return self._every()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._every())

    def __len__(self) -> int:
        return len(self._every())

    def _every(self) -> Shown:
        if self._all is None:
            seen, figures = self._look(), self._figures()
            self._all = {
                **seen,
                **{name: {**seen.get(name, {}), **fields} for name, fields in figures.items()},
            }
        return self._all
