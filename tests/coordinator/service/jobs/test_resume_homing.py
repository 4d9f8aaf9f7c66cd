"""How a machine finds out where its head is above a part, for each kind of machine, and what is refused."""

from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.ipc.protocol.methods import ApiError
from coordinator.modules.module_set import build_modules
from coordinator.service.jobs.resume_homing import ResumeHomingPlan, plan_resume_homing, sure_height

CONFIG = Path("config")


def way(path: Path, homed: str = "", *, z_mm: float | None = 12.0, part_mm: float = 12.0) -> ResumeHomingPlan:
    described = load_machine(str(path))
    return plan_resume_homing(described, build_modules(described), homed, part_mm=part_mm, z_mm=z_mm)


def with_text(folder: Path, before: str, after: str) -> Path:
    text = (CONFIG / "corexy_toolhead.cfg").read_text(encoding="utf-8")
    assert before in text
    path = folder / "printer.cfg"
    path.write_text(text.replace(before, after), encoding="utf-8")
    return path


@pytest.mark.parametrize("name", ["corexy_toolhead", "cartesian", "corexz"])
def test_x_and_y_are_homed_above_the_part(name: str) -> None:
    path = CONFIG / f"{name}.cfg"
    assert way(path) == ResumeHomingPlan(12.0, 17.0, ("G28 X", "G28 Y"))
    assert way(path, "Z", z_mm=None) == ResumeHomingPlan(None, 17.0, ("G28 X", "G28 Y"))
    assert way(path, "XY") == ResumeHomingPlan(12.0, 17.0, ())
    assert way(path, "XYZ", z_mm=None) == ResumeHomingPlan()
    assert way(path, part_mm=249).up_mm == load_machine(str(path)).limits.position_max[2]
    with pytest.raises(ApiError, match="so Z is not known: home Y Z where the part is not in the way"):
        way(path, "X", z_mm=None)


def test_a_z_that_homes_away_from_the_part_is_homed(tmp_path: Path) -> None:
    before = "endstop_pin: ^PC2\nposition_endstop: 0"
    path = with_text(tmp_path, before, before.replace("p: 0", "p: 250"))
    assert way(path, z_mm=None) == ResumeHomingPlan(homing=("G28 Z", "G28 X", "G28 Y"))


def test_towers_go_up() -> None:
    assert way(CONFIG / "delta.cfg", z_mm=None) == ResumeHomingPlan(homing=("G28",))


@pytest.mark.parametrize(
    ("section", "why"),
    [
        ("[gcode_macro G28]\nrename_existing: G28.1\ngcode:\n    G28.1\n", "says what G28 does, maybe in Z"),
        ("[homing_override]\ngcode:\n    G28\n", "says what G28 does, maybe in Z"),
    ],
)
def test_what_may_move_the_head_into_the_part_is_refused(tmp_path: Path, section: str, why: str) -> None:
    path = with_text(tmp_path, "[fan]\n", f"{section}\n[fan]\n")
    with pytest.raises(ApiError, match=why):
        way(path)


def test_a_machine_whose_arm_swings_is_refused() -> None:
    with pytest.raises(ApiError, match="homing a polar machine moves the head past the part: home X Y Z"):
        way(CONFIG / "polar.cfg")


@pytest.mark.parametrize(
    ("heights", "sure"),
    [
        ([1.2, 1.2], 1.2),
        ([1.2, 1.25], 1.2),
        ([1.2, 1.5], None),
        (None, None),
        ([1], None),
        (["a", 1], None),
        ("ab", None),
    ],
)
def test_a_height_counts_where_it_is_sure(heights: object, sure: float | None) -> None:
    assert sure_height(heights) == sure
