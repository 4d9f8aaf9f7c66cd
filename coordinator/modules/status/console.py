"""Commands for people at a console: HELP, STATUS, M115."""

from typing import Final

from coordinator.gcode.commands import Call, Immediate, Reading
from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.modules.base import Build, Module, Modules
from coordinator.modules.status.print_stats import PrintStats
from coordinator.support.version import VERSION

NAME: Final = "canductor"


class Console(Module):
    """The commands."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        self._modules: Modules | None = None
        for name, help_, read in (
            ("HELP", "List all commands", self._help),
            ("STATUS", "Report the machine's state", self._status),
            ("M115", "Report the firmware name and version", self._identify),
        ):
            build.add_command(name, help_, read, while_printing=True)

    def link(self, modules: Modules) -> None:
        """Remember the modules."""
        self._modules = modules

    def _help(self, call: Call) -> Reading:
        call.parameters()
        command_help = {} if self._modules is None else self._modules.command_help
        return Immediate(
            tuple(
                f"{name}: {command_help[name]}" for name in sorted(command_help) if not name.startswith("_")
            )
        )

    def _status(self, call: Call) -> Reading:
        call.parameters()
        stats = None if self._modules is None else self._modules.find("print_stats", PrintStats)
        if stats is None or stats.state not in ("printing", "paused"):
            return Immediate(("ready",))
        return Immediate((f"{stats.state} {stats.job['filename']}",))

    def _identify(self, _call: Call) -> Reading:
        return Immediate((f"FIRMWARE_NAME:{NAME} FIRMWARE_VERSION:{VERSION}",), kind=ReplyKind.PLAIN)
