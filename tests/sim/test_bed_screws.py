"""[screws_tilt_adjust] and [bed_screws] above a virtual bed."""

from pathlib import Path
from typing import Any

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from coordinator.virtual_machine.plant_bed import BedSettings
from nodes.virtual.plant import Bed
from tests.stages.printer_text import section
from tests.stages.probe_stage import ProbeStage, machine_text

SCREWS: dict[str, Any] = {
    "screw1": "10, 20",
    "screw1_name": "front left",
    "screw2": "170, 20",
    "screw3": "170, 180",
    "screw3_name": "back right",
}
TILTED = BedSettings(shape=Bed(tilt_x=0.005, tilt_y=-0.0025))
"""screw2 is 0.8 mm higher than screw1, screw3 0.4 mm."""
SEE = """[gcode_macro SEE]
gcode:
  {% set s = printer.screws_tilt_adjust %}
  {% set r = s.results %}
  M118 {s.error} {s.max_deviation} {r.screw2.sign} {r.screw2.adjust} {r.screw1.is_base}
[gcode_macro STATE]
gcode:
  {% set s = printer.bed_screws %}
  M118 {s.is_active} {s.state} {s.current_screw} {s.accepted_screws}
"""


def stage_of(folder: Path, kind: str, **options: Any) -> ProbeStage:
    text = section(kind, **{"speed": 150, "horizontal_move_z": 5, **SCREWS, **options})
    other = section("bed_screws" if kind != "bed_screws" else "screws_tilt_adjust", **SCREWS)
    return ProbeStage(folder, machine_text(sections=text + other + SEE), bed=TILTED)


@pytest.mark.parametrize(
    ("command", "options", "said"),
    [
        ("", {}, {"screw at 170.000,20.000": "CCW 01:36", "back right": "CCW 00:48"}),
        ("", {"screw_thread": "CCW-M4"}, {"screw at 170.000,20.000": "CW 01:09", "back right": "CW 00:34"}),
        (" DIRECTION=CW", {}, {"front left": "CW 01:36", "back right": "CW 00:48"}),
        (
            " SAMPLES=2",
            {"screw_thread": "CW-M5"},
            {"screw at 170.000,20.000": "CCW 01:00", "back right": "CCW 00:30"},
        ),
    ],
)
def test_turns_are_reported_as_a_clock_face(
    tmp_path: Path, command: str, options: dict[str, Any], said: dict[str, str]
) -> None:
    stage = stage_of(tmp_path, "screws_tilt_adjust", **options)
    output = stage.do("G28", f"SCREWS_TILT_CALCULATE{command}")
    told = {}
    for line in output:
        if " : adjust " in line:
            told[line.partition(" : ")[0]] = line.rpartition("adjust ")[2]
    assert {name: turn.split()[0] for name, turn in told.items()} == {
        n: t.split()[0] for n, t in said.items()
    }
    for name, turn in said.items():
        assert minutes(told[name]) == pytest.approx(minutes(turn), abs=1)
    assert len([line for line in output if "(base)" in line]) == 1


def minutes(turn: str) -> int:
    full, _, rest = turn.split()[1].partition(":")
    return int(full) * 60 + int(rest)


def test_places_may_be_those_of_the_probe(tmp_path: Path) -> None:
    stage = stage_of(tmp_path, "screws_tilt_adjust", use_probe_xy_offsets=True, screw1="30, 30")
    output = stage.do("G28", "SCREWS_TILT_CALCULATE HORIZONTAL_MOVE_Z=4")
    assert next(line.split()[2] for line in output if line.startswith("probe at")) == "30.000,30.000"


def test_a_limit_ends_a_program_and_macros_see_it(tmp_path: Path) -> None:
    stage = stage_of(tmp_path, "screws_tilt_adjust")
    output = stage.do("G28", "SCREWS_TILT_CALCULATE MAX_DEVIATION=0.9", "SEE")
    assert output[-1].startswith("echo: False 0.9 CCW 01:3")
    assert output[-1].endswith(" True")
    with pytest.raises(Exception, match=r"a screw is 0\.\d+ mm off, more than MAX_DEVIATION \(0\.7 mm\)"):
        stage_of(tmp_path, "screws_tilt_adjust").do("G28", "SCREWS_TILT_CALCULATE MAX_DEVIATION=0.7")
    with pytest.raises(Exception, match="DIRECTION of SCREWS_TILT_CALCULATE is 'UP'; give CW or CCW"):
        stage_of(tmp_path, "screws_tilt_adjust").do("G28", "SCREWS_TILT_CALCULATE DIRECTION=UP")


def place(output: list[str]) -> str:
    """Return where the nozzle is, by the last M114."""
    return next(line for line in reversed(output) if line.startswith("X:")).partition(" E")[0]


def test_the_nozzle_goes_from_screw_to_screw_until_all_are_accepted(tmp_path: Path) -> None:
    options = {"probe_height": 0.2, "screw1_fine_adjust": "12, 22", "probe_speed": 4}
    stage = stage_of(tmp_path, "bed_screws", **options)
    steps = [
        ("BED_SCREWS_ADJUST", "X:10.000 Y:20.000 Z:0.200", "True adjust 0 0"),
        ("ACCEPT", "X:170.000 Y:20.000 Z:0.200", "True adjust 1 1"),
        ("ADJUSTED", "X:170.000 Y:180.000 Z:0.200", "True adjust 2 0"),
        ("ACCEPT", "X:10.000 Y:20.000 Z:0.200", "True adjust 0 1"),
        ("ACCEPT", "X:170.000 Y:20.000 Z:0.200", "True adjust 1 2"),
        ("ACCEPT", "X:12.000 Y:22.000 Z:0.200", "True fine 0 0"),
        ("ACCEPT", "X:12.000 Y:22.000 Z:5.000", "False None None None"),
        ("BED_SCREWS_ADJUST", "X:10.000 Y:20.000 Z:0.200", "True adjust 0 0"),
        ("ABORT", "X:10.000 Y:20.000 Z:5.000", "False None None None"),
    ]
    lines = [line for command, *_ in steps for line in (command, "M114", "STATE")]
    output = stage.do("G28", *lines)
    told = [line for line in output if line.startswith(("X:", "echo: "))]
    found = [(told[2 * n].partition(" E")[0], told[2 * n + 1][6:]) for n in range(len(steps))]
    assert found == [(at, state) for _, at, state in steps]
    assert "all bed screws are adjusted" in output
    assert any(line.startswith("adjust front left; then ACCEPT") for line in output)


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        (("BED_SCREWS_ADJUST",), "BED_SCREWS_ADJUST comes before X is homed; home with G28 first"),
        (("ADJUSTED",), "ADJUSTED is for BED_SCREWS_ADJUST; begin with that"),
        (("G28", "BED_SCREWS_ADJUST", "BED_SCREWS_ADJUST"), "already in progress"),
        (("G28", "BED_SCREWS_ADJUST", "MANUAL_PROBE"), "a height is looked for already"),
        (("SCREWS_TILT_CALCULATE",), "SCREWS_TILT_CALCULATE comes before Z is homed"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, lines: tuple[str, ...], sentence: str) -> None:
    with pytest.raises(Exception, match=sentence):
        stage_of(tmp_path, "bed_screws").do(*lines)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"screw1": "10"}, "option 'screw1' of [bed_screws] must be X and Y in mm with a comma between them"),
        ({"screw4_name": "d"}, "'screw4_name' of [bed_screws] refers to screw4, which is not configured"),
        ({"screws": "4"}, "[bed_screws] has no option 'screws'; remove it"),
        ({"screw_thread": "CW-M3"}, "[bed_screws] has no option 'screw_thread'; remove it"),
    ],
)
def test_mistakes_name_their_option(tmp_path: Path, options: dict[str, Any], sentence: str) -> None:
    path = tmp_path / "machine.cfg"
    path.write_text(machine_text(sections=section("bed_screws", **{**SCREWS, **options})))
    with pytest.raises(ConfigError) as error:
        load_machine(str(path))
    assert sentence in str(error.value)


def test_two_screws_are_too_few(tmp_path: Path) -> None:
    path = tmp_path / "machine.cfg"
    screws = {key: SCREWS[key] for key in ("screw1", "screw2")}
    path.write_text(machine_text(sections=section("screws_tilt_adjust", **screws)))
    with pytest.raises(ConfigError, match=r"\[screws_tilt_adjust\] has 2 screws; give 3 or more"):
        load_machine(str(path))
