"""What a user may write about heaters, sensors and fans, and what is said about mistakes."""

from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from coordinator.gcode.commands import Call, Synchronized
from coordinator.gcode.parser import WordError, parse
from coordinator.heat.known_sensors import PT1000, THERMISTORS
from coordinator.modules.heaters.sections import ExtruderHeaterSection, HeaterBed
from coordinator.modules.module_set import build_modules
from coordinator.modules.sensors.temperature_input import TemperatureInput
from coordinator.modules.sensors.temperature_sensor import TemperatureSensor
from tests.stages.heat_machine import BASE, BED, HOTEND_PID, build, configured

THREE = "\n[thermistor x]\ntemperature1: 25\ntemperature2: 50\ntemperature3: 70\n"
BLOWER = (
    "\n[temperature_fan x]\npin: PC5\nsensor_type: PT1000\nsensor_pin: PC6\nmin_temp: 0\nmax_temp: 99\n"
    "control: watermark\n"
)


def error(tmp_path: Path, text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        build(tmp_path, text)
    return str(caught.value)


def test_every_heater_has_the_nodes_own_net(tmp_path: Path) -> None:
    commands = configured(build(tmp_path, HOTEND_PID + BED), "toolhead") + configured(
        build(tmp_path, HOTEND_PID + BED.replace("[heater_bed]", "[heater_bed]\nmax_duration: 3")), "mcu"
    )
    outs = [command for command in commands if command.startswith("config_digital_out")]
    # It counts on the node from when a value takes effect, 0.4 s after the host was heard.
    ticks = [round((limit_s - 0.4) * 168_000_000) for limit_s in (1.5, 3.0)]
    assert [out.split()[-1] for out in outs] == [f"max_duration={n}" for n in ticks]
    assert all("value=0 default_value=0" in out for out in outs)


def test_only_a_sensor_with_limits_stops_its_node(tmp_path: Path) -> None:
    sensor = "\n[temperature_sensor air]\nsensor_type: PT1000\nsensor_pin: PC3\n"
    for text, low, high in ((sensor, 0.0, 1.0), (sensor + "min_temp: 0\nmax_temp: 100\n", 0.1754, 0.2276)):
        (air,) = build(tmp_path, HOTEND_PID + text).of(TemperatureSensor)
        assert isinstance(air.input, TemperatureInput)
        limits = air.input._analog._low, air.input._analog._high
        assert limits == pytest.approx((low, high), abs=1e-4)


def test_targets_are_for_the_extruder_that_is_meant(tmp_path: Path) -> None:
    second = BASE[BASE.index("[extruder]") :].replace("[extruder]", "[extruder1]").replace("PB", "PD")
    modules = build(tmp_path, HOTEND_PID + second + HOTEND_PID)
    heaters = {module.name: module for module in modules.of(ExtruderHeaterSection)}
    for line, active, name in (
        ("M104 S200", "", "extruder"),
        ("M104 S201", "extruder", "extruder"),
        ("M104 S202", "extruder1", "extruder1"),
        ("M104 S203 T1", "extruder", "extruder1"),
        ("M104 S204 T0", "extruder1", "extruder"),
    ):
        command = parse(line.encode())
        assert command is not None
        reading = modules.vocabulary.commands["M104"].read(
            Call(command, 1, (0, 0, 0, 0), "", extruder=active)
        )
        assert isinstance(reading, Synchronized)
        reading.act(0.0)
        unit = heaters[name].unit
        assert unit is not None
        assert unit.target_c == float(line.split()[1][1:])


def test_extruders_that_there_are_not_and_those_without_heater(tmp_path: Path) -> None:
    cold = BASE[BASE.index("[extruder]") : BASE.index("heater_pin")]
    cold = cold.replace("[extruder]", "[extruder1]").replace("PB", "PD")
    read = build(tmp_path, HOTEND_PID + cold).vocabulary.commands["M109"].read
    for line, told in (
        ("M109 S200 T7", "M109 refers to unknown extruder T7; there is T0 to T1"),
        ("M109 S200 T1", r"M109: \[extruder1\] has no heater; give it a heater_pin"),
    ):
        command = parse(line.encode())
        assert command is not None
        with pytest.raises(WordError, match=told):
            read(Call(command, 1, (0, 0, 0, 0), ""))


LINES = len(BASE.splitlines())


@pytest.mark.parametrize("name", THERMISTORS)
def test_sensors_by_name(tmp_path: Path, name: str) -> None:
    (bed,) = build(tmp_path, HOTEND_PID + BED.replace("Generic 3950", name)).of(HeaterBed)
    sensor = bed.unit.input._sensor
    assert sensor is not None
    assert sensor.ratio(80) == pytest.approx(
        THERMISTORS[name].curve.ohms(80) / (THERMISTORS[name].curve.ohms(80) + 4700)
    )


def test_sensors_of_the_users_own(tmp_path: Path) -> None:
    own = (
        "\n[thermistor mine]\ntemperature1: 25\nresistance1: 10000\nbeta: 3435\n"
        "[thermistor three]\ntemperature1: 25\nresistance1: 103180\ntemperature2: 150\nresistance2: 1366.2\n"
        "temperature3: 250\nresistance3: 168.6\n"
        "[adc_temperature volts]\ntemperature1: 0\nvoltage1: 0.5\ntemperature2: 100\nvoltage2: 1.5\n"
        "[adc_temperature ohms]\ntemperature1: 0\nresistance1: 1000\ntemperature2: 200\nresistance2: 1758\n"
    )
    for name, celsius, ratio in (
        ("mine", 25, 10_000 / 14_700),
        ("three", 150, 1366.2 / 6066.2),
        ("volts", 50, 0.2),
        ("ohms", 100, 1379 / 6079),
        ("PT1000", 100, PT1000.ohms(100) / (PT1000.ohms(100) + 4700)),
    ):
        (bed,) = build(tmp_path, HOTEND_PID + BED.replace("Generic 3950", name) + own).of(HeaterBed)
        sensor = bed.unit.input._sensor
        assert sensor is not None
        assert sensor.ratio(celsius) == pytest.approx(ratio), name


def test_an_extruder_without_heater_is_never_cold(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(BASE[: BASE.index("heater_pin")])
    machine = load_machine(str(path))
    modules = build_modules(machine)
    (heater,) = modules.of(ExtruderHeaterSection)
    assert heater.can_extrude
    assert not modules.vocabulary.too_cold("extruder")
    assert "M104" not in modules.vocabulary.commands


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "control: pdi\n",
            f"printer.cfg:{LINES + 1}: option 'control' of [extruder] is 'pdi', must be pid, ",
        ),
        ("control: pid\npid_kp: 1\n", "[extruder] lacks option 'pid_ki'"),
        ("control: mpc\n", "[extruder] lacks option 'heater_power', a number in W"),
        (
            "control: mpc\nheater_power: 40\nblock_heat_capacity: 12\n",
            "[extruder] has only some of 'block_heat_capacity', 'ambient_transfer' and ",
        ),
        (
            "control: watermark\nmax_power: 1.5\n",
            "'max_power' of [extruder] is '1.5', must be a number",
        ),
        ("pwm_cycle_tme: 1\n", "[extruder] has no option 'pwm_cycle_tme'; did you mean 'pwm_cycle_time'"),
        ("min_extrude_temp: hot\n", "'min_extrude_temp' of [extruder] is 'hot', must be a number in °C"),
        (
            BED.replace("Generic 3950", "Generik 3950"),
            "'Generik 3950'; did you mean 'Generic 3950'",
        ),
        (
            BED.replace("Generic 3950", "my_own"),
            "no sensor 'my_own'; add a section [thermistor my_own]",
        ),
        (BED.replace("max_temp: 130", "max_temp: -5"), "min_temp (0 °C) must be below max_temp (-5 °C)"),
        (BED.replace("PC1", "PA1"), "pin mcu:PA1 is already used for 'step_pin' of [stepper_x]"),
        (BED.replace("PC2", "toolhead:PB4"), "pin toolhead:PB4 is already used"),
        (BED.replace("sensor_pin: PC2", ""), "[heater_bed] lacks option 'sensor_pin'"),
        (
            "\n[thermistor x]\ntemperature1: 25\nresistance1: 5\n",
            "x] lacks option 'temperature2'",
        ),
        (
            THREE + "resistance1: 5\nresistance2: 6\nresistance3: 2\n",
            "[thermistor x]: the resistance of a thermistor's three points must fall",
        ),
        ("\n[adc_temperature x]\ntemperature1: 25\nvoltage1: 5\n", "at least two points are needed"),
        (
            "\n[adc_temperature x]\ntemperature1: 25\nvoltage1: 5\ntemperature2: 50\nresistance2: 5\n",
            "mixes voltages and resistances",
        ),
        (
            "\n[adc_temperature x]\ntemperature1: 25\n",
            "'temperature1' needs either 'voltage1' or ",
        ),
        (
            "\n[heater_fan x]\npin: PC5\nheater: bed\n",
            "'heater' of [heater_fan x] names 'bed', which ",
        ),
        ("cooling_fan: fan\n", "'cooling_fan' of [extruder] names 'fan', which does not exist"),
        ("\n[verify_heater extruder]\nhysteresis: -1\n", "'hysteresis' of [verify_heater extruder] is '-1'"),
        ("\n[verify_heater extrudr]\n", "[verify_heater extrudr] refers to an unknown heater; did you mean"),
        (
            BLOWER + "min_speed: 0.9\nmax_speed: 0.5\n",
            "'min_speed' of [temperature_fan x] is '0.9', more than max_speed (0.5)",
        ),
    ],
)
def test_one_sentence_for(tmp_path: Path, text: str, sentence: str) -> None:
    assert sentence in error(tmp_path, text)
