"""Modules that programs talk to and that need no node: retraction, arcs, display, respond, variables."""

import tracemalloc
from pathlib import Path

import pytest

from coordinator.config.errors import ConfigError
from coordinator.gcode.errors import GCodeError
from coordinator.modules.programs.save_variables import FILE_BYTES_MAX, read_variables
from tests.stages.program_stage import ProgramStage


def at(machine: ProgramStage) -> tuple[float, ...]:
    return tuple(round(value, 9) for value in machine.planner.toolhead_position)


RETRACTION = """
[firmware_retraction]
retract_length: 0.8
retract_speed: 40
unretract_extra_length: 0.1
unretract_speed: 30
z_hop_height: 0.2
"""


def test_filament_is_drawn_back_and_pushed_forward(tmp_path: Path) -> None:
    machine = ProgramStage(tmp_path, RETRACTION)
    machine.run("G28", "G1 X10 Y10 Z1 F6000", "G1 E5", "G10", "G10")
    assert at(machine) == (10, 10, 1.2, 4.2)
    machine.run("G1 X20 Z1 F1200")
    assert at(machine) == (20, 10, 1.2, 4.2)
    assert machine.modules.status()["firmware_retraction"]["retracted"] is True
    machine.run("SET_RETRACTION RETRACT_LENGTH=2 UNRETRACT_EXTRA_LENGTH=0", "G11", "G11")
    assert at(machine) == (20, 10, 1.0, 5.0)
    assert machine.run("M114") == ["X:20.000 Y:10.000 Z:1.000 E:5.000"]
    assert machine.planner.speed_mm_s == 20
    machine.run("G1 X50 E6")
    assert at(machine)[3] == 6.0
    assert machine.run("GET_RETRACTION") == [
        "RETRACT_LENGTH=2 RETRACT_SPEED=40 UNRETRACT_EXTRA_LENGTH=0 UNRETRACT_SPEED=30 Z_HOP_HEIGHT=0.2"
    ]


def test_retraction_can_be_forgotten(tmp_path: Path) -> None:
    machine = ProgramStage(tmp_path, RETRACTION)
    machine.run("G28", "G1 Z1 F600", "G1 E5", "SET_RETRACTION RETRACT_LENGTH=2", "G10", "CLEAR_RETRACTION")
    assert machine.modules.status()["firmware_retraction"]["retracted"] is False
    assert machine.run("GET_RETRACTION")[0].startswith("RETRACT_LENGTH=0.8 ")
    before = at(machine)
    machine.run("G11")
    assert at(machine) == before, "nothing is drawn back any more"


def test_settings_of_retraction_go_back_to_the_configured_ones(tmp_path: Path) -> None:
    machine = ProgramStage(tmp_path, RETRACTION)
    machine.run("G28", "G1 Z1 F600", "G1 E5", "SET_RETRACTION RETRACT_LENGTH=2", "G10", "RESET_RETRACTION")
    assert machine.modules.status()["firmware_retraction"]["retracted"] is True
    assert machine.run("GET_RETRACTION")[0].startswith("RETRACT_LENGTH=0.8 ")


def test_retraction_goes_by_no_mode(tmp_path: Path) -> None:
    machine = ProgramStage(tmp_path, RETRACTION)
    machine.run("G28", "G1 Z1 F600", "G91", "G20", "M82", "G10", "G1 X1", "G11")
    assert at(machine) == (25.4, 0, 1.0, 0.1)
    assert machine.planner.relative
    assert machine.planner.unit_mm == 25.4
    with pytest.raises(GCodeError, match=r"RETRACT_LENGTH of SET_RETRACTION is -1; 0 to 100"):
        machine.run("SET_RETRACTION RETRACT_LENGTH=-1")


def test_arcs_are_as_fine_as_configured(tmp_path: Path) -> None:
    machine = ProgramStage(tmp_path, "[gcode_arcs]\nresolution: 10\nmax_deviation: 1\n")
    machine.run("G28", "G1 X100 Y100 F6000", "G2 I20")
    assert machine.planner.moves == 1 + 13
    plain = ProgramStage(tmp_path)
    plain.run("G28", "G1 X100 Y100 Z50 F6000", "G18", "G2 I20 K0 E1", "G17")
    assert plain.planner.moves > 100
    with pytest.raises(GCodeError, match=r"part\.gcode:2: G2 needs its center"):
        plain.run("G28", "G2 X5")


def test_messages_and_progress_are_kept(tmp_path: Path) -> None:
    machine = ProgramStage(tmp_path, "[display_status]\n")
    machine.run("M117 Layer 1; of 2", "M73 P25 R10")
    assert machine.modules.status()["display_status"] == {"message": "Layer 1; of 2", "progress": 0.25}
    machine.run('SET_DISPLAY_TEXT MSG="a b"')
    assert machine.modules.status()["display_status"]["message"] == "a b"
    machine.run("M117")
    assert machine.modules.status()["display_status"]["message"] is None
    with pytest.raises(GCodeError, match="0 to 100 %"):
        machine.run("M73 P101")


def test_lines_are_shown(tmp_path: Path) -> None:
    assert ProgramStage(tmp_path).run("M118 Hello") == ["echo: Hello"]
    machine = ProgramStage(tmp_path, "[respond]\ndefault_type: command\n")
    assert machine.run(
        "M118 Hello",
        'RESPOND MSG="a b"',
        "RESPOND TYPE=error MSG=bad",
        "RESPOND PREFIX=tgtg: MSG=x",
        "RESPOND",
    ) == ["// Hello", "// a b", "!! bad", "tgtg: x", "// "]
    with pytest.raises(GCodeError, match="there are echo command error"):
        machine.run("RESPOND TYPE=what MSG=x")


# ---- Variables in a file ----


def variables(folder: Path) -> ProgramStage:
    return ProgramStage(
        folder,
        """
[save_variables]
filename: kept.cfg
[gcode_macro LOOK]
gcode:
    {action_respond_info(printer.save_variables.variables.x|string)}
""",
    )


def test_a_plan_keeps_variables_to_itself(tmp_path: Path) -> None:
    (tmp_path / "kept.cfg").write_text("[Variables]\nx = 1.5\nname = 'a = b'\n", encoding="utf-8")
    machine = variables(tmp_path)
    assert machine.modules.status()["save_variables"] == {"variables": {"x": 1.5, "name": "a = b"}}
    assert machine.run("LOOK", "SAVE_VARIABLE VARIABLE=X VALUE=2", "LOOK") == ["1.5", "2"]
    assert read_variables(tmp_path / "kept.cfg")["x"] == 1.5


def test_a_file_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    """Failed before: the start was refused, for a value of '' in line 1."""
    (tmp_path / "kept.cfg").write_text("[Variables]\nx = 'é'\n", encoding="utf-8-sig")
    assert read_variables(tmp_path / "kept.cfg") == {"x": "é"}


@pytest.mark.parametrize(("section", "option"), [("save_variables", "filename"), ("virtual_sdcard", "path")])
def test_a_path_below_a_home_that_does_not_exist(tmp_path: Path, section: str, option: str) -> None:
    with pytest.raises(ConfigError) as error:
        ProgramStage(tmp_path, f"\n[{section}]\n{option}: ~nosuchuser/x\n")
    assert f"option '{option}' of [{section}] is '~nosuchuser/x', but there is no such home" in str(
        error.value
    )


@pytest.mark.parametrize(
    ("line", "part"),
    [
        ("SAVE_VARIABLE VARIABLE=a-b VALUE=1", "letters, digits and _"),
        ("SAVE_VARIABLE VARIABLE=a VALUE=b", "is 'b', which is no value"),
        ("SAVE_VARIABLE VARIABLE=a", "has no VALUE"),
    ],
)
def test_mistakes_with_variables(tmp_path: Path, line: str, part: str) -> None:
    with pytest.raises(GCodeError) as error:
        variables(tmp_path).run(line)
    assert part in str(error.value)


def test_no_variables_are_kept_that_the_next_start_refuses(tmp_path: Path) -> None:
    """Failed before: a file beyond what a start reads; 1e15 is four characters, but is written in 18."""
    machine = variables(tmp_path)
    big = "y" * 3_900
    lines = [f"SAVE_VARIABLE VARIABLE=v{number} VALUE=\"'{big}'\"" for number in range(300)]
    assert "has no room for" in machine.error(*lines)
    longer = ",".join(["1e15"] * 700)
    assert "once it is written, is longer than 10000" in machine.error(
        f"SAVE_VARIABLE VARIABLE=x VALUE=[{longer}]"
    )
    saved = machine.modules.status()["save_variables"]["variables"]
    assert isinstance(saved, dict)
    assert FILE_BYTES_MAX // 4_000 <= len(saved) < 300
    assert "x" not in saved, "what is refused is not kept"
    machine.run("SAVE_VARIABLE VARIABLE=v0 VALUE=1", "SAVE_VARIABLE VARIABLE=z VALUE=1")
    text = "".join(f"{name} = {value!r}\n" for name, value in saved.items())
    (tmp_path / "kept.cfg").write_text(text, encoding="utf-8")
    assert variables(tmp_path).modules.status()["save_variables"] == {"variables": saved}


def test_saving_a_variable_leaves_the_others_as_they_are(tmp_path: Path) -> None:
    """Failed before: all of them were written out for each line, 24 ms where they fill the file."""
    text = "".join(f"v{number} = {'y' * 3_900!r}\n" for number in range(240))
    (tmp_path / "kept.cfg").write_text(text, encoding="utf-8")
    machine = variables(tmp_path)
    tracemalloc.start()
    machine.run("SAVE_VARIABLE VARIABLE=v7 VALUE=1", "SAVE_VARIABLE VARIABLE=v8 VALUE=2")
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < FILE_BYTES_MAX // 2


@pytest.mark.parametrize(
    ("text", "part"),
    [
        (b"x", ":1: there is no = in this line"),
        (b"\nx = what", ":2: the value is 'what'"),
        (b"x = 1\ny: 2", ":2: there is no ="),
        (b"[Variables]\nx = 'caf\xe9'\n", ":2: byte 0xe9 is not UTF-8 text; save the file as UTF-8"),
    ],
)
def test_a_file_that_is_spoilt_is_told(tmp_path: Path, text: bytes, part: str) -> None:
    """Failed before: what is no UTF-8 was read as another text, which the next SAVE_VARIABLE wrote."""
    (tmp_path / "kept.cfg").write_bytes(text)
    with pytest.raises(ConfigError) as error:
        variables(tmp_path)
    assert part in str(error.value)
    assert str(tmp_path / "printer.cfg") in str(error.value)
