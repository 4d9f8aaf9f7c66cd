"""[gcode_button NAME]: g-code that is run when a button is pressed or released."""

from collections.abc import Mapping
from typing import Final

from coordinator.config.options import GCodeOption, SectionSpec
from coordinator.config.pins import PinOption
from coordinator.gcode.commands import Call, Immediate, Reading
from coordinator.gcode.parameters import flag, one
from coordinator.gcode.parser import command_line
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.programs.gcode_macro import GCodeTemplate
from coordinator.support.values import Value
from nodes.devices.button import Button

PIN: Final = PinOption(name="pin", help="input of the button; pressed is high, with ! low", pullable=True)
PRESS: Final = GCodeOption(name="press_gcode", help="g-code to run when it is pressed")
RELEASE: Final = GCodeOption(name="release_gcode", help="g-code to run when it is released", default="")
LATER: Final = ("analog_range", "analog_pullup_resistor", "debounce_delay")
_COMMAND: Final = "_BUTTON"


class GCodeButton(Module):
    """One button; a service runs its lines as those of a client."""

    SPEC = SectionSpec("A button that runs g-code", (PIN, PRESS, RELEASE), unsupported=LATER)
    NAMED = True

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self.id = build.instance
        self.press = GCodeTemplate(build, PRESS)
        self.release = GCodeTemplate(build, RELEASE)
        pin = build.pin(PIN)
        self._button = Button(self.name, pin=pin.name, pull=pin.pull, invert=pin.invert)
        self._button.on_change = self._changed
        build.add_device(pin.node, self._button, pin)
        build.shared(GCodeButtons)

    def end(self, cause: str) -> None:  # noqa: ARG002
        """Stop acting."""
        self._live = None

    def status(self) -> Mapping[str, Value]:
        """Report whether it is pressed."""
        return {"state": "PRESSED" if self._button.pressed else "RELEASED"}

    def _changed(self, pressed: bool) -> None:
        template = self.press if pressed else self.release
        if self._live is None or not template.text.strip():
            return
        runner = self._live.machine.runner
        if runner is None:
            self._live.say(f"[{self.name}] does nothing: only a service (canductor run) runs its g-code")
            return
        runner.run_lines(
            self.name, [command_line(_COMMAND, BUTTON=self.id, PRESSED=int(pressed))], template.text
        )


class GCodeButtons(Module):
    """The commands for all buttons."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._all: dict[str, GCodeButton] = {}
        build.add_command(
            "QUERY_BUTTON", "Report whether BUTTON is pressed", self._query, while_printing=True
        )
        build.add_command(_COMMAND, "Run the g-code of a button", self._run, while_printing=True)

    def link(self, modules: Modules) -> None:
        """Find all sections."""
        self._all = {found.id: found for found in modules.of(GCodeButton)}

    def _query(self, call: Call) -> Reading:
        name = one(call.command, call.parameters("BUTTON"), "BUTTON", self._all)
        return Immediate((f"{name}: {self._all[name].status()['state']}",))

    def _run(self, call: Call) -> Reading:
        given = call.parameters("BUTTON", "PRESSED")
        found = self._all[one(call.command, given, "BUTTON", self._all)]
        pressed = flag(call.command, given, "PRESSED")
        return (found.press if pressed else found.release).lines(call, {})
