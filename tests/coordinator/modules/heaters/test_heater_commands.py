"""The commands of all heaters, read and carried out on heaters whose measurements the test gives."""

import asyncio
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.errors import ConfigError
from coordinator.gcode.commands import AtStandstill, Call, Immediate, Reading, Synchronized
from coordinator.gcode.events import Done
from coordinator.gcode.parser import WordError, parse
from coordinator.gcode.reply_kinds import ReplyKind
from coordinator.modules.heaters.heater import Heater
from coordinator.modules.heaters.heaters import HeaterRegistry
from coordinator.modules.heaters.verify_heater import VerifyHeater
from coordinator.modules.module_set import ModuleSet
from coordinator.modules.sensors.temperature_source import TemperatureSource
from tests.coordinator.modules.scripted_live import Driven
from tests.stages.heat_machine import BASE, HOTEND_PID, build, configured

CHAMBER = (
    "\n[heater_generic chamber]\nheater_pin: PC3\nsensor_type: Generic 3950\nsensor_pin: PA12\nmin_temp: 5\n"
    "max_temp: 100\ncontrol: watermark\nheater_power: 50\n"
)
SENSORS = (
    "\n[temperature_sensor air]\nsensor_type: PT1000\nsensor_pin: PC4\ngcode_id: A\n"
    "\n[temperature_sensor box]\nsensor_type: PT1000\nsensor_pin: PC5\n"
)


class Shop:
    """A machine with a hot end, a chamber and two sensors, none of which is connected."""

    def __init__(self, modules: ModuleSet) -> None:
        self.modules = modules
        for node in ("mcu", "toolhead"):
            configured(modules, node)
        heaters = modules.find("heaters", HeaterRegistry)
        assert heaters is not None
        self.heaters = heaters
        self.chamber, self.extruder = heaters.units["chamber"], heaters.units["extruder"]

    def source(self, name: str) -> TemperatureSource:
        return self.heaters.sensors[name]

    def read(self, line: str) -> Reading:
        command = parse(line.encode())
        assert command is not None
        return self.modules.vocabulary.commands[command.name].read(Call(command, 1, (0, 0, 0, 0), ""))

    def told(self, line: str) -> tuple[str, ...]:
        reading = self.read(line)
        assert isinstance(reading, Immediate)
        return reading.replies

    def perform(self, line: str) -> "asyncio.Future[Done | None]":
        reading = self.read(line)
        assert isinstance(reading, AtStandstill)
        return asyncio.ensure_future(reading.perform())

    def refused(self, line: str) -> str:
        with pytest.raises(WordError) as error:
            self.read(line)
        return str(error.value)


@pytest.fixture
def shop(tmp_path: Path) -> Shop:
    return Shop(build(tmp_path, HOTEND_PID + CHAMBER + SENSORS))


async def turns() -> None:
    for _ in range(8):
        await asyncio.sleep(0)


# ---------------------------------------------------------------------------------------------- what there is


def test_all_are_known_by_the_names_that_programs_may_use(shop: Shop) -> None:
    assert shop.heaters.name == "heaters"
    status = {
        "available_heaters": ["extruder", "chamber"],
        "available_sensors": [
            *("extruder", "chamber", "heater_generic chamber"),
            *("temperature_sensor air", "temperature_sensor box"),
        ],
        "available_monitors": [],
        "calibrated": {},
    }
    found = dict(shop.heaters.status())
    assert found.pop("waiting_for") is None
    assert {name: sorted(map(str, found[name])) for name in found} == {  # type: ignore[arg-type]
        name: sorted(values) for name, values in status.items()
    }
    shop.chamber.keep({"pid_kp": "1"})
    assert shop.heaters.status()["calibrated"] == {"heater_generic chamber": {"pid_kp": "1"}}


def test_all_temperatures_are_told_in_the_order_of_their_tags(shop: Shop) -> None:
    shop.chamber.target_c = 61.25
    shop.chamber.input.celsius = 55.55
    shop.source("temperature_sensor air").celsius = 21.04
    reading = shop.read("M105")
    assert isinstance(reading, Immediate)
    assert reading.replies == ("A:21.0 /0.0 T0:0.0 /0.0 chamber:55.5 /61.2",)
    assert reading.kind is ReplyKind.PLAIN
    assert "belong" in shop.refused("M105 =")


def test_without_heaters_there_is_one_temperature_of_nothing(shop: Shop) -> None:
    shop.heaters._tags.clear()
    assert shop.told("M105") == ("T:0",)


def test_which_commands_need_not_wait_for_a_job(shop: Shop) -> None:
    beside = {name for name, command in shop.modules.vocabulary.commands.items() if command.while_printing}
    assert {"M105", "TURN_OFF_HEATERS", "SET_HEATER_TEMPERATURE"} <= beside
    assert not {"TEMPERATURE_WAIT", "QUERY_ADC", "PID_CALIBRATE", "MPC_CALIBRATE"} & beside


# --------------------------------------------------------------------------------------------------- targets


@pytest.mark.parametrize("name", ["chamber", "CHAMBER", "'heater_generic chamber'"])
def test_a_target_is_set_in_time_by_either_name(shop: Shop, name: str) -> None:
    for target, celsius in ((" TARGET=60", 60.0), ("", 0.0)):
        reading = shop.read(f"SET_HEATER_TEMPERATURE HEATER={name}{target}")
        assert isinstance(reading, Synchronized)
        reading.act(0.0)
        assert shop.chamber.target_c == celsius
    assert "outside what" in shop.refused(f"SET_HEATER_TEMPERATURE HEATER={name} TARGET=101")


def test_all_are_switched_off_together(shop: Shop) -> None:
    shop.chamber.target_c, shop.extruder.target_c = 60.0, 200.0
    reading = shop.read("TURN_OFF_HEATERS")
    assert isinstance(reading, Synchronized)
    assert shop.chamber.target_c == 60.0
    reading.act(0.0)
    assert (shop.chamber.target_c, shop.extruder.target_c) == (0.0, 0.0)
    assert shop.refused("TURN_OFF_HEATERS X").startswith("TURN_OFF_HEATERS")


def test_a_wait_for_a_target_ends_with_it_and_tells_all_and_off_waits_for_nothing(shop: Shop) -> None:
    driven = Driven(shop.extruder)

    async def main() -> None:
        assert "outside" in shop.refused("M109 S301")
        for line, celsius in (("M109 S1", 1.0), ("M109 S200", 200.0)):
            waiting = shop.perform(line)
            await turns()
            assert shop.extruder.target_c == celsius
            assert not waiting.done()
            for at_s in (1.0, 2.0):
                driven.measured(celsius, at_s + celsius)
            await turns()
            done = await waiting
            assert done is not None
            assert done.kind is ReplyKind.PLAIN
            assert done.replies == (shop.heaters.temperatures(),)
            assert f"T0:{celsius:.1f} /{celsius:.1f}" in done.replies[0]
        waiting = shop.perform("M109 S0")
        await turns()
        assert waiting.done()
        assert shop.extruder.target_c == 0.0

    asyncio.run(main())


# ----------------------------------------------------------------------------------------------------- waits


@pytest.mark.parametrize(
    ("text", "celsius", "ends"),
    [
        ("MINIMUM=50", 49.9, False),
        ("MINIMUM=50", 50.0, True),
        ("MAXIMUM=50", 50.1, False),
        ("MAXIMUM=50", 50.0, True),
        ("MINIMUM=50 MAXIMUM=50", 50.0, True),
        ("MINIMUM=50 MAXIMUM=60", 45.0, False),
        ("MINIMUM=50 MAXIMUM=60", 65.0, False),
        ("MAXIMUM=50", 4.9, False),
    ],
)
def test_a_temperature_is_waited_for_with_new_and_sound_measurements(
    shop: Shop, text: str, celsius: float, ends: bool
) -> None:
    source = shop.source("chamber")

    async def main() -> None:
        for measured in (20.0, 55.0, 50.0):
            source._take(measured, lambda _: 0.0)  # before the command: these do not count
        waiting = shop.perform(f"TEMPERATURE_WAIT SENSOR=chamber {text}")
        await turns()
        assert not waiting.done()
        source._take(celsius, lambda _: 0.0)
        await turns()
        assert waiting.done() is ends
        if not ends:
            source._take(50.0, lambda _: 0.0)
            await turns()
        assert waiting.done()
        assert await waiting is None

    asyncio.run(main())


def test_a_wait_goes_on_while_nothing_is_known(shop: Shop) -> None:
    source = shop.source("chamber")

    async def main() -> None:
        waiting = shop.perform("TEMPERATURE_WAIT SENSOR=chamber MINIMUM=50")
        await turns()
        source.wake()
        await turns()
        assert not waiting.done()
        source._take(60.0, lambda _: 0.0)
        await turns()
        assert waiting.done()

    asyncio.run(main())


def test_a_wait_needs_a_sensor_and_a_range(shop: Shop) -> None:
    assert "MINIMUM= or MAXIMUM=" in shop.refused("TEMPERATURE_WAIT SENSOR=chamber")
    assert "is above" in shop.refused("TEMPERATURE_WAIT SENSOR=chamber MINIMUM=50.1 MAXIMUM=50")
    assert "there is no 'x'" in shop.refused("TEMPERATURE_WAIT SENSOR=x MINIMUM=50")


# ------------------------------------------------------------------------------------------------ converters


def test_converters_tell_what_they_read(shop: Shop) -> None:
    assert shop.told("QUERY_ADC") == ("sensors with a converter: none has read anything yet",)
    for ratio in (0.0, 0.75, 1.0):
        shop.source("temperature_sensor air").ratio = ratio
        shop.source("temperature_sensor box").ratio = 0.5
        assert shop.told("QUERY_ADC") == (
            "sensors with a converter: temperature_sensor air, temperature_sensor box",
        )
        query = "QUERY_ADC NAME='temperature_sensor air'"
        told = f"temperature_sensor air: {ratio:.6f} of full scale"
        assert shop.told(query) == (told,)
        below = {0.0: "0.0 Ω", 0.75: "3000.0 Ω", 1.0: "no resistor"}[ratio]
        assert shop.told(f"{query} PULLUP=1000") == (f"{told}, with 1000 Ω above it {below}",)


# ----------------------------------------------------------------------------------------------- calibration


@pytest.mark.parametrize("name", ["PID_CALIBRATE", "MPC_CALIBRATE"])
@pytest.mark.parametrize(("target", "allowed"), [(5, False), (5.1, True), (100, True), (100.1, False)])
def test_a_calibration_is_for_a_target_that_is_possible(
    shop: Shop, name: str, target: float, allowed: bool
) -> None:
    line = f"{name} HEATER=chamber TARGET={target}"
    if allowed:
        assert isinstance(shop.read(line), AtStandstill)
    else:
        assert f"TARGET={target:g} is outside what [heater_generic chamber] allows, 5 to 100 °C" in (
            shop.refused(line)
        )


def test_a_model_is_found_at_200_degrees_with_a_few_fan_speeds(shop: Shop) -> None:
    assert "TARGET=200 is outside what [heater_generic chamber]" in shop.refused(
        "MPC_CALIBRATE HEATER=chamber"
    )
    line = "MPC_CALIBRATE HEATER=chamber TARGET=60 FAN_BREAKPOINTS="
    for steps in (2, 12):
        assert isinstance(shop.read(f"{line}{steps}"), AtStandstill)
    for steps in (1, 13):
        assert shop.refused(f"{line}{steps}") == "FAN_BREAKPOINTS of MPC_CALIBRATE must be 2 to 12"
    assert "needs the option heater_power of [extruder], in W" in shop.refused(
        "MPC_CALIBRATE HEATER=extruder"
    )


def test_three_fan_speeds_unless_others_are_asked_for(shop: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, float, int]] = []

    async def note(unit: Heater, target_c: float, fan_steps: int) -> Done:
        asked.append((unit.key, target_c, fan_steps))
        return Done()

    monkeypatch.setattr("coordinator.modules.heaters.heaters.calibrate_mpc", note)

    async def main() -> None:
        for more in ("", " FAN_BREAKPOINTS=5"):
            await shop.perform(f"MPC_CALIBRATE HEATER=chamber TARGET=60{more}")

    asyncio.run(main())
    assert asked == [("chamber", 60.0, 3), ("chamber", 60.0, 5)]


# ------------------------------------------------------------------------------------- [verify_heater NAME]


@pytest.mark.parametrize(
    ("option", "possible", "impossible"),
    [
        ("max_error", (0, 1e9), (-0.1, 1.0000000005e9)),
        ("check_gain_time", (1, 1e9), (0.5, 1.0000000005e9)),
        ("hysteresis", (0, 500), (-0.1, 500.5)),
        ("heating_gain", (0.5, 500), (0, 500.5)),
    ],
)
def test_how_strict_the_watch_may_be(
    tmp_path: Path, option: str, possible: tuple[float, ...], impossible: tuple[float, ...]
) -> None:
    fields = {
        "max_error": "max_error_ks",
        "check_gain_time": "check_gain_s",
        "hysteresis": "hysteresis_k",
        "heating_gain": "heating_gain_k",
    }
    for value in possible:
        (verify,) = build(tmp_path, f"{HOTEND_PID}\n[verify_heater extruder]\n{option}: {value!r}\n").of(
            VerifyHeater
        )
        assert getattr(verify.options, fields[option]) == value
    for value in impossible:
        with pytest.raises(ConfigError, match=f"'{option}' of .verify_heater extruder. is "):
            build(tmp_path, f"{HOTEND_PID}\n[verify_heater extruder]\n{option}: {value!r}\n")


@pytest.mark.parametrize(("name", "gain_s"), [("extruder", 20.0), ("chamber", 20.0)])
def test_a_section_without_options_changes_nothing(tmp_path: Path, name: str, gain_s: float) -> None:
    modules = build(tmp_path, f"{HOTEND_PID}{CHAMBER}\n[verify_heater {name}]\n")
    (verify,) = modules.of(VerifyHeater)
    assert verify.name == f"verify_heater {name}"
    found = verify.options
    assert (found.max_error_ks, found.check_gain_s, found.hysteresis_k, found.heating_gain_k) == (
        *(120.0, gain_s),
        *(5.0, 2.0),
    )


def test_it_waits_for_a_heater_that_does_not_act_yet(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    later = CHAMBER.replace("Generic 3950", "MAX31865")
    path.write_text(BASE + HOTEND_PID + later + "\n[verify_heater chamber]\n")
    reasons = {entry.section: entry.reason for entry in load_machine(str(path)).unsupported}
    assert reasons["verify_heater chamber"] == "the heater chamber is not supported yet"


def test_it_is_for_no_heater_where_there_is_none(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    text = BASE[: BASE.index("heater_pin")] + "[verify_heater extruder]\n"
    path.write_text(text)
    line = text.splitlines().index("[verify_heater extruder]") + 1
    with pytest.raises(ConfigError) as error:
        load_machine(str(path))
    assert (
        str(error.value)
        == f"{path}:{line}: [verify_heater extruder] refers to an unknown heater; there is none"
    )
