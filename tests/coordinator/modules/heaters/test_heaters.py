"""Heaters and their commands on virtual nodes, whose plant is the truth about temperatures."""

import asyncio
import re
from pathlib import Path

import pytest

from coordinator.assembly.check import check_config
from coordinator.gcode.commands import Call
from coordinator.gcode.parser import WordError, parse
from coordinator.heat.mpc import Mpc
from coordinator.verification.heat_proof import HeatWatch
from nodes.support.errors import CanductorError
from tests.stages.heat_machine import BED, FAN, HOTEND_PID, HeatMachine, build

MPC = (
    "control: mpc\nheater_power: 40\ncooling_fan: fan\nblock_heat_capacity: 13\nambient_transfer: 0.075\n"
    "sensor_responsiveness: 0.5\nfan_ambient_transfer: 0.075, 0.105\n"
)


@pytest.mark.parametrize("control", [HOTEND_PID, MPC, "control: watermark\nmax_delta: 0.3\n"])
def test_a_hot_end_is_held_within_a_kelvin_of_the_truth(tmp_path: Path, control: str) -> None:
    stage = HeatMachine(tmp_path, control + FAN)

    async def main() -> None:
        replies = await stage.do("M109 S200")
        assert replies[0].startswith("T0:")
        await asyncio.sleep(20)
        low, high = await stage.true_range(20)
        # A switch overshoots by what its hot cartridge still gives: it is for beds.
        margin = 4.0 if "watermark" in control else 1.0
        assert 200 - margin < low <= high < 200 + margin
        if control is MPC:
            await stage.do("M106")
            low, high = await stage.true_range(20)
            assert 199 < low <= high < 201, "it is told of the fan"
        await stage.do("M104 S0")
        await asyncio.sleep(2)
        assert stage.heater_off_after(stage.now_s()) < 0

    stage.connected(main)


def test_a_bed_by_watermark_and_lost_frames(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, BED.replace("watermark", "watermark\nmax_delta: 0.5"), loss=0.01)

    async def main() -> None:
        await stage.do("M190 S60")
        low, high = await stage.true_range(20, "heater_bed", "mcu")
        assert 58.5 < low <= high < 62, "it swings by max_delta and what the delay adds"
        assert "B:" in (await stage.do("M105"))[0]

    stage.connected(main)


def test_pid_calibration_gives_constants_that_hold(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID.replace("22.2", "1.0"), hurry=4)

    saved: list[str] = []

    async def main() -> None:
        replies = await stage.do("PID_CALIBRATE HEATER=extruder TARGET=210")
        assert [line.partition(":")[0] for line in replies[1:]] == ["control", "pid_kp", "pid_ki", "pid_kd"]
        assert stage.status("extruder")["target"] == 0
        kept = stage.status("heaters")["calibrated"]
        assert kept == {"extruder": dict(line.split(": ") for line in replies[1:])}
        assert stage.status("configfile")["save_config_pending_items"] == kept
        (told,) = await stage.do("SAVE_CONFIG")
        path, _, rest = told.removeprefix("saved into ").partition("; ")
        assert rest == "it counts from the next start on", "nobody restarts this machine"
        saved.append(path)
        with pytest.raises(CanductorError, match="cannot restart; start the command again"):
            await stage.do("RESTART")
        await stage.do("M109 S210")
        await asyncio.sleep(15)
        low, high = await stage.true_range(10)
        assert 209 < low <= high < 211

    stage.connected(main)
    assert "\n#*# [extruder]\n#*# control = pid\n#*# pid_kp = " in Path(saved[0]).read_text()
    assert not check_config(saved[0])


def test_mpc_calibration_finds_the_plant(tmp_path: Path) -> None:
    text = "control: mpc\nheater_power: 40\ncooling_fan: fan\n"
    stage = HeatMachine(tmp_path, text + FAN, hurry=4)

    async def main() -> None:
        with pytest.raises(WordError, match="MPC_CALIBRATE HEATER=extruder"):
            stage.read("M104 S200")
        replies = await stage.do("MPC_CALIBRATE HEATER=extruder TARGET=200 FAN_BREAKPOINTS=2")
        found = {name: text for name, _, text in (line.partition(": ") for line in replies[1:])}
        assert float(found["block_heat_capacity"]) == pytest.approx(13 / 4, rel=0.1)
        assert float(found["ambient_transfer"]) == pytest.approx(0.075, rel=0.1)
        still, blown = map(float, found["fan_ambient_transfer"].split(","))
        assert (still, blown) == pytest.approx((0.075, 0.105), rel=0.1)
        assert stage.status("fan")["speed"] == 0
        await stage.do("M109 S220")
        await asyncio.sleep(15)
        low, high = await stage.true_range(10)
        assert 219 < low <= high < 221

    stage.connected(main)


@pytest.mark.parametrize("bounds", ["MINIMUM=300", "MAXIMUM=0", "MINIMUM=1e9 MAXIMUM=2e9"])
def test_a_wait_that_cannot_come_true_is_refused(tmp_path: Path, bounds: str) -> None:
    """Also when the program is only planned: no machine has to be there.

    Failed before at the limits themselves, where the sensor faults.
    """
    command = parse(f"TEMPERATURE_WAIT SENSOR=extruder {bounds}".encode())
    assert command is not None
    read = build(tmp_path, HOTEND_PID).vocabulary.commands["TEMPERATURE_WAIT"].read
    with pytest.raises(WordError, match=r"waits for what \[extruder\] never reads: it takes 0 to \d+ °C"):
        read(Call(command, 1, (0, 0, 0, 0), ""))


def test_a_wait_can_be_cancelled_and_the_heater_goes_on(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID + BED, hurry=10)

    async def main() -> None:
        for line in ("M109 S250", "TEMPERATURE_WAIT SENSOR=heater_bed MINIMUM=100"):
            waiting = asyncio.ensure_future(stage.do(line))
            await asyncio.sleep(0.7)
            waiting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await waiting
        assert stage.status("extruder")["target"] == 250
        await stage.do("TURN_OFF_HEATERS")
        assert stage.status("extruder") | {"temperature": 0} == {
            "temperature": 0,
            "target": 0.0,
            "power": 0.0,
            "held_s": None,
            "held_low": None,
            "held_high": None,
            "can_extrude": False,
        }

    stage.connected(main)


def test_a_calibration_that_is_cancelled_leaves_the_heater_off(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, HOTEND_PID, hurry=10)

    async def main() -> None:
        tuning = asyncio.ensure_future(stage.do("PID_CALIBRATE HEATER=extruder TARGET=200"))
        await asyncio.sleep(5)
        with pytest.raises(CanductorError, match="being calibrated already"):
            await stage.do("PID_CALIBRATE HEATER=extruder TARGET=200")
        tuning.cancel()
        with pytest.raises(asyncio.CancelledError):
            await tuning
        await asyncio.sleep(1)
        assert stage.heater_off_after(stage.now_s()) < 0
        assert stage.status("extruder")["power"] == 0

    stage.connected(main)


def test_temperature_wait_in_both_directions(tmp_path: Path) -> None:
    stage = HeatMachine(
        tmp_path,
        HOTEND_PID + "\n[temperature_sensor air]\nsensor_type: PT1000\n"
        "sensor_pin: PC3\npullup_resistor: 2200\ngcode_id: A\n",
        hurry=10,
    )

    async def main() -> None:
        await stage.do("SET_HEATER_TEMPERATURE HEATER=extruder TARGET=150")
        await stage.do("TEMPERATURE_WAIT SENSOR=extruder MINIMUM=100")
        assert 98 < stage.true_c() < 130
        await stage.do("SET_HEATER_TEMPERATURE HEATER=extruder")
        await stage.do("TEMPERATURE_WAIT SENSOR=extruder MAXIMUM=80")
        assert stage.true_c() < 82
        await stage.do('TEMPERATURE_WAIT SENSOR="temperature_sensor air" MINIMUM=10 MAXIMUM=40')
        air_c = pytest.approx(25, abs=1)
        found = re.match(r"A:([\d.]+) ", (await stage.do("M105"))[0])
        assert found is not None
        assert float(found[1]) == air_c
        assert stage.status("temperature_sensor air")["temperature"] == air_c

    stage.connected(main)


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("M104 S301", "outside what .extruder. allows, 0 to 300"),
        ("M109 S-5", "outside"),
        ("M104 S200 T1", "M104 refers to unknown extruder T1; there is only T0"),
        ("SET_HEATER_TEMPERATURE HEATER=extrudr TARGET=1", "there is no 'extrudr'.*extruder"),
        ("SET_HEATER_TEMPERATURE TARGET=1", "needs HEATER="),
        ("TEMPERATURE_WAIT SENSOR=extruder", "MINIMUM= or MAXIMUM="),
        ("TEMPERATURE_WAIT SENSOR=extruder MINIMUM=50 MAXIMUM=40", "is above"),
        ("PID_CALIBRATE HEATER=extruder", "needs TARGET="),
        ("PID_CALIBRATE HEATER=extruder TARGET=400", "TARGET=400 is outside"),
        ("MPC_CALIBRATE HEATER=extruder TARGET=200", "needs the option heater_power"),
    ],
)
def test_mistakes_in_commands_are_told_when_they_are_read(calm: HeatMachine, line: str, text: str) -> None:
    with pytest.raises(WordError, match=text):
        calm.read(line)


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> HeatMachine:
    """A machine that has been and is gone: commands are read without it."""
    stage = HeatMachine(tmp_path_factory.mktemp("calm"), HOTEND_PID)

    async def main() -> None:
        await stage.do("M105")

    stage.connected(main)
    return stage


def test_a_target_behind_a_dwell_waits_for_its_time(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, BED)
    stage.print("M140 S100", "G4 P20000", "M140 S0", "G4 P5000")
    on_s = next(at_s for at_s, level in stage.edges("PC1", "mcu") if level)
    assert 18 < stage.heater_off_after(on_s, "PC1", "mcu") < 21


def test_the_band_that_was_kept_is_told_while_it_lasts_and_at_its_end(tmp_path: Path) -> None:
    stage, watch = HeatMachine(tmp_path, MPC + FAN + BED), HeatWatch()
    stage.print("M140 S30", "M109 S80", "G4 P20000", "M104 S0", "G4 P8000", ready=watch.attach)
    assert sorted({state.heater for state in watch.states}) == ["extruder", "heater_bed"]
    hotend = next(state for state in watch.states if state.heater == "extruder")
    assert (hotend.control, hotend.held.target_c, hotend.node) == ("mpc", 80.0, "toolhead")
    assert 5 < hotend.held.seconds < 20
    assert hotend.held.deviation_k < 1
    bed = next(state for state in watch.states if state.heater == "heater_bed")
    assert (bed.control, bed.max_delta_k, bed.body) == ("watermark", 2.0, "heater_bed")
    assert bed.span_ns[1] - bed.span_ns[0] == pytest.approx(bed.held.seconds * 1e9, rel=1e-3)
    assert bed.held.seconds > hotend.held.seconds + 8, "it lasted to the end of the machine"


def test_a_model_is_told_of_filament_before_it_passes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage, told = HeatMachine(tmp_path, MPC + FAN), list[tuple[float, float | None]]()
    tell = Mpc.set_filament

    def note(model: Mpc, passed: float, coming: float | None = None) -> None:
        assert model.model.filament_j_per_mm_k == pytest.approx(0.0052, abs=1e-4)
        told.append((passed, coming))
        tell(model, passed, coming)

    monkeypatch.setattr(Mpc, "set_filament", note)
    stage.print("M109 S180", "G28", "M83", "G1 X100 E20 F1200", "G4 P2000", "M104 S0")
    passed = [speed for speed, _ in told]
    coming = [speed or 0.0 for _, speed in told]
    assert max(passed) == pytest.approx(4, abs=0.05), "100 mm in 5 s with 20 mm of filament"
    assert max(coming) == pytest.approx(4, abs=0.05)
    begins = [next(n for n, speed in enumerate(speeds) if speed > 1) for speeds in (coming, passed)]
    ends = [next(n for n, speed in enumerate(speeds[-1::-1]) if speed > 1) for speeds in (coming, passed)]
    assert begins[0] <= begins[1] - 1, "a measurement earlier at least"
    assert ends[0] >= ends[1] + 1
