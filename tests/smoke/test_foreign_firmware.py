"""Resets, restarts and edits with firmware that this project did not make; in real time, so few and long."""

from pathlib import Path
from typing import Any, Final

import pytest

from tests.profiles import is_full
from tests.stages.foreign_firmware import (
    LINUX_MACHINE,
    AvrBoard,
    ForeignService,
    LinuxProcess,
    foreign_service,
    need,
)
from tests.stages.printer_text import printer_section, section, stepper_section

RESTARTS: Final = 10 if is_full() else 1
thorough = pytest.mark.skipif(not is_full(), reason="half a minute of real time: part of 'make thorough'")
TARGET: Final = (10 * 80, 12 * 80, 400)
"""X10 Y12 Z1, in steps."""


def linux_machine(folder: Path) -> Path:
    """Write the configuration that goes with the Linux process."""
    need(LINUX_MACHINE)
    text = LINUX_MACHINE.read_text(encoding="utf-8").replace("SERIAL", str(folder / "mcu.tty"))
    path = folder / "printer.cfg"
    text = text.replace("second_homing_speed: 2", "second_homing_speed: 2\nhoming_retract_dist: 0.5")
    path.write_text(text + "\n", encoding="utf-8")
    return path


def avr_machine(folder: Path) -> Path:
    """Write the configuration of a RAMPS board; the pins are not connected, so the axes are taken as home."""
    path = folder / "printer.cfg"
    path.write_text(
        section("mcu", serial=folder / "avr.tty")
        + printer_section(max_velocity=20, max_accel=200)
        + stepper_section("stepper_x", "PF0", "PF1", enable_pin="!PD7", position_max=200)
        + stepper_section("stepper_y", "PF6", "!PF7", enable_pin="!PF2", position_max=200)
        + stepper_section(
            "stepper_z", "PL3", "PL1", enable_pin="!PK0", rotation_distance=8, position_max=200
        ),
        encoding="utf-8",
    )
    return path


def edit(config: Path, pin: str) -> None:
    """Let the configuration have one more output."""
    name = pin.replace("/", "_").replace(":", "_")
    with config.open("a", encoding="utf-8") as file:
        file.write(section(f"output_pin {name}", pin=pin))


@thorough
def test_a_linux_process(tmp_path: Path) -> None:
    """FIRMWARE_RESTARTs in a row, a shutdown, a killed process, an edit; then it homes and moves exactly."""
    with LinuxProcess(tmp_path) as firmware:
        config = linux_machine(tmp_path)
        with foreign_service(config) as service:
            for _ in range(RESTARTS):
                service.restart(firmware=True)
            service.client.call("machine.emergency_stop")
            service.restart("shutdown", firmware=False)
            firmware.kill()
            service.until("shutdown")
            firmware.start_again()
            service.restart("shutdown", firmware=True)
            edit(config, "gpiochip0/gpio30")
            service.restart(firmware=False)
            check_exact(service, firmware)
            service.client.call("machine.emergency_stop")
            service.until("shutdown")
        edit(config, "gpiochip0/gpio31")
        with foreign_service(config):  # the first run after a shutdown and an edit
            pass


def check_exact(service: ForeignService, firmware: LinuxProcess) -> None:
    """Home and move: the pins made exactly the steps that were sent, from where the endstops are."""
    service.run("G28")
    before, homed = service.step_counts(), firmware.positions()[:3]
    service.run("G1 X10 Y12 Z1 F3000")
    after, moved = service.step_counts(), firmware.positions()[:3]
    for number, name in enumerate(("stepper_x", "stepper_y", "stepper_z")):
        assert moved[number] - homed[number] == after[name] - before[name] > 0
        # The process samples an endstop when the kernel runs it: before a step or after it.
        assert abs(moved[number] - TARGET[number]) <= 2


@thorough
def test_two_linux_processes(tmp_path: Path) -> None:
    """Both are reset; one is killed; then both make exactly the steps that were sent."""
    with LinuxProcess(tmp_path) as main, LinuxProcess(tmp_path, "tool") as tool:
        config = linux_machine(tmp_path)
        text = config.read_text(encoding="utf-8").replace("gpiochip0/gpio10\n", "tool:gpiochip0/gpio10\n")
        text = text.replace("gpiochip0/gpio11\n", "tool:gpiochip0/gpio11\nmin_extrude_temp: 0\n")
        config.write_text(text + section("mcu tool", serial=tool.device), encoding="utf-8")
        with foreign_service(config) as service:
            service.restart(firmware=True)
            tool.kill()
            service.until("shutdown")
            tool.start_again()
            service.restart("shutdown", firmware=True)
            check_exact(service, main)
            before = tool.positions()[3]
            service.run("M83\nG1 X12 E2 F1200")
            moved = round(2 * 200 * 16 / 33.5)
            assert abs(tool.positions()[3] - before - moved) <= 1
            assert service.step_counts()["stepper_x"] != 0


@thorough
@pytest.mark.parametrize(
    "board",
    [{"deaf_s": 3.0, "dtr": True}, {"deaf_s": 0.5, "gone_s": 0.8}],
    ids=["reset by opening its device, with a deaf boot loader", "on USB"],
)
def test_an_atmega2560(tmp_path: Path, board: dict[str, Any]) -> None:
    """It knows only ``reset``, by its watchdog."""
    with AvrBoard(tmp_path, **board):
        config = avr_machine(tmp_path)
        with foreign_service(config) as service:
            for _ in range(RESTARTS):
                service.restart(firmware=True)
            edit(config, "PB5")
            service.restart(firmware=False)
            service.client.call("machine.emergency_stop")
            service.until("shutdown")
        edit(config, "PB6")
        with foreign_service(config) as service:
            position = service.client.call("position.get", {"ask_nodes": True})
            assert position["nodes_steps"] == {"stepper_x": 0, "stepper_y": 0, "stepper_z": 0}
