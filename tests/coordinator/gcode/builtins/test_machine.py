"""Commands that change the machine: what the planner and the events are told, from which print time on."""

from dataclasses import replace
from typing import Any

import pytest

from coordinator.gcode.builtins.state import SAVED_MAX
from coordinator.gcode.errors import GCodeError
from coordinator.gcode.events import (
    End,
    Event,
    Full,
    MachineChange,
    Notice,
    PositionSet,
    Progress,
    Reply,
    ShaperChange,
    SmoothTimeChange,
    WeightsChange,
)
from coordinator.gcode.interpreter import Job
from coordinator.gcode.machine_state import Extruder, MachineState, Shaper
from coordinator.gcode.program import Program
from coordinator.kinematics.dual_carriage import Carriage, DualCarriage
from coordinator.kinematics.extruder import ExtruderMotion
from coordinator.motion.planner.planner import Planner
from tests.coordinator.motion.planner_helpers import LIMITS, Array, check_invariants, drain, joined

HOME = {"X": 0.0, "Y": 0.0, "Z": 0.0}
IDEX = DualCarriage(
    0,
    (
        Carriage(0, 200, 0, (("stepper_x", (1, 0, 0, 0)),)),
        Carriage(50, 250, 250, (("dual", (1, 0, 0, 0)),)),
    ),
    40,
)
SMALL = replace(LIMITS, max_extrude_only_distance=2)


def about(value: float) -> Any:
    """VALUE but for rounding."""
    return pytest.approx(value)


def machine(shapers: dict[str, Shaper] | None = None) -> MachineState:
    """A machine with two carriages, two extruders and a stepper that follows the first of them."""
    return MachineState(
        {
            "extruder": Extruder("extruder", LIMITS, 0.05, 0.04),
            "extruder1": Extruder("extruder1", SMALL, 0.02, 0.03),
        },
        ExtruderMotion(
            ("extruder", "extruder1"),
            "extruder",
            {"extruder": "extruder", "extruder1": "extruder1", "belted": ""},
        ),
        IDEX,
        IDEX.home,
        shapers or {},
    )


def run(*lines: str, on: MachineState | None = None) -> tuple[list[Event], Array, Job]:
    job = Job(Program.from_lines(lines, "part.gcode"), Planner(LIMITS), HOME, on or machine())
    events: list[Event] = []
    pieces: list[Array] = []
    while not (events and isinstance(events[-1], End)):
        event = job.step()
        pieces += drain(job.planner)
        if isinstance(event, MachineChange | PositionSet):
            assert job.planner.at_standstill
        if not isinstance(event, Progress | Full | Notice):
            events.append(event)
    return events, joined(pieces), job


def changes(events: list[Event]) -> list[Event]:
    return [event for event in events if isinstance(event, MachineChange)]


def ends(t: Array) -> list[float]:
    return [float(end) for end in t["print_time"] + t["accel_s"] + t["cruise_s"] + t["decel_s"]]


# ---- Pressure advance ----


def test_an_advance_holds_from_its_line_on_and_stops_nothing() -> None:
    events, t, _ = run(
        "G28", "M83", "G1 X10 E1 F6000", "SET_PRESSURE_ADVANCE ADVANCE=0.1", "G1 X20 E1",
        "SET_PRESSURE_ADVANCE EXTRUDER=extruder1 ADVANCE=0.3", "G1 X30 E1",
    )  # fmt: skip
    assert t["pressure_advance"].tolist() == [0.05, 0.1, 0.1]
    assert not changes(events)
    assert (t["start_v"][1:] > 50).all(), "the machine does not stop for it"
    check_invariants(t)


def test_a_smooth_time_comes_after_a_rest_as_wide_as_both_windows() -> None:
    events, t, job = run(
        "G28", "G1 X10 F6000", "SET_PRESSURE_ADVANCE SMOOTH_TIME=0.2 ADVANCE=0.01", "G1 X20",
        "SET_PRESSURE_ADVANCE SMOOTH_TIME=0.2", "SET_PRESSURE_ADVANCE",
    )  # fmt: skip
    at = ends(t)[0] + 0.2
    assert changes(events) == [SmoothTimeChange(3, "extruder", 0.2, about(at))]
    assert t["print_time"][1] == pytest.approx(at)
    assert Reply(6, "extruder: ADVANCE=0.01 SMOOTH_TIME=0.2") in events
    assert job.planner.pressure_advance == 0.01


# ---- Shapers ----


def test_shapers_change_at_rest_and_only_where_they_do() -> None:
    on = machine({"X": Shaper("ei", 40, 0.05)})
    events, t, job = run(
        "G28", "G1 X10 F6000", "SET_INPUT_SHAPER SHAPER_FREQ_Y=20 SHAPER_TYPE_Y=ZVD", "G1 X20",
        "SET_INPUT_SHAPER SHAPER_FREQ_Y=20", "SET_INPUT_SHAPER SHAPER_TYPE=mzv DAMPING_RATIO_X=0", "G1 X30",
        "SET_INPUT_SHAPER SHAPER_FREQ_X=0", "G1 X40", "SET_INPUT_SHAPER",
        on=on,
    )  # fmt: skip
    end = ends(t)
    assert changes(events) == [
        ShaperChange(3, "Y", "zvd", 20, 0.1, about(end[0] + 0.1)),
        ShaperChange(6, "X", "mzv", 40, 0, about(end[1] + 0.1)),
        ShaperChange(6, "Y", "mzv", 20, 0.1, about(end[1] + 0.1)),
        ShaperChange(8, "X", "mzv", 0, 0, about(end[2] + 0.1)),
    ]
    assert t["print_time"][1:].tolist() == pytest.approx([e + 0.1 for e in end[:3]])
    told = [event.text for event in events if isinstance(event, Reply)]
    assert told[0].startswith(
        "SHAPER_TYPE_X=mzv SHAPER_FREQ_X=0 DAMPING_RATIO_X=0 SHAPER_TYPE_Y=mzv SHAPER_FREQ"
    )
    assert job.machine.shapers["Y"] == Shaper("mzv", 20, 0.1)


# ---- Extruders ----


def test_another_extruder_brings_its_limits_its_advance_and_its_steppers() -> None:
    events, t, job = run(
        "G28", "M83", "G1 X10 E1 F6000", "T1", "G1 X20 E1", "T1", "SYNC_EXTRUDER_MOTION EXTRUDER=belted "
        "MOTION_QUEUE=extruder1", "ACTIVATE_EXTRUDER EXTRUDER=extruder", "G1 X30 E1",
    )  # fmt: skip
    end = ends(t)
    still, moves = (0, 0, 0, 0), (0, 0, 0, 1)
    assert changes(events) == [
        WeightsChange(4, {"extruder": still, "extruder1": moves, "belted": still}, about(end[0] + 0.04)),
        WeightsChange(7, {"extruder": still, "extruder1": moves, "belted": moves}, about(end[1] + 0.04)),
        WeightsChange(8, {"extruder": moves, "extruder1": still, "belted": still}, about(end[1] + 0.08)),
    ]
    assert t["pressure_advance"].tolist() == [0.05, 0.02, 0.05]
    assert job.machine.active is job.machine.extruders["extruder"]
    with pytest.raises(GCodeError, match=r"part.gcode:4: the move pushes 6 mm of filament at once"):
        run("G28", "G1 E3", "T1", "G1 E6")


def test_each_extruder_has_its_own_place() -> None:
    events, t, job = run(
        "G28", "G1 E1.5", "T1", "M114", "G1 E1", "T0", "M114", "G1 E2", "G92 E10", "T1", "M114", "G92 E0.25",
        "G1 E0.5", "ACTIVATE_EXTRUDER EXTRUDER=extruder", "M114", "T0", "M114", "G1 E10.125",
    )  # fmt: skip
    told = [event.text.split("E:")[1] for event in events if isinstance(event, Reply)]
    assert told == ["0.000", "1.500", "1.000", "10.000", "10.000"]
    lengths = t["start_v"] * t["accel_s"] + t["accel"] * t["accel_s"] ** 2 / 2
    lengths += t["cruise_v"] * (t["cruise_s"] + t["decel_s"]) - t["accel"] * t["decel_s"] ** 2 / 2
    assert lengths.tolist() == pytest.approx([1.5, 1, 0.5, 0.25, 0.125])
    # The machine's own axis just goes on: no stepper jumps when another takes over.
    assert t["start"][:, 3].tolist() == pytest.approx([0, 1.5, 2.5, 3, 3.25])
    assert job.planner.toolhead_position[3] == pytest.approx(3.375)


def test_places_of_extruders_know_the_unit_and_the_extrude_factor() -> None:
    events, t, _ = run(
        "G28", "M221 S50", "G1 E2", "T1", "G20", "M221 S200", "G1 E0.01", "M114", "T0", "M114", "G1 E0.1",
    )  # fmt: skip
    told = [float(event.text.split("E:")[1]) for event in events if isinstance(event, Reply)]
    assert told == pytest.approx([0.01, 2 / 25.4], abs=1e-3)
    assert t["start"][:, 3].tolist() == pytest.approx([0, 1, 1 + 0.508])
    with pytest.raises(GCodeError, match=r"part.gcode:5: the move pushes 2.5 mm"):
        run("G28", "G1 E2", "T1", "G1 X1", "G1 E2.5")


def test_one_extruder_needs_no_change() -> None:
    assert not changes(run("T0", on=MachineState())[0])
    with pytest.raises(GCodeError, match="this machine has only T0"):
        run("T1", on=MachineState())


# ---- Carriages ----


def test_the_carriages_take_turns_copy_and_mirror() -> None:
    events, t, job = run(
        "G28", "G1 X100 F6000", "SET_DUAL_CARRIAGE CARRIAGE=1", "G1 X200", "SET_DUAL_CARRIAGE CARRIAGE=0",
        "SET_DUAL_CARRIAGE CARRIAGE=1 MODE=mirror", "G1 X90", "G28", "G1 X10",
    )  # fmt: skip
    weights = [e.weights for e in events if isinstance(e, WeightsChange)]
    one, other = (1, 0, 0, 0), (0, 0, 0, 0)
    assert weights == [
        {"stepper_x": other, "dual": one},
        {"stepper_x": one, "dual": other},
        {"stepper_x": one, "dual": (-1, 0, 0, 0)},
        {"stepper_x": one, "dual": other},
    ]
    at = [event.position[0] for event in events if isinstance(event, PositionSet)]
    assert at == [0, 250, 100, 0], "homed, the other carriage, the first again, homed"
    assert t["start"][:, 0].tolist() == [0, 250, 100, 0]
    where = [type(e) for e in events if isinstance(e, WeightsChange | PositionSet)]
    assert where[1:3] == [WeightsChange, PositionSet], "the position is of the new head"
    assert job.machine.carriage_state == IDEX.home


def test_what_the_carriages_do_is_kept_and_taken_up_again() -> None:
    _, _, job = run(
        "G28", "G1 X100 F6000", "SET_DUAL_CARRIAGE CARRIAGE=1", "SET_DUAL_CARRIAGE CARRIAGE=0",
        "SET_DUAL_CARRIAGE CARRIAGE=1 MODE=COPY", "SAVE_DUAL_CARRIAGE_STATE NAME=a",
        "SET_DUAL_CARRIAGE CARRIAGE=1", "RESTORE_DUAL_CARRIAGE_STATE NAME=a MOVE=0",
    )  # fmt: skip
    state = job.machine.carriage_state
    assert state is not None
    assert state.modes == job.machine.saved_carriages["a"].modes
    assert state.positions == (100, 250)


def test_an_extruder_stepper_has_the_advance_of_whom_it_follows() -> None:
    _, t, job = run(
        "G28", "M83", "SET_PRESSURE_ADVANCE EXTRUDER=belted ADVANCE=0.3",
        "SYNC_EXTRUDER_MOTION EXTRUDER=belted MOTION_QUEUE=extruder",
        "SET_PRESSURE_ADVANCE EXTRUDER=belted ADVANCE=0.2", "G1 X20 E1 F6000",
    )  # fmt: skip
    assert t["pressure_advance"].tolist() == [0.2]
    assert job.machine.extruders["extruder1"].pressure_advance_s == 0.02


def test_the_carriages_go_back_to_where_they_were() -> None:
    _, t, job = run(
        "G28", "G1 X60 F6000", "SET_DUAL_CARRIAGE CARRIAGE=1", "G1 X180", "SET_DUAL_CARRIAGE CARRIAGE=0",
        "SET_DUAL_CARRIAGE CARRIAGE=1 MODE=MIRROR", "SAVE_DUAL_CARRIAGE_STATE", "G1 X30",
        "SET_DUAL_CARRIAGE CARRIAGE=1", "G1 X90", "SET_DUAL_CARRIAGE CARRIAGE=0", "G1 X50",
        "RESTORE_DUAL_CARRIAGE_STATE MOVE_SPEED=30", "G1 X70 F6000",
    )  # fmt: skip
    # The second one makes room first: 60 mm would be too near to its 90 mm.
    back = t[-3:]
    assert back["start"][:, 0].tolist() == [90, 50, 60]
    assert back["cruise_v"].tolist() == [30, 30, 100]
    state = job.machine.carriage_state
    assert state is not None
    assert state.modes == job.machine.saved_carriages["default"].modes
    assert state.at(70) == (70, 170)


def test_so_many_states_of_carriages_are_saved_and_no_more() -> None:
    lines = [f"SAVE_DUAL_CARRIAGE_STATE NAME=s{n}" for n in range(SAVED_MAX)]
    _, _, job = run(*lines, "SAVE_DUAL_CARRIAGE_STATE NAME=s0")
    assert len(job.machine.saved_carriages) == SAVED_MAX
    with pytest.raises(GCodeError, match=f"{SAVED_MAX} states are saved already"):
        run(*lines, "SAVE_DUAL_CARRIAGE_STATE")


def test_another_way_per_turn_holds_from_a_standstill_on() -> None:
    motion = ExtruderMotion(("extruder",), "extruder", {"extruder": "extruder"}, {"extruder": 22.5})
    on = MachineState({"extruder": Extruder("extruder", LIMITS)}, motion)
    events, _, _ = run(
        "M83", "G1 E2", "SET_EXTRUDER_ROTATION_DISTANCE EXTRUDER=extruder",
        "SET_EXTRUDER_ROTATION_DISTANCE EXTRUDER=extruder DISTANCE=-7.5", "G1 E2",
        "SET_EXTRUDER_ROTATION_DISTANCE EXTRUDER=extruder DISTANCE=-7.5", on=on,
    )  # fmt: skip
    assert [event.weights for event in events if isinstance(event, WeightsChange)] == [
        {"extruder": (0, 0, 0, -3)}
    ]
    assert [event.text for event in events if isinstance(event, Reply)] == [
        "extruder: rotation_distance 22.500000 mm",
        *["extruder: rotation_distance -7.500000 mm"] * 2,
    ]


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        (
            ["RESTORE_DUAL_CARRIAGE_STATE NAME=x"],
            ":1: RESTORE_DUAL_CARRIAGE_STATE names the state 'x', which is not saved",
        ),
        (
            ["SAVE_DUAL_CARRIAGE_STATE", "RESTORE_DUAL_CARRIAGE_STATE"],
            ":2: RESTORE_DUAL_CARRIAGE_STATE comes before X is homed",
        ),
        (
            ["G28", "SET_EXTRUDER_ROTATION_DISTANCE EXTRUDER=belted DISTANCE=0"],
            ":2: DISTANCE of SET_EXTRUDER_ROTATION_DISTANCE is 0; 0.1 to 10000 mm are possible, with a minus",
        ),
        (
            ["SET_EXTRUDER_ROTATION_DISTANCE EXTRUDER=nix"],
            ":1: there is no extruder stepper 'nix'",
        ),
        (["G28", "G1 X211"], ":2: the move goes to X 211 mm, outside 0 to 200 mm"),
        (
            ["G28", "G1 X180", "SET_DUAL_CARRIAGE CARRIAGE=1", "G1 X215"],
            ":4: the move goes to X 215 mm",
        ),
        (
            ["G28", "SET_DUAL_CARRIAGE CARRIAGE=0 MODE=COPY"],
            ":2: carriage 0 is the primary and cannot",
        ),
        (["SET_DUAL_CARRIAGE CARRIAGE=1"], ":1: SET_DUAL_CARRIAGE comes before X is homed"),
        (["SET_DUAL_CARRIAGE"], ":1: SET_DUAL_CARRIAGE has no CARRIAGE; add CARRIAGE="),
        (["SET_DUAL_CARRIAGE CARRIAGE=2"], ":1: CARRIAGE of SET_DUAL_CARRIAGE is '2'; give 0 or 1"),
        (["SET_DUAL_CARRIAGE CARRIAGE=1 MODE=x"], ":1: MODE of SET_DUAL_CARRIAGE is 'X'; there are PRIMARY"),
        (["SET_PRESSURE_ADVANCE ADVANCE=-1"], ":1: ADVANCE of SET_PRESSURE_ADVANCE is -1; 0 to 10 are"),
        (
            ["SET_PRESSURE_ADVANCE ADVANCE=x"],
            ":1: ADVANCE of SET_PRESSURE_ADVANCE is 'x', which is",
        ),
        (
            ["SET_PRESSURE_ADVANCE ADVANCE=0.05 SMOOTH_TIME=0.00001"],
            ":1: SMOOTH_TIME of SET_PRESSURE_ADVANCE is 1e-05; give 0, or 0.0001 s and more",
        ),
        (
            ["SET_PRESSURE_ADVANCE SMOOTH_TIME=0.21"],
            ":1: SMOOTH_TIME of SET_PRESSURE_ADVANCE is 0.21; 0 to 0.2 are possible",
        ),
        (
            ["SET_PRESSURE_ADVANCE EXTRUDER=e ADVANCE=1"],
            ":1: SET_PRESSURE_ADVANCE names the extruder 'e'",
        ),
        (["SET_INPUT_SHAPER SHAPER_TYPE=box"], ":1: SET_INPUT_SHAPER names the shaper 'box'; there are zv"),
        (
            ["SET_INPUT_SHAPER SHAPER_FREQ_X=0.1"],
            ":1: SHAPER_FREQ_X of SET_INPUT_SHAPER is 0.1; give 0 or",
        ),
        (
            ["SET_INPUT_SHAPER SHAPER_TYPE=3hump_ei SHAPER_FREQ_X=1 DAMPING_RATIO_X=0.1"],
            ":1: SET_INPUT_SHAPER: 3hump_ei of 1 Hz with a damping ratio of 0.1 reaches 1.22 s far",
        ),
        (["SET_INPUT_SHAPER DAMPING_RATIO_Z=1"], ":1: DAMPING_RATIO_Z of SET_INPUT_SHAPER is 1; 0 to 0.999"),
        (
            ["SYNC_EXTRUDER_MOTION EXTRUDER=nix MOTION_QUEUE="],
            ":1: there is no extruder stepper 'nix'",
        ),
        (["SYNC_EXTRUDER_MOTION EXTRUDER=belted"], ":1: SYNC_EXTRUDER_MOTION has no MOTION_QUEUE"),
        (["ACTIVATE_EXTRUDER"], ":1: ACTIVATE_EXTRUDER has no EXTRUDER"),
        (["T2"], ":1: T2 selects a tool that does not exist; this machine has T0 to T1"),
    ],
)
def test_what_cannot_be_is_told_in_one_sentence(lines: list[str], sentence: str) -> None:
    with pytest.raises(GCodeError) as caught:
        run(*lines)
    assert str(caught.value).startswith(f"part.gcode{sentence}")
    assert "\n" not in str(caught.value)
