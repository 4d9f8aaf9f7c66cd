"""GET_POSITION: where the machine is in all frames, from what the nodes count to the program's numbers."""

from coordinator.gcode.commands import AtStandstill, Call, Immediate, Reading
from coordinator.gcode.events import Done
from coordinator.gcode.status import frames
from coordinator.modules.base import Build, Module


class Positions(Module):
    """The command."""

    def __init__(self, build: Build) -> None:
        super().__init__(build)
        build.add_command(
            "GET_POSITION",
            "Report the position in all frames; while a job prints, in those of the job",
            self._read,
            while_printing=True,
        )

    def _read(self, call: Call) -> Reading:
        lines = frames(call.figures())
        if call.while_printing:
            return Immediate(lines)
        return AtStandstill(lambda: self._report(lines), Done(lines))

    async def _report(self, lines: tuple[str, ...]) -> Done:
        """Report what the nodes count, what follows from that, and the LINES of the program's frames."""
        machine = self.live.machine
        counts = await machine.query_stepper_counts()
        places = machine.stepper_positions.positions(counts)
        head = machine.stepper_positions.head(places)
        mcu = " ".join(f"{name}:{count}" for name, count in counts.items())
        stepper = " ".join(f"{name}:{place:.6f}" for name, place in places.items())
        unknown = "unknown; home the machine with G28"
        kinematic = (
            unknown if head is None else " ".join(f"{a}:{v:.6f}" for a, v in zip("XYZ", head, strict=True))
        )
        return Done((f"mcu: {mcu}", f"stepper: {stepper or unknown}", f"kinematic: {kinematic}", *lines))
