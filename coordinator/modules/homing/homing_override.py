"""[homing_override]: a template of g-code that replaces G28. A G28 in it is the machine's own."""

from dataclasses import replace
from typing import Final

from coordinator.config.options import FloatOption, GCodeOption, SectionSpec, TextOption
from coordinator.gcode.commands import AtStandstill, Call, Lines, Reading
from coordinator.gcode.events import Done
from coordinator.modules.base import Build, Module
from coordinator.modules.homing.homing import Homing
from coordinator.modules.programs.gcode_macro import GCodeTemplate, parameters

GCODE: Final = GCodeOption(name="gcode", help="what is run instead of G28, a template; a G28 in it homes")
AXES: Final = TextOption(
    name="axes",
    help="letters of the axes for which it is run; G28 of others homes",
    default="xyz",
    pattern=r"[xyzXYZ]+",
    pattern_rule="letters of x, y and z",
)
SET: Final = tuple(
    FloatOption(
        name=f"set_position_{axis}",
        help=f"what {axis.upper()} is set to before the lines are run; by default it stays unknown",
        unit="mm",
        minimum=-100_000,
        maximum=100_000,
    )
    for axis in "xyz"
)
_SET_POSITION: Final = "_HOMING_OVERRIDE_SET_POSITION"
_LINES: Final = "_HOMING_OVERRIDE_LINES"


class HomingOverride(Module):
    """The lines that replace G28."""

    SPEC = SectionSpec("G28 is replaced by these lines of g-code", (GCODE, AXES, *SET))

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._template = GCodeTemplate(build, GCODE)
        self._axes = set(build.get(AXES).upper())
        self._set = [build.find(option) for option in SET]
        self._sets = any(value is not None for value in self._set)
        if self._sets:
            build.add_command(
                _SET_POSITION, "Set the position before the lines that replace G28", self._read_set_position
            )
            build.add_command(_LINES, "Run the lines that replace G28", self._read_lines)
        self._homing = build.shared(Homing)
        self._homing.replace_by(self._read, build)

    def _read(self, call: Call, axes: str) -> Reading:
        if not self._axes & set(axes):
            return self._homing.read(replace(call, callers=(*call.callers, "G28")), axes)
        if self._sets:  # the template sees the position that was set
            return Lines(f"{_SET_POSITION}\n{_LINES} {call.command.text.strip()}")
        return self._read_lines(call)

    def _read_lines(self, call: Call) -> Reading:
        homes = call.command.called("G28")
        values = {"params": parameters(homes), "rawparams": homes.text.strip()}
        return self._template.lines(call, values)

    def _read_set_position(self, call: Call) -> Reading:
        x, y, z = (
            at if value is None else value for at, value in zip(call.position[:3], self._set, strict=True)
        )
        known = "".join(axis for axis, value in zip("XYZ", self._set, strict=True) if value is not None)
        done = Done(position=(x, y, z, call.position[3]), homed=known)

        async def take() -> Done:
            return done

        return AtStandstill(take, done)
