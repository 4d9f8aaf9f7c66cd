"""Axes that lean: what is measured, what steppers follow instead, and where the head is called to be."""

import math
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from coordinator.gcode.events import PositionSet, WeightsChange
from coordinator.modules.compensation.skew_correction import PROFILES_MAX, Skew, Skews
from tests.stages.program_stage import ProgramStage

PROFILE = "[skew_correction cold]\nxy_skew: 0.01\nxz_skew: -0.002\nyz_skew: 0.003\n"


def leaning(side: float, tangent: float) -> str:
    """Return AC,BD,AD of a square whose upper side is shifted."""
    up, shift = side * math.cos(math.atan(tangent)), side * math.sin(math.atan(tangent))
    return f"{math.hypot(side + shift, up)},{math.hypot(side - shift, up)},{side}"


def test_what_is_believed_and_made_are_each_others_inverse() -> None:
    skew = Skew(xy=0.01, xz=-0.002, yz=0.003)
    at = (100.0, 200.0, 50.0, 7.0)
    assert skew.made(skew.wanted(at)) == pytest.approx(at)
    believed = skew.wanted(at)
    for straight in ((1, 0, 0, 0), (1, 1, 0, 0), (1, -1, 0, 0), (0, 0.5, 2, 0)):
        follows = skew.weights(straight)
        assert sum(w * p for w, p in zip(follows, at, strict=True)) == pytest.approx(
            sum(w * p for w, p in zip(straight, believed, strict=True))
        )


@pytest.mark.parametrize("tangent", [0.0, 0.01, -0.02])
def test_a_measured_square_tells_how_it_leans(tmp_path: Path, tangent: float) -> None:
    machine = ProgramStage(tmp_path, "[skew_correction]\n")
    measured = leaning(140, tangent)
    ac, bd, ad = measured.split(",")
    machine.run("G28", f"SET_SKEW XY={measured}")
    told = f"{math.atan(tangent):.6f} radians, {math.degrees(math.atan(tangent)):.2f} degrees"
    assert machine.run("GET_CURRENT_SKEW")[0].replace("-0.000000", "0.000000") == f"XY: {told}"
    (calculated,) = machine.run(f"CALC_MEASURED_SKEW AC={ac} BD={bd} AD={ad}")
    assert calculated.replace("-0.000000", "0.000000") == f"Calculated skew: {told}"
    assert machine.modules.status()["skew_correction"]["xy_skew"] == pytest.approx(tangent)


def test_the_head_stays_where_it_is_and_is_called_by_another_place(tmp_path: Path) -> None:
    machine = ProgramStage(tmp_path, PROFILE)
    machine.run("G28", "G90", "G1 X100 Y100 Z10 F6000")
    events = machine.events("SKEW_PROFILE LOAD=cold")
    skew = Skew(0.01, -0.002, 0.003)
    place = skew.made((100.0, 100.0, 10.0, 0.0))
    (told,) = [event for event in events if isinstance(event, PositionSet)]
    assert told.position == pytest.approx(place)
    (change,) = [event for event in events if isinstance(event, WeightsChange)]
    assert change.weights["stepper_x"] == pytest.approx(skew.weights((1, 1, 0, 0)))
    assert change.weights["stepper_z"] == (0, 0, 1, 0)
    assert "extruder" not in change.weights
    (reply,) = machine.run("M114")
    assert reply == f"X:{place[0]:.3f} Y:{place[1]:.3f} Z:{place[2]:.3f} E:0.000"
    machine.run("SKEW_PROFILE SAVE=other", "SET_SKEW CLEAR=1")
    assert machine.planner.toolhead_position == pytest.approx((100, 100, 10, 0))
    machine.run("SKEW_PROFILE LOAD=other")
    (skews,) = machine.modules.of(Skews)
    restoring = skews.restoring
    machine.run("SET_SKEW CLEAR=1")
    assert not skews.restoring
    machine.run(restoring)
    assert machine.planner.toolhead_position == pytest.approx(place)
    machine.run("SKEW_PROFILE LOAD=other")
    machine.run("SKEW_PROFILE REMOVE=other")
    assert "there is no 'other'" in machine.error("SKEW_PROFILE LOAD=other")
    assert machine.modules.status()["skew_correction"] == {
        "current_profile_name": "other", "xy_skew": 0.01, "xz_skew": -0.002, "yz_skew": 0.003
    }  # fmt: skip


def test_a_program_makes_so_many_profiles_and_no_more(tmp_path: Path) -> None:
    machine = ProgramStage(tmp_path, PROFILE)
    machine.run("G28", *(f"SKEW_PROFILE SAVE=p{n}" for n in range(PROFILES_MAX - 1)))
    assert f"there are {PROFILES_MAX} profiles already" in machine.error("SKEW_PROFILE SAVE=another")
    machine.run("SKEW_PROFILE SAVE=p0", "SKEW_PROFILE REMOVE=cold", "SKEW_PROFILE SAVE=another")


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("SET_SKEW XY=1,2", "XY of SET_SKEW is '1,2'; give AC,BD,AD in mm, as measured"),
        ("SET_SKEW XY=200,100,100", "is no square that leans a little"),
        ("SET_SKEW XZ=1,2,x", "AD of SET_SKEW is 'x', which is not a number"),
        ("SET_SKEW XZ=0,0,0", "is no square that leans a little"),
        ("SET_SKEW", "SET_SKEW has nothing to set"),
        ("SKEW_PROFILE LOAD=warm", "there is no 'warm'"),
        ("SKEW_PROFILE SAVE=a-b", "'a-b' cannot be a profile's name"),
        ("SKEW_PROFILE", "SKEW_PROFILE takes one of LOAD=name, SAVE=name and REMOVE"),
    ],
)
def test_mistakes_are_told(tmp_path: Path, line: str, sentence: str) -> None:
    assert sentence in ProgramStage(tmp_path, PROFILE).error(line)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("plane", "by_mm"), [("XY", 6.3), ("XZ", 6.6), ("YZ", 6.6)])
def test_motors_stay_near_their_range(tmp_path: Path, plane: str, by_mm: float, sign: int) -> None:
    """Failed before: X went to -250 mm with _SET_SKEW XY=1, and to -8 mm with a square measured wrongly."""
    machine = ProgramStage(tmp_path, "[skew_correction]\n[skew_correction wrong]\nxy_skew: 0.2\n")
    machine.run("G28", f"SET_SKEW {plane}={leaning(140, sign * 0.02)}")
    (skews,) = machine.modules.of(Skews)
    before = skews.now
    refused = f"at a corner it would drive {plane[0]} {by_mm} mm beyond position_min or position_max"
    assert refused in machine.error(f"SET_SKEW {plane}={leaning(140, sign * 0.03)}")
    assert refused in machine.error(f"_SET_SKEW {plane}={sign * 0.03}")
    assert f"{plane} of _SET_SKEW is {sign * 1e15:g}; -0.2 to 0.2" in machine.error(
        f"_SET_SKEW {plane}={sign * 1e15}"
    )
    assert "would drive X 42.0 mm" in machine.error("SKEW_PROFILE LOAD=wrong")
    assert skews.now == before
    assert machine.machine.follows == {name: before.weights(own) for name, own in skews.straight.items()}


def test_a_machine_that_is_no_sum_of_axes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(Path("config/delta.cfg").read_text(encoding="utf-8") + "\n[skew_correction]\n")
    with pytest.raises(
        ConfigError, match="needs a machine whose motors move along X, Y and Z or sums of them"
    ):
        load_machine(str(path))
