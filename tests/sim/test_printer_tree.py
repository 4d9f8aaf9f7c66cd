"""What macros see as ``printer`` on a machine that is connected: the page tells all of it, and no more."""

import re
from pathlib import Path

from tests.stages.printer import Printer, gcode
from tests.stages.served import Served

SECTIONS = """
[pause_resume]
[virtual_sdcard]
path: jobs
[exclude_object]
[display_status]
[respond]
[gcode_arcs]
[firmware_retraction]
[idle_timeout]
[save_variables]
filename: kept.cfg
[fan_generic box]
pin: PB4
[temperature_fan chamber]
pin: PB5
sensor_type: Generic 3950
sensor_pin: PB6
min_temp: 0
max_temp: 100
target_temp: 40
control: watermark
[temperature_sensor enclosure]
sensor_type: Generic 3950
sensor_pin: PB7
[heater_generic dryer]
heater_pin: PB8
sensor_type: Generic 3950
sensor_pin: PB9
control: watermark
min_temp: 0
max_temp: 90
[controller_fan board]
pin: PB10
[extruder_stepper second]
step_pin: PC4
dir_pin: PC5
microsteps: 16
rotation_distance: 22
extruder: extruder
[skew_correction]
[output_pin light]
pin: PB13
value: 0
[gcode_button door]
pin: PB11
press_gcode: M117
[filament_switch_sensor in]
switch_pin: PB12
[delayed_gcode later]
gcode:
    M117
[gcode_macro TREE]
variable_x: 1
gcode:
    {% for name in printer|sort %}
    {action_respond_info(name ~ ": " ~ printer[name].keys()|sort|join(" "))}
    {% endfor %}
[gcode_macro VALUES]
description: what is there
gcode:
    G28
    M119
    READ
[gcode_macro READ]
gcode:
    {% set p = printer %}
    {% set s = p.configfile.settings %}
    {% for value in [
        p.toolhead.position.x|abs|round(1), p.toolhead.homed_axes, p.toolhead.axis_maximum.y,
        p.gcode_move.homing_origin.z,
        p.gcode_move.absolute_coordinates, p.fan.speed, p.extruder.target, p.extruder.can_extrude,
        p.extruder.pressure_advance, p.print_stats.state, p.idle_timeout.state, p.pause_resume.is_paused,
        p.stepper_enable.steppers.stepper_x, p.query_endstops.last_query.y, s.extruder.max_temp,
        s.extruder.min_extrude_temp, s.stepper_x.homing_speed, s.printer.kinematics,
        s["fan_generic box"].max_power, p.configfile.config.extruder.max_temp,
        p.mcu.mcu_constants.CLOCK_FREQ > 1e6, p.system_stats.memavail > 0,
        p["mcu toolhead"].mcu_version != "", p.webhooks.state, p.gcode.commands.VALUES.help,
        p.probe is defined, p.respond is defined, p["gcode_macro TREE"].x, p.virtual_sdcard.is_active,
        p.configfile.save_config_pending_items,
    ] %}
    {action_respond_info(value|string)}
    {% endfor %}
"""
PAGE = (
    Path("docs/gcode.md").read_text(encoding="utf-8").partition("## What macros see")[2].partition("\n## ")[0]
)


def documented() -> dict[str, set[str]]:
    """Return the fields of each thing, by the first word of its name."""
    found: dict[str, set[str]] = {}
    for names, text in re.findall(r"^\| (`.*?) \| (.*) \|$", PAGE, re.MULTILINE)[1:]:
        fields = {field.strip() for field in re.sub(r"\([^)]*\)", "", text).split(",")} - {""}
        for name in re.findall(r"`(.*?)`", names):
            found[name.removesuffix(" NAME")] = fields
    return found


def test_the_page_tells_all_that_there_is(tmp_path: Path) -> None:
    printer = Printer(tmp_path, SECTIONS)

    async def go(stage: Served) -> None:
        there = dict(line.split(": ", 1) for line in await gcode(stage, "TREE"))
        fields, seen = documented(), set()
        for name, keys in there.items():
            if name.startswith("gcode_macro") or not keys:
                continue
            kind = name.partition(" ")[0]
            assert set(keys.split()) == fields[kind], name
            seen.add(kind)
        of_others = {
            "probe",
            "bed_mesh",
            "bed_screws",
            "screws_tilt_adjust",
            "z_tilt",
            "quad_gantry_level",
        } | {
            "z_tilt_ng",
            "z_thermal_adjust",
            "endstop_phase",
            "load_cell",
            "load_cell_probe",
            "temperature_probe",
        }
        elsewhere = {
            "gcode_macro",
            "extruder1",
            "dual_carriage",
            "tmc2208",
        } | of_others  # machines with a probe: test_probe.py
        assert fields.keys() - seen == elsewhere, "documented only"

    printer.serve(go)


def test_the_page_that_compares_knows_every_command(tmp_path: Path) -> None:
    printer = Printer(tmp_path, SECTIONS)
    page = Path("docs/compared.md").read_text(encoding="utf-8").partition("## Commands")[2]
    rows = set(re.findall(r"^\| `(\w+)` \| (?:works|differs)", page, re.MULTILINE))
    macros = {"TREE", "VALUES", "READ"}

    async def go(stage: Served) -> None:
        assert stage.service.machine is not None
        known = {name for name in stage.service.machine.modules.command_help if not name.startswith("_")}
        assert len(known) > 60
        assert sorted(known - rows - macros) == []

    printer.serve(go)


VALUES = (
    *("0.0", "xyz", "250.0", "0.0", "True", "0.0", "0.0", "False", "0.04", "standby", "Printing", "False"),
    *("True", "True", "300.0", "170.0", "50.0", "corexy", "1.0", "300", "True", "True", "True", "ready"),
    *("what is there", "False", "True", "1", "False", "{'heater_bed': {'pid_kp': '12'}}"),
)


def test_what_macros_read_is_how_it_is(tmp_path: Path) -> None:
    printer = Printer(tmp_path, SECTIONS)

    async def go(stage: Served) -> None:
        assert stage.service.machine is not None
        stage.service.machine.unsaved.put("heater_bed", "pid_kp", "12")
        _, *told = await gcode(stage, "VALUES")
        assert tuple(told) == VALUES

    printer.serve(go)
