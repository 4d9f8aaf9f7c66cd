"""[safe_z_home] and [homing_override] as rows of moves and lines, with their order and figures."""

import asyncio
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from coordinator.gcode.commands import AtStandstill, Lines
from coordinator.gcode.events import Done
from coordinator.gcode.parser import WordError
from coordinator.modules.homing.homing_override import HomingOverride
from coordinator.modules.homing.safe_z_home import SafeZHome
from coordinator.support.examples import EXAMPLES
from nodes.support.errors import CanductorError
from tests.coordinator.modules.scripted_homing import Head, HomingStage, To, perform
from tests.stages.printer_text import SWITCHES_CFG, changed, write

SAFE = "\n[safe_z_home]\nhome_xy_position: 30, 200\n"
HOP = "z_hop: 3\n"
BACK = "move_to_previous: True\n"
Position = tuple[float, float, float, float]
PLACE: Position = (100.0, 110.0, 1.0, 5.0)


class Stager:
    """Makes stages in one folder."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self._monkeypatch = folder, monkeypatch

    def __call__(self, sections: str, machine: str = SWITCHES_CFG) -> HomingStage:
        stage = HomingStage(write(self.folder, machine + sections), self._monkeypatch)
        for safe in stage.modules.of(SafeZHome):
            asyncio.run(safe.connect(stage.live))
        return stage


@pytest.fixture
def stager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Stager:
    return Stager(tmp_path, monkeypatch)


def home(stage: HomingStage, axes: str, place: Position = PLACE, homed: str = "") -> Done:
    return perform(stage.homing.read(stage.call("G28", place, homed), axes))


def steps(stage: HomingStage) -> list[object]:
    """Return what was done: the way of a move of the head, or the rail of the first approach."""
    found: list[object] = []
    for move in stage.moves:
        if isinstance(move, Head):
            found.append(tuple(round(mm, 6) for mm in move.way))
        elif isinstance(move, To) and found[-1:] != [move.rails[0]]:
            found.append(move.rails[0])
    return found


def near(position: Position | None, *expected: float) -> bool:
    return position == pytest.approx(expected)


# ------------------------------------------------------------------------------------------------ safe_z_home


def test_all_axes_with_the_head_lifted_before_and_after(stager: Stager) -> None:
    """Z is not known: it is lifted by the hop, and to it when it is known."""
    stage = stager(SAFE + HOP)
    done = home(stage, "XYZ")
    assert steps(stage) == [(0, 0, 3), "x", "y", (30, -50, 0), "z", (0, 0, 3.5)]
    heads = [move for move in stage.moves if isinstance(move, Head)]
    assert [(move.speed, move.accel) for move in heads] == [(15.0, 500.0), (50.0, 3000.0), (15.0, 500.0)]
    assert near(done.position, 30, 200, 3, 5)
    assert (done.homed, done.moved) == ("XYZ", True)


def test_where_the_head_is_follows_from_the_steps_that_were_made(stager: Stager) -> None:
    stage = stager(SAFE + HOP)
    stage.made = (0.25, 0.5, 0.125)
    done = home(stage, "Z", (10.0, 20.0, 1.0, 5.0), "XYZ")
    assert steps(stage) == [(0, 0, 2), (19.75, 179.5, 0), "z", (0, 0, 3.5)]
    assert near(done.position, 30.5, 201, 3.125, 5)


@pytest.mark.parametrize(
    ("z", "homed", "lift"),
    [(3.0, "XYZ", []), (2.5, "XYZ", [(0, 0, 0.5)]), (8.0, "XYZ", []), (8.0, "XY", [(0, 0, 3)])],
)
def test_the_head_is_lifted_to_the_hop_but_never_lowered(
    stager: Stager, z: float, homed: str, lift: list[object]
) -> None:
    stage = stager(SAFE + HOP)
    done = home(stage, "X", (100.0, 110.0, z, 0.0), homed)
    assert steps(stage) == [*lift, "x"]
    assert near(done.position, 0, 110, z + sum(way[2] for way in lift), 0)  # type: ignore[index]
    assert done.homed == "X"


def test_a_hop_may_be_small(stager: Stager) -> None:
    stage = stager(SAFE + "z_hop: 0.5\n")
    home(stage, "X", PLACE, "")
    assert steps(stage) == [(0, 0, 0.5), "x"]


def test_without_a_hop_nothing_is_lifted(stager: Stager) -> None:
    stage = stager(SAFE)
    home(stage, "XYZ")
    assert steps(stage) == ["x", "y", (30, -50, 0), "z", (0, 0, 0.5)]
    assert near(home(stager(SAFE), "X", (9.0, 9.0, -0.75, 0.0), "Z").position, 0, 9, 0, 0)


@pytest.mark.parametrize(
    ("axes", "homed", "back"),
    [("Z", "XYZ", (70, -90, 0)), ("YZ", "XYZ", (70, 50, 0)), ("XYZ", "", (-30, 50, 0))],
)
def test_x_and_y_go_back_to_where_they_were_before_z(
    stager: Stager, axes: str, homed: str, back: tuple[float, ...]
) -> None:
    """Where they were homed with it that is where they were then."""
    stage = stager(SAFE + BACK)
    home(stage, axes, (100.0, 110.0, 0.0, 0.0), homed)
    assert steps(stage)[-1] == back


def test_no_speed_is_above_what_the_machine_allows(stager: Stager) -> None:
    stage = stager(SAFE + HOP + "speed: 400\nz_hop_speed: 30\n")
    home(stage, "XYZ")
    assert [m.speed for m in stage.moves if isinstance(m, Head)] == [20.0, 250.0, 20.0]
    slow = stager(SAFE + HOP + "speed: 0.5\nz_hop_speed: 0.25\n")
    home(slow, "XYZ")
    assert [m.speed for m in slow.moves if isinstance(m, Head)] == [0.25, 0.5, 0.25]


@pytest.mark.parametrize(
    ("axes", "homed", "missing"),
    [("Z", "", "X"), ("Z", "X", "Y"), ("YZ", "", "X"), ("XZ", "", "Y"), ("XZ", "Y", ""), ("X", "", "")],
)
def test_z_comes_behind_x_and_y(stager: Stager, axes: str, homed: str, missing: str) -> None:
    stage = stager(SAFE)
    call = stage.call("G28", PLACE, homed)
    if missing:
        with pytest.raises(WordError, match=f"G28 of Z comes before {missing} is homed; home with G28 first"):
            stage.homing.read(call, axes)
    else:
        assert isinstance(stage.homing.read(call, axes), AtStandstill)


@pytest.mark.parametrize(
    ("place", "outside"),
    [
        ("0, 0", ""),
        ("250, 250", ""),
        ("-0.1, 3", "-0.1, 3, but X goes from 0 to 250 mm"),
        ("3, 250.1", "3, 250.1, but Y goes from 0 to 250 mm"),
        ("100000, -100000", "100000, -100000, but X goes from 0 to 250 mm"),
    ],
)
def test_z_is_refused_at_a_place_outside_and_other_axes_are_not(
    stager: Stager, place: str, outside: str
) -> None:
    stage = stager(SAFE.replace("30, 200", place))
    notes = [note for note in stage.described.notes if "home_xy_position" in note]
    if outside:
        (note,) = notes
        assert f"is {outside}: G28 of Z is refused until it names a place within" in note
        refused = f"^G28 of Z is refused: home_xy_position of .safe_z_home. is {outside}; correct it$"
        with pytest.raises(CanductorError, match=refused):
            home(stage, "Z", PLACE, "XY")
    else:
        assert notes == []
        assert home(stage, "Z", PLACE, "XY").homed == "Z"
    stage.moves.clear()
    assert home(stage, "X", PLACE, "XYZ").homed == "X"
    assert steps(stage) == ["x"]


def test_what_cannot_be_homed_is_refused_before_the_head_is_lifted(stager: Stager) -> None:
    text = changed("endstop_pin: PC7\n", "endstop_pin: probe:z_virtual_endstop\n", SWITCHES_CFG)
    text = changed("position_endstop: -0.5\n", "", text) + "[dockable_probe]\npin: PA9\nz_offset: 1\n"
    stage = stager(SAFE + HOP, text)
    with pytest.raises(CanductorError, match="G28 of Z is refused: the endstop probe:z_virtual_endstop"):
        home(stage, "XYZ")
    assert stage.moves == []


def test_it_has_no_use_where_the_head_cannot_be_moved_before_it_is_known(tmp_path: Path) -> None:
    text = (EXAMPLES / "delta.cfg").read_text() + SAFE
    with pytest.raises(
        ConfigError, match=r"\[safe_z_home\] has no use on a machine of kinematics delta; remove it"
    ):
        load_machine(write(tmp_path, text))


def test_a_hop_does_not_lead_beyond_the_end_of_z(tmp_path: Path) -> None:
    """Failed before: the head was moved as far as z_hop says, whatever Z has."""
    load_machine(write(tmp_path, SWITCHES_CFG + SAFE + "z_hop: 250\n"))
    with pytest.raises(ConfigError, match=r"'z_hop' of \[safe_z_home\] is '250.5', but Z goes up to 250 mm$"):
        load_machine(write(tmp_path, SWITCHES_CFG + SAFE + "z_hop: 250.5\n"))


@pytest.mark.parametrize(
    ("options", "wrong"),
    [
        ("home_xy_position: 1\n", "home_xy_position"),
        ("home_xy_position: 1, 2, 3\n", "home_xy_position"),
        ("home_xy_position: 100000.5, 0\n", "home_xy_position"),
        ("home_xy_position: 0, -100000.5\n", "home_xy_position"),
        ("home_xy_position: 1, 2\nz_hop: -0.1\n", "z_hop"),
        ("home_xy_position: 1, 2\nspeed: 0\n", "speed"),
        ("home_xy_position: 1, 2\nz_hop_speed: 0\n", "z_hop_speed"),
    ],
)
def test_mistakes_are_told_with_their_option(tmp_path: Path, options: str, wrong: str) -> None:
    with pytest.raises(ConfigError, match=f"'{wrong}' of .safe_z_home. is"):
        load_machine(write(tmp_path, SWITCHES_CFG + "\n[safe_z_home]\n" + options))


def test_a_place_is_explained_and_has_a_stand_in(stager: Stager) -> None:
    (place, *_) = SafeZHome.SPEC.options
    assert place.rule() == "X and Y in mm with a comma between them, as in 100, 100"
    assert place.stand_in() == (0.0, 0.0)
    (safe,) = stager(SAFE + "z_hop: 250\n").modules.of(SafeZHome)
    assert safe.name == "safe_z_home"
    assert safe._outside == ""


# -------------------------------------------------------------------------------------------- homing_override


OVERRIDE = "\n[homing_override]\ngcode:\n  G28 X\n  M117 {rawparams} {params.Z|default('none')}\n"


def override(stager: Stager, options: str = "") -> HomingStage:
    return stager(OVERRIDE + options)


def test_its_lines_take_the_place_of_g28_with_what_was_asked_for(stager: Stager) -> None:
    stage = override(stager)
    assert [module.name for module in stage.modules.of(HomingOverride)] == ["homing_override"]
    reading = stage.homing.read(stage.call("G28 Z0"), "Z")
    assert isinstance(reading, Lines)
    assert reading.text.split("\n")[:2] == ["G28 X", "M117 Z0 0"]
    assert not [name for name in stage.modules.vocabulary.commands if name.startswith("_HOMING")]


def test_g28_of_axes_that_it_is_not_for_homes(stager: Stager) -> None:
    stage = override(stager, "axes: zY\n")
    for axes, is_own in (("X", False), ("XZ", True), ("Y", True), ("Z", True)):
        reading = stage.homing.read(stage.call(f"G28 {' '.join(axes)}"), axes)
        assert isinstance(reading, Lines if is_own else AtStandstill)
    done = perform(stage.homing.read(stage.call("G28 X"), "X"))
    assert done.homed == "X"


@pytest.mark.parametrize(
    ("options", "position", "known"),
    [
        ("set_position_z: 7\n", (1.0, 2.0, 7.0, 4.0), "Z"),
        ("set_position_x: 0\nset_position_y: 100000\n", (0.0, 100000.0, 3.0, 4.0), "XY"),
        ("set_position_y: -100000\n", (1.0, -100000.0, 3.0, 4.0), "Y"),
    ],
)
def test_a_position_is_set_before_the_lines_are_read(
    stager: Stager, options: str, position: Position, known: str
) -> None:
    stage = override(stager, options)
    reading = stage.homing.read(stage.call("G28 Z0"), "Z")
    assert isinstance(reading, Lines)
    assert reading.text == "_HOMING_OVERRIDE_SET_POSITION\n_HOMING_OVERRIDE_LINES Z0"
    commands = stage.modules.vocabulary.commands
    call = stage.call("_HOMING_OVERRIDE_SET_POSITION", (1.0, 2.0, 3.0, 4.0))
    taken = commands["_HOMING_OVERRIDE_SET_POSITION"].read(call)
    assert isinstance(taken, AtStandstill)
    assert taken.planned == Done(position=position, homed=known)
    assert perform(taken) == taken.planned
    lines = commands["_HOMING_OVERRIDE_LINES"].read(stage.call("_HOMING_OVERRIDE_LINES Z0"))
    assert isinstance(lines, Lines)
    assert lines.text.split("\n")[:2] == ["G28 X", "M117 Z0 0"]


@pytest.mark.parametrize("value", ["100000.5", "-100000.5"])
def test_a_position_is_within_100_m(tmp_path: Path, value: str) -> None:
    with pytest.raises(ConfigError, match=r"'set_position_x' of \[homing_override\] is"):
        load_machine(write(tmp_path, f"{SWITCHES_CFG}{OVERRIDE}set_position_x: {value}\n"))


def test_only_one_may_stand_in_for_g28(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="and another section both replace G28; remove one"):
        load_machine(write(tmp_path, SWITCHES_CFG + OVERRIDE + SAFE))
