"""[filament_switch_sensor NAME]: a switch that detects filament; jobs pause when it runs out."""

from collections.abc import Mapping
from typing import Final

from coordinator.config.options import BoolOption, FloatOption, GCodeOption, SectionSpec
from coordinator.config.pins import PinOption
from coordinator.gcode.commands import Call, Immediate, Reading
from coordinator.gcode.parameters import flag, needed, one
from coordinator.gcode.parser import command_line
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.programs.gcode_macro import GCodeTemplate
from coordinator.modules.status.print_stats import PrintStats
from coordinator.runtime.module_context import ModuleContext
from coordinator.support.values import Value
from nodes.devices.button import Button

PIN: Final = PinOption(
    name="switch_pin", help="input of the switch; with filament it is high, with ! low", pullable=True
)
PAUSE: Final = BoolOption(
    name="pause_on_runout",
    help="whether a job pauses, by PAUSE if there is [pause_resume]; if not, it goes on after runout_gcode,"
    " unless that pauses it",
    default=True,
)
RUNOUT: Final = GCodeOption(
    name="runout_gcode", help="g-code to run when a job runs out of filament", default=""
)
INSERT: Final = GCodeOption(
    name="insert_gcode", help="g-code to run when filament is inserted while no job prints", default=""
)
EVENT_DELAY: Final = FloatOption(
    name="event_delay",
    help="How long after an event, and after the start, further events are ignored",
    default=3.0,
    unit="s",
    minimum=0.0,
    maximum=1e4,
)
LATER: Final = (
    "pause_delay",
    "debounce_delay",
    "immediate_runout_gcode",
    "smart",
    "runout_distance",
    "always_fire_events",
    "check_on_print_start",
)
_RUNOUT: Final = "_FILAMENT_RUNOUT"
_INSERT: Final = "_FILAMENT_INSERT"


class FilamentSwitchSensor(Module):
    """One sensor."""

    SPEC = SectionSpec(
        "A switch that detects filament",
        (PIN, PAUSE, RUNOUT, INSERT, EVENT_DELAY),
        unsupported=LATER,
    )
    NAMED = True

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.id = build.instance
        self.enabled = True
        self.runout = GCodeTemplate(build, RUNOUT)
        self.insert = GCodeTemplate(build, INSERT)
        self._pauses = build.get(PAUSE)
        self._delay_s = build.get(EVENT_DELAY)
        self._stats = build.shared(PrintStats)
        self._can_pause = False
        self._quiet_until_s = 0.0
        pin = build.pin(PIN)
        self.switch = Button(self.name, pin=pin.name, pull=pin.pull, invert=pin.invert)
        self.switch.on_change = self._changed
        build.add_device(pin.node, self.switch, pin)
        build.shared(FilamentSensors)

    def link(self, modules: Modules) -> None:
        """See whether there is PAUSE."""
        self._can_pause = modules.knows("PAUSE")

    async def connect(self, live: "ModuleContext") -> None:
        """Start acting."""
        await super().connect(live)
        self._quiet_until_s = live.now_s() + self._delay_s

    def end(self, cause: str) -> None:  # noqa: ARG002
        """Stop acting."""
        self._live = None

    def status(self) -> Mapping[str, Value]:
        """Report whether there is filament, and whether the sensor is enabled."""
        return {"filament_detected": self.switch.pressed, "enabled": self.enabled}

    def _changed(self, there: bool) -> None:
        live, prints = self._live, self._stats.state == "printing"
        if live is None or not self.enabled or live.now_s() < self._quiet_until_s or there is prints:
            return
        self._quiet_until_s = live.now_s() + self._delay_s
        runner = live.machine.runner
        if runner is None:
            return
        if there:
            runner.run_lines(self.name, [command_line(_INSERT, SENSOR=self.id)], self.insert.text)
            return
        live.say(f"{self.name}: the filament has run out")
        lines = ["PAUSE"] if self._pauses and self._can_pause else []
        runner.run_paused(self.name, [*lines, command_line(_RUNOUT, SENSOR=self.id)], stay=self._pauses)


class FilamentSensors(Module):
    """The commands for all sensors."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._all: dict[str, FilamentSwitchSensor] = {}
        for name, help_, read in (
            ("QUERY_FILAMENT_SENSOR", "Report whether SENSOR has filament", self._query),
            ("SET_FILAMENT_SENSOR", "Enable SENSOR (ENABLE=1) or disable it (0)", self._set),
            (_RUNOUT, "Run runout_gcode", self._runout),
            (_INSERT, "Run insert_gcode", self._insert),
        ):
            build.add_command(name, help_, read, while_printing=True)

    def link(self, modules: Modules) -> None:
        """Find all sections."""
        self._all = {found.id: found for found in modules.of(FilamentSwitchSensor)}

    def _sensor(self, call: Call, *others: str) -> tuple[FilamentSwitchSensor, Mapping[str, str]]:
        given = call.parameters("SENSOR", *others)
        return self._all[one(call.command, given, "SENSOR", self._all)], given

    def _query(self, call: Call) -> Reading:
        sensor, _ = self._sensor(call)
        found = "detected" if sensor.switch.pressed else "not detected"
        return Immediate((f"Filament Sensor {sensor.id}: filament {found}",))

    def _set(self, call: Call) -> Reading:
        sensor, given = self._sensor(call, "ENABLE")
        needed(call.command, given, "ENABLE")
        enabled = flag(call.command, given, "ENABLE")

        def act() -> None:
            sensor.enabled = enabled

        return Immediate(act=act)

    def _runout(self, call: Call) -> Reading:
        return self._sensor(call)[0].runout.lines(call, {})

    def _insert(self, call: Call) -> Reading:
        return self._sensor(call)[0].insert.lines(call, {})
