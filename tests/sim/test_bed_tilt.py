"""[bed_tilt]: Z follows a tilted virtual bed, by configured figures and by those that are found."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from coordinator.virtual_machine.plant_bed import BedSettings
from nodes.virtual.plant import Bed
from tests.stages.printer_text import section
from tests.stages.probe_stage import MICROSTEP_MM, ProbeStage, bed_height, machine_text
from tests.stages.served import Served, running

TILTED = Bed(z=0.1, x0=100, y0=100, tilt_x=0.004, tilt_y=-0.003)
POINTS = "\n  10, 90\n  170, 10\n  170, 180"
PLACES = ((20.0, 20.0), (180.0, 30.0), (100.0, 100.0), (30.0, 180.0), (0.0, 0.0))
SWITCH: Mapping[str, Any] = {"endstop_pin": "PC7", "position_endstop": 5}
LAYER_MM = 0.3


def make(
    folder: Path, *, z: Mapping[str, Any] | None = None, further: str = "", **options: Any
) -> ProbeStage:
    folder.mkdir(exist_ok=True)
    own: dict[str, Any] = {"points": POINTS, "horizontal_move_z": 7, "speed": 150} | options
    text = machine_text(
        z=z, sections=section("bed_tilt", **{n: v for n, v in own.items() if v is not None}) + further
    )
    return ProbeStage(folder, text, bed=BedSettings(shape=TILTED))


def gaps(stage: ProbeStage, *before: str) -> list[float]:
    """Return how high the nozzle truly is above the bed at the places, where it was sent LAYER_MM high."""
    found: list[float] = []

    def look() -> None:
        x, y = PLACES[len(found)]
        found.append(stage.true_mm("z") - bed_height(TILTED, x, y))

    lines = []
    for number, (x, y) in enumerate(PLACES):
        stage.on_echo[f"there {number}"] = look
        lines += [f"G1 X{x:g} Y{y:g} Z{LAYER_MM} F6000", "M400", f"M118 there {number}"]
    stage.do("G28", *before, *lines)
    return found


@pytest.mark.parametrize("z", [None, SWITCH], ids=["by the probe", "by a switch"])
def test_z_follows_what_is_found_at_once_and_after_a_restart(
    tmp_path: Path, z: Mapping[str, Any] | None
) -> None:
    stage = make(tmp_path / "first", z=z)
    assert gaps(stage, "G1 Z9 F600", "BED_TILT_CALIBRATE") == pytest.approx(
        [LAYER_MM] * 5, abs=2 * MICROSTEP_MM
    )
    assert stage.machine is not None
    saved = stage.machine.unsaved.pending["bed_tilt"]
    assert float(saved["x_adjust"]) == pytest.approx(TILTED.tilt_x, abs=3e-5)
    assert float(saved["y_adjust"]) == pytest.approx(TILTED.tilt_y, abs=3e-5)
    again = make(tmp_path / "second", z=z, **saved)
    assert gaps(again) == pytest.approx([LAYER_MM] * 5, abs=2 * MICROSTEP_MM)


@pytest.mark.parametrize(
    ("options", "higher_mm"),
    [
        ({"x_adjust": 0.01}, [0.01 * x for x, _ in PLACES]),
        ({"y_adjust": -0.01}, [-0.01 * y for _, y in PLACES]),
        ({"z_adjust": 0.2}, [0.2] * 5),
    ],
)
def test_each_option_counts(tmp_path: Path, options: dict[str, Any], higher_mm: list[float]) -> None:
    level = gaps(make(tmp_path / "level", z=SWITCH))
    found = gaps(make(tmp_path / "tilted", z=SWITCH, **options))
    by = [after - before for before, after in zip(level, found, strict=True)]
    assert by == pytest.approx(higher_mm, abs=MICROSTEP_MM)


def test_it_is_found_by_hand_with_the_tilt_of_before(tmp_path: Path) -> None:
    """Somebody lowers the nozzle onto the bed at each place; the tilt that is followed meanwhile is wrong."""
    stage = make(tmp_path, z=SWITCH, x_adjust=-0.002, z_adjust=0.1)
    served = Served(tmp_path, lambda: stage.description, stage.host)

    async def run(script: str) -> list[str]:
        return list((await served.call("gcode.run", script=script))["replies"])

    async def main() -> None:
        async with running(served):
            said = await run("G28\nG1 Z9 F600\nBED_TILT_CALIBRATE METHOD=manual")
            for number in range(3):
                assert f"place {number + 1} of 3" in "".join(said), said
                x, y = served.planned[:2]
                said = await run(f"TESTZ Z={bed_height(TILTED, x, y) - stage.true_mm('z'):.4f}\nM400\nACCEPT")
            assert "SAVE_CONFIG writes them" in said[-1]
            await run("G1 Z1 F600\nG1 X180 Y30 F6000\nG1 Z0.3 F600\nM400")
            gap = stage.true_mm("z") - bed_height(TILTED, 180, 30)
            assert gap == pytest.approx(LAYER_MM, abs=2 * MICROSTEP_MM)

    stage.run(main)


@pytest.mark.parametrize(
    ("options", "further", "said"),
    [
        (
            {},
            section("bed_mesh", mesh_min="30, 30", mesh_max="150, 150"),
            r"\[bed_tilt\] and \[bed_mesh\] both",
        ),
        ({"x_adjust": 0.2}, "", "x_adjust"),
        ({"points": "1, 2\n  3, 4"}, "", "3 or more places"),
        # Failed before: the motors went 74.8 mm below position_min.
        (
            {"x_adjust": 0.1, "z_adjust": -100},
            "",
            r"\[bed_tilt\]: the tilt is refused: .* Z 100\.0 mm beyond",
        ),
        ({"y_adjust": 0.03}, "", r"would drive Z 6\.0 mm beyond position_min or position_max"),
    ],
)
def test_what_cannot_be_is_refused(
    tmp_path: Path, options: Mapping[str, Any], further: str, said: str
) -> None:
    own = {"points": POINTS, **options}
    path = tmp_path / "printer.cfg"
    path.write_text(machine_text(sections=section("bed_tilt", **own) + further))
    with pytest.raises(ConfigError, match=said):
        load_machine(str(path))


def test_it_needs_points(tmp_path: Path) -> None:
    stage = make(tmp_path, points=None)
    with pytest.raises(Exception, match=r"BED_TILT_CALIBRATE needs points of \[bed_tilt\]"):
        stage.do("G28", "BED_TILT_CALIBRATE")
