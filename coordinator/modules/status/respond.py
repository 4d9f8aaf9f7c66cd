"""[respond]: RESPOND shows a line to the user, with a prefix for its kind; so does M118."""

from coordinator.config.options import ChoiceOption, SectionSpec, TextOption
from coordinator.gcode.commands import Call, Immediate, Reading
from coordinator.gcode.parser import WordError, quoted
from coordinator.gcode.reply_kinds import kind_of_line
from coordinator.modules.base import Build, Module

PREFIXES = {"echo": "echo:", "command": "//", "error": "!!"}
TYPE = ChoiceOption(
    name="default_type", help="Kind of a line without one", default="echo", choices=tuple(PREFIXES)
)
PREFIX = TextOption(name="default_prefix", help="Prefix of a line, instead of that of default_type")


class Respond(Module):
    """Its commands."""

    SPEC = SectionSpec(
        "Lines that programs show to the user", (TYPE, PREFIX), unsupported=("enable_respond",)
    )

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        usual = PREFIXES[build.get(TYPE)]
        self._prefix = build.get_or(PREFIX, usual)
        build.add_command("M118", "Show a line", self._echo, while_printing=True)
        build.add_command(
            "RESPOND", "Show MSG, after PREFIX or that of TYPE", self._respond, while_printing=True
        )

    def _echo(self, call: Call) -> Reading:
        return _line(f"{self._prefix} {call.command.text.strip()}")

    def _respond(self, call: Call) -> Reading:
        values = call.parameters("TYPE", "PREFIX", "MSG")
        prefix = self._prefix
        if "TYPE" in values:
            kind = values["TYPE"].lower()
            if kind == "echo_no_space":
                return _line(PREFIXES["echo"] + values.get("MSG", ""))
            if kind not in PREFIXES:
                raise WordError(f"TYPE of RESPOND is {quoted(kind)}; there are {' '.join(PREFIXES)}")
            prefix = PREFIXES[kind]
        return _line(f"{values.get('PREFIX', prefix)} {values.get('MSG', '')}")


def _line(line: str) -> Immediate:
    return Immediate((line,), kind=kind_of_line(line))
