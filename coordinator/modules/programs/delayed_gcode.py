"""[delayed_gcode NAME]: g-code that runs after a delay, and again when it asks for that."""

from collections.abc import Callable, Mapping
from typing import Final

from coordinator.config.options import FloatOption, GCodeOption, SectionSpec
from coordinator.gcode.commands import Call, Immediate, Reading
from coordinator.gcode.parameters import bounded, needed, one
from coordinator.gcode.parser import Command, command_line
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.programs.gcode_macro import GCodeTemplate
from coordinator.support.values import Value

GCODE = GCodeOption(name="gcode", help="g-code to run, a Jinja2 template with { } and {% %}")
INITIAL = FloatOption(
    name="initial_duration",
    help="Delay after the start; 0: only UPDATE_DELAYED_GCODE starts it",
    default=0.0,
    unit="s",
    minimum=0.0,
    maximum=1e9,
)
DURATION_MAX_S: Final = 1e6
SHORTEST_S: Final = 0.05
"""The shortest delay between two runs: others must get their turn."""
_COMMAND: Final = "_RUN_DELAYED_GCODE"


class DelayedGCode(Module):
    """One section; a service runs its lines as those of a client."""

    SPEC = SectionSpec(
        "G-code that runs by itself after a delay", (GCODE, INITIAL), unsupported=("description",)
    )
    NAMED = True

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.id = build.instance
        self.template = GCodeTemplate(build, GCODE)
        self._initial_s = build.get(INITIAL)
        self._call_off: Callable[[], None] | None = None
        build.shared(DelayedGCodes)

    def ready(self) -> None:
        """Start the initial delay."""
        self.wait(self._initial_s)

    def end(self, cause: str) -> None:  # noqa: ARG002
        """Stop running."""
        self.wait(0)
        self._live = None

    def status(self) -> Mapping[str, Value]:
        """Report whether it is going to run."""
        return {"waits": self._call_off is not None}

    def wait(self, duration_s: float) -> None:
        """Run after DURATION_S; 0: cancel. On the control loop."""
        if self._call_off is not None:
            self._call_off()
            self._call_off = None
        if duration_s and self._live is not None:
            self._call_off = self._live.after(max(duration_s, SHORTEST_S), self._run)

    def wait_from_program(self, duration_s: float) -> None:
        """Do the same from the reader's thread; no effect without a machine."""
        if (live := self._live) is not None:
            live.soon_on_loop(lambda: self.wait(duration_s))

    def _run(self) -> None:
        self._call_off = None
        if self._live is None:
            return
        runner = self._live.machine.runner
        if runner is None:
            self._live.say(f"[{self.name}] does not run: only a service (canductor run) runs it")
        else:
            runner.run_lines(self.name, [command_line(_COMMAND, ID=self.id)])


class DelayedGCodes(Module):
    """The commands for all delayed g-codes."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._all: dict[str, DelayedGCode] = {}
        build.add_command(
                "UPDATE_DELAYED_GCODE", "Run the delayed g-code ID after DURATION s; 0: cancel it",
                self._update, while_printing=True)  # fmt: skip
        build.add_command(_COMMAND, "Run a delayed g-code", self._run, while_printing=True)

    def link(self, modules: Modules) -> None:
        """Find all sections."""
        self._all = {found.id: found for found in modules.of(DelayedGCode)}

    def _named(self, command: Command, values: Mapping[str, str]) -> DelayedGCode:
        return self._all[one(command, values, "ID", self._all)]

    def _update(self, call: Call) -> Reading:
        values = call.parameters("ID", "DURATION")
        found = self._named(call.command, values)
        needed(call.command, values, "DURATION")
        duration_s = bounded(call.command, values, "DURATION", 0.0, low=0.0, high=DURATION_MAX_S)
        return Immediate(act=lambda: found.wait_from_program(duration_s))

    def _run(self, call: Call) -> Reading:
        return self._named(call.command, call.parameters("ID")).template.lines(call, {})
