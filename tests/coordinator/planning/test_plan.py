"""``canductor plan``: every figure is checked against the streams it wrote, or against arithmetic."""

import io
import json
import math
import re
import struct
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.options import FloatOption, IntOption
from coordinator.config.sections.extruder import EXTRUDER
from coordinator.config.sections.printer import PRINTER
from coordinator.config.sections.rails import RAIL
from coordinator.planning.figures import Peak
from coordinator.planning.options import PlanOptions
from coordinator.planning.plan import plan_file
from coordinator.planning.plot import draw
from coordinator.planning.report import PlanReport, Timeline
from coordinator.planning.warnings import NodeClock, step_rate_warnings, ticks_per_step
from coordinator.support.examples import DEMO_MACHINE
from nodes.support.errors import CanductorError
from nodes.virtual.firmware import MAINBOARD, firmware_dictionary

SQUARE = """\
G28
G90
M83
G1 Z1 F600
G1 X10 Y10 F6000
G1 X60 E2 F6000
G1 Y60 E2
G1 X10 E2
G1 Y10 E2
G1 E-5 F1800
"""

BOUNDED = [
    (section, option)
    for section, spec in (("printer", PRINTER), ("stepper_x", RAIL), ("extruder", EXTRUDER))
    for option in spec.options
    if isinstance(option, FloatOption | IntOption)
]
RECORD = struct.Struct("<QQB")
DATA = Path(__file__).parents[3] / ".." / "shared" / "data"


def plan(tmp_path: Path, text: str = SQUARE, **options: Any) -> PlanReport:
    gcode = tmp_path / "square.gcode"
    gcode.write_text(text)
    return plan_file(replace(PlanOptions(config=DEMO_MACHINE, gcode=gcode, json=True), **options))


def records(path: Path) -> list[tuple[int, bytes]]:
    """Return what a batch file asks for: when each command is due (ticks), and the command."""
    data, at, found = path.read_bytes(), 0, []
    while at < len(data):
        _, req_clock, size = RECORD.unpack_from(data, at)
        at += RECORD.size
        found.append((req_clock, data[at : at + size]))
        at += size
    return found


def test_peaks_are_those_of_the_moves(tmp_path: Path) -> None:
    report = plan(tmp_path)
    axes = {axis.name: axis for axis in report.axes}
    assert axes["X"].speed.value == pytest.approx(100)
    assert axes["X"].speed.line == 6
    assert axes["Y"].speed.value == pytest.approx(100)
    assert axes["Y"].speed.line == 7
    assert axes["Z"].speed.value == pytest.approx(10)
    assert axes["Z"].speed.line == 4
    assert axes["E"].speed.line == 10
    assert axes["X"].accel.value == pytest.approx(5000)
    assert report.path_speed.value == pytest.approx(100)
    assert report.flow.value == pytest.approx(100 * 2 / 50 * math.pi / 4 * 1.75**2)
    assert report.flow.line == 6
    assert max(report.timeline.speed_mm_s) == pytest.approx(100)
    assert max(report.timeline.flow_mm3_s) == pytest.approx(report.flow.value, rel=1e-4)


def test_steps_bytes_and_loads_are_those_of_the_streams(tmp_path: Path) -> None:
    out = tmp_path / "out"
    report = plan(tmp_path, output=out)
    dictionary = firmware_dictionary(MAINBOARD)
    for node in report.nodes:
        found = records(out / f"{node.name}.batch")
        assert len(found) == node.commands
        assert node.bytes >= sum(len(command) for _, command in found)
    steps, fastest = 0, 0.0
    for _, command in records(out / "mcu.batch"):
        messages = dictionary.decode_commands(command)
        assert messages is not None
        (message,) = messages
        if message.name == "queue_step":
            interval, count, add = (message.integer(name) for name in ("interval", "count", "add"))
            steps += count
            fastest = max(fastest, dictionary.clock_freq_hz / min(interval, interval + add * (count - 1)))
    mine = [stepper for stepper in report.steppers if stepper.node == "mcu"]
    assert steps == sum(stepper.steps for stepper in mine)
    assert fastest == pytest.approx(max(stepper.max_step_rate for stepper in mine))
    uart = next(bus for bus in report.buses if bus.kind == "uart")
    assert uart.bits == 10 * next(node.bytes for node in report.nodes if node.bus == uart.name)


def test_a_can_bus_carries_the_sum_of_its_nodes(tmp_path: Path) -> None:
    report = plan(tmp_path)
    assert [(bus.name, bus.kind, bus.bitrate) for bus in report.buses] == [
        ("can0", "can", 1_000_000),
        ("/dev/ttyUSB0", "uart", 250_000),
    ]
    can = report.buses[0]
    on_it = sum(node.bytes for node in report.nodes if node.bus == "can0")
    # A full frame has 111 bits and up to 24 stuff bits for 64 of data; short ones and answers cost more.
    assert 111 / 64 * 8 * on_it < can.bits < 3 * 135 / 64 * 8 * on_it
    load = report.timeline.bus_load["can0"]
    assert sum(load) * report.timeline.bin_s * can.bitrate == pytest.approx(can.bits, rel=1e-3)
    assert can.peak_load == pytest.approx(max(load), rel=1e-3)
    slow = plan(tmp_path, can_bitrate=125_000).buses[0]
    assert slow.bits == can.bits
    assert slow.peak_load == pytest.approx(8 * can.peak_load)


def test_an_overloaded_bus_is_a_warning_with_a_line(tmp_path: Path) -> None:
    report = plan(tmp_path)
    assert report.warnings == ()
    report = plan(tmp_path, can_bitrate=10_000)
    (warning,) = report.warnings
    assert warning.startswith(f"{tmp_path}/square.gcode:{report.buses[0].peak_line}: can can0 would need ")
    assert report.buses[0].over_ceiling_s > 0
    assert f"warning: {warning}" in report.to_text()


def test_a_step_rate_beyond_the_node_is_told_with_its_line(tmp_path: Path) -> None:
    slow = json.loads((Path(__file__).parents[3] / "nodes/virtual/bin" / f"{MAINBOARD}.json").read_bytes())
    slow["config"]["CLOCK_FREQ"] = 1_000_000
    (tmp_path / "slow.json").write_text(json.dumps(slow))
    report = plan(tmp_path, dictionaries={"mcu": tmp_path / "slow.json"})
    assert any(
        ": stepper_x is to make " in text and "more than the 10,000 that node mcu" in text
        for text in report.warnings
    )
    line = next(s.max_step_rate_line for s in report.steppers if s.name == "stepper_x")
    assert any(text.startswith(f"{tmp_path}/square.gcode:{line}: stepper_x") for text in report.warnings)


@pytest.mark.parametrize(
    ("chip", "clock_hz", "limit"),
    [
        ("stm32f407xx", 16_800_000, "168,000"),
        ("atmega2560", 16_000_000, "100,000"),
        ("rp2040", 12_000_000, "1,200,000"),
    ],
)
def test_how_fast_a_node_may_step_depends_on_its_chip(chip: str, clock_hz: int, limit: str) -> None:
    assert ticks_per_step(chip) == {"s": 100, "a": 160, "r": 10}[chip[0]]
    node = NodeClock("mcu", chip, clock_hz)
    most = clock_hz / ticks_per_step(chip)
    assert not list(step_rate_warnings("p", node, Peak(most, 1.0, 7), []))
    (told,) = step_rate_warnings("p", node, Peak(1.01 * most, 1.0, 7), [])
    assert told.startswith("p:7: the steppers of node mcu are to make ")
    assert f"more than the {limit} that node mcu, {chip}, with its clock of " in told


def test_speeds_that_limits_lower_are_counted_with_their_lines(tmp_path: Path) -> None:
    text = "G28\nG90\nM83\nG1 X10 Y10 Z1 F120\n"
    limits = load_machine(str(DEMO_MACHINE)).limits
    assert not plan(tmp_path, text).slowed
    fast, z, e = (
        v * 60 for v in (limits.max_velocity, limits.max_z_velocity, limits.max_extrude_only_velocity)
    )
    asked = [
        f"G1 X60 F{fast:.3f}", f"G1 X10 F{1.5 * fast:.3f}", f"G1 Y60 F{2 * fast:.3f}",
        f"G1 Z11 F{z:.3f}", f"G1 Z1 F{3 * z:.3f}", f"G1 E5 F{e:.3f}", f"G1 E-5 F{1.25 * e:.3f}",
    ]  # fmt: skip
    report = plan(tmp_path, text + "\n".join(asked))
    assert [(s.limit, s.moves, s.first_line, s.worst_line) for s in report.slowed] == [
        ("max_velocity", 2, 6, 7),
        ("max_z_velocity", 1, 9, 9),
        ("max_extrude_only_velocity", 1, 11, 11),
    ]
    assert [s.asked_mm_s / s.allowed_mm_s for s in report.slowed] == pytest.approx([2, 3, 1.25], rel=1e-3)
    told = [w for w in report.warnings if " allows" in w]
    assert (
        f"square.gcode:6: from here on 2 moves ask for more speed than max_velocity allows, line 7 for "
        f"{fast / 30:.1f} mm/s where {fast / 60:.1f} are made;" in told[0]
    )
    assert "square.gcode:9: one move asks for more speed than max_z_velocity allows, for " in told[1]
    assert len(told) == 3


@pytest.mark.parametrize(
    ("machine", "line", "told"),
    [
        ("cartesian", "G1 X9999", "correct the program or position_min and position_max of [stepper_x]"),
        ("corexz", "G1 Z9999", "correct the program or position_min and position_max of [stepper_z]"),
        ("delta", "G1 X9999", "correct the program or print_radius of [printer]"),
        ("delta", "G1 Z-99", "or minimum_z_position of [printer] and position_endstop of [stepper_a]"),
        ("rotary_delta", "G1 Y9999", "correct the program or print_radius of [printer]"),
        ("deltesian", "G1 X9999", "correct the program or print_width and min_angle of [printer]"),
        ("deltesian", "G1 Y9999", "correct the program or position_min and position_max of [stepper_y]"),
        ("polar", "G1 X9999", "correct the program or position_min and position_max of [stepper_arm]"),
        ("polar", "G1 Z9999", "correct the program or position_min and position_max of [stepper_z]"),
        ("winch", "G1 Y9999", "correct the program or anchor_y of the sections [stepper_a], [stepper_b], …"),
        ("generic_cartesian", "G1 Y9999", "or position_min and position_max of [carriage "),
        ("idex", "G1 X9999", "of [stepper_x], or those and safe_distance of [dual_carriage]"),
    ],
)
def test_a_refusal_names_the_options_that_this_machine_has(
    tmp_path: Path, machine: str, line: str, told: str
) -> None:
    config = DEMO_MACHINE.parents[1] / f"{machine}.cfg"
    with pytest.raises(CanductorError) as refused:
        plan(tmp_path, f"G28\nG90\n{line} F600\n", config=config)
    assert "square.gcode:3: the move goes to " in str(refused.value)
    assert told in str(refused.value)
    sections = re.findall(r"\[(\w+(?: \w+)?)\]", str(refused.value))
    assert all(f"\n[{section}]" in config.read_text() for section in sections)


@pytest.mark.parametrize("line", ["G1 E1", "G1 X10 E1"])
def test_a_machine_without_an_extruder(tmp_path: Path, line: str) -> None:
    """A mill: it moves, and refuses filament."""
    config = tmp_path / "mill.cfg"
    sections = (DEMO_MACHINE.parents[1] / "cartesian.cfg").read_text().split("\n[")
    config.write_text("\n[".join(part for part in sections if not part.startswith("extruder")))
    assert plan(tmp_path, "G28\nG1 X10 F6000\n", config=config).moves == 1
    with pytest.raises(CanductorError, match=r"square\.gcode:2: the move pushes filament, .* no extruder"):
        plan(tmp_path, f"G28\n{line} F600\n", config=config)


def test_steps_faster_than_the_pulse_end_the_plan_near_their_line(tmp_path: Path) -> None:
    machine = tmp_path / "machine.cfg"
    machine.write_text(
        DEMO_MACHINE.read_text().replace("[stepper_x]", "[stepper_x]\nstep_pulse_duration: 0.00005")
    )
    with pytest.raises(
        CanductorError, match=r"square\.gcode, near line \d+: stepper_x at print time .*pulse"
    ):
        plan(tmp_path, config=machine)


def test_files_of_an_output_folder(tmp_path: Path) -> None:
    out = tmp_path / "new" / "out"
    report = plan(tmp_path, output=out, plot=tmp_path / "p.svg")
    assert {Path(name).name for name in report.written} == {
        "mcu.batch",
        "toolhead.batch",
        "zboard.batch",
        "p.svg",
        "plan.svg",
        "plan.json",
    }
    assert all(Path(name).stat().st_size > 0 for name in report.written)
    kept = json.loads((out / "plan.json").read_text())
    assert kept["ok"] is True
    assert kept["buses"] == json.loads(json.dumps(report.to_json()))["buses"]
    assert (out / "plan.svg").read_text() == (tmp_path / "p.svg").read_text()


def test_a_plot_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(CanductorError, match=r"^cannot write .*p\.svg: No such file"):
        plan(tmp_path, plot=tmp_path / "none" / "p.svg")


def test_the_picture_is_xml_for_any_title_and_any_length() -> None:
    for bins in (0, 1, 5000):
        line = Timeline(2.0, (10.0,) * bins, (0.0,) * bins, {"<can & co>": (0.5,) * bins})
        root = ET.parse(io.StringIO(draw('a<b>&"\x00.gcode', line))).getroot()  # noqa: S314 (our own text)
        curves = [e for e in root.iter() if e.tag.endswith("polyline")]
        assert len(curves) == 3
        assert all(len(curve.attrib["points"]) < 40_000 for curve in curves)
        texts = [e.text for e in root.iter() if e.tag.endswith(("text", "tspan"))]
        assert texts[0] == 'a<b>&"?.gcode'
        assert "<can & co>" in texts


def test_reads_standard_input(tmp_path: Path) -> None:
    words = [sys.executable, "-m", "coordinator.cli.main", "plan", "--json", str(DEMO_MACHINE), "-"]
    done = subprocess.run(
        words, input=SQUARE.encode(), capture_output=True, timeout=60, check=True, cwd=tmp_path
    )
    told = json.loads(done.stdout)
    here = json.loads(json.dumps(plan(tmp_path).to_json()))
    assert told["gcode"] == "standard input"
    for name in ("moves", "print_time_s", "steps", "buses", "axes", "timeline"):
        assert told[name] == here[name]


def test_an_empty_program_has_a_report(tmp_path: Path) -> None:
    report = plan(tmp_path, "G28\n", plot=tmp_path / "p.svg")
    assert report.moves == 0
    assert [bus.peak_load for bus in report.buses] == [0, 0]
    assert "0 moves in 0:00.0 min" in report.to_text()


@pytest.mark.skipif(not DATA.exists(), reason="the shared real-world data is not here")
def test_a_real_file_is_planned_with_all_figures(tmp_path: Path) -> None:
    options = PlanOptions(
        config=DATA / "config" / "corexy_is_pa_toolhead.cfg",
        gcode=DATA / "gcode" / "circles01.gcode",
        output=tmp_path,
        json=True,
    )
    report = plan_file(options)
    assert report.path_speed.value == pytest.approx(300)
    for node in report.nodes:
        size = (tmp_path / f"{node.name}.batch").stat().st_size
        assert size == node.commands * RECORD.size + sum(
            len(command) for _, command in records(tmp_path / f"{node.name}.batch")
        )
        assert 0 < node.max_slots <= node.move_count
    assert all(0 < bus.mean_load < bus.peak_load < 1 for bus in report.buses)


def with_option(section: str, option: str, value: str, text: str) -> str:
    """Return the configuration TEXT with VALUE for OPTION of [SECTION]."""
    head, header, rest = text.partition(f"[{section}]\n")
    own, bracket, others = rest.partition("\n[")
    assert header
    own = re.sub(rf"^{option}: .*\n", "", own, flags=re.MULTILINE)
    return f"{head}{header}{option}: {value}\n{own}{bracket}{others}"


@pytest.mark.parametrize(("section", "option"), BOUNDED, ids=lambda each: getattr(each, "name", each))
def test_what_an_option_allows_can_be_planned(
    tmp_path: Path, section: str, option: FloatOption | IntOption
) -> None:
    """Or it is refused in a sentence about the machine; the planner calculates with no number it cannot."""
    config = tmp_path / "machine.cfg"
    for value in (option.minimum, option.maximum, 1e-300, 5e-4, 0.99999999):
        config.write_text(with_option(section, option.name, repr(value), DEMO_MACHINE.read_text()))
        try:
            plan(tmp_path, config=config)
        except CanductorError as refused:
            assert "bug" not in str(refused)  # noqa: PT017


def test_the_narrowest_nozzle_and_filament_can_be_planned(tmp_path: Path) -> None:
    """The limits of filament that follow from them are within what the planner calculates with, too."""
    text = with_option("printer", "max_velocity", "0.001", DEMO_MACHINE.read_text())
    for option, value in (
        ("nozzle_diameter", "0.01"),
        ("filament_diameter", "0.1"),
        ("max_extrude_cross_section", "1e9"),
    ):
        text = with_option("extruder", option, value, text)
    config = tmp_path / "machine.cfg"
    config.write_text(text)
    assert plan(tmp_path, "G28\nM83\nG1 Z1 F600\n", config=config).ok
