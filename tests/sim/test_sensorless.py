"""Homing by what the drivers feel, and drivers that fail: on simulated boards whose plant has the drivers."""

import asyncio
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from coordinator.gcode.errors import GCodeError
from coordinator.modules.drivers.tmc_driver import TmcDriver
from coordinator.runtime.machine import Machine, MachineStopped
from coordinator.service.jobs.outcome import Outcome
from coordinator.simulate.scenario import BusSetting
from coordinator.streaming.move_source import ProgramOutput
from coordinator.support.toml_values import Range
from coordinator.virtual_machine.plant import PlantSettings
from nodes.support.errors import CanductorError
from nodes.virtual.plant_page import PlantFault, PlantItemKind, PlantPage
from tests.stages.machine_stage import MachineStage
from tests.stages.printer_text import SENSORLESS_CFG

if TYPE_CHECKING:
    from coordinator.support.values import Value

EXAMPLE = Path(__file__).parents[2] / "config" / "sensorless.cfg"
FULL_STEP_MM = 40 / 200


class Printer(MachineStage):
    """The machine of the text MACHINE, with its head at START; SETTINGS are of its buses."""

    def __init__(
        self,
        folder: Path,
        start: tuple[float, float, float] = (31.0, 214.0, 20.0),
        machine: str = SENSORLESS_CFG,
        *,
        buses: Mapping[str, BusSetting] | None = None,
        on_ready: Callable[["Printer", Machine], None] = lambda printer, machine: None,
    ) -> None:
        config = folder / "home.cfg"
        config.write_text(machine)
        super().__init__(config, buses=buses, plant=PlantSettings(start=start))
        self.output: list[str] = []
        self.places: list[tuple[float, float]] = []
        """Where the head truly stood at each M119."""
        self._on_ready = on_ready

    def print(self, *lines: str) -> Outcome:
        return self.print_lines(
            lines, on_output=self._tell, on_ready=lambda machine: self._on_ready(self, machine)
        )

    def _tell(self, output: ProgramOutput) -> None:
        self.output.append(output.text)
        if output.text.startswith("x:"):  # M119: it stands
            self.places.append((self.true_mm("x"), self.true_mm("y")))

    @property
    def mcu(self) -> PlantPage:
        return self.page("mcu")

    def break_driver(self, fault: PlantFault, name: str = "stepper_x") -> None:
        self.mcu.set_fault(PlantItemKind.TMC, name, fault)
        assert self.mcu.item(PlantItemKind.TMC, name).fault is fault  # it is looked at: the driver knows


def test_axes_are_homed_by_what_their_drivers_feel_the_same_from_anywhere(tmp_path: Path) -> None:
    printer = Printer(tmp_path, buses={"can0": BusSetting(loss=Range(0.01, 0.01))})
    spot = ("G1 X30 Y200 F9000", "M119")
    others = (("G1 X41.33 Y190.07",), ("G1 X3 Y247.123",))
    printer.print("G28 X Y", *spot, *(line for go in others for line in (*go, "G28 Y X", *spot)), "M114")
    assert printer.output == ["x:open y:open"] * 3 + ["X:30.000 Y:200.000 Z:0.000 E:0.000"]
    # The motor counts as stalled when its field is up to two full steps ahead: so far from the stop.
    x, y = printer.places[0]
    assert x == pytest.approx(30 - 1.1 * FULL_STEP_MM, abs=0.6 * FULL_STEP_MM)
    assert y == pytest.approx(200 + 1.1 * FULL_STEP_MM, abs=0.6 * FULL_STEP_MM)
    assert len(printer.places) == 3
    for places, microstep in zip(zip(*printer.places, strict=True), (40 / 3200, 40 / 6400), strict=True):
        assert max(places) - min(places) < 1.01 * microstep
    assert printer.mcu.motors["stepper_x"].lost == 0
    assert printer.mcu.motors["stepper_y"].lost == 0


def test_towers_go_up_until_each_feels_its_end(tmp_path: Path) -> None:
    text = (EXAMPLE.parent / "delta.cfg").read_text(encoding="utf-8")
    for number, tower in enumerate("abc"):
        pin = f"endstop_pin: tmc2209_stepper_{tower}:virtual_endstop\nhoming_retract_dist: 0\n"
        text = text.replace(f"endstop_pin: ^PG{number}\n", pin)
        wires = f"uart_pin: PD0\nuart_address: {number}\ndiag_pin: PG{number}\n"
        text += f"\n[tmc2209 stepper_{tower}]\n{wires}run_current: 0.8\ndriver_SGTHRS: 70\n"
    printer = Printer(tmp_path, (5.0, 3.0, 380.0), text)
    printer.print("G28", "G1 X20 Y10 Z350 F6000", "M114")
    assert printer.output == ["X:20.000 Y:10.000 Z:350.000 E:0.000"]
    inverse = printer.description.kinematics.inverse
    for tower, end, begin in zip("abc", inverse((20, 10, 350)), inverse((5.0, 3.0, 380.0)), strict=True):
        motor = printer.mcu.motors[f"stepper_{tower}"]
        assert motor.lost == 0
        assert motor.count * 40 / 3200 == pytest.approx(end - begin + FULL_STEP_MM, abs=0.7 * FULL_STEP_MM)


def test_the_example_homes_its_corexy(tmp_path: Path) -> None:
    printer = Printer(tmp_path, machine=EXAMPLE.read_text(encoding="utf-8"))
    printer.print("G28", "G1 X30 Y200 F6000", "M119", "G28 X Y", "G1 X30 Y200 F6000", "M119")
    first, again = printer.places
    assert first == pytest.approx((30 - FULL_STEP_MM, 200 + FULL_STEP_MM), abs=0.12)
    assert again == pytest.approx(first, abs=0.007)
    assert all(motor.lost == 0 for motor in printer.mcu.motors.values())


def test_a_driver_is_set_anew_when_its_node_comes_back(tmp_path: Path) -> None:
    status: list[Mapping[str, Value]] = []

    def come_back(printer: Printer, machine: Machine) -> None:
        driver = machine.modules.find("tmc2209 stepper_x", TmcDriver)
        assert driver is not None
        printer.break_driver(PlantFault.DEAD)
        printer.break_driver(PlantFault.SOUND)  # it has forgotten all
        driver.started(machine.nodes["mcu"])
        asyncio.get_running_loop().call_later(1, lambda: status.append(driver.status()))

    printer = Printer(tmp_path, on_ready=come_back)
    printer.print("G4 P3000", "DUMP_TMC STEPPER=stepper_x REGISTER=CHOPCONF")
    assert printer.output == ["CHOPCONF: 14030053 toff=3 hstrt=5 tbl=2 vsense=1 mres=4 intpol=1"]
    (found,) = status
    assert (found["run_current"], found["hold_current"]) == (0.8, 0.5)
    assert found["drv_status"] == {"cs_actual": 15, "stst": 1}


def test_afterwards_the_drivers_are_as_they_were(tmp_path: Path) -> None:
    printer = Printer(tmp_path)
    dump = "DUMP_TMC STEPPER=stepper_{} REGISTER={}"
    printer.print(
        "G28 X Y",
        dump.format("x", "gconf"),
        dump.format("y", "GCONF"),
        dump.format("x", "CHOPCONF"),
        dump.format("y", "CHOPCONF"),
        dump.format("z", "IOIN"),
        "SET_TMC_CURRENT STEPPER=stepper_x CURRENT=1.2",
        dump.format("x", "IHOLD_IRUN"),
        "SET_TMC_FIELD STEPPER=stepper_x FIELD=PWM_GRAD VALUE=0x21",
        "SET_TMC_FIELD STEPPER=stepper_x FIELD=tpwmthrs VELOCITY=30",
        "INIT_TMC STEPPER=stepper_x",
        dump.format("x", "PWMCONF"),
        dump.format("x", "TPWMTHRS"),
        "DUMP_TMC STEPPER=stepper_z",
    )
    # The data sheet's formula has 1.77 A for a scale of 31 and vsense 0: 1.2 A is 21, and 0.5 A is 8.
    ofs = "pwm_ofs=36 pwm_grad=33"
    assert printer.output[:9] == [
        "GCONF: 000001c4 en_spreadcycle=1 pdn_disable=1 mstep_reg_select=1 multistep_filt=1",
        "GCONF: 000001c0 pdn_disable=1 mstep_reg_select=1 multistep_filt=1",
        "CHOPCONF: 14030053 toff=3 hstrt=5 tbl=2 vsense=1 mres=4 intpol=1",
        "CHOPCONF: 23030053 toff=3 hstrt=5 tbl=2 vsense=1 mres=3 dedge=1",
        "IOIN: 20000040 pdn_uart=1 version=32",
        "stepper_x: run current 1.2 A, hold current 0.5 A",
        "IHOLD_IRUN: 00081508 ihold=8 irun=21 iholddelay=8 (as written)",
        f"PWMCONF: c80d2124 {ofs} pwm_freq=1 pwm_autoscale=1 pwm_autograd=1 pwm_reg=8 pwm_lim=12",
        "TPWMTHRS: 00000139 tpwmthrs=313 (as written)",
    ]
    assert printer.output[9:11] == [printer.output[0], "GSTAT: 00000000"]
    assert [line.split(":")[0] for line in printer.output[-3:]] == ["PWMCONF", "PWM_SCALE", "PWM_AUTO"]


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        (
            PlantFault.OPEN,
            "does not answer; check that its motor supply is on, and uart_pin and uart_address",
        ),
        (PlantFault.GARBLED, "sends damaged answers; check its UART's wiring and for other drivers"),
        (PlantFault.SHORTED, "reports a short circuit to ground at coil A; check motor and cable"),
    ],
)
def test_a_driver_that_cannot_be_set_ends_the_start(tmp_path: Path, fault: PlantFault, sentence: str) -> None:
    printer = Printer(tmp_path)
    printer.break_driver(fault)
    with pytest.raises(CanductorError) as error:
        printer.print("G28 X")
    assert str(error.value).startswith(f"the driver of stepper_x ([tmc2209 stepper_x]) {sentence}")


@pytest.mark.parametrize(
    ("faults", "sentence"),
    [
        ((PlantFault.OVERHEATED,), "is too hot and switched itself off; lower run_current, cool it"),
        ((PlantFault.GARBLED,), "sends damaged answers"),
        ((PlantFault.DEAD, PlantFault.SOUND), "has lost its settings: its motor supply was off for a moment"),
    ],
)
def test_a_driver_that_fails_stops_the_machine(
    tmp_path: Path, faults: tuple[PlantFault, ...], sentence: str
) -> None:
    def fail(printer: Printer, _: Machine) -> None:
        for number, fault in enumerate(faults):
            asyncio.get_running_loop().call_later(3 + 0.01 * number, printer.break_driver, fault)

    printer = Printer(tmp_path, on_ready=fail)
    with pytest.raises(MachineStopped) as error:
        printer.print("G28 X Y", *("G1 X100 F2000", "G1 X30") * 9)
    assert str(error.value).startswith(f"the driver of stepper_x ([tmc2209 stepper_x]) {sentence}")


def test_a_driver_that_gets_warm_is_told_of_once(tmp_path: Path) -> None:
    def warm(printer: Printer, _: Machine) -> None:
        asyncio.get_running_loop().call_later(2, printer.break_driver, PlantFault.WARM, "stepper_y")

    printer = Printer(tmp_path, on_ready=warm)
    printer.print("G4 P6000")
    (output,) = printer.output
    assert output.startswith("the driver of stepper_y ([tmc2209 stepper_y]) is getting too hot; lower")


def test_a_driver_that_falls_silent_while_an_axis_homes(tmp_path: Path) -> None:
    def cut(printer: Printer, _: Machine) -> None:
        asyncio.get_running_loop().call_later(0.8, printer.break_driver, PlantFault.OPEN)

    printer = Printer(tmp_path, start=(60.0, 214.0, 20.0), on_ready=cut)
    with pytest.raises(GCodeError, match=r"^part\.gcode:1: the driver of stepper_x .* does not answer"):
        printer.print("G28 X", "G1 X5 F6000")
    assert printer.true_mm("x") == 0.0  # it had found the end


def test_one_that_feels_nothing_at_that_speed(tmp_path: Path) -> None:
    text = SENSORLESS_CFG.replace("hold_current: 0.5\n", "coolstep_threshold: 41\n")
    with pytest.raises(GCodeError, match=r"^part\.gcode:1: .* cannot detect the end of the axis at 40 mm/s"):
        Printer(tmp_path, machine=text).print("G28 X")
