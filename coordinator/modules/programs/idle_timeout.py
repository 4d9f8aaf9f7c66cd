"""[idle_timeout]: acts when the machine was idle for a while; by default heaters and motors are switched off.

Every machine has it, with its defaults where there is no such section.
"""

from collections.abc import Mapping
from typing import Final

from coordinator.config.options import FloatOption, GCodeOption, SectionSpec
from coordinator.gcode.commands import Call, Immediate, Lines, Reading
from coordinator.gcode.parameters import bounded
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.programs.gcode_macro import GCodeTemplate
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.values import Value

TIMEOUT = FloatOption(
    name="timeout",
    help="How long the machine may be idle; while a job is paused it counts as idle",
    default=600.0,
    unit="s",
    above=0.0,
    maximum=1e9,
)
GCODE = GCodeOption(
    name="gcode",
    help="g-code to run then; by default TURN_OFF_HEATERS and M84, where there are heaters and motors",
    default="",
)
OFF: Final = ("TURN_OFF_HEATERS", "M84")
LOOK_S: Final = 1.0


class IdleTimeout(Module):
    """Watches for idleness and acts."""

    SPEC = SectionSpec("G-code to run when the machine is idle", (TIMEOUT, GCODE))

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._configured_s = self._timeout_s = build.get(TIMEOUT)
        self._template = GCodeTemplate(build, GCODE) if build.find(GCODE) is not None else None
        self._default: tuple[str, ...] = ()
        self._state = "Idle"
        self._since_s = 0.0
        self._busy_since_s: float | None = None
        self._works = 0
        self._acting = False
        build.add_command(
            "SET_IDLE_TIMEOUT", "Set the idle time-out: TIMEOUT, s", self._set, while_printing=True
        )
        build.add_command("_IDLE_TIMEOUT", "Run what [idle_timeout] does", self._lines)

    def link(self, modules: Modules) -> None:
        """Find out what can be switched off."""
        self._default = tuple(name for name in OFF if modules.knows(name))

    async def connect(self, live: "ModuleContext") -> None:
        """Start watching."""
        await super().connect(live)
        self._since_s = live.now_s()
        self._state = "Ready"
        live.every(LOOK_S, self.look)

    def end(self, cause: str) -> None:  # noqa: ARG002
        """Stop watching: all is off."""
        self._live, self._state = None, "Idle"

    def status(self) -> Mapping[str, Value]:
        """Report Printing, Ready or Idle, and for how long it has been printing, s."""
        printing_s = 0.0
        if self._live is not None and self._busy_since_s is not None:
            printing_s = self._live.now_s() - self._busy_since_s
        return {
            "state": self._state,
            "printing_time": round(printing_s, 1),
            "idle_timeout": self._timeout_s,
        }

    def look(self) -> None:
        """Check whether the machine is idle; on the control loop."""
        live = self._live
        if live is None or (runner := live.machine.runner) is None:
            return
        now_s = live.now_s()
        if self._acting:  # its own lines do not count as activity
            self._acting, self._works = runner.busy, runner.works
            return
        works, self._works = self._works, runner.works
        if runner.busy or runner.works != works:
            if self._busy_since_s is None:
                self._busy_since_s = now_s
            self._since_s, self._state = now_s, "Printing"
            return
        self._busy_since_s = None
        if self._state == "Printing":
            self._state = "Ready"
        if self._state == "Ready" and now_s >= self._since_s + self._timeout_s:
            self._state = "Idle"
            if self._template is None and not self._default:
                return
            live.say(f"the machine was idle for {self._timeout_s:g} s: {self._action()}")
            runner.run_lines("idle_timeout", ["_IDLE_TIMEOUT"])
            self._acting = True

    def _action(self) -> str:
        return (
            "the g-code of [idle_timeout] runs" if self._template is not None else " and ".join(self._default)
        )

    def _lines(self, call: Call) -> Reading:
        if self._template is not None:
            return self._template.lines(call, {})
        return Lines("\n".join(self._default))

    def _set(self, call: Call) -> Reading:
        values = call.parameters("TIMEOUT")
        timeout_s = bounded(call.command, values, "TIMEOUT", self._configured_s, low=0.001, high=1e6)

        def act() -> None:
            self._timeout_s = timeout_s

        return Immediate((f"idle_timeout: Timeout set to {timeout_s:.2f} s",), act)
