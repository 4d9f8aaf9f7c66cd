"""[idle_timeout]: acts when the machine was idle for a while; by default heaters and motors are switched off.

Every machine has it, with its defaults where there is no such section. Moves, dwells and waits are use of the
machine, and so is another target of a heater; clients that ask and macros that only look are not.

It is the last thing that turns heaters off which somebody forgot: what its g-code leaves on, because it fails
or does not come to its end, is turned off without it. Only while a job is paused its g-code may leave heaters
on, since a part comes off a bed that gets cold.
"""

from collections.abc import Iterator, Mapping
from enum import Enum
from typing import Final

from coordinator.config.options import FloatOption, GCodeOption, SectionSpec
from coordinator.gcode.commands import AtStandstill, Call, Immediate, Lines, Phases, ProgramContext, Reading
from coordinator.gcode.parameters import bounded
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.modules.programs.gcode_macro import GCodeTemplate
from coordinator.runtime.module_context import ModuleContext
from coordinator.runtime.module_runner import Runner
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
    help="g-code to run then; by default TURN_OFF_HEATERS and M84, where there are heaters and motors. These"
    " follow where it fails, or leaves a heater on while no job is paused",
    default="",
)
HEATERS_OFF: Final = "TURN_OFF_HEATERS"
MOTORS_OFF: Final = "M84"
LOOK_S: Final = 1.0
STUCK_S: Final = 60.0
"""When its g-code has neither ended nor done anything for so long, it does not get its turn."""


class _Acting(Enum):
    """How far its g-code is."""

    NO = "no"
    WAITS = "waits"
    RUNS = "runs"
    COMPLETE = "complete"
    CALLED_OFF = "called off"
    """Others have used the machine before it got its turn."""


class IdleTimeout(Module):
    """Watches for idleness and acts."""

    SPEC = SectionSpec("G-code to run when the machine is idle", (TIMEOUT, GCODE))

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._configured_s = self._timeout_s = build.get(TIMEOUT)
        self._template = GCodeTemplate(build, GCODE) if build.find(GCODE) is not None else None
        self._default: tuple[str, ...] = ()
        self._heaters: HeaterRegistry | None = None
        self._state = "Idle"
        self._since_s = 0.0
        self._busy_since_s: float | None = None
        self._counted = (0, 0)
        """Works that have moved something, and changes of targets, as far as they are noted."""
        self._acting = _Acting.NO
        build.add_command(
            "SET_IDLE_TIMEOUT", "Set the idle time-out: TIMEOUT, s", self._set, while_printing=True
        )
        build.add_command("_IDLE_TIMEOUT", "Run what [idle_timeout] does", self._read_act)

    def link(self, modules: Modules) -> None:
        """Find out what can be switched off."""
        self._default = tuple(name for name in (HEATERS_OFF, MOTORS_OFF) if modules.knows(name))
        self._heaters = modules.find("heaters", HeaterRegistry)

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
        if self._acting is not _Acting.NO:
            if runner.busy:
                self._since_s = now_s
            elif now_s >= self._since_s + STUCK_S and self._targets:
                self._turn_off(live, runner, "its g-code does not get its turn")
            return
        counted = self._count(runner)
        if runner.busy or counted != self._counted:
            if self._busy_since_s is None:
                self._busy_since_s = now_s
            self._since_s, self._counted, self._state = now_s, counted, "Printing"
            return
        self._busy_since_s = None
        if self._state == "Printing":
            self._state = "Ready"
        if self._state == "Ready" and now_s >= self._since_s + self._timeout_s:
            self._act(live, runner, now_s)

    def _count(self, runner: Runner) -> tuple[int, int]:
        return runner.moved, 0 if self._heaters is None else self._heaters.changes

    @property
    def _targets(self) -> Mapping[str, float]:
        """Of heaters that have one."""
        return {} if self._heaters is None else self._heaters.targets

    # -------------------------------------------------------------------------------------------- acting

    def _act(self, live: ModuleContext, runner: Runner, now_s: float) -> None:
        self._state = "Idle"
        if self._template is None and not self._default:
            return
        what = (
            "the g-code of [idle_timeout] runs" if self._template is not None else " and ".join(self._default)
        )
        live.say(f"the machine was idle for {self._timeout_s:g} s: {what}")
        self._acting, self._since_s = _Acting.WAITS, now_s
        runner.run_lines("idle_timeout", ["_IDLE_TIMEOUT"], on_end=self._ended)

    def _read_act(self, call: Call) -> Reading:
        return Phases(lambda job: self._phases(job, call))

    def _phases(self, job: ProgramContext, call: Call) -> Iterator[Reading]:
        """Run the g-code. What is counted before it and behind it is by others, between them its own."""
        yield AtStandstill(self._begin)
        if self._acting is _Acting.CALLED_OFF:
            return
        yield (
            Lines("\n".join(self._default))
            if self._template is None
            else self._template.lines(job.call(call.command), {})
        )
        yield AtStandstill(self._come_to_end)

    async def _begin(self) -> None:
        """Call it off if others have used the machine since it was idle for too long."""
        runner = self.live.machine.runner
        if self._acting is _Acting.WAITS and runner is not None:
            used = self._count(runner) != self._counted
            self._acting = _Acting.CALLED_OFF if used else _Acting.RUNS

    async def _come_to_end(self) -> None:
        """Turn off what the g-code has left on."""
        live, targets = self.live, self._targets
        if (runner := live.machine.runner) is None:
            return
        if self._acting is _Acting.RUNS:
            self._acting = _Acting.COMPLETE
        self._counted = self._count(runner)
        listed = " and ".join(f"{name} ({celsius:g} °C)" for name, celsius in targets.items())
        if targets and runner.paused:
            live.say(f"{listed}: left on by the g-code of [idle_timeout], as a job is paused")
        elif targets:
            self._turn_off(live, runner, f"its g-code leaves on {listed}")

    def _ended(self) -> None:
        """Look for how the g-code has ended; on the control loop."""
        live, ended, self._acting = self._live, self._acting, _Acting.NO
        if live is None or (runner := live.machine.runner) is None:
            return
        if ended is _Acting.WAITS and (runner.busy or self._count(runner) != self._counted):
            ended = _Acting.CALLED_OFF  # refused, as a job begins
        if ended is _Acting.CALLED_OFF:
            live.say("the machine is used again: [idle_timeout] does nothing")
            self._state = "Ready"
        elif ended is not _Acting.COMPLETE:
            self._turn_off(live, runner, "its g-code failed")

    def _turn_off(self, live: ModuleContext, runner: Runner, why: str) -> None:
        """Turn heaters off at once, whatever waits for its turn, and motors as soon as that is possible."""
        live.say(f"[idle_timeout]: {why}: {' and '.join(self._default)}")
        if self._heaters is not None:
            self._heaters.turn_off()
        self._counted = self._count(runner)
        if MOTORS_OFF in self._default:
            runner.run_lines("idle_timeout", [MOTORS_OFF])

    def _set(self, call: Call) -> Reading:
        values = call.parameters("TIMEOUT")
        timeout_s = bounded(call.command, values, "TIMEOUT", self._configured_s, low=0.001, high=1e6)

        def act() -> None:
            self._timeout_s = timeout_s

        return Immediate((f"idle_timeout: Timeout set to {timeout_s:.2f} s",), act)
