"""How a machine finds out where its head is while a part stands on its bed.

X and Y are homed above the part. Z is homed only where that leads away from it; else the head is taken to
stand where it stood when the job was interrupted: nobody may have moved it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from coordinator.config.model import MachineDescription
from coordinator.gcode.builtins.machine import come_to_standstill
from coordinator.gcode.events import Done, Event, Full
from coordinator.ipc.protocol.methods import ApiError
from coordinator.modules.homing.homing import Homing
from coordinator.runtime.machine import Modules
from coordinator.service.core.work import LinesWork, Setting

LIFT_MM: Final = 5.0
"""Above what is printed, on the way to where the job goes on."""
LIFT_MM_S: Final = 5.0
SURE_MM: Final = 0.1
"""Heights that are no further apart are one: of a part that grows all the time. The lowest counts."""


@dataclass(frozen=True, slots=True)
class ResumeHomingPlan:
    """What is done."""

    z_mm: float | None = None
    """Where the head is taken to stand before; None: that is known, or does not matter."""
    up_mm: float | None = None
    """Up to which height it goes before; None: not at all."""
    homing: tuple[str, ...] = ()
    """Lines that home."""


def plan_resume_homing(
    described: "MachineDescription",
    modules: "Modules",
    homed: str,
    *,
    part_mm: float,
    z_mm: float | None,
) -> ResumeHomingPlan:
    """Return how the axes become known that are not among HOMED (letters).

    PART_MM: how high the part is. Z_MM: where the head stands; None: it is not known. Raises ApiError.
    """
    missing = [axis for axis in described.homed_position if axis in "XYZ" and axis not in homed]
    if not missing:
        return ResumeHomingPlan()
    home = f"home {' '.join(missing)} where the part is not in the way, then try again"
    homing = next(modules.of(Homing))
    if homing.instead is not None or "G28" in modules.vocabulary.commands:
        raise ApiError("not_ready", f"a section of this machine says what G28 does, maybe in Z: {home}")
    kinematics = described.kinematics
    if kinematics.homes_upwards:
        return ResumeHomingPlan(homing=("G28",))
    if not kinematics.straight:
        raise ApiError(
            "not_ready", f"homing a {kinematics.name} machine moves the head past the part: {home}"
        )
    around = tuple(f"G28 {axis}" for axis in missing if axis != "Z")
    if "Z" in missing and _homes_upwards(described):
        return ResumeHomingPlan(homing=("G28 Z", *around))
    if "Z" in missing and z_mm is None:
        raise ApiError(
            "not_ready",
            f"the head was going up or down when it was interrupted, or has since, so Z is not known: {home},"
            " or say with z where the head stands",
        )
    up_mm = min(part_mm + LIFT_MM, described.limits.position_max[2])
    return ResumeHomingPlan(z_mm if "Z" in missing else None, up_mm, around)


def _homes_upwards(described: "MachineDescription") -> bool:
    rails = [rail for rail in described.rails if rail.axis == "z"]
    return any(
        rail.homing.positive_dir and (rail.homing.endstop_pin is not None or rail.homing.virtual_endstop)
        for rail in rails
    )


def sure_height(heights: object) -> float | None:
    """Return where a head stands that was interrupted on its way through HEIGHTS (lowest, highest; mm)."""
    if not isinstance(heights, Sequence) or len(heights) != 2:
        return None
    low, high = heights
    if not isinstance(low, int | float) or not isinstance(high, int | float) or high - low > SURE_MM:
        return None
    return float(low)


@dataclass(slots=True)
class TakeHeight(LinesWork):
    """From now on the head counts as standing at Z_MM."""

    z_mm: float = 0.0
    _setting: Setting | None = None

    def begin(self, setting: Setting) -> None:
        """Remember what it acts on."""
        LinesWork.begin(self, setting)
        self._setting = setting

    def step(self) -> Event:
        """Take it while nothing moves."""
        job, setting = self._job, self._setting
        assert job is not None
        if setting is not None:
            if not come_to_standstill(job):
                return Full()
            x, y, _, e = setting.planner.toolhead_position
            job.take(Done(position=(x, y, self.z_mm, e), homed="Z"))
            self._setting = None
        return LinesWork.step(self)
