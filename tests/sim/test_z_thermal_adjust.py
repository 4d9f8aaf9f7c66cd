"""[z_thermal_adjust]: how high the nozzle truly is while the frame gets warm."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.stages.printer_text import section
from tests.stages.probe_stage import MICROSTEP_MM, ProbeStage, machine_text

COEFF = 0.02
"""mm/K, configured."""
NEAR_MM = 1.5 * MICROSTEP_MM
WARMER = ("M118 warmer", "G4 S20")
FIELDS = ("current_z_adjust", "temperature", "z_adjust_ref_temperature")
SHOWN = " ".join(f"{{s.{name}|round(3)}}" for name in FIELDS)
STATUS = (
    f"[gcode_macro SEE]\ngcode:\n  {{% set s = printer.z_thermal_adjust %}}\n  M118 {{s.enabled}} {SHOWN}\n"
)


class Frame:
    """A machine whose frame has 20 °C, and 30 °C from the line M118 warmer on."""

    def __init__(self, folder: Path, **options: Any) -> None:
        folder.mkdir(exist_ok=True)
        self._file = folder / "temp"
        self._file.write_text("20000")
        own: dict[str, Any] = {
            "sensor_type": "temperature_host",
            "sensor_path": self._file,
            "min_temp": 0,
            "max_temp": 100,
            "temp_coeff": COEFF,
        } | options
        switch = {"endstop_pin": "PC7", "position_endstop": 5}
        text = machine_text(
            z=switch,
            sections=section("z_thermal_adjust", **{n: v for n, v in own.items() if v is not None}) + STATUS,
        )
        self.stage = ProbeStage(folder, text)
        self.stage.on_echo["warmer"] = self._warm

    def _warm(self) -> None:
        self._file.write_text("30000")

    def heights(self, *lines: str) -> list[float]:
        """Return the true Z at each line LOOK."""
        found: list[float] = []
        numbered = []
        for line in ("G28", "G1 Z1 F600", *lines):
            if line != "LOOK":
                numbered.append(line)
                continue
            name = f"look {len(self.stage.on_echo)}"
            self.stage.on_echo[name] = self._look(found)
            numbered += ["M400", f"M118 {name}"]
        self.stage.do("M118 begin", "G4 S5", *numbered)
        return found

    def _look(self, found: list[float]) -> Callable[[], None]:
        return lambda: found.append(self.stage.true_mm("z"))


def check(found: list[float], wanted: list[float]) -> None:
    assert found == pytest.approx(wanted, abs=NEAR_MM)


def test_moves_are_lower_when_the_frame_is_warm(tmp_path: Path) -> None:
    """The next move goes along, also a relative one; what the program says of places does not change."""
    frame = Frame(tmp_path)
    check(
        frame.heights(
            *("LOOK", *WARMER, "LOOK", "G1 X10", "LOOK", "G1 Z2", "LOOK"),
            *("G91", "G1 Z1", "G90", "LOOK", "M114", "SAVE_GCODE_STATE NAME=a", "G92 Z7", "G1 X5", "LOOK"),
            *("RESTORE_GCODE_STATE NAME=a", "G1 Z1", "LOOK"),
        ),
        [1.0, 1.0, 0.8, 1.8, 2.8, 2.8, 0.8],
    )
    (told,) = (text for text in frame.stage.output if "Z:" in text)
    assert "Z:3.0" in told
    # Homed again, it is right as it is.
    check(
        Frame(tmp_path / "again").heights(*WARMER, "G1 X10", "LOOK", "G1 Z9", "G28", "G1 Z1", "LOOK"),
        [0.8, 1.0],
    )


def test_macros_and_front_ends_see_it(tmp_path: Path) -> None:
    frame = Frame(tmp_path)
    frame.heights("SEE", *WARMER, "G1 X10", "M400", "SEE", "SET_Z_THERMAL_ADJUST")
    seen = [text.removeprefix("echo: ") for text in frame.stage.output if text.startswith("echo: True")]
    assert seen[0] == "True 0.0 20.0 20.0"
    words = seen[1].split()
    assert float(words[1]) == pytest.approx(-0.2, abs=0.002)
    assert words[2:] == ["30.0", "20.0"]
    assert frame.stage.output[-1].startswith(
        "enabled: True, temp_coeff: 0.02 mm/K, reference: 20.00 °C, correction: -0.19"
    )


@pytest.mark.parametrize(
    ("options", "at_mm"),
    [
        ({}, 0.8),
        ({"temp_coeff": -0.01}, 1.1),
        ({"temp_coeff": None}, 1.0),
        ({"max_z_adjustment": 0.05}, 0.95),
        ({"z_adjust_off_above": 0.5}, 1.0),
        ({"smooth_time": 100}, 0.965),  # 18 of 100 s: 0.2·(1 - e^-0.18), by steps of 1 s
    ],
)
def test_each_option_counts(tmp_path: Path, options: dict[str, Any], at_mm: float) -> None:
    frame = Frame(tmp_path, **options)
    (found,) = frame.heights(*WARMER, "G1 X10", "LOOK")
    assert found == pytest.approx(at_mm, abs=NEAR_MM)


def test_above_a_height_it_stays_as_it_was(tmp_path: Path) -> None:
    frame = Frame(tmp_path, z_adjust_off_above=1.5, max_z_adjustment=0.1)
    check(frame.heights(*WARMER, "G1 X10", "LOOK", "G1 Z2", "G1 X5", "LOOK"), [0.9, 1.9])


@pytest.mark.parametrize(
    ("line", "at_mm"),
    [
        ("SET_Z_THERMAL_ADJUST ENABLE=0", 1.0),
        ("SET_Z_THERMAL_ADJUST TEMP_COEFF=0.01", 0.9),
        ("SET_Z_THERMAL_ADJUST REF_TEMP=25", 0.9),
    ],
)
def test_the_command_counts(tmp_path: Path, line: str, at_mm: float) -> None:
    check(Frame(tmp_path).heights(line, *WARMER, "G1 X10", "LOOK"), [at_mm])


def test_switched_off_it_stays_as_it_is(tmp_path: Path) -> None:
    """A nozzle that suddenly goes down could meet the bed."""
    lines = (*WARMER, "G1 X10", "SET_Z_THERMAL_ADJUST ENABLE=0", "G1 X5", "LOOK", "G1 Z2", "LOOK")
    check(Frame(tmp_path).heights(*lines), [0.8, 1.8])


def test_a_bad_parameter_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="TEMP_COEFF"):
        Frame(tmp_path).heights("SET_Z_THERMAL_ADJUST TEMP_COEFF=2")
