"""G28 as a row of moves: their order, ways, speeds and accelerations, and where they leave the head."""

import asyncio
from pathlib import Path

import pytest

from coordinator.gcode.commands import AtStandstill
from coordinator.gcode.events import Done
from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.modules.homing.homing import Homing
from coordinator.support.examples import EXAMPLES
from nodes.support.errors import CanductorError
from tests.coordinator.modules.scripted_homing import Feels, Head, HomingStage, Motors, To, perform
from tests.stages.printer_text import (
    MCU,
    PRINTER_CFG,
    SENSORLESS_CFG,
    SWITCHES_CFG,
    TOOLHEAD,
    changed,
    example_text,
    printer_section,
    stepper_section,
    write,
)

STEP_MM = 0.0125
Position = tuple[float, float, float, float]


class Stager:
    """Makes stages in one folder."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self._folder, self._monkeypatch = folder, monkeypatch

    def __call__(self, text: str = SWITCHES_CFG, *, live: bool = True) -> HomingStage:
        return HomingStage(write(self._folder, text), self._monkeypatch, live=live)

    def example(self, name: str) -> HomingStage:
        return HomingStage(str(EXAMPLES / f"{name}.cfg"), self._monkeypatch)


@pytest.fixture
def stager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Stager:
    return Stager(tmp_path, monkeypatch)


def home(
    stage: HomingStage, axes: str, place: Position = (100.0, 110.0, 120.0, 5.0), homed: str = ""
) -> Done:
    reading = stage.homing.read(stage.call("G28", place, homed), axes)
    return perform(reading)


def close(position: Position | None, *expected: float) -> bool:
    return position == pytest.approx(expected, abs=1e-9)


# ----------------------------------------------------------------------------------------------------- moves


def test_an_axis_goes_to_its_endstop_back_and_there_again_slowly(stager: Stager) -> None:
    stage = stager()
    done = home(stage, "x")
    there, back = {"stepper_x": -1}, {"stepper_x": 1}
    assert stage.moves == [
        To(("x",), there, 375.0, 50.0, 3000.0),
        Motors(back, 5.0, 50.0, 3000.0),
        To(("x",), there, 15.0, 25.0, 3000.0),
    ]
    assert (done.position, done.homed, done.moved) == ((0.0, 110.0, 120.0, 5.0), "X", True)
    assert done.second_carriage_mm is None
    assert stage.looked_at == ["x"]


def test_all_axes_in_their_order_with_what_each_allows(stager: Stager) -> None:
    more = "homing_speed: 40\nhoming_accel: 700\nhoming_retract_speed: 33\n"
    text = changed("homing_speed: 40\n", more, SWITCHES_CFG)
    stage = stager(text)
    stage.beyond = {"z": 0.25}
    done = home(stage, "ZYX")
    assert [move.rails for move in stage.moves if isinstance(move, To)] == [(axis,) for axis in "xxyyzz"]
    y, z = stage.moves[3:6], stage.moves[6:]
    assert y == [
        To(("y",), {"stepper_y": 1}, 375.0, 40.0, 700.0),
        Motors({"stepper_y": -1}, 3.0, 33.0, 700.0),
        To(("y",), {"stepper_y": 1}, 11.0, 20.0, 700.0),
    ]
    assert z == [
        To(("z",), {"stepper_z": -1}, 376.5, 8.0, 500.0),
        Motors({"stepper_z": 1}, 5.0, 8.0, 500.0),
        To(("z",), {"stepper_z": -1}, 15.0, 2.0, 500.0),
    ]
    assert done.homed == "XYZ"
    assert close(done.position, 0.0, 250.0, -0.75, 5.0)


def test_more_acceleration_than_the_machine_has_is_not_used(stager: Stager) -> None:
    stage = stager(changed("homing_speed: 40\n", "homing_speed: 40\nhoming_accel: 7000\n", SWITCHES_CFG))
    home(stage, "Y")
    assert {move.accel for move in stage.moves if not isinstance(move, Feels)} == {3000.0}


@pytest.mark.parametrize(("retract", "back_mm"), [(3.0, 3.0), (0.0, 5.0)])
def test_an_axis_that_stands_on_its_endstop_leaves_it_first(
    stager: Stager, retract: float, back_mm: float
) -> None:
    stage = stager(changed("homing_retract_dist: 3\n", f"homing_retract_dist: {retract}\n", SWITCHES_CFG))
    stage.pressed = {"x", "y"}
    home(stage, "Y")
    away = Motors({"stepper_y": -1}, back_mm, 40.0, 3000.0)
    assert stage.moves[0] == away
    assert stage.moves[1] == To(("y",), {"stepper_y": 1}, 375.0, 40.0, 3000.0)
    assert stage.moves[2:] == ([away, To(("y",), {"stepper_y": 1}, 11.0, 20.0, 3000.0)] if retract else [])
    assert stage.looked_at == ["y"]


def test_an_axis_that_feels_its_end_is_not_looked_at_and_feels_it_in_each_move(stager: Stager) -> None:
    stage = stager(SENSORLESS_CFG)
    stage.homing.link(stage.modules)
    stage.pressed = {"x", "y"}
    home(stage, "XY")
    feels = [move for move in stage.moves if not isinstance(move, Motors | Head)]
    kinds = [(type(m).__name__, m.on if isinstance(m, Feels) else m.rails[0]) for m in feels]
    assert kinds == [
        *(("Feels", True), ("To", "x"), ("Feels", False)),
        *(("Feels", True), ("To", "y"), ("Feels", False)) * 2,
    ]
    assert [(m.section, m.speed) for m in feels if isinstance(m, Feels) and m.on] == [
        ("tmc2209 stepper_x", 40.0),
        ("tmc2209 stepper_y", 40.0),
        ("tmc2209 stepper_y", 20.0),
    ]
    assert stage.looked_at == []


# ---------------------------------------------------------------------------------------------------- places


@pytest.mark.parametrize(
    ("axis", "beyond", "way", "place"),
    [
        ("x", 0.5, (0.5 + STEP_MM, 0.0, 0.0), (STEP_MM, 110.0, 120.0)),
        ("y", 0.25, (0.0, -0.25 - STEP_MM, 0.0), (100.0, 250.0 - STEP_MM, 120.0)),
        ("z", 1.0, (0.0, 0.0, 0.5 + 0.0025), (100.0, 110.0, -1.0 + 0.0025)),
    ],
)
def test_an_axis_that_ends_beyond_its_range_comes_back_by_a_step_more(
    stager: Stager, axis: str, beyond: float, way: tuple[float, float, float], place: tuple[float, ...]
) -> None:
    stage = stager()
    stage.beyond = {axis: beyond}
    stage.made = (0.001, 0.002, 0.004)
    done = home(stage, axis.upper())
    *_, last = stage.moves
    assert isinstance(last, Head)
    assert last.way == pytest.approx(way)
    speed, accel = {"x": (50.0, 3000.0), "y": (40.0, 3000.0), "z": (8.0, 500.0)}[axis]
    assert (last.speed, last.accel) == (speed, accel)
    made = [at + more for at, more in zip(place, stage.made, strict=True)]
    assert close(done.position, *made, 5.0), "it is where the steps led that were made"


@pytest.mark.parametrize(("axis", "beyond"), [("x", 0.0), ("y", 0.0), ("z", 0.5), ("x", -0.5), ("y", -0.5)])
def test_an_axis_at_the_end_of_its_range_or_within_stays_there(
    stager: Stager, axis: str, beyond: float
) -> None:
    stage = stager()
    stage.beyond = {axis: beyond}
    home(stage, axis.upper())
    assert not [move for move in stage.moves if isinstance(move, Head)]


def test_motors_that_share_an_axis_give_the_length_of_a_step(stager: Stager) -> None:
    """One whose motor makes longer steps counts; one that has nothing to do with the axis does not."""
    stage = stager.example("corexy")
    stage.beyond = {"x": 0.5}
    home(stage, "X")
    (head,) = [move for move in stage.moves if isinstance(move, Head)]
    longest = max(m.step_distance for m in stage.described.motors if m.weights[0])
    assert head.way == pytest.approx((0.5 + longest, 0.0, 0.0))


def test_a_motor_of_which_an_axis_takes_half_makes_steps_of_twice_the_length(stager: Stager) -> None:
    stage = stager(changed("carriages: x+y", "carriages: - .5 * y + x", example_text("generic_cartesian")))
    stage.beyond = {"y": 0.5}
    home(stage, "Y")
    (head,) = [move for move in stage.moves if isinstance(move, Head)]
    step_mm = stage.described.motors[0].step_distance
    assert head.way == pytest.approx((0.0, 0.5 + 2 * step_mm, 0.0))


def test_only_axes_that_were_homed_come_back_into_their_range(stager: Stager) -> None:
    stage = stager()
    done = home(stage, "X", (-3.0, -7.0, 300.0, 0.0), "YZ")
    assert done.position == (0.0, -7.0, 300.0, 0.0)
    assert not [move for move in stage.moves if isinstance(move, Head)]


def test_a_head_of_towers_is_left_where_it_is(stager: Stager) -> None:
    stage = stager.example("delta")
    stage.beyond = {"a": 0.5, "b": 0.5, "c": 0.5}
    done = home(stage, "X")
    assert done.homed == "XYZ"
    assert close(done.position, 0.0, 0.0, 400.5, 5.0)
    assert not [move for move in stage.moves if isinstance(move, Head)]
    assert len({move.accel for move in stage.moves if isinstance(move, To)}) == 1


@pytest.mark.parametrize(("homed", "y_mm"), [("Y", 70.0), ("X", 0.0)])
def test_towers_that_do_not_move_y_leave_it_where_it_is_known(
    stager: Stager, homed: str, y_mm: float
) -> None:
    stage = stager.example("deltesian")
    call = stage.call("G28", (0.0, 70.0, 20.0, 0.0), homed)
    stage.homing._approaches = stage.homing._approaches[:1]
    done = asyncio.run(stage.homing.home(call, "Z"))
    assert done.position is not None
    assert done.position[1] == y_mm


def test_a_second_carriage_has_a_place_of_its_own(stager: Stager) -> None:
    stage = stager.example("idex")
    stage.beyond = {"dual_carriage": 0.25}
    done = home(stage, "X")
    rails = [move.rails for move in stage.moves if isinstance(move, To)]
    assert rails == [("x",), ("x",), ("dual_carriage",), ("dual_carriage",)]
    assert done.second_carriage_mm == 350.25
    assert close(done.position, -50.0, 110.0, 120.0, 5.0)
    assert home(stage, "Y").second_carriage_mm is None


def test_axes_without_endstops_are_home_where_they_are_and_nothing_moves(stager: Stager) -> None:
    stage = stager(PRINTER_CFG, live=False)
    done = home(stage, "xz")
    assert (done.position, done.homed) == ((0.0, 110.0, 0.0, 5.0), "XZ")
    assert stage.moves == []
    assert not stage.homing.acts


def test_homing_needs_a_machine(stager: Stager) -> None:
    stage = stager(live=False)
    with pytest.raises(CanductorError, match="needs a machine that is connected"):
        home(stage, "X")
    assert stage.homing.acts


# ----------------------------------------------------------------------------------------------------- sides

SIDES_CFG = (
    MCU
    + TOOLHEAD
    + printer_section(max_accel=5000, max_z_accel=400)
    + stepper_section("stepper_x", "PB0", "PB1", position_max=250)
    + stepper_section("stepper_y", "PB6", "PB7", position_max=250)
    + stepper_section(
        "stepper_z", "PB3", "PB4", endstop_pin="^PC5", position_endstop=0, position_max=250, homing_speed=10
    )
    + stepper_section("stepper_z1", "toolhead:PB3", "!toolhead:PB4", endstop_pin="^toolhead:PC6")
)


@pytest.mark.parametrize(
    ("first", "second", "way"),
    [
        (-0.5, -0.75, {"stepper_z1": -1.0}),
        (-0.75, -0.5, {"stepper_z1": 1.0}),
        (0.0, -STEP_MM / 2, {"stepper_z1": -1.0}),
        (0.0, -STEP_MM / 2.01, None),
        (0.0, STEP_MM / 2, {"stepper_z1": 1.0}),
        (0.0, STEP_MM / 2.01, None),
    ],
)
def test_the_second_side_is_brought_level_with_the_first(
    stager: Stager, first: float, second: float, way: dict[str, float] | None
) -> None:
    stage = stager(SIDES_CFG)
    stage.beyond = {"z": first, "z1": second}
    done = home(stage, "Z")
    both = {"stepper_z": -1, "stepper_z1": -1}
    assert stage.moves[0] == To(("z", "z1"), both, 375.0, 10.0, 400.0)
    levelled = stage.moves[3:]
    if way is None:
        assert levelled == []
    else:
        (move,) = levelled
        assert isinstance(move, Motors)
        assert (move.ways, move.speed, move.accel) == (way, 10.0, 400.0)
        assert move.way_mm == pytest.approx(abs(first - second))
    assert close(done.position, 100.0, 110.0, -first, 5.0)
    assert stage.looked_at == ["z", "z1"]


# -------------------------------------------------------------------------------------------------- refusals


def test_axes_that_cannot_be_homed_are_refused_before_anything_moves(stager: Stager) -> None:
    text = changed("endstop_pin: PC7\n", "endstop_pin: probe:z_virtual_endstop\n", SWITCHES_CFG)
    stage = stager(
        changed("position_endstop: -0.5\n", "", text) + "[dockable_probe]\npin: PA9\nz_offset: 1\n"
    )
    refused = r"^G28 of Z is refused: the endstop probe:z_virtual_endstop \(.*\) is not supported yet; give"
    with pytest.raises(CanductorError, match=refused):
        home(stage, "xz")
    assert stage.moves == []
    stage.homing.check("XY")
    with pytest.raises(CanductorError, match="G28 of Z"):
        stage.homing.check("z")
    home(stage, "X")
    assert stage.homing.acts


def test_a_motor_that_cannot_be_switched_on_moves_no_axis(stager: Stager) -> None:
    stage = stager()
    assert stage.homing._refusal(stage.homing._approaches[1]) == ""
    (motor,) = [motor for motor in stage.described.motors if motor.name == "stepper_y"]
    object.__setattr__(motor, "unpowered", "its driver does not act")
    stage.homing.check("XZ")
    told = "G28 of Y is refused: its driver does not act, so the motor stepper_y cannot be switched on"
    with pytest.raises(CanductorError, match=f"^{told}$"):
        stage.homing.check("XYZ")


def test_a_rail_that_is_refused_says_why(stager: Stager) -> None:
    stage = stager()
    rail = stage.homing._approaches[0].rails[0]
    object.__setattr__(rail.homing, "refused", "the second carriage is in its way")
    with pytest.raises(CanductorError, match="G28 of X is refused: the second carriage is in its way"):
        stage.homing.check("X")


def test_what_stands_in_for_g28_is_asked_but_for_g28_among_its_own_lines(stager: Stager) -> None:
    stage = stager(PRINTER_CFG)
    instead = AtStandstill(lambda: asyncio.sleep(0))
    stage.homing.instead = lambda _call, _axes: instead
    assert stage.homing.acts
    call = stage.call("G28")
    assert stage.homing.read(call, "X") is instead
    object.__setattr__(call, "callers", ("G28",))
    assert stage.homing.read(call, "X") is not instead


# ------------------------------------------------------------------------------------------------- endstops


@pytest.mark.parametrize("name", ["M119", "QUERY_ENDSTOPS"])
def test_endstops_are_told_and_remembered(stager: Stager, name: str) -> None:
    stage = stager()
    assert stage.homing.status() == {"last_query": {}}
    stage.pressed = {"y"}
    reading = stage.modules.vocabulary.commands[name].read(stage.call(name))
    assert perform(reading) == Done(("x:open y:pressed z:open",), kind=ReplyKind.PLAIN)
    assert stage.homing.status() == {"last_query": {"x": False, "y": True, "z": False}}


def test_a_machine_without_endstops_says_so(stager: Stager) -> None:
    stage = stager(PRINTER_CFG)
    done = asyncio.run(stage.homing._query())
    assert done.replies == ("this machine has no endstops on pins",)


def test_the_module_is_found_by_the_name_that_front_ends_ask_for(stager: Stager) -> None:
    (homing,) = stager().modules.of(Homing)
    assert homing.name == "query_endstops"
