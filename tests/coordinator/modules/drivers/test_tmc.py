"""Sections of stepper drivers: what follows from their options, and what is told of mistakes."""

import math
from pathlib import Path

import pytest

from coordinator.assembly.check import check_config
from coordinator.assembly.load import load_machine
from coordinator.drivers.tmc_chips import CHIPS, TMC2209, Chip
from coordinator.drivers.tmc_formulas import currents, largest_current, tstep
from coordinator.modules.drivers.tmc_driver import TmcDriver
from coordinator.modules.homing.virtual_endstop import StallEndstop, section_of
from coordinator.modules.module_set import build_modules
from tests.stages.printer_text import SENSORLESS_CFG

SENSE_OHM_AND_LARGEST_A = (
    *((1.00, 0.23), (0.82, 0.27), (0.75, 0.30), (0.68, 0.33), (0.50, 0.44), (0.47, 0.47)),
    *((0.33, 0.66), (0.27, 0.79), (0.22, 0.96), (0.15, 1.35), (0.12, 1.64), (0.10, 1.92)),
)
"""TMC2209 data sheet, "Choice of R_sense and resulting max. motor current", vsense 0."""


def problems(folder: Path, *changes: tuple[str, str]) -> list[str]:
    text = SENSORLESS_CFG
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "printer.cfg"
    path.write_text(text)
    return [str(problem) for problem in check_config(str(path))]


@pytest.mark.parametrize(("sense_ohm", "amperes"), SENSE_OHM_AND_LARGEST_A)
def test_the_largest_current_is_the_data_sheets(sense_ohm: float, amperes: float) -> None:
    assert largest_current(sense_ohm) == pytest.approx(amperes, abs=0.006)


@pytest.mark.parametrize("run_a", [0.05, 0.3, 0.58, 0.97, 0.98, 1.0, 1.5, 1.76])
def test_a_current_is_met_to_half_a_step_of_its_scale(run_a: float) -> None:
    found = currents(run_a, run_a / 2, 0.11)
    one = {0: 0.325, 1: 0.18}[found.vsense] / 32 / 0.13 / math.sqrt(2)
    assert (found.irun + 1) * one == pytest.approx(run_a, abs=one / 2 + 1e-9)
    assert (found.ihold + 1) * one == pytest.approx(run_a / 2, abs=one / 2 + 1e-9)
    assert found.vsense == (run_a <= 0.18 / 0.13 / math.sqrt(2)), "the finer scale where it suffices"


def test_a_speed_is_a_time_between_the_smallest_microsteps() -> None:
    # 40 mm a turn of 200 full steps: at 40 mm/s 51,200 of 256 to a full step in a second.
    assert tstep(40.0, 40 / 3200, 16) == tstep(40.0, 40 / 200, 1) == round(12e6 / 51_200)
    assert tstep(1e-9, 40 / 3200, 16) == 0xFFFFF
    assert tstep(1e9, 40 / 3200, 16) == 1


@pytest.mark.parametrize("chip", CHIPS.values(), ids=list(CHIPS))
def test_fields_do_not_overlap_and_addresses_differ(chip: Chip) -> None:
    registers = chip.registers.values()
    assert len({register.address for register in registers}) == len(registers)
    for register in registers:
        value = 0
        for field in register.fields:
            assert field.of(value) == 0
            value = field.put(value, field.maximum)
            assert field.of(value) == field.maximum
        assert value < 1 << 32


def test_the_endstop_of_a_driver_is_its_diag_pin(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    path.write_text(SENSORLESS_CFG)
    machine = load_machine(str(path))
    x, y, _ = machine.rails
    assert x.homing.endstop_pin is not None
    assert y.homing.endstop_pin is not None
    assert (x.homing.endstop_pin.node, x.homing.endstop_pin.name) == ("mcu", "PE0")
    assert (y.homing.endstop_pin.node, y.homing.endstop_pin.pull) == ("toolhead", 1)
    assert machine.unsupported == ()
    modules = build_modules(machine)
    assert modules.find(section_of(x.homing.virtual_endstop), StallEndstop) is not None
    assert modules.names(TmcDriver) == ["tmc2209 stepper_x", "tmc2209 stepper_y", "tmc2208 stepper_z"]
    assert {"INIT_TMC", "DUMP_TMC", "SET_TMC_CURRENT", "SET_TMC_FIELD"} <= modules.vocabulary.commands.keys()


def test_options_become_registers(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    changed = "run_current: 0.8\ncoolstep_threshold: 20\ndriver_SEMIN: 3\ndriver_multistep_filt: False\n"
    path.write_text(SENSORLESS_CFG.replace("run_current: 0.8\n", changed, 1))
    machine = load_machine(str(path))
    driver = build_modules(machine).find("tmc2209 stepper_x", TmcDriver)
    assert driver is not None
    values = driver.settings.registers(both_edges=False)

    def of(register: str, field: str) -> int:
        return TMC2209.registers[register].field(field).of(values[register])

    assert of("GCONF", "multistep_filt") == 0
    assert of("COOLCONF", "semin") == 3
    assert of("CHOPCONF", "mres") == 4
    assert values["TCOOLTHRS"] == tstep(20.0, 40 / 3200, 16)
    assert values["SGTHRS"] == 70
    assert values["TPWMTHRS"] == 0
    assert set(values) <= {name for name, register in TMC2209.registers.items() if register.writable}


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("diag_pin: PE0\n", "", "but [tmc2209 stepper_x] has no diag_pin; add it"),
        (
            "[tmc2209 stepper_x]",
            "[tmc2209 stepper_q]",
            "but there is no section [tmc2209 stepper_x]",
        ),
        ("tmc2209_stepper_x:virtual_endstop", "!tmc2209_stepper_x:virtual_endstop", "takes no marks"),
        ("tmc2209_stepper_x:virtual_endstop", "tmc2208_stepper_z:virtual_endstop", "cannot detect the end"),
        ("run_current: 0.8\nhold", "run_current: 2.1\nhold", "must be a number in A, above 0 and at most 2"),
        ("hold_current: 0.5", "holdcurrent: 0.5", "did you mean 'hold_current'?"),
        ("uart_address: 1", "uart_address: 0", "have the same pins and uart_address 0; give each driver"),
        ("microsteps: 16", "microsteps: 24", "is 24, but its driver [tmc2209 stepper_x] has 1, 2, 4, 8"),
        ("tx_pin: PD3", "tx_pin: toolhead:PD3", "but uart_pin is on 'mcu'; both must be on one node"),
        ("driver_SGTHRS: 70", "driver_SGTHRS: 256", "must be a whole number, at least 0 and at most 255"),
        ("run_current: 0.6\n", "run_current: 0.6\ndriver_sgthrs: 3\n", "has no option 'driver_sgthrs'"),
        ("diag_pin: PE0", "diag_pin: PB0", "already used for 'step_pin' of [stepper_x]"),
    ],
)
def test_mistakes_are_told(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    found = problems(tmp_path, (old, new))
    assert any(sentence in problem for problem in found), found


def test_two_drivers_of_one_stepper_are_refused(tmp_path: Path) -> None:
    (found,) = problems(tmp_path, ("[tmc2208 stepper_z]", "[tmc2208 stepper_x]"))
    assert "are for the same stepper; remove one" in found


def test_a_further_side_of_an_axis_feels_by_its_own_driver(tmp_path: Path) -> None:
    path = tmp_path / "printer.cfg"
    motor = "step_pin: PF0\ndir_pin: PF1\nmicrosteps: 32\nrotation_distance: 40\n"
    side = f"[stepper_y1]\n{motor}endstop_pin: tmc2209_stepper_y1:virtual_endstop\n"
    driver = "[tmc2209 stepper_y1]\nuart_pin: PD0\nuart_address: 2\ndiag_pin: PE2\nrun_current: 0.8\n"
    path.write_text(SENSORLESS_CFG + side + driver)
    machine = load_machine(str(path))
    first, second = (piece.homing for piece in machine.rails[1].pieces)
    assert first.virtual_endstop == "tmc2209_stepper_y:virtual_endstop"
    assert second.virtual_endstop == "tmc2209_stepper_y1:virtual_endstop"
    assert second.endstop_pin is not None
    assert second.endstop_pin.name == "PE2"
    assert machine.unsupported == ()
