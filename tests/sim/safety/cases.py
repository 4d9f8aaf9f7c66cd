"""What ends with the heaters off: every case is caused on a simulated machine, and judged by its pins.

``python -m tests.sim.safety`` prints a table: the case, the heater, how long after the cause its
pin went off for good, and within what it has to. A cause that only the host can find, such as a heater that
runs away, counts from when it did. ``--real`` adds hosts that are processes, killed or stopped by a signal.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from nodes.support.errors import CanductorError
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests.sim.safety import real_host
from tests.sim.safety.row import MAX_DURATION_S, Row, table
from tests.stages.safety_rig import Found, Rig

STOP_S: Final = 0.02
"""From the host's decision to stop to the nodes' having done so."""
NOTICE_S: Final = 2.0
"""To when the host gives up on a node that is silent, and stops the others."""
STEPS_S: Final = 0.02
"""Within this nothing moves any more after an emergency stop: commands of the stop, over the bus."""
LEFT_ALONE_S: Final = 1.25
"""Steps are sent 1.2 s ahead: so long a machine may go on that loses its host."""
PYTHON_STALLS_S: Final = 1.85
"""Steps are made 1.8 s ahead, and sent by threads that need no Python."""
NODE_LOST_S: Final = 1.5
"""So long the other nodes may go on after one is cut off: motion is sent every 0.3 s, and the host waits a
second for an acknowledgement, and then for an answer."""
HOLD: Final = ("M140 S110", "M104 S200", "TEMPERATURE_WAIT SENSOR=extruder MINIMUM=197", "M118 hot")
"""The bed is still heated when the hotend holds."""


@dataclass(frozen=True, slots=True)
class Case:
    """Something goes wrong."""

    name: str
    lines: tuple[str, ...]
    """Of the program, behind HOLD if it is HOT."""
    moment: Callable[[Rig], bool]
    cause: Callable[[Rig], None]
    bounds_s: dict[str, float]
    """By heater: how long after the cause it may be on. Others are off anyway, or not asked about."""
    told: str
    """Is in the sentence that the user reads."""
    since_found: bool = False
    """Count from when the host stopped the machine: nobody else can find this."""
    steps_s: float | None = None
    """How long after the cause motors may move; None: nothing moves."""
    hurry: float = 5.0
    hot: bool = True
    """Whether it heats at all."""
    warm: bool = True
    """Whether it begins near its target."""


def _holding(rig: Rig) -> bool:
    """Tell whether the hotend has been held for a while: its program waits."""
    return rig.since_s("hot") > 2.0


def _warm(rig: Rig) -> bool:
    return rig.celsius() > 60


def _idle(rig: Rig) -> bool:
    return rig.since_s("cold") > 35


def _homing(rig: Rig) -> bool:
    """Tell whether the head is on its way to the endstop of X: 10 mm from where it began."""
    return abs(rig.steps_of("stepper_x", "mcu")) > 10 * 80


def _homed(rig: Rig) -> bool:
    """Tell whether homing is over and the moves behind it have not begun."""
    return rig.since_s("homed") >= 0


BOTH: Final = {"extruder": MAX_DURATION_S, "heater_bed": MAX_DURATION_S}
LOST: Final = {"extruder": MAX_DURATION_S, "heater_bed": NOTICE_S}
WAIT: Final = ("G4 P60000",)
HOME: Final = ("G28 X Y", "M118 homed", "G1 X100 Y100 F6000", "G1 X10", "G1 X100", "G1 X10", "G1 X100")
PRINT: Final = (
    "G28",
    "M118 homed",
    *(f"G1 X{x} Y{y} F9000" for _ in range(8) for x, y in ((20, 20), (200, 20), (110, 200))),
)


def _sensor(rig: Rig, fault: PlantFault) -> None:
    rig.fault(PlantItemKind.SENSOR, fault)


def _cut(rig: Rig) -> None:
    rig.cut("toolhead")


def _heater(rig: Rig, fault: PlantFault) -> None:
    rig.fault(PlantItemKind.HEATER, fault)


def cases() -> list[Case]:
    """Return them, in the order of the table."""
    found = {"extruder": STOP_S, "heater_bed": STOP_S}
    broken = partial(Case, lines=WAIT, moment=_holding, bounds_s=BOTH)
    runaway = partial(Case, lines=WAIT, moment=_holding, bounds_s=found, since_found=True, hurry=1.0)
    moving = partial(Case, lines=PRINT, moment=_printing, bounds_s=BOTH, steps_s=LEFT_ALONE_S)
    stopped = partial(Case, bounds_s=found, told="emergency stop", steps_s=STEPS_S)
    return [
        broken("sensor open", cause=partial(_sensor, fault=PlantFault.OPEN), told="ADC out of range"),
        broken("sensor shorted", cause=partial(_sensor, fault=PlantFault.SHORTED), told="ADC out of range"),
        broken(
            "sensor open, heating up",
            moment=_warm,
            warm=False,
            cause=partial(_sensor, fault=PlantFault.OPEN),
            told="ADC out of range",
        ),
        runaway("sensor fallen out", cause=partial(_sensor, fault=PlantFault.FALLEN), told="does not hold"),
        runaway("heater dead", cause=partial(_heater, fault=PlantFault.DEAD), told="does not hold"),
        runaway(
            "switch stuck on while off",
            lines=("M118 cold", "G4 P600000"),
            hot=False,
            warm=False,
            moment=_idle,
            cause=partial(_heater, fault=PlantFault.STUCK_ON),
            told="heats though it is off",
            bounds_s={"extruder": STOP_S},
        ),
        broken("node lost, heating", cause=_cut, bounds_s=LOST, told="lost node toolhead"),
        moving(
            "node lost, printing",
            cause=_cut,
            bounds_s=LOST,
            told="lost node toolhead",
            steps_s=NODE_LOST_S,
        ),
        moving(
            "node lost, homing",
            lines=HOME,
            moment=_homing,
            cause=_cut,
            bounds_s=LOST,
            told="lost node toolhead",
        ),
        broken("host stalls 2 s", cause=lambda rig: rig.stall(2.0), told="shut down"),
        broken("host's Python stalls 2 s", cause=lambda rig: rig.stall(2.0, io=False), told="shut down"),
        moving("host stalls 2 s, printing", cause=lambda rig: rig.stall(2.0), told="shut down"),
        moving(
            "host's Python stalls 2 s, printing",
            cause=lambda rig: rig.stall(2.0, io=False),
            told="shut down",
            steps_s=PYTHON_STALLS_S,
        ),
        broken("host gone", cause=lambda rig: rig.stall(30.0), told="shut down"),
        moving(
            "host gone, homing",
            lines=HOME,
            moment=_homing,
            cause=lambda rig: rig.stall(30.0),
            told="shut down",
        ),
        stopped("emergency stop", lines=WAIT, moment=_holding, cause=Rig.stop),
        stopped("emergency stop, printing", lines=PRINT, moment=_printing, cause=Rig.stop),
        stopped("emergency stop, homing", lines=HOME, moment=_homing, cause=Rig.stop),
        stopped("emergency stop, just homed", lines=HOME, moment=_homed, cause=Rig.stop),
    ]


def _printing(rig: Rig) -> bool:
    """Tell whether the moves behind homing are under way."""
    return rig.since_s("homed") > 1.0


def run(case: Case) -> list[Row]:
    """Cause CASE; return a row for each heater that it names. Raises CanductorError when it cannot be."""
    rig = Rig((*(HOLD if case.hot else ()), *case.lines), hurry=case.hurry, warm=case.warm)
    found = rig.run(case.moment, case.cause)
    return [_judged(case, found, heater) for heater in case.bounds_s]


def _judged(case: Case, found: Found, heater: str) -> Row:
    seen = next(one for one in found.heaters if one.name == heater)
    since_s = found.stopped_after_s if case.since_found else 0.0
    off_s, bound_s = max(0.0, seen.off_after_s - since_s), case.bounds_s[heater]
    was_on = seen.was_on or not case.hot
    in_time = off_s <= bound_s and (case.steps_s is None or found.last_step_after_s <= case.steps_s)
    still = found.steps_after == 0 or case.steps_s is not None
    steps = f"{found.last_step_after_s:.4f} of {case.steps_s:.2f}" if case.steps_s is not None else "-"
    return Row(
        case.name,
        heater,
        off_s,
        bound_s,
        steps,
        was_on and in_time and still and case.told in found.told,
        found.told,
    )


def main(arguments: Sequence[str]) -> int:
    """Run the command line; status 0: every heater was off in time."""
    parser = argparse.ArgumentParser(prog="python -m tests.sim.safety", description=__doc__)
    parser.add_argument("--case", default="", help="only cases whose names contain this")
    parser.add_argument("--real", action="store_true", help="also kill and stop hosts that are processes")
    given = parser.parse_args(arguments)
    chosen = [case for case in cases() if given.case in case.name]
    if not chosen:
        parser.error(f"no case has {given.case!r} in its name; leave out --case to see all")
    try:
        rows = [row for case in chosen for row in run(case)]
        if given.real:
            rows += real_host.rows()
    except CanductorError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(f"{table(rows)}\n")
    return int(not all(row.ok for row in rows))
