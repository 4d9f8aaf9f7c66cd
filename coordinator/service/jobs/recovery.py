"""Interrupted jobs: what is written down of a job, and how one goes on after the service came to an end.

A job goes on only where nothing has to be guessed: the file is the one that was printed, all axes are homed,
and what was hot can be made hot again. The line that was being carried out is carried out again.
"""

import asyncio
import contextlib
import dataclasses
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from coordinator.gcode.builtins.state import come_back
from coordinator.gcode.commands import Recovering
from coordinator.gcode.events import Event, Full, Notice
from coordinator.gcode.parser import WordError, command_line
from coordinator.ipc.protocol.methods import ApiError
from coordinator.modules.base import Module
from coordinator.modules.compensation.bed_mesh import RESTORE, BedMesh
from coordinator.modules.compensation.bed_tilt import BedTilt
from coordinator.modules.programs.exclude_object import ExcludeObject
from coordinator.modules.programs.gcode_macro import GCodeMacro
from coordinator.motion.planner.planner import Planner
from coordinator.runtime.machine import Modules
from coordinator.service.core.feeder import COME_BACK_MM_S
from coordinator.service.core.interface import ServiceInterface
from coordinator.service.core.motion import Motion
from coordinator.service.core.work import FileWork, LinesWork, MoveWork, Setting, Work
from coordinator.service.jobs.forward import Reached, read_forward
from coordinator.service.jobs.jobs import JobPhase, JobRun
from coordinator.service.jobs.journal import ENTRY_S, NAME, Interrupted, Journal, journal_path, read_journal
from coordinator.service.jobs.resume_homing import (
    LIFT_MM,
    LIFT_MM_S,
    ResumeHomingPlan,
    TakeHeight,
    plan_resume_homing,
    sure_height,
)
from nodes.support.errors import CanductorError

NEAR_K: Final = 2.0
"""A heater that is no further below its target is hot enough."""
_FORGOTTEN: Final = frozenset((JobPhase.DONE, JobPhase.CANCELLED, JobPhase.FAILED))


@dataclass(slots=True)
class RecoverWork(FileWork):
    """A job that goes on at LINE of its PROGRAM, which stands there, in the state that was REACHED."""

    line: int = 1
    reached: Reached | None = None
    held: Mapping[str, Any] | None = None
    objects: ExcludeObject | None = None
    """Of the machine."""
    _planner: "Planner | None" = None
    _there: bool = False

    def begin(self, setting: Setting) -> None:
        """Take over what held there."""
        FileWork.begin(self, setting)
        assert self.reached is not None
        planner, held = setting.planner, self.held or {}
        self._planner = planner
        planner.lines = self.line - 1
        for name, value in self.reached.dynamics.items():
            setattr(planner, name, value)
        planner.speed_factor = float(held.get("speed_factor", 1.0))
        planner.extrude_factor = float(held.get("extrude_factor", 1.0))
        offset = held.get("offset", self.reached.state.offset)
        planner.set_gcode_offset(dict(zip("XYZE", map(float, offset), strict=True)))
        if self.objects is not None and self.reached.objects is not None:
            self.objects.take_over(self.reached.objects, held.get("excluded", ()))

    def step(self) -> Event:
        """Go there, then on."""
        assert self._planner is not None
        assert self.reached is not None
        if not self._there:
            state, objects = self.reached.state, self.objects
            left_out = objects is not None and objects.leaves_out
            lift_mm = max(self.reached.part_mm - state.position[2], 0.0) + LIFT_MM
            if not come_back(self._planner, state, COME_BACK_MM_S, lift_mm, left_out=left_out):
                return Full()
            if left_out and objects is not None:
                objects.begin_leaving_out(self._planner)
            self._there = True
            return Notice(self.line, f"{self.name}: goes on at line {self.line}")
        return FileWork.step(self)


class _Kept:
    """What of MODULES is written down with each line; found once for each job."""

    def __init__(self, modules: Modules) -> None:
        self._tilt = next(modules.of(BedTilt), None)
        self._mesh = next(modules.of(BedMesh), None)
        self._heaters: dict[str, Module] = {}
        self._fans: dict[str, Module] = {}
        self._objects = next(modules.of(ExcludeObject), None)
        for module in modules.of(Module):
            kind, _, instance = module.name.partition(" ")
            if kind.startswith(("extruder", "heater_")):
                self._heaters[instance or kind] = module
            elif kind in ("fan", "fan_generic"):
                self._fans[instance or kind] = module

    def hot(self) -> Mapping[str, Any]:
        """Return heater targets, fan speeds and excluded objects, as the modules report them."""
        targets = {name: module.status().get("target") for name, module in self._heaters.items()}
        speeds = {name: module.status().get("speed") for name, module in self._fans.items()}
        return {
            "heaters": {n: round(t, 3) for n, t in targets.items() if isinstance(t, int | float) and t > 0},
            "fans": {n: round(v, 4) for n, v in speeds.items() if isinstance(v, int | float)},
            "excluded": [] if self._objects is None else self._objects.excluded,
        }

    def mesh(self, motion: Motion) -> Mapping[str, Any]:
        """Return the mesh that Z follows, and how much higher the head stands for it, or for a tilt."""
        mesh = self._mesh
        held = None if mesh is None else mesh.held()
        if self._tilt is None and held is None:
            return {}
        x, y, z, _ = motion.moment().position
        if self._tilt is not None:
            return {"bed_mm": self._tilt.added_mm((x, y, z))}
        assert mesh is not None
        return {"mesh": held, "bed_mm": mesh.added_mm((x, y, z))}


class Recovery:
    """Keeps the journal of SERVICE's jobs in the folder STATE, has an interrupted one go on; on the loop."""

    def __init__(self, service: ServiceInterface, state: Path | None) -> None:
        self.interrupted: Interrupted | None = None
        self._service = service
        self._state = state
        self._journal: Journal | None = None
        self._job: JobRun | None = None
        self._kept: _Kept | None = None
        """Of the machine that carries out the job."""
        self._noted_s = 0.0
        self._heights_noted: tuple[float, float] | None = None
        self._last: Interrupted | None = None
        self._modified_ns = 0

    def open(self) -> None:
        """Look for an interrupted job, once there is a job folder."""
        folder = self._service.folder
        if folder is None or self._state is None or self._journal is not None:
            return
        path = journal_path(self._state, folder.path)
        _take_over(folder.path / NAME, path)
        self._show(read_journal(path))
        loop = asyncio.get_running_loop()

        def report(
            text: str,
        ) -> None:  # in the journal's thread: no place for the log's listeners
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(self._service.log.add, "notice", text)

        self._journal = Journal(path, report)
        if (found := self.interrupted) is not None:
            what_next = (
                "its lines came from a client, which has to begin it again"
                if found.fed
                else "job.recover (RESUME_INTERRUPTED) goes on there once all axes are homed, with home"
                " (HOME=1) it homes them itself"
            )
            self._service.log.add("job", f"{found.file} was interrupted at line {found.line}; {what_next}")

    def close(self) -> None:
        """Bring all to the disk."""
        if self._journal is not None:
            self._journal.close()
            self._journal = None

    def begin(self, job: JobRun, work: FileWork) -> None:
        """Keep the journal of JOB, which does WORK."""
        self._job, self._noted_s, self._last = job, 0.0, None
        self._kept = _Kept(self._service.up_machine().modules)
        self._modified_ns = work.program.modified_ns
        self._show(None)
        if isinstance(work, RecoverWork):  # until it is there, it is interrupted where it was
            self._last = Interrupted(
                job.file, job.size_bytes, self._modified_ns, work.line, {**(work.held or {}), "z": None}
            )
            if self._journal is not None:
                self._journal.go_on(self._last)
        elif self._journal is not None:
            fed = job.lines_fed is not None
            self._journal.begin(job.file, job.size_bytes, self._modified_ns, fed=fed)

    def has_new_heights(self) -> bool:
        """Return whether the job leads to other heights than are written down."""
        job = self._job
        return job is not None and job.active and self._heights() != self._heights_noted

    def look(self) -> None:
        """Write down how far the job is."""
        job, journal, now_s = self._job, self._journal, self._service.now_s
        if job is None or journal is None:
            return
        if not job.active:
            self._job = self._kept = None
            if job.phase in _FORGOTTEN:
                journal.end()
            else:
                self._show(self._last)
        elif job.line:
            heights = self._heights()
            if now_s < self._noted_s + ENTRY_S and heights == self._heights_noted:
                return
            self._noted_s, self._heights_noted = now_s, heights
            held = self._held(heights)
            journal.note(job.line, held)
            fed = job.lines_fed is not None
            self._last = Interrupted(job.file, job.size_bytes, self._modified_ns, job.line, held, fed)

    def _heights(self) -> tuple[float, float] | None:
        """Return between which heights the head may be found if all comes to an end now."""
        motion = self._service.motion
        if motion is None:
            return None
        end_mm = motion.planned.state.toolhead_position[2]
        low, high = motion.trace.heights(motion.now_s) or (end_mm, end_mm)
        return (round(min(low, end_mm), 4), round(max(high, end_mm), 4))

    def _held(self, heights: tuple[float, float] | None) -> Mapping[str, Any]:
        motion, kept = self._service.motion, self._kept
        if motion is None or kept is None:
            return {}
        return {
            "z": heights,
            "offset": list(motion.feeder.planner.gcode_offset),
            "speed_factor": motion.planned.state.speed_factor,
            "extrude_factor": motion.planned.state.extrude_factor,
            **kept.hot(),
            **kept.mesh(motion),
        }

    def _show(self, found: Interrupted | None) -> None:
        self.interrupted = found
        file, line = (None, None) if found is None else (found.file, found.line)
        self._service.tree.update("job", {"interrupted_file": file, "interrupted_line": line})

    # ------------------------------------------------------------------------------------- going on

    async def recover(self, how: Recovering) -> JobRun:
        """Go on with the interrupted job; raises ApiError, MotionOver."""
        service = self._service
        found, motion = self._ready(how)
        try:
            hot, blown = self._heating(found)
            work = await asyncio.to_thread(self._prepare, found, how.line or found.line)
        except ApiError:
            raise
        except (CanductorError, WordError) as error:
            raise ApiError("failed", f"{found.file} cannot go on: {error}") from None
        with contextlib.ExitStack() as unless_done:
            unless_done.callback(work.program.close)
            assert work.reached is not None
            moved = await self._z_has_moved()
            way = self._homing_plan(how, found, motion, work.reached.part_mm, moved=moved)
            await self._do(found, LinesWork(hot or ["M400"], name="recover"))
            self._forget_height(found)
            if way.z_mm is not None:
                await self._do(found, TakeHeight((), "recover", z_mm=way.z_mm))
            if way.up_mm is not None and way.up_mm > motion.planned.state.toolhead_position[2]:
                await self._do(found, MoveWork({"Z": way.up_mm}, LIFT_MM_S, relative=False, name="recover"))
            mesh = self._mesh_lines(found)
            lines = [*way.homing, *work.reached.lines, *mesh, *blown, "M400"]
            await self._do(found, LinesWork(lines, "recover"))
            for name, variables in work.reached.variables.items():
                macro = service.up_machine().modules.find(name, GCodeMacro)
                if macro is not None:
                    for variable, value in variables.items():
                        macro.set_variable(variable, value)
            job = service.start_job(work)
            unless_done.pop_all()
        return job

    async def _z_has_moved(self) -> bool:
        """Return whether motors that move Z have made steps since their nodes were started."""
        machine = self._service.up_machine()
        counts = await machine.query_stepper_counts()
        return any(counts[motor.name] for motor in machine.description.motors if motor.weights[2])

    def _forget_height(self, found: Interrupted) -> None:
        """Have nobody rely on where the head stood when FOUND was interrupted: from now on it moves."""
        found = dataclasses.replace(found, held={**found.held, "z": None})
        self._show(found)
        if self._journal is not None:
            self._journal.go_on(found)

    async def _do(self, found: Interrupted, work: Work) -> None:
        queued = await self._service.ready_motion().do(work)
        if queued.error is not None:
            raise ApiError("failed", f"{found.file} cannot go on: {queued.error}")

    def _ready(self, how: Recovering) -> tuple[Interrupted, Motion]:
        """Return what is to go on, and what moves it; raises ApiError."""
        service = self._service
        found, motion = self.interrupted, service.ready_motion()
        if found is None or service.folder is None:
            raise ApiError("no_job", "no job was interrupted")
        if found.fed:
            raise ApiError(
                "no_such_file",
                f"{found.file} was interrupted at line {found.line}, but its lines came from a client: there"
                " is no file to go on with; have them sent again",
            )
        if service.active_job is not None:
            raise ApiError("busy", "a job is active; wait for its end, or cancel it")
        if how.line is not None and how.line > found.line:
            raise ApiError(
                "bad_params", f"{found.file} was interrupted at line {found.line}, before {how.line}"
            )
        missing = [axis for axis in motion.feeder.axes if axis not in motion.planned.state.homed]
        if missing and not how.home:
            raise ApiError(
                "not_ready",
                f"{' and '.join(missing)} must be homed before {found.file} can go on; mind what is printed."
                " With home (HOME=1) that is done, but for Z towards the part",
            )
        return found, motion

    def _homing_plan(
        self, how: Recovering, found: Interrupted, motion: Motion, part_mm: float, *, moved: bool
    ) -> ResumeHomingPlan:
        z_mm = how.z_mm
        if z_mm is None and not moved:
            z_mm = sure_height(found.held.get("z"))
        if z_mm is not None and how.z_mm is None and isinstance(bed_mm := found.held.get("bed_mm"), float):
            z_mm += bed_mm
        machine = self._service.up_machine()
        homed, part_mm = motion.planned.state.homed, max(part_mm, z_mm or 0.0)
        return plan_resume_homing(machine.description, machine.modules, homed, part_mm=part_mm, z_mm=z_mm)

    def _mesh_lines(self, found: Interrupted) -> list[str]:
        """Return the line that has Z follow the mesh that it followed, once all is homed."""
        mesh = next(self._service.up_machine().modules.of(BedMesh), None)
        held = found.held.get("mesh")
        if not isinstance(held, dict):
            return []
        if mesh is None:
            raise ApiError("not_ready", f"{found.file} was printed with a mesh, and there is no [bed_mesh]")
        mesh.to_restore = held
        return [RESTORE]

    def _heating(self, found: Interrupted) -> tuple[list[str], list[str]]:
        """Return the lines that make hot what was hot, extruders last, and those of fans; raises ApiError."""
        heaters = found.held.get("heaters", {})
        known = self._service.up_machine().modules.knows
        if not isinstance(heaters, dict):
            return [], []
        if heaters and not (known("SET_HEATER_TEMPERATURE") and known("TEMPERATURE_WAIT")):
            raise ApiError("not_ready", f"{found.file} was printed hot, but no heater can be set")
        lines: list[str] = []
        for some in (False, True):
            chosen = {name: t for name, t in heaters.items() if name.startswith("extruder") is some}
            lines += [command_line("SET_HEATER_TEMPERATURE", HEATER=n, TARGET=t) for n, t in chosen.items()]
            lines += [
                command_line("TEMPERATURE_WAIT", SENSOR=n, MINIMUM=t - NEAR_K) for n, t in chosen.items()
            ]
        fans = found.held.get("fans", {})
        blown = [
            f"M106 S{speed * 255:.4f}"
            if name == "fan"
            else command_line("SET_FAN_SPEED", FAN=name, SPEED=speed)
            for name, speed in (fans.items() if isinstance(fans, dict) else ())
            if known("M106" if name == "fan" else "SET_FAN_SPEED")
        ]
        return lines, blown

    def _prepare(self, found: Interrupted, line: int) -> RecoverWork:
        """Read the file up to LINE; raises CanductorError. It reads a disk: not on the control loop."""
        folder = self._service.folder
        assert folder is not None
        with contextlib.ExitStack() as unless_done:
            program = unless_done.enter_context(folder.open(found.file))
            if (program.size_bytes, program.modified_ns) != (found.size_bytes, found.modified_ns):
                raise CanductorError("the file has changed since; start the print again")
            if not program.skip_lines(line - 1):
                raise CanductorError(f"it has no line {line}")
            with folder.open(found.file) as again:
                description = self._service.up_machine().description
                reached = read_forward(description, again, program.done_bytes)
            unless_done.pop_all()
        objects = next(self._service.up_machine().modules.of(ExcludeObject), None)
        return RecoverWork(program, line=line, reached=reached, held=found.held, objects=objects)


def _take_over(old: Path, path: Path) -> None:
    """Move the journal that an earlier version has left in the job folder, and make the folder of PATH."""
    with contextlib.suppress(OSError):  # the journal says when it cannot be written
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if old.is_file() and not old.is_symlink() and not path.exists():
            shutil.move(old, path)
