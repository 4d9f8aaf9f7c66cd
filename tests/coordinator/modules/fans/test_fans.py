"""Fans on virtual nodes: what their pins do, and what the plant's fans make of it."""

import asyncio
from pathlib import Path

import pytest

from coordinator.gcode.parser import WordError
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from tests.stages.heat_machine import BASE, BED, FAN, HeatMachine

PID = "control: pid\npid_kp: 10\npid_ki: 1\npid_kd: 15\n"


def on_part(stage: HeatMachine, pin: str, seconds: float, node: str = "toolhead") -> float:
    """Return which part of the last SECONDS an output was high."""
    end = stage.now_s()
    begin, level, high = end - seconds, 0, 0.0
    last = begin
    for at, new in stage.edges(pin, node):
        if at > begin:
            high += (at - last) * level
            last = at
        level = new
    return (high + (end - last) * level) / seconds


def test_the_part_fan(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, PID + FAN.replace("[fan]", "[fan]\nmax_power: 0.8\noff_below: 0.1"))

    async def main() -> None:
        for line, speed, part in (
            ("M106 S128", 128 / 255, 0.8 * 128 / 255),
            ("M106", 1.0, 0.8),
            ("M106 S20", 0.0, 0.0),
            ("M106 S300", 1.0, 0.8),
            ("M107", 0.0, 0.0),
        ):
            await stage.do(line)
            await asyncio.sleep(3)
            assert stage.status("fan")["speed"] == pytest.approx(speed, abs=1e-3)
            assert on_part(stage, "PB5", 1.5) == pytest.approx(part, abs=0.01)
        with pytest.raises(WordError, match="must be 0 to 255"):
            stage.read("M106 S-1")

    stage.connected(main)


def test_a_fan_starts_with_a_kick(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, PID + FAN.replace("[fan]", "[fan]\nkick_start_time: 0.5"))

    async def main() -> None:
        await stage.do("M106 S26")
        await asyncio.sleep(2)
        (up_s, _), (down_s, _) = stage.edges("PB5")[:2]
        assert down_s - up_s == pytest.approx(0.5 + 26 / 255 * 0.01, abs=1e-3)
        before = len(stage.edges("PB5"))
        await stage.do("M106 S26")
        await asyncio.sleep(0.5)
        assert len(stage.edges("PB5")) - before == pytest.approx(100, abs=4), "no kick: nothing changed"

    stage.connected(main)


def test_a_tachometer_tells_a_fan_that_fails(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, PID + FAN)

    async def main() -> None:
        await stage.do("M106")
        await asyncio.sleep(6)
        turns = stage.status("fan")["rpm"]
        assert turns == pytest.approx(6000, rel=0.03)
        stage.fault(PlantItemKind.FAN, PlantFault.DEAD, "fan")
        await asyncio.sleep(6)
        status = stage.status("fan")
        assert (status["speed"], status["rpm"]) == (1.0, 0.0)

    stage.connected(main)


def test_a_heater_goes_on_when_the_part_fan_fails_and_comes_back(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, PID + FAN, hurry=3)

    async def main() -> None:
        await stage.do("M104 S180")
        await stage.do("TEMPERATURE_WAIT SENSOR=extruder MINIMUM=177")
        for _ in range(2):
            await stage.do("M106")
            await asyncio.sleep(5)
            stage.fault(PlantItemKind.FAN, PlantFault.DEAD, "fan")
            await asyncio.sleep(5)
            stage.fault(PlantItemKind.FAN, PlantFault.SOUND, "fan")
        assert stage.machine.stopped is None
        assert 170 < stage.true_c() < 190

    stage.connected(main)


def test_a_heater_fan_runs_while_its_heater_is_or_is_to_be_hot(tmp_path: Path) -> None:
    fan = "\n[heater_fan cold_end]\npin: toolhead:PB7\nfan_speed: 0.5\nkick_start_time: 0\n"
    stage = HeatMachine(tmp_path, PID + fan, hurry=5)

    async def main() -> None:
        await asyncio.sleep(2)
        assert stage.edges("PB7") == []
        await stage.do("M104 S150")
        await asyncio.sleep(5)
        assert on_part(stage, "PB7", 2) == pytest.approx(0.5, abs=0.01)
        await stage.do("TEMPERATURE_WAIT SENSOR=extruder MINIMUM=120")
        await stage.do("M104 S0")
        await asyncio.sleep(3)
        assert on_part(stage, "PB7", 1) > 0.4, "it is still hot"
        await stage.do("TEMPERATURE_WAIT SENSOR=extruder MAXIMUM=45")
        await asyncio.sleep(4)
        assert on_part(stage, "PB7", 1) == 0
        stage.machine.stop("for the test")
        await asyncio.sleep(1)
        assert stage.edges("PB7")[-1][1] == 1, "when all stops it runs: the hot end may be hot"

    stage.connected(main)


def test_a_controller_fan_runs_while_there_is_work_and_a_time_after(tmp_path: Path) -> None:
    fan = "\n[controller_fan board]\npin: PC5\nidle_timeout: 5\nidle_speed: 0.25\nkick_start_time: 0\n"
    stage = HeatMachine(tmp_path, PID + fan, hurry=5)

    async def main() -> None:
        await asyncio.sleep(3)
        assert stage.edges("PC5", "mcu") == []
        await stage.do("M104 S60")
        await asyncio.sleep(3)
        assert on_part(stage, "PC5", 1, "mcu") == 1
        await stage.do("M104 S0")
        await asyncio.sleep(4)
        assert on_part(stage, "PC5", 1, "mcu") == pytest.approx(0.25, abs=0.02)
        await asyncio.sleep(5)
        assert on_part(stage, "PC5", 1, "mcu") == 0

    stage.connected(main)


def test_a_controller_fan_runs_while_its_steppers_are_on(tmp_path: Path) -> None:
    base = BASE.replace("step_pin: PA1\n", "step_pin: PA1\nenable_pin: !PD1\n").replace(
        "step_pin: PA3\n", "step_pin: PA3\nenable_pin: !PD2\n"
    )
    common = "idle_timeout: 2\nidle_speed: 0\nkick_start_time: 0\n"
    fans = "".join(
        f"\n[controller_fan {axis}]\npin: {pin}\nstepper: stepper_{axis}\n{common}"
        for axis, pin in (("x", "PC5"), ("z", "PC6"))
    )
    stage = HeatMachine(tmp_path, PID + fans + f"\n[controller_fan all]\npin: PC7\n{common}", base=base)

    def running() -> list[float]:
        return [on_part(stage, pin, 1, "mcu") for pin in ("PC5", "PC6", "PC7")]

    async def main() -> None:
        await stage.do("SET_STEPPER_ENABLE STEPPER=stepper_y ENABLE=1")
        await asyncio.sleep(3)
        assert running() == [0, 0, 1], "Y is none of theirs, and Z without enable_pin is on while a job runs"
        await stage.do("SET_STEPPER_ENABLE STEPPER=stepper_x ENABLE=1")
        await asyncio.sleep(3)
        assert running() == [1, 0, 1]
        await stage.do("M84")
        await asyncio.sleep(5)
        assert running() == [0, 0, 0]

    stage.connected(main)


def test_a_fan_by_its_name_and_by_hardware(tmp_path: Path) -> None:
    text = "\n[fan_generic Chamber]\npin: PC6\nhardware_pwm: True\ncycle_time: 0.00004\nshutdown_speed: 0.3\n"
    stage = HeatMachine(tmp_path, PID + text)

    async def main() -> None:
        await stage.do("SET_FAN_SPEED FAN=chamber SPEED=0.4")
        await asyncio.sleep(1)
        assert stage.status("fan_generic Chamber")["speed"] == 0.4
        assert stage.page("mcu").item(PlantItemKind.FAN, "fan_generic_Chamber").value == pytest.approx(
            0.4, abs=0.01
        )
        with pytest.raises(WordError, match="there is no 'Chmber'"):
            stage.read("SET_FAN_SPEED FAN=Chmber SPEED=1")
        with pytest.raises(WordError, match="must be 0 to 1"):
            stage.read("SET_FAN_SPEED FAN=Chamber SPEED=2")
        stage.machine.stop("for the test")
        await asyncio.sleep(1)
        assert stage.page("mcu").item(PlantItemKind.FAN, "fan_generic_Chamber").value == pytest.approx(
            0.3, abs=0.01
        )

    stage.connected(main)


@pytest.mark.parametrize("control", ["watermark\nmax_delta: 2", "pid\npid_kp: 20\npid_ki: 0.5\npid_kd: 5"])
def test_a_temperature_fan_follows_its_sensor(tmp_path: Path, control: str) -> None:
    text = (
        "\n[temperature_fan bed_side]\npin: PC7\nsensor_type: Generic 3950\nsensor_pin: PC8\nmin_temp: 0\n"
        f"max_temp: 150\ntarget_temp: 60\nkick_start_time: 0\nmin_speed: 0.2\ncontrol: {control}\n"
    )
    stage = HeatMachine(tmp_path, PID + text)

    async def main() -> None:
        await asyncio.sleep(3)
        fan = "temperature_fan bed_side"
        assert stage.status(fan)["speed"] == 0.2, "25 °C are cool enough"
        await stage.do("SET_TEMPERATURE_FAN_TARGET TEMPERATURE_FAN=bed_side TARGET=10")
        await asyncio.sleep(3)
        assert stage.status(fan)["speed"] == 1.0
        assert on_part(stage, "PC7", 1, "mcu") == 1
        await stage.do("SET_TEMPERATURE_FAN_TARGET TEMPERATURE_FAN=bed_side TARGET=0")
        await asyncio.sleep(2)
        assert stage.status(fan) | {"temperature": 25} == {
            "speed": 0.0,
            "rpm": None,
            "temperature": 25,
            "target": 0,
        }
        with pytest.raises(WordError, match="outside what"):
            stage.read("SET_TEMPERATURE_FAN_TARGET TEMPERATURE_FAN=bed_side TARGET=200")

    stage.connected(main)


def test_a_fans_enable_pin(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, PID + BED + "\n[fan]\npin: PC5\nenable_pin: !PC6\nkick_start_time: 0\n")

    async def main() -> None:
        await asyncio.sleep(1)
        assert [level for _, level in stage.edges("PC6", "mcu")] == [1]
        await stage.do("M106 S100")
        await asyncio.sleep(1)
        await stage.do("M106 S200")
        await asyncio.sleep(1)
        await stage.do("M107")
        await asyncio.sleep(1)
        assert [level for _, level in stage.edges("PC6", "mcu")] == [1, 0, 1]

    stage.connected(main)
