"""Axis tables in motion: what they are worth on a bad screw, and when they are taken up."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from coordinator.assembly.load import load_machine
from coordinator.cli import main as cli
from coordinator.config.model import AxisTablesDescription, MachineDescription
from coordinator.ipc.server.state import StateTree
from coordinator.modules.module_set import build_modules
from coordinator.motion.steps.errors import StepError
from coordinator.motion.steps.shapers import Impulses, shaper_impulses
from coordinator.motion.steps.steps import TABLE_POINTS_MAX, StepGenerator
from coordinator.runtime.linux_host import LinuxHost
from coordinator.runtime.machine import Machine
from coordinator.service.core.tables import TableService
from coordinator.streaming.compensation import NO_CORRECTION, Compensation
from coordinator.tables.axis_table import AxisTable, Direction, Unit
from coordinator.tables.store import TableStore
from coordinator.verification.planned import epochs
from tests.coordinator.motion.exact_program import Planned, plan_program
from tests.coordinator.motion.planner_helpers import LIMITS, homed_planner, planned
from tests.coordinator.motion.steps_harness import NODES, E, X, Y, Z, stepper
from tests.coordinator.screw import (
    PERFECT,
    STEP_MM,
    Floats,
    Screw,
    carry_out,
    measure,
    motor_mm,
    planned_mm,
    workout,
)

ROOT = Path(__file__).parents[3]
DEMO = ROOT / "config" / "demo"
CUBE = ROOT / ".." / "shared" / "data"


def wavy(axis: str = "x", backlash: float = 0.03) -> AxisTable:
    """A table with slopes up to 0.02."""
    at = np.arange(0, 301, 2.5)
    forward = 0.03 * np.sin(at / 4) + 1e-4 * at
    return AxisTable(
        axis=axis, positions=tuple(at), forward=tuple(forward), reverse=tuple(forward - backlash)
    )


def flat(axis: str, value: float) -> AxisTable:
    return AxisTable(axis=axis, positions=(0.0, 100.0), forward=(value,) * 2, reverse=(value,) * 2)


# --------------------------------------------------------------------------------------------- its worth


def test_a_measured_table_takes_away_nineteen_twentieths_of_the_error(tmp_path: Path) -> None:
    screw = Screw()
    table = measure(screw, tmp_path)
    lines = workout(1, 16)
    without = carry_out(lines, screw, tmp_path, {})
    corrected = carry_out(lines, screw, tmp_path, {"x": table})
    assert without.rms_mm > 0.03
    assert corrected.rms_mm <= without.rms_mm / 20


@pytest.mark.parametrize("screw", [Screw(stretch=0, wobble_mm=0), Screw(stretch=-1e-3, backlash_mm=0.1)])
def test_other_screws(tmp_path: Path, screw: Screw) -> None:
    lines = workout(2, 8)
    corrected = carry_out(lines, screw, tmp_path, {"x": measure(screw, tmp_path)})
    assert corrected.rms_mm <= carry_out(lines, screw, tmp_path, {}).rms_mm / 20


BETWEEN_POINTS_MM = 0.00025
"""What points half a millimetre apart miss of the wobble (0.12 µm rms), and the way to the first."""


@pytest.mark.parametrize(("microsteps", "share"), [(32, 17), (64, 20)])
def test_a_wobble_alone_is_taken_away_down_to_what_steps_are(
    tmp_path: Path, microsteps: int, share: int
) -> None:
    """A wobble of 12 µm is not 20 times what steps of 1.25 µm are wrong by on a perfect screw."""
    screw, lines = Screw(stretch=0, backlash_mm=0), workout(1, 10)
    table = measure(screw, tmp_path, microsteps=microsteps)
    floor, without, corrected = (
        carry_out(lines, one, tmp_path, tables, microsteps=microsteps).rms_mm
        for one, tables in ((PERFECT, {}), (screw, {}), (screw, {"x": table}))
    )
    assert math.hypot(floor, BETWEEN_POINTS_MM) >= corrected
    assert corrected <= without / share
    assert (without / floor >= 20) == (share >= 20), "where the floor allows it, a twentieth is reached"


SHAPED = "SET_INPUT_SHAPER SHAPER_TYPE_X=mzv SHAPER_FREQ_X=40"


@pytest.mark.parametrize(
    "impulses", [((1.0, 0.0),), shaper_impulses("mzv", 40, 0.1)], ids=["plain", "shaped"]
)
def test_steps_come_when_the_corrected_axis_is_there(tmp_path: Path, impulses: Impulses) -> None:
    """Against an evaluation of its own: the planned position plus the table's correction, at every step."""
    table = wavy(backlash=0)
    lines = [*([SHAPED] if len(impulses) > 1 else []), *workout(3, 6)]
    trial = carry_out(lines, Screw(), tmp_path, {"x": table})
    moves = np.concatenate([moves for _, moves in epochs(trial.plan.record)])
    clock, direction, before = trial.plan.streams()["stepper_x"].expand()
    times = clock / trial.plan.nodes[trial.plan.steppers[0].node].clock_freq
    parts = [share * corrected_mm(moves, times - later_s, table) for share, later_s in impulses]
    wanted = np.sum(parts, axis=0)
    off = wanted - (before + direction / 2) * STEP_MM
    speed = np.abs(np.gradient(wanted, times, edge_order=1)) + 1
    assert abs(wanted[0]) < 0.01, "the table begins with no correction: nothing is to be taken up"
    assert np.abs(off / speed).max() < 14e-6, "12.5 µs, and what the speed here is not exact"
    assert len(times) > 200_000


def corrected_mm(moves: NDArray[np.void], times_s: Floats, table: AxisTable) -> Floats:
    planned = planned_mm(moves, times_s)
    return np.asarray(planned + np.interp(planned, table.positions, table.forward))


def test_other_axes_and_filament_go_on_as_before(tmp_path: Path) -> None:
    lines = workout(4, 5)
    one, other = (carry_out(lines, Screw(), tmp_path, tables).plan for tables in ({}, {"x": wavy()}))
    a, b = one.streams()["stepper_y"].expand(), other.streams()["stepper_y"].expand()
    assert np.array_equal(a[1], b[1])
    assert np.abs(a[0] - b[0]).max() <= 25e-6 * one.nodes[0].clock_freq, "both within the error of a step"


def test_a_change_of_side_is_taken_up_at_a_bounded_speed(tmp_path: Path) -> None:
    table = AxisTable(axis="x", positions=(0.0, 300.0), forward=(0.0, 0.0), reverse=(-0.2, -0.2))
    lines = ["G1 X100 F6000", "G1 X20 F6000", "G1 Y100 F6000", "G1 X19.9995", "G1 X20", "G1 X90"]
    trial = carry_out(lines, Screw(), tmp_path, {"x": table}, every_s=1e-4)
    extra = motor_mm(trial.plan, "stepper_x", trial.times_s) - trial.wanted_mm
    window = 200
    speed = np.abs(extra[window:] - extra[:-window]) / (window * 1e-4)
    assert speed.max() < 5 + 2 * STEP_MM / (window * 1e-4), "the square corner velocity of the machine"
    back = (trial.wanted_mm < 95) & (np.gradient(trial.wanted_mm) < 0)
    assert np.abs(extra[back] + 0.2).max() < 2 * STEP_MM, "taken up within the first millimetres"
    assert np.abs(extra[-20:]).max() < 2 * STEP_MM, "and taken back at the end"


# -------------------------------------------------------------------------------------- without a table


def streams(config: Path, program: Path, *, stage: bool) -> dict[int, bytes]:
    return {n: bytes(batch) for n, batch in plan_program(config, program, stage=stage).batches.items()}


def test_without_a_table_not_a_bit_changes() -> None:
    plain, staged = (streams(DEMO / "machine.cfg", DEMO / "part.gcode", stage=s) for s in (False, True))
    assert plain == staged
    assert sum(map(len, plain.values())) > 500_000


def test_without_a_table_not_a_bit_of_a_real_print_changes(tmp_path: Path) -> None:
    config, program = CUBE / "config" / "cartesian_plain.cfg", CUBE / "gcode" / "text_cube.gcode"
    if not program.exists():
        pytest.skip("text_cube.gcode is not beside the project")
    part = tmp_path / "part.gcode"
    part.write_bytes(b"".join(program.read_bytes().splitlines(keepends=True)[:6000]))
    assert streams(config, part, stage=False) == streams(config, part, stage=True)


def test_corexy_corrects_the_axis_and_not_the_motor(tmp_path: Path) -> None:
    program = tmp_path / "corexy.gcode"
    program.write_text("G28\nG1 X100 Y50 F6000\nG1 X120 Y60\nG1 X150 Y70\n")
    ends = []
    for tables in ({}, {"x": flat("x", 0.5), "y": flat("y", 0.25)}):
        plan = plan_program(DEMO / "machine.cfg", program, tables)
        ends.append([end_mm(plan, name) for name in ("stepper_x", "stepper_y")])
    moved = np.subtract(ends[1], ends[0])
    assert moved == pytest.approx([0.75, 0.25], abs=0.007), "the motors carry x + y and x - y"


def end_mm(plan: Planned, name: str) -> float:
    spec = next(spec for spec in plan.steppers if spec.name == name)
    return plan.streams()[name].end_position * spec.step_distance


# ------------------------------------------------------------------------------------ when it is taken up


def generator() -> StepGenerator:
    return StepGenerator([stepper(i, axis) for i, axis in enumerate((X, Y, Z, E))], NODES[:1])


def test_only_homed_axes_get_their_tables() -> None:
    compensation, steps = Compensation(LIMITS), generator()
    assert not compensation.is_due("XYZ")
    compensation.want("y", wavy("y"))
    compensation.want("x", flat("x", 0.5))
    assert not compensation.is_due("")
    assert compensation.is_due("X")
    compensation.take_up(steps, "X")
    assert [c.points for c in steps.corrections] == [2, 0, 0]
    assert compensation.states["x"].applied
    assert not compensation.states["y"].applied
    assert not compensation.is_due("X")
    assert compensation.is_due("XYZ")


def test_a_removed_table_leaves_a_lag_and_an_axis_that_is_lost_none() -> None:
    for homed, lag in (("X", 0.5), ("", 0.0)):
        compensation, steps = Compensation(LIMITS), generator()
        compensation.want("x", flat("x", 0.5))
        compensation.take_up(steps, "X")
        assert steps.corrections[0].lag_mm == -0.5
        run(steps, 50)
        assert steps.corrections[0].lag_mm == 0
        assert steps.corrections[0].offset_mm == 0.5
        if homed:
            compensation.want("x", None)
        compensation.take_up(steps, homed)
        assert steps.corrections[0].lag_mm == lag
        assert steps.corrections[0].offset_mm == lag
        assert compensation.states["x"].side == ""


def test_homing_one_axis_leaves_what_is_added_to_the_others() -> None:
    compensation, steps = Compensation(LIMITS), generator()
    compensation.want("x", flat("x", 0.5))
    compensation.want("y", flat("y", 0.25))
    compensation.take_up(steps, "XY")
    run(steps, 50)
    compensation.begin_again(steps)
    fresh = generator()
    fresh.set_axis_position((0.0, 0.0, 0.0, 0.0))
    compensation.declared(fresh, fresh.corrections, "X")
    compensation.take_up(fresh, "XY")
    x, y, z = fresh.corrections
    assert (x.offset_mm, x.lag_mm) == (0, -0.5), "homed: its motor stands at the axis's place"
    assert (y.offset_mm, y.lag_mm) == (0.25, 0)
    assert z == NO_CORRECTION
    assert fresh.stats().steppers[1].steps == 0, "not a step is made by declaring"


def run(steps: StepGenerator, to_mm: float) -> None:
    """Move X and Y to and from there, from standstill to standstill."""
    planner = homed_planner()
    planner.begin_at(steps.next_move_s)
    moves = planned(planner, f"G1 X{to_mm} Y{to_mm} F6000\nG1 X0 Y0\n".encode())
    assert steps.append(np.ascontiguousarray(moves), len(moves)) == len(moves)
    while not steps.generate(planner.print_time_end_s, flush=True):
        steps.take_batch(0)


def test_a_table_corrects_as_it_says() -> None:
    table = wavy()
    compensation, steps = Compensation(LIMITS), generator()
    compensation.want("x", table)
    compensation.take_up(steps, "X")
    run(steps, 60)
    assert compensation.states["x"].side == "forward", "told before the moves"
    compensation.note(steps)
    state = compensation.states["x"]
    assert state.side == "reverse"
    assert state.offset_mm == pytest.approx(table.correction(0.0, Direction.REVERSE), abs=1e-12)


# ------------------------------------------------------------------------------------- what it must hold


def test_fine_tables_of_three_axes_need_more_pieces_than_there_is_room_for() -> None:
    steps, at = generator(), np.linspace(0, 240, TABLE_POINTS_MAX)
    for axis in range(3):
        values = 0.001 * np.sin(at + axis)
        steps.set_table(axis, list(at), list(values), list(values), take_up_mm_s=5)
    planner = homed_planner()
    lines = [f"G1 X{x} Y{240 - x} Z{x} F6000" for x in (240, 0, 240, 0)]
    moves = np.ascontiguousarray(planned(planner, "\n".join(["G1 X0 Y240", *lines, ""]).encode()))
    appended = rounds = 0
    while appended < len(moves):
        taken = steps.append(np.ascontiguousarray(moves[appended:]), len(moves) - appended)
        assert taken or rounds, "an empty generator has room for any move"
        appended, rounds = appended + taken, rounds + 1
        last = moves[appended - 1]
        end = last["print_time"] + last["accel_s"] + last["cruise_s"] + last["decel_s"]
        while not steps.generate(float(end), flush=appended == len(moves)):
            steps.take_batch(0)
        steps.take_batch(0)
    assert rounds > 2
    assert steps.position(0) == round(float(np.interp(0, at, 0.001 * np.sin(at))) / 0.00625)


def test_a_table_does_not_change_while_moves_wait() -> None:
    steps, planner = generator(), homed_planner()
    moves = planned(planner, b"G1 X50 F6000\n")
    steps.append(np.ascontiguousarray(moves), len(moves))
    with pytest.raises(StepError, match="the table of axis X cannot change while moves wait"):
        steps.set_table(0, [0, 1], [0, 0], [0, 0], take_up_mm_s=5)
    with pytest.raises(StepError, match="corrections cannot become"):
        steps.set_corrections([NO_CORRECTION] * 3)


@pytest.mark.parametrize(
    ("positions", "resume_program"),
    [([1.0], 5.0), ([1.0, 1.0], 5.0), ([0.0, float("nan")], 5.0), ([0.0, 1.0], 0.0), ([*range(2000)], 5.0)],
)
def test_bad_tables_are_refused(positions: list[float], resume_program: float) -> None:
    zeros = [0.0] * len(positions)
    with pytest.raises(StepError, match="the table of axis Z is refused"):
        generator().set_table(2, positions, zeros, zeros, take_up_mm_s=resume_program)


def test_a_service_takes_the_kept_tables_that_it_can_use(tmp_path: Path) -> None:
    plain = load_machine(str(DEMO / "machine.cfg"))
    described = replace(plain, axis_tables=AxisTablesDescription(64, plain.nodes[0].place))
    store, said = TableStore(tmp_path), list[str]()
    for table in (flat("x", 0.5), flat("a", 0.5), replace(flat("y", 0.5), unit=Unit.DEG)):
        store.save(table)

    def compensation_of(description: MachineDescription) -> Compensation | None:
        machine = Machine(description, LinuxHost(), build_modules(description))
        service = TableService(store, StateTree(), said.append)
        service.read()
        return service.compensation_of(machine)

    assert compensation_of(plain) is None
    compensation = compensation_of(described)
    assert compensation is not None
    assert dict(compensation.wanted) == {"x": flat("x", 0.5)}
    assert [line.split(":")[0] for line in said] == ["axis a is not corrected", "axis y is not corrected"]


def test_a_plan_takes_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table, program = tmp_path / "x.csv", tmp_path / "x.gcode"
    table.write_text("position_mm,forward_um\n0,0\n100,1000\n")
    program.write_text("G28\nG1 X100 F6000\n")
    steps = []
    for words in ((), ("--table", f"X={table}")):
        assert cli.main(["plan", str(DEMO / "machine.cfg"), str(program), "--json", *words]) == 0
        steps.append(json.loads(capsys.readouterr().out.splitlines()[-1])["steps"])
    assert steps == [2 * 16000, 2 * 16160], "corexy: both motors, 160 steps a mm"
    words = ("--table", f"w={table}")
    assert cli.main(["plan", str(DEMO / "machine.cfg"), str(program), *words]) == 1
    assert "axis w is not corrected: that is for x, y and z" in capsys.readouterr().err
