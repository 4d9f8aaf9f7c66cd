"""Lines of g-code from clients, in whatever state the machine is."""

from collections.abc import Callable, Sequence
from typing import Final

from coordinator.gcode.commands import Call, Immediate
from coordinator.gcode.parser import WordError, parse
from coordinator.gcode.reply_kinds import ReplyKind, line_of
from coordinator.klippy_api.params import RequestError
from coordinator.klippy_api.status import state_of
from coordinator.modules.programs.gcode_macro import GCodeMacro
from coordinator.service.api.motion import RESTARTS, run_script
from coordinator.service.core.machine_service import MachineService
from coordinator.streaming.move_source import ProgramOutput

ALWAYS: Final = frozenset(("M105", "M115", "STATUS", "HELP"))
"""Commands that also a machine that stopped answers."""
LINES_MAX: Final = 5_000
"""Of one script: ten times what ``gcode.run`` takes. Front ends send whole macros and what is pasted."""
BYTES_MAX: Final = 131_072


def check_size(script: str) -> None:
    """Raise RequestError for a SCRIPT that is too long; it is not split for that."""
    ends, size = script.count("\n") + script.count("\r"), len(script.encode(errors="replace"))
    if ends > LINES_MAX or size > BYTES_MAX:
        raise RequestError(
            f"gcode/script: {ends:,} line ends, {size:,} bytes; at most {LINES_MAX:,} and {BYTES_MAX:,}:"
            " print a file instead"
        )


async def run_lines(service: MachineService, lines: Sequence[str], say: Callable[[str], None]) -> None:
    """Have LINES done; SAY gets what they answer and the service's log does not have. Raises CanductorError.

    A machine that stopped takes RESTART and FIRMWARE_RESTART and answers ALWAYS.
    """
    state, message = state_of(service)
    if state != "ready":
        names = {line.split(maxsplit=1)[0].upper() for line in lines}
        if names <= ALWAYS and service.machine is not None:
            for line in lines:
                await service.turns.next()
                _answer(service, line, say)
            return
        if state == "startup" or not names <= RESTARTS.keys():
            raise RequestError(message)
        lines = lines[:1]
    outcome = await run_script(service, "\n".join(lines), wait=False)
    if not outcome.logged:
        for output in outcome.output:
            say(line_of(kind_of(output), output.text))


def _answer(service: MachineService, line: str, say: Callable[[str], None]) -> None:
    """Answer what a machine that stopped still knows; for a macro, what it replaced: nothing is rendered."""
    modules = service.up_machine().modules
    command = parse(line.encode(errors="replace"))
    renamed = {macro.command: macro.renamed for macro in modules.of(GCodeMacro)}
    name = "" if command is None else renamed.get(command.name, command.name)
    reader = modules.vocabulary.commands.get(name)
    if command is None or reader is None:
        raise WordError(f"this machine does not know {line.strip()[:40]}")
    reading = reader.read(Call(command, 0, (0.0,) * 4, ""))
    if isinstance(reading, Immediate):
        for text in reading.replies:
            say(line_of(reading.kind, text))


def kind_of(output: ProgramOutput) -> ReplyKind:
    """Return how OUTPUT reads: notices are information."""
    kind = getattr(output, "kind", ReplyKind.INFORMATION)
    assert isinstance(kind, ReplyKind)
    return kind
