"""What docs/gcode.md says of probes, meshes and levelling, against what their modules report and know."""

import re
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.modules.module_set import ModuleSet, build_modules
from tests.stages.printer_text import section
from tests.stages.probe_stage import machine_text

PAGE = (Path(__file__).parents[4] / "docs" / "gcode.md").read_text(encoding="utf-8")
SCREWS = {"screw1": "20, 20", "screw2": "120, 20", "screw3": "70, 120"}
CORNERS = "10, 10\n  10, 150\n  150, 150\n  150, 10"
SECTIONS = (
    section("bed_mesh", mesh_min="30, 30", mesh_max="150, 150")
    + section("screws_tilt_adjust", **SCREWS)
    + section("bed_screws", **SCREWS)
    + section("z_tilt_ng", z_positions=CORNERS, points=CORNERS)
    + section("quad_gantry_level", gantry_corners="0, 0\n  200, 200", points=CORNERS)
    + "[skew_correction]\n"
)
STATUS = (
    *(
        "bed_mesh",
        "manual_probe",
        "z_tilt_ng",
        "quad_gantry_level",
        "screws_tilt_adjust",
        "bed_screws",
        "probe",
    ),
    "skew_correction",
)
MODULES = (
    "bed_mesh",
    "bed_screws",
    "screws_tilt_adjust",
    "z_tilt_ng",
    "quad_gantry_level",
    "probe",
    "skew_correction",
)
OTHERS = {"ACCEPT", "ABORT", "TESTZ", "MANUAL_PROBE", "Z_ENDSTOP_CALIBRATE", "Z_OFFSET_APPLY_ENDSTOP"}

OF_LEVELLING = re.compile(
    "MESH|PROBE|TILT|SCREW|SKEW|GANTRY|CALIBRATE|TESTZ|ACCEPT|ABORT|ADJUSTED|OFFSET_APPLY"
)


@pytest.fixture(scope="module")
def modules(tmp_path_factory: pytest.TempPathFactory) -> ModuleSet:
    path = tmp_path_factory.mktemp("documented") / "printer.cfg"
    path.write_text(machine_text(further_z=3, sections=SECTIONS))
    return build_modules(load_machine(str(path)))


@pytest.mark.parametrize("name", STATUS)
def test_the_status_has_the_documented_fields(modules: ModuleSet, name: str) -> None:
    (row,) = (
        line
        for line in PAGE.splitlines()
        if re.match(rf"\| .*`{name}`", line) and "printer" not in line and line.count("|") == 3
    )
    told = re.sub(r"\([^)]*\)", "", row.split("|")[2])
    assert {field.strip() for field in told.split(",")} == set(modules.status()[name])


def test_commands_are_documented(modules: ModuleSet) -> None:
    """All of these sections, and no others stand beside their names."""
    written = set(re.findall(r"\b[A-Z][A-Z_]{3,}\b", PAGE))
    here = [name for name in modules.vocabulary.commands if OF_LEVELLING.search(name) and name[0] != "_"]
    assert len(here) > 20
    assert set(here) <= written
    rows = [line for line in PAGE.splitlines() if any(f"`[{name}]`" in line for name in MODULES)]
    documented = {
        word for row in rows for word in re.findall(r"\b[A-Z]\w*_[A-Z_]+\b(?!=)", row.split("|")[1])
    }
    assert documented >= {"BED_MESH_CALIBRATE", "Z_TILT_ADJUST", "QUAD_GANTRY_LEVEL", "SCREWS_TILT_CALCULATE"}
    assert documented | OTHERS <= set(modules.vocabulary.commands)
