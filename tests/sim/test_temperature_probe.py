"""[temperature_probe]: an eddy current probe whose coil gets warm, on a virtual bed in virtual time."""

import ast
import asyncio
import json
import math
import re
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from coordinator.config.errors import ConfigError
from coordinator.gcode.errors import GCodeError
from coordinator.ipc.protocol.methods import ApiError
from coordinator.modules.eddy_current.coil_drift import HEIGHTS
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.virtual_machine.plant_bed import BedSettings
from coordinator.virtual_machine.plant_heat import HeatSettings
from nodes.virtual.plant import Bed
from tests.stages.printer import gcode
from tests.stages.printer_text import section
from tests.stages.probe_stage import MICROSTEP_MM, OFFSET, ProbeStage, bed_height, heights, machine_text
from tests.stages.served import Served, running

KIND = "probe_eddy_current coil"
NAME = "temperature_probe coil"
SHAPE = Bed(z=0.2, x0=100, y0=100, tilt_x=0.002, tilt_y=-0.001, bow=0.3, radius=120)
DRIFT = 1e-4
"""Of the frequency, 1/K: 0.1 mm for 25 K."""
BED = BedSettings(shape=SHAPE, coil_drift=DRIFT)
AIR_C = 25.0
SENSOR = {"sensor_type": "Generic 3950", "sensor_pin": "toolhead:PA1", "min_temp": 0, "max_temp": 120}
HEATER = section(
    "heater_bed",
    heater_pin="toolhead:PB2",
    sensor_type="Generic 3950",
    sensor_pin="toolhead:PA0",
    control="watermark",
    min_temp=0,
    max_temp=120,
)
EXTRUDER = section(
    "extruder",
    step_pin="toolhead:PB4",
    dir_pin="toolhead:PB5",
    microsteps=16,
    rotation_distance=22.5,
    nozzle_diameter=0.4,
    filament_diameter=1.75,
    heater_pin="toolhead:PB6",
    sensor_type="Generic 3950",
    sensor_pin="toolhead:PA3",
    control="watermark",
    min_temp=0,
    max_temp=250,
)
SWITCH = {"endstop_pin": "PC7", "position_endstop": 5}
SEE = "[gcode_macro SEE]\ngcode:\n  {% set s = printer[params.OF] %}\n  M118 {s}\n"


def frequency(height_mm: float, celsius: float = AIR_C) -> float:
    """Return the frequency of the coil by the formula of docs/plant.md, Hz."""
    return 3e6 * (1 + 0.1 * math.exp(-height_mm / 3)) * (1 + DRIFT * (celsius - 25))


TABLE = ",\n  ".join(f"{mm / 20:g}:{frequency(mm / 20):.3f}" for mm in range(1, 81))
CURVES = "\n  " + "\n  ".join(
    f"{mm:g}: {frequency(mm, 0):.6f}, {frequency(mm, 1) - frequency(mm, 0):.9f}, 0" for mm in HEIGHTS
)
CALIBRATED = {"drift_calibration": CURVES, "calibration_temp": AIR_C, "drift_calibration_min_temp": 20}


def stage_with(
    folder: Path,
    *,
    air_c: float = AIR_C,
    own: dict[str, Any] | None = None,
    sections: str = "",
    **options: Any,
) -> ProbeStage:
    """Return the machine; OWN: options of [temperature_probe], None: it has none of these sections."""
    folder.mkdir(exist_ok=True)
    given = {name: value for name, value in {**SENSOR, **(own or {})}.items() if value is not None}
    probe = "" if own is None else section(NAME, **given)
    text = machine_text(
        kind=KIND, **({"calibrate": TABLE} | options), sections=probe + HEATER + SEE + sections
    )
    return ProbeStage(folder, text, bed=BED, heat=HeatSettings(ambient_c=air_c, adc_noise=0.0))


def coil_height(x: float, y: float) -> float:
    return bed_height(SHAPE, x + OFFSET[0], y + OFFSET[1])


def zero_error(stage: ProbeStage) -> float:
    """Return how far off the zero of Z is that G28 found at X 0, Y 0, mm."""
    assert stage.machine is not None
    counts = {name: motor.count for name, motor in stage.page("mcu").motors.items()}
    positions = stage.machine.stepper_positions
    head = positions.head(positions.positions(counts))
    assert head is not None
    return head[2] - (stage.true_mm("z") - coil_height(0, 0))


# ------------------------------------------------------------------------------------------ what it corrects


@pytest.mark.parametrize("air_c", [22, 40, 60])
def test_homing_and_probing_with_a_coil_of_another_temperature(tmp_path: Path, air_c: float) -> None:
    lines = ("G4 S20", "M400", "G28", "G1 X30 Y50 Z2 F6000", "PROBE")
    stage = stage_with(tmp_path, air_c=air_c, own=CALIBRATED)
    (found,) = heights(stage.do(*lines))
    assert abs(zero_error(stage)) < 2 * MICROSTEP_MM
    assert found - 0.5 == pytest.approx(coil_height(30, 50) - coil_height(0, 0), abs=2 * MICROSTEP_MM)
    plain = stage_with(tmp_path / "plain", air_c=air_c)
    plain.do(*lines)
    # 1e-4 of 3.3 MHz for each kelvin, with 85 kHz for a millimetre at half a millimetre.
    assert zero_error(plain) == pytest.approx(-0.0039 * (air_c - AIR_C), rel=0.1)


def test_meshes_in_flight_are_corrected(tmp_path: Path) -> None:
    mesh = section(
        "bed_mesh", mesh_min="30, 30", mesh_max="180, 170", probe_count="4, 3", horizontal_move_z=2
    )
    stage = stage_with(tmp_path, air_c=50, own=CALIBRATED, sections=mesh)
    output = stage.do("G4 S20", "M400", "G28", "BED_MESH_CALIBRATE METHOD=rapid_scan", "BED_MESH_MAP")
    (text,) = (line.removeprefix("mesh_map_output") for line in output if line.startswith("mesh_map_output"))
    exact = [[bed_height(SHAPE, x, y) for x in np.linspace(30, 180, 4)] for y in np.linspace(30, 170, 3)]
    assert np.array(json.loads(text)["z_positions"]) == pytest.approx(
        np.array(exact) - coil_height(0, 0), abs=0.005
    )


def test_it_may_be_switched_off_and_on(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, air_c=50, own=CALIBRATED, z=SWITCH)
    probing = ("G1 Z3 F600", "PROBE")
    output = stage.do(
        *(
            "G4 S20",
            "M400",
            "G28",
            "G1 X30 Y50 F6000",
            *probing,
            "TEMPERATURE_PROBE_ENABLE ENABLE=0",
            *probing,
        ),
        *(f"SEE OF='{NAME}'", "TEMPERATURE_PROBE_ENABLE ENABLE=1", *probing, f"SEE OF='{NAME}'"),
    )
    on, off, again = heights(output)
    assert off - on == pytest.approx(0.0039 * 25, rel=0.1)
    assert again == pytest.approx(on, abs=MICROSTEP_MM)
    shown = [
        ast.literal_eval(text[6:])["compensation_enabled"] for text in output if text.startswith("echo: {")
    ]
    assert shown == [False, True]


def test_what_is_colder_than_the_calibration_is_corrected_as_its_lowest(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, air_c=30, own={**CALIBRATED, "drift_calibration_min_temp": 40})
    stage.do("G4 S20", "M400", "G28")
    assert zero_error(stage) == pytest.approx(0.0039 * 10, rel=0.1)


# ------------------------------------------------------------------------------------------ its calibration


def test_a_calibration_finds_the_drift(tmp_path: Path) -> None:
    """The bed heats the coil; each time a client's user finds the bed, at the same place."""
    touch_z = bed_height(SHAPE, 100, 100)
    own = {"calibration_bed_temp": 100, "max_validation_temp": 60, "resting_z": 0.6}
    stage = stage_with(tmp_path, own=own, z=SWITCH)
    served = Served(tmp_path, lambda: stage.description, stage.host)
    samples: list[str] = []

    def status(section_name: str) -> Mapping[str, Any]:
        assert served.service.machine is not None
        return served.service.machine.modules.status()[section_name]

    async def calibrate() -> None:
        async with running(served):
            assert not status(NAME)["in_calibration"]
            await gcode(served, "G28", "G1 X100 Y100 Z1 F6000", "PROBE_EDDY_CURRENT_CALIBRATE CHIP=coil")
            await gcode(served, f"TESTZ Z={touch_z - 1:.4f}", "ACCEPT", "G1 X100 Y100 Z1")
            await gcode(served, "TEMPERATURE_PROBE_CALIBRATE PROBE=coil TARGET=50 STEP=6")
            down_mm = touch_z - 1
            while status(NAME)["in_calibration"]:
                assert status("heater_bed")["target"] == 100
                # It begins each further search by itself.
                await served.until(lambda: bool(status("manual_probe")["is_active"]), "a search", 600)
                samples.extend(await gcode(served, f"TESTZ Z={down_mm:.4f}", "ACCEPT"))
                down_mm = -0.6
            assert status("heater_bed")["target"] == 0
            assert status(NAME)["compensation_enabled"]
            assert served.service.machine is not None
            check_saved(served.service.machine.unsaved.pending[NAME])

    def check_saved(saved: Mapping[str, str]) -> None:
        assert float(saved["calibration_temp"]) == pytest.approx(25, abs=0.5)
        assert float(saved["drift_calibration_min_temp"]) == pytest.approx(25, abs=1)
        for line in saved["drift_calibration"].strip().splitlines():
            height, _, words = line.partition(":")
            a, b, c = map(float, words.split(","))
            for celsius in (28, 40, 50):
                # A kelvin is 330 Hz: the sensor follows the coil with a lag.
                assert a + b * celsius + c * celsius**2 == pytest.approx(
                    frequency(float(height), celsius), abs=400
                )

    stage.run(calibrate)
    at_c = [float(line.split()[3]) for line in samples if line.startswith("sample ")]
    assert at_c[0] == pytest.approx(25, abs=1)
    # What is measured after 6 K more, at nine heights, gets warmer meanwhile.
    assert all(6 <= step < 12 for step in np.diff(at_c)), at_c
    assert at_c[-1] < 50 < at_c[-1] + 12, "the last one ends it"


@pytest.mark.parametrize(
    ("lines", "why"),
    [
        (("TEMPERATURE_PROBE_NEXT",), "is for a calibration; begin with TEMPERATURE_PROBE_CALIBRATE"),
        (("TEMPERATURE_PROBE_COMPLETE",), "is for a calibration; begin with TEMPERATURE_PROBE_CALIBRATE"),
        (("TEMPERATURE_PROBE_CALIBRATE PROBE=other",), "the probe is coil"),
        (("TEMPERATURE_PROBE_CALIBRATE STEP=0.5",), "STEP of TEMPERATURE_PROBE_CALIBRATE is 0.5"),
        (("TEMPERATURE_PROBE_CALIBRATE", "TEMPERATURE_PROBE_CALIBRATE"), "is looked for already"),
        (
            ("TEMPERATURE_PROBE_CALIBRATE", "TESTZ Z=-0.5", "ACCEPT", "TEMPERATURE_PROBE_NEXT"),
            "wait until it is warmer",
        ),
        (
            ("TEMPERATURE_PROBE_CALIBRATE", "TESTZ Z=-0.5", "ACCEPT", "TEMPERATURE_PROBE_COMPLETE"),
            "1 of 3 samples are there",
        ),
        (("TEMPERATURE_PROBE_CALIBRATE", "TESTZ Z=-0.5", "ACCEPT", "ACCEPT"), "nothing is looked for"),
        (("TEMPERATURE_PROBE_CALIBRATE", "ABORT", "ABORT"), "ABORT is for looking for a height"),
        (("TEMPERATURE_PROBE_ENABLE ENABLE=1",), "is not calibrated: calibrate with"),
        (("TEMPERATURE_PROBE_ENABLE",), "needs ENABLE=0 or ENABLE=1"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path: Path, lines: tuple[str, ...], why: str) -> None:
    stage = stage_with(tmp_path, own={}, z=SWITCH)
    with pytest.raises(GCodeError, match=re.escape(why)):
        stage.do("G4 S2", "M400", "G28", "G1 X100 Y100 Z1 F6000", *lines)
    assert stage.machine is not None
    assert NAME not in stage.machine.unsaved.pending


def test_an_abort_switches_the_heaters_off(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, own={"calibration_bed_temp": 60}, z=SWITCH)
    output = stage.do(
        *(
            "G4 S2",
            "M400",
            "G28",
            "G1 X100 Y100 Z1 F6000",
            "TEMPERATURE_PROBE_CALIBRATE",
            "M400",
            "SEE OF=heater_bed",
        ),
        *("ABORT", "M400", "SEE OF=heater_bed", f"SEE OF='{NAME}'"),
    )
    bed, after, own = (ast.literal_eval(text[6:]) for text in output if text.startswith("echo: {"))
    assert (bed["target"], after["target"]) == (60, 0)
    assert not own["in_calibration"]


def calibrating(stage: ProbeStage, folder: Path, main: Callable[[Served], Awaitable[None]]) -> None:
    """Run MAIN with a service, Z homed; then the calibration has to be over, and all that it heats off."""
    served = Served(folder, lambda: stage.description, stage.host)

    async def whole() -> None:
        async with running(served):
            await gcode(served, "G28", "G1 X100 Y100 Z1 F6000")
            await main(served)
            assert served.service.machine is not None
            modules = served.service.machine.modules
            assert not modules.status()[NAME]["in_calibration"]
            (heaters,) = modules.of(HeaterRegistry)
            assert heaters.units
            await served.until(lambda: not heaters.targets, "all heaters off")
            assert "temperature_probe coil: the calibration ended early; nothing is kept" in served.lines

    stage.run(whole)


@pytest.mark.parametrize(
    ("own", "why"),
    [
        ({"calibration_position": "150, 60, 300"}, "Z"),
        ({"calibration_position": "250, 60, 2"}, "X"),
        ({"calibration_extruder_temp": 260, "calibration_position": "150, 60, 2"}, "260 °C is outside"),
    ],
)
def test_a_beginning_that_fails_heats_nothing(tmp_path: Path, own: dict[str, Any], why: str) -> None:
    """Failed before: the bed stayed on, and the calibration was thought to go on."""
    stage = stage_with(tmp_path, own={"calibration_bed_temp": 60, **own}, z=SWITCH, sections=EXTRUDER)

    async def main(served: Served) -> None:
        with pytest.raises(ApiError, match=why):
            await gcode(served, "TEMPERATURE_PROBE_CALIBRATE")

    calibrating(stage, tmp_path, main)


def test_a_sample_that_fails_ends_it(tmp_path: Path) -> None:
    stage = stage_with(tmp_path, own={"calibration_bed_temp": 60}, z=SWITCH)

    async def main(served: Served) -> None:
        await gcode(served, "TEMPERATURE_PROBE_CALIBRATE", "TESTZ Z=-0.5")
        # Nine heights above this place: the last ones are outside.
        await gcode(served, "G1 X5 Y5 F6000")
        with pytest.raises(ApiError, match="X"):
            await gcode(served, "ACCEPT")

    calibrating(stage, tmp_path, main)


def test_a_script_that_is_cancelled_ends_it(tmp_path: Path) -> None:
    own = {"calibration_bed_temp": 60, "calibration_extruder_temp": 200}
    stage = stage_with(tmp_path, own=own, z=SWITCH, sections=EXTRUDER)

    async def main(served: Served) -> None:
        script = asyncio.ensure_future(gcode(served, "TEMPERATURE_PROBE_CALIBRATE"))
        assert served.service.machine is not None
        (heaters,) = served.service.machine.modules.of(HeaterRegistry)
        await served.until(lambda: heaters.targets == {"heater_bed": 60, "extruder": 200}, "the heat")
        script.cancel()
        await asyncio.gather(script, return_exceptions=True)
        await served.until(lambda: not heaters.targets, "the end")

    calibrating(stage, tmp_path, main)


def test_it_begins_where_it_is_configured(tmp_path: Path) -> None:
    own = {"calibration_position": "150, 60, 2", "horizontal_move_z": 12, "speed": 40}
    stage = stage_with(tmp_path, own=own, z=SWITCH)
    highest: list[float] = []

    def look() -> bool:
        highest.append(stage.true_mm("z"))
        return False

    stage.when(look, lambda: None)
    stage.do(
        "G4 S2", "M400", "G28", "G1 Z3 F600", "M400", "TEMPERATURE_PROBE_CALIBRATE", "M400", "G4 S1", "M400"
    )
    assert stage.machine is not None
    counts = {name: motor.count for name, motor in stage.page("mcu").motors.items()}
    head = stage.machine.stepper_positions.head(stage.machine.stepper_positions.positions(counts))
    assert head == pytest.approx((150, 60, 2), abs=0.02)
    assert max(highest) == pytest.approx(12, abs=0.02)
    at = np.array([at for at, level in stage.edges("PB0", "mcu") if level])
    assert 40 / (at[40:] - at[:-40]).min() / 80 == pytest.approx(40 * np.cos(np.arctan2(60, 150)), rel=0.05)


def test_the_extruder_is_heated_high_above_the_bed(tmp_path: Path) -> None:
    own = {"calibration_extruder_temp": 60, "extruder_heating_z": 20, "calibration_position": "90, 80, 1.5"}
    stage = stage_with(tmp_path, own=own, z=SWITCH, sections=EXTRUDER)
    heated_at: list[float] = []

    def look() -> bool:
        if (
            stage.machine is not None
            and not heated_at
            and stage.page("toolhead").temperature("extruder") > 40
        ):
            heated_at.append(stage.true_mm("z"))
        return False

    stage.when(look, lambda: None)
    output = stage.do(
        *("G4 S2", "M400", "G28", "TEMPERATURE_PROBE_CALIBRATE", "M400", "SEE OF=extruder"),
        *("ABORT", "M400", "SEE OF=extruder"),
    )
    before, after = (ast.literal_eval(text[6:]) for text in output if text.startswith("echo: {"))
    assert (before["target"], after["target"]) == (60, 0)
    assert before["temperature"] > 57
    assert heated_at == pytest.approx([20], abs=0.02)
    assert stage.true_mm("z") == pytest.approx(1.5, abs=0.02)


# ------------------------------------------------------------------------------------------------- options


def test_a_smooth_time_has_the_correction_follow_slowly(tmp_path: Path) -> None:
    """The sensor says 40 K more than the coil has: after 20 s, 1 - e^-0.2 of that is corrected."""
    file = tmp_path / "temp"
    file.write_text("25000")
    sensor = {"sensor_type": "temperature_host", "sensor_path": file, "sensor_pin": None}
    stage = stage_with(tmp_path, own={**CALIBRATED, "smooth_time": 100, **sensor}, z=SWITCH)

    def warm() -> None:
        file.write_text("65000")

    stage.on_echo["warm"] = warm
    probing = ("G1 Z3 F600", "PROBE")
    output = stage.do(
        *("G4 S5", "M400", "G28", "G1 X30 Y50 F6000", *probing, *probing[:1], "M400", "M118 warm"),
        *("G4 S20", "M400", *probing),
    )
    cold, soon = heights(output)
    assert soon - cold == pytest.approx(-0.0039 * 40 * (1 - math.exp(-0.2)), rel=0.1)


def test_how_warm_a_calibration_has_to_be_plausible_is_an_option(tmp_path: Path) -> None:
    """Curves that cross at 55 °C."""
    crossing = "0.1: 3055, -1, 0\n  0.5: 3000, 0, 0\n  1: 2000, 0, 0"
    own = {"drift_calibration": crossing}
    with pytest.raises(ConfigError, match="not plausible up to max_validation_temp"):
        stage_with(tmp_path, own=own)
    stage_with(tmp_path, own={**own, "max_validation_temp": 50})


@pytest.mark.parametrize(
    ("own", "why"),
    [
        ({"drift_calibration": "0.1: 1, 2"}, "drift_calibration"),
        ({"drift_calibration": "0.1: 1, 2, 3\n  0.5: 1, 2, 3"}, "drift_calibration"),
        ({"drift_calibration": "0.1: 1, 0, 0\n  0.5: 2, 0, 0\n  1: 3, 0, 0"}, "not plausible up to"),
        ({"calibration_position": "1, 2"}, "X, Y and Z in mm"),
        ({"calibration_extruder_temp": 60}, "needs a heater in [extruder], and there is none"),
    ],
)
def test_what_cannot_be_configured_is_said(tmp_path: Path, own: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(why)):
        stage_with(tmp_path, own=own)


def test_without_a_coil_of_its_name_it_only_reports(tmp_path: Path) -> None:
    other = section("temperature_probe other", **{**SENSOR, "sensor_pin": "toolhead:PA2"}, **CALIBRATED)
    stage = stage_with(tmp_path, air_c=60, sections=other)
    (text,) = (line for line in stage.do("G4 S2", "M400", "SEE OF='temperature_probe other'", "G28"))
    shown = ast.literal_eval(text.removeprefix("echo: "))
    assert shown["temperature"] == pytest.approx(60, abs=0.5)
    assert (shown["in_calibration"], shown["compensation_enabled"]) == (False, False)
    assert zero_error(stage) == pytest.approx(-0.0039 * 35, rel=0.1)


def test_without_a_coil_nothing_can_be_calibrated(tmp_path: Path) -> None:
    other = section("temperature_probe other", **{**SENSOR, "sensor_pin": "toolhead:PA2"})
    with pytest.raises(GCodeError, match=r"with the NAME of a \[probe_eddy_current\], and there is none"):
        stage_with(tmp_path, sections=other, z=SWITCH).do("G28", "TEMPERATURE_PROBE_CALIBRATE")
