"""Macros in programs: what they stand for and see, whose names they take, what is told of mistakes."""

import asyncio
import threading
from collections.abc import Mapping
from pathlib import Path

import pytest

from coordinator.config.errors import ConfigError
from coordinator.modules.status.display_status import DisplayStatus
from coordinator.modules.status.printer_status import PrinterStatus
from coordinator.support.values import Value
from tests.stages.program_stage import ProgramStage


def stage(folder: Path, sections: str) -> ProgramStage:
    return ProgramStage(folder, sections)


def config_error(folder: Path, sections: str) -> str:
    with pytest.raises(ConfigError) as error:
        ProgramStage(folder, sections)
    return str(error.value)


def line_of(machine: ProgramStage, text: str) -> int:
    lines = Path(machine.path).read_text(encoding="utf-8").splitlines()
    return next(number for number, line in enumerate(lines, 1) if text in line)


PARK = """
[gcode_macro park]
description: goes there
variable_x: 50
variable_names: ['a', 'b']
gcode:
    # a comment, which leaves a gap
    {% set z = params.Z|default(5)|float %}
    G90
    G1 X{x} Z{z} F{ params.F|default(6000) }
    {action_respond_info("parked at %.1f %s" % (z, names|join("-")))}
    M114
"""


def test_a_macro_is_a_command_with_parameters_and_variables(tmp_path: Path) -> None:
    machine = stage(tmp_path, PARK)
    assert machine.run(
        "G28", "PARK", "park z=7", "SET_GCODE_VARIABLE MACRO=Park VARIABLE=x VALUE=60", "PARK"
    ) == [
        "parked at 5.0 a-b",
        "X:50.000 Y:0.000 Z:5.000 E:0.000",
        "parked at 7.0 a-b",
        "X:50.000 Y:0.000 Z:7.000 E:0.000",
        "parked at 5.0 a-b",
        "X:60.000 Y:0.000 Z:5.000 E:0.000",
    ]
    assert machine.modules.status()["gcode_macro park"] == {"x": 60, "names": ["a", "b"]}


@pytest.mark.parametrize(
    ("value", "expected"),
    [("1", 1), ("-0.5", -0.5), ("True", True), ('"[1, 2]"', [1, 2]), ("'text'", "text"), ("\"'a b'\"", "a b"),
     ("{'a':1}", {"a": 1}), ("None", None)],
)  # fmt: skip
def test_values_of_variables(tmp_path: Path, value: str, expected: object) -> None:
    machine = stage(tmp_path, PARK)
    machine.run(f"SET_GCODE_VARIABLE MACRO=park VARIABLE=x VALUE={value}")
    assert machine.modules.status()["gcode_macro park"]["x"] == expected


@pytest.mark.parametrize(
    ("line", "part"),
    [
        ("SET_GCODE_VARIABLE MACRO=pork VARIABLE=x VALUE=1", "did you mean PARK"),
        ("SET_GCODE_VARIABLE MACRO=park VARIABLE=y VALUE=1", "it has x, names"),
        ("SET_GCODE_VARIABLE MACRO=park VARIABLE=x VALUE=word", "is 'word', which is no value"),
        ("SET_GCODE_VARIABLE MACRO=park VARIABLE=x", "has no VALUE"),
        ("SET_GCODE_VARIABLE MACRO=park VARIABLE=x VALUE=" + "(" * 300, "is no value"),
    ],
)
def test_mistakes_with_variables(tmp_path: Path, line: str, part: str) -> None:
    assert part in stage(tmp_path, PARK).error(line)


def test_macros_see_the_machine_as_it_will_be_when_their_line_comes(tmp_path: Path) -> None:
    machine = stage(
        tmp_path,
        """
[gcode_macro LOOK]
gcode:
    {action_respond_info(printer.toolhead.position.x|string ~ printer.toolhead.homed_axes)}
    {action_respond_info(printer.gcode_move.absolute_coordinates|string)}
    {action_respond_info(printer["gcode_macro other"].count|string)}
    {action_respond_info(printer.configfile.settings.printer.max_velocity|string)}
    {action_respond_info(printer.configfile.config["stepper_x"].position_max)}
    {action_respond_info(("extruder" in printer)|string ~ ("probe" in printer)|string)}
[gcode_macro other]
variable_count: 3
gcode:
""",
    )
    assert machine.run("G28", "G1 X12 F6000", "G91", "LOOK") == [
        "12.0xyz", "False", "3", "300.0", "200", "TrueFalse",
    ]  # fmt: skip


def test_macros_may_be_called_by_macros_and_take_what_they_get(tmp_path: Path) -> None:
    machine = stage(
        tmp_path,
        """
[gcode_macro outer]
gcode:
    INNER A={params.A} MSG="two words"
    M104 S{params.A}
[gcode_macro inner]
gcode:
    {action_respond_info(params.MSG ~ params.A ~ "|" ~ rawparams)}
[gcode_macro m104]
gcode:
    {action_respond_info("S=" ~ params.S ~ (params.T is defined)|string)}
[gcode_macro m117]
rename_existing: M117.1
gcode:
    {action_respond_info("shown: " ~ rawparams)}
    M117.1 {rawparams}
""",
    )
    assert machine.run("OUTER A=5", "M117 it; is (all) = fine") == [
        'two words5|A=5 MSG="two words"',
        "S=5False",
        "shown: it; is (all) = fine",
    ]


def test_a_macro_takes_a_built_in_commands_name(tmp_path: Path) -> None:
    machine = stage(
        tmp_path,
        """
[gcode_macro G28]
rename_existing: G28.1
gcode:
    {action_respond_info("homing")}
    G28.1 {rawparams}
[gcode_macro M114]
rename_existing: WHERE
gcode:
    WHERE
    WHERE
""",
    )
    assert machine.run("G28 X", "M114") == [
        "homing",
        "X:0.000 Y:0.000 Z:0.000 E:0.000",
        "X:0.000 Y:0.000 Z:0.000 E:0.000",
    ]
    assert machine.planner.homed == "X"


def test_macros_may_take_names_from_one_another(tmp_path: Path) -> None:
    machine = stage(
        tmp_path,
        """
[gcode_macro SET_GCODE_VARIABLE]
rename_existing: _SET
gcode:
    _SET {rawparams}
    {action_respond_info("set")}
"""
        + PARK,
    )
    assert machine.run("SET_GCODE_VARIABLE MACRO=park VARIABLE=x VALUE=1") == ["set"]
    assert machine.modules.status()["gcode_macro park"]["x"] == 1


def test_mistakes_of_the_configuration(tmp_path: Path) -> None:
    macro = "[gcode_macro a]\ngcode:\n    G28\n    {% if %}\n"
    assert ": the template of [gcode_macro a]: Expected an expression" in config_error(tmp_path, macro)
    path = tmp_path / "printer.cfg"
    line = path.read_text(encoding="utf-8").splitlines().index("    {% if %}") + 1
    assert config_error(tmp_path, macro).startswith(f"{path}:{line}: ")
    assert "no name that can be a command" in config_error(tmp_path, "[gcode_macro a-b]\ngcode:\n    G28\n")
    assert "lacks option 'gcode'" in config_error(tmp_path, "[gcode_macro a]\n")
    assert "did you mean 'gcode'" in config_error(tmp_path, "[gcode_macro a]\ngcode:\nqcode: G28\n")
    assert "'variable_x' of [gcode_macro a] is 'word', which is no value" in config_error(
        tmp_path, "[gcode_macro a]\nvariable_x: word\ngcode:\n"
    )
    assert "there is no command A; remove" in config_error(
        tmp_path, "[gcode_macro a]\nrename_existing: b\ngcode:\n"
    )
    assert "is M105, which is a command already" in config_error(
        tmp_path, "[gcode_macro M104]\nrename_existing: M105\ngcode:\n"
    )


HEATER = """heater_pin: PH1
sensor_type: Generic 3950
sensor_pin: PH2
control: watermark
min_temp: 0
max_temp: 250
"""


@pytest.mark.parametrize(
    ("name", "sections", "whose"),
    [
        ("G28", "", "canductor's own"),
        ("G1", "", "canductor's own"),
        ("SAVE_GCODE_STATE", "", "canductor's own"),
        ("SET_GCODE_VARIABLE", "", "canductor's own"),
        ("M112", "", "canductor's own"),
        ("M104", "[extruder]\n" + HEATER, "canductor's own"),
        ("M140", "[heater_bed]\n" + HEATER, "that of [heater_bed]"),
    ],
)
def test_no_command_is_taken_away_without_another_name(
    tmp_path: Path, name: str, sections: str, whose: str
) -> None:
    told = config_error(tmp_path, f"{sections}[gcode_macro {name}]\ngcode:\n    {name}\n")
    assert (
        f"[gcode_macro {name}] takes the name of the command {name}, which is {whose}; add rename_ex" in told
    )


def test_a_name_of_which_the_machine_makes_nothing_is_free(tmp_path: Path) -> None:
    macros = "".join(f"[gcode_macro {name}]\ngcode:\n    G4 P1\n" for name in ("M106", "M117", "T0", "M600"))
    assert stage(tmp_path, macros).notices("M106 S255", "M117 it", "T0", "M600") == []


def test_what_goes_wrong_names_program_and_configuration(tmp_path: Path) -> None:
    machine = stage(
        tmp_path,
        """
[gcode_macro FAR]
gcode:
    # a gap
    {% for x in [10, 9999] %}
    G1 X{x} F6000
    {% endfor %}
[gcode_macro ZERO]
gcode:
    G28
    G4 P{1 / params.X|int}
[gcode_macro REFUSE]
gcode:
    {% if not params.FILE %}
    {action_raise_error("no file is named")}
    {% endif %}
[gcode_macro FOREVER]
gcode:
    {% for a in range(9999) %}{% for b in range(9999) %}{% endfor %}{% endfor %}
[gcode_macro AGAIN]
gcode:
    AGAIN
""",
    )
    path = machine.path
    line = line_of(machine, "G1 X{x}")
    assert machine.error("G28", "FAR").startswith(f"part.gcode:2: {path}:{line}: [gcode_macro FAR]: ")
    line = line_of(machine, "G4 P")
    assert machine.error("ZERO X=0") == (f"part.gcode:1: {path}:{line}: [gcode_macro ZERO]: division by zero")
    assert machine.error("REFUSE") == "part.gcode:1: no file is named"
    assert "turns of loops" in machine.error("FOREVER")
    line = line_of(machine, "    AGAIN")
    assert machine.error("AGAIN") == (
        f"part.gcode:1: {path}:{line}: [gcode_macro AGAIN]: AGAIN calls itself, 30 levels deep; end that"
    )


def test_macros_that_call_one_another_without_end(tmp_path: Path) -> None:
    macros = "".join(
        f"[gcode_macro M_{name}]\ngcode:\n    M_{inner}\n" for name, inner in ("AB", "BC", "CD", "DB")
    )
    machine = stage(tmp_path, macros)
    outer, inner = (line_of(machine, f"    M_{name}") for name in "BD")
    assert machine.error("M_A") == (
        f"part.gcode:1: {machine.path}:{outer}: [gcode_macro M_A]: …:"
        f" {machine.path}:{inner}: [gcode_macro M_C]:"
        " M_D calls itself by way of M_B and M_C, 30 levels deep; end that"
    )
    many = "".join(f"[gcode_macro N_{n}_]\ngcode:\n    N_{n + 1}_\n" for n in range(40))
    told = stage(tmp_path, many).error("N_0_")
    assert told.endswith("[gcode_macro N_29_]: N_30_ stands in 30 others, one in another; let there be fewer")
    assert told.count("[gcode_macro") == 2


def test_a_macro_can_stop_the_machine(tmp_path: Path) -> None:
    machine = stage(tmp_path, "[gcode_macro STOP]\ngcode:\n    {action_emergency_stop('too hot')}\n")
    job = machine.job("STOP")
    kinds = [type(job.step()).__name__ for _ in range(4)]
    assert "Emergency" in kinds


def test_a_macro_may_take_the_name_of_what_is_read_in_c(tmp_path: Path) -> None:
    machine = stage(
        tmp_path,
        """
[gcode_macro M204]
rename_existing: M204.1
gcode:
    M204.1 S{params.S|float / 2}
[gcode_macro G1]
rename_existing: G1.1
gcode:
    G1.1 {rawparams}
    {action_respond_info("moved")}
[gcode_macro G2]
rename_existing: G2.1
gcode:
    G1.1 X{params.X}
""",
    )
    assert machine.run("G28", "M204 S1000", "G1 X10 F6000", "G0 X20", "G2 X30 I5") == ["moved"]
    assert machine.planner.accel == 500
    assert machine.planner.toolhead_position[0] == 30


def test_the_example_of_the_page_works(tmp_path: Path) -> None:
    page = (Path(__file__).parents[4] / "docs" / "gcode.md").read_text(encoding="utf-8")
    machine = stage(tmp_path, page.split("```ini\n")[1].split("```")[0])
    assert machine.run("PARK") == ["home first"]
    assert machine.run("G28", "PARK Z=20") == []
    assert machine.planner.toolhead_position == (5, 0, 20, 0)


def test_machine_status_is_asked_for_on_its_loop(tmp_path: Path) -> None:
    machine = stage(
        tmp_path,
        """
[display_status]
[gcode_macro LOOK]
gcode:
    {action_respond_info(printer.display_status.message|string)}
""",
    )
    threads: list[int] = []
    status = machine.modules.find("display_status", DisplayStatus)
    assert status is not None
    plain_status = status.status

    def noted() -> Mapping[str, Value]:
        threads.append(threading.get_ident())
        return plain_status()

    status.status = noted  # type: ignore[method-assign]

    async def main() -> None:
        seen = next(machine.modules.of(PrinterStatus))
        await seen.connect(None)  # type: ignore[arg-type]
        told = await asyncio.to_thread(machine.run, "M117 hello", "LOOK", "M117 you", "LOOK")
        assert told == ["hello", "you"]
        assert threads == [threading.get_ident()] * 2
        seen.close()

    asyncio.run(main())
    # A loop that has gone, or is busy for too long, leaves what it told last.
    assert machine.run("M117 again", "LOOK") == ["again"]


def test_a_loop_that_is_busy_is_not_waited_for(tmp_path: Path) -> None:
    machine = stage(
        tmp_path, "[gcode_macro LOOK]\ngcode:\n    {action_respond_info(('x' in printer)|string)}\n"
    )

    async def main() -> None:
        seen = next(machine.modules.of(PrinterStatus))
        await seen.connect(None)  # type: ignore[arg-type]
        worker = threading.Thread(target=lambda: told.extend(machine.run("LOOK")))
        told: list[str] = []
        worker.start()
        worker.join(30)  # the loop does nothing else
        assert told == ["False"]

    asyncio.run(main())


ASKS = """
[bed_mesh]
mesh_min: 10, 20.5
mesh_max: 110, 120
probe_count: 5
faulty_region_1_min: 1, 2
faulty_region_1_max: 3, 4
[stepper_z1]
step_pin: PE0
dir_pin: PE1
microsteps: 16
rotation_distance: 8
[z_tilt_ng]
points:
    50, 25
    50, 225
[neopixel light]
pin: PA8
[dockable_probe]
pin: PA9
[fan_generic mine]
pin: sx1509_a:PIN_1
[sx1509 a]
i2c_address: 62
[gcode_macro ask]
gcode:
    {% set s = printer.configfile.settings %}
    {% set mesh = s.bed_mesh %}
    {action_respond_info("%s|%s|%s" % (mesh.mesh_min, mesh.probe_count, mesh.faulty_region_1_min))}
    {action_respond_info("%s|%s" % (s.z_tilt_ng.points, s.stepper_x.step_pin))}
    {action_respond_info("%s|%s" % (s.stepper_x.gear_ratio, s.stepper_y.gear_ratio))}
    {action_respond_info("%s|%s" % (printer.bed_mesh.profiles, printer.bed_mesh.mesh_min))}
    {action_respond_info("%s|%s" % (printer.z_tilt_ng.applied, printer["neopixel light"].color_data))}
    {action_respond_info("%s|%s" % (printer.probe.last_query, printer["fan_generic mine"].speed))}
    {action_respond_info("[%s]" % printer.bed_mesh.nothing.of.that.kind|default("", true))}
    {action_call_remote_method("notify", text="x")}
"""


def test_asking_for_what_a_section_that_exists_does_not_tell_ends_nothing(tmp_path: Path) -> None:
    machine = stage(tmp_path, ASKS + "[stepper_y]\ngear_ratio: 50:17, 3:1\n")
    told = machine.run("ASK")
    assert told[:6] == [
        "[10.0, 20.5]|[5, 5]|[1.0, 2.0]",
        "[[50.0, 25.0], [50.0, 225.0]]|PA0",
        "[]|[[50.0, 17.0], [3.0, 1.0]]",
        "{}|[0.0, 0.0]",
        "False|[[0.0, 0.0, 0.0, 0.0]]",
        "False|0.0",
    ]
    assert told[-1] == "the remote method notify was not called: no client has registered one"


def test_an_object_that_does_not_exist_is_still_a_mistake(tmp_path: Path) -> None:
    machine = stage(tmp_path, "[gcode_macro ask]\ngcode:\n    M117 {printer.nothing.at_all}\n")
    assert "nothing" in machine.error("ASK")


def test_replies_of_a_rendering_and_their_lengths_are_bounded(tmp_path: Path) -> None:
    """Failed before: 20,000 of them, and a sentence of a million characters, held the control loop."""
    machine = stage(
        tmp_path,
        """
[gcode_macro MANY]
gcode:
    {% for _ in range(params.N|int) %}{action_respond_info("a")}{% endfor %}
[gcode_macro LONG]
gcode:
    {action_respond_info("b" * 900000)}
[gcode_macro FAIL]
gcode:
    {action_raise_error("c" * 900000)}
""",
    )
    assert machine.run("MANY N=1000") == ["a"] * 1_000
    assert "more than 1,000 lines to show" in machine.error("MANY N=1001")
    assert machine.run("LONG") == ["b" * 2_000]
    assert machine.error("FAIL").endswith(" " + "c" * 2_000)
