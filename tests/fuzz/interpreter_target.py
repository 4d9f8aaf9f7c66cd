"""What the fuzzers of the interpreter run: bytes as a program, on a machine where every command can act."""

from coordinator.gcode.events import Emergency, End
from coordinator.gcode.interpreter import Job
from coordinator.gcode.machine_state import Extruder, MachineState, Shaper
from coordinator.gcode.program import Program
from coordinator.kinematics.dual_carriage import Carriage, DualCarriage
from coordinator.kinematics.extruder import ExtruderMotion
from coordinator.motion.planner.planner import Planner
from coordinator.motion.trapezoid_array import TRAPEZOID
from nodes.support.errors import CanductorError
from tests.coordinator.motion.planner_helpers import LIMITS, check_limits, drain, joined

SEEDS = (
    b"G28\nG1 X10.5 Y20 E1 F6000\nM204 P500 T800\nG92 E0\nG91\nG1 X-1 E-.5\nM400\nM114",
    b"G28\nM83\nT1\nG1 E1 F300\nSYNC_EXTRUDER_MOTION EXTRUDER=extruder MOTION_QUEUE=extruder1\nT0\nG1 X5 E1",
    (
        b"G28\nSET_DUAL_CARRIAGE CARRIAGE=1\nG1 X200 F9000\nSET_DUAL_CARRIAGE CARRIAGE=0 MODE=PRIMARY\n"
        b"SET_DUAL_CARRIAGE CARRIAGE=1 MODE=MIRROR\nG1 X20\nACTIVATE_EXTRUDER EXTRUDER=extruder1\nG4 P10"
    ),
    (
        b"G28\nSET_INPUT_SHAPER SHAPER_FREQ_X=40 SHAPER_TYPE=ei DAMPING_RATIO_Y=.1\nG1 X9\nM220 S50\nM221 S9"
        b"\nSET_PRESSURE_ADVANCE ADVANCE=.05 SMOOTH_TIME=.02\nSET_VELOCITY_LIMIT VELOCITY=50 ACCEL=100 "
        b"MINIMUM_CRUISE_RATIO=0 SQUARE_CORNER_VELOCITY=1\nN7 G20\n(a) G21 ; b\nM112"
    ),
    (
        b"G28\nG1 X50 Y50 Z50 F6000\nG2 I10 E1\nG3 X60 Y60 R20 Z5\nG18\nG2 X70 Z60 I5 K5\nG19\nG3 J9\nG17\n"
        b"SAVE_GCODE_STATE NAME=a\nSET_GCODE_OFFSET Z=.2 X_ADJUST=-1 MOVE=1 MOVE_SPEED=9\nG1 X5\n"
        b"RESTORE_GCODE_STATE NAME=a MOVE=1\nGET_POSITION\nM118 hi"
    ),
)
TOKENS = sorted({token for seed in SEEDS for token in seed.replace(b"\n", b" ").split(b" ")})


def machine() -> MachineState:
    """Two carriages, two extruders, a shaper."""
    carriages = DualCarriage(
        0,
        (
            Carriage(0, 200, 0, (("stepper_x", (1, 0, 0, 0)),)),
            Carriage(50, 250, 250, (("dual", (1, 0, 0, 0)),)),
        ),
        40,
    )
    names = ("extruder", "extruder1")
    return MachineState(
        {name: Extruder(name, LIMITS, 0.05, 0.04) for name in names},
        ExtruderMotion(names, names[0], {name: name for name in names}),
        carriages,
        carriages.home,
        {"Y": Shaper("mzv", 50.0)},
    )


def run_program(text: bytes) -> None:
    """Run TEXT; only a CanductorError may stop it, and whatever was planned keeps all limits."""
    job = Job(Program.from_lines([text], "fuzz"), Planner(LIMITS), {"X": 0.0, "Y": 0.0, "Z": 0.0}, machine())
    pieces, told = [], ""
    try:
        while not isinstance(job.step(), End | Emergency):
            pieces += drain(job.planner)
    except CanductorError as error:
        told = str(error)
    assert "\n" not in told, "more than one line"
    while not job.planner.flush():
        pieces += drain(job.planner)
    t = joined(pieces + drain(job.planner))
    if not len(t):
        return
    for name in TRAPEZOID.names or ():
        assert abs(t[name]).max() < float("inf"), name  # false for NaN too
    assert (t["print_time"][1:] >= t["print_time"][:-1]).all()
    check_limits(t, LIMITS)
