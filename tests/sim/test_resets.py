"""Boards through resets: most firmware knows only ``reset``, and on USB the device disappears meanwhile."""

import re
from collections.abc import Mapping
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.simulate.scenario import BusSetting, NodeSetting
from coordinator.support.toml_values import Range
from nodes.node.absence import BACK_WITHIN_S
from nodes.support.errors import CanductorError
from tests.stages.demo_machine import NODES, SQUARE, DemoMachine
from tests.stages.served import Served, running

DEVICE = "/dev/ttyUSB0"
METHOD = "restart_method: command"
ONLY_RESET = {name: NodeSetting(config_reset="unknown") for name in NODES}
"""As all boards but Linux processes are."""
USB = {DEVICE: BusSetting(usb_of="zboard")}
DEAF = NodeSetting(config_reset="unknown", boot_s=Range(3.0, 3.0))
"""A board with a boot loader that is deaf for three seconds."""


def other_microsteps(folder: Path) -> Mapping[str, str]:
    """Return a change of the configuration of every node of the demo machine."""
    return {"microsteps: 32": "microsteps: 16", "microsteps: 16": "microsteps: 8"}


def resets(machine: DemoMachine) -> dict[str, int]:
    return {name: machine.node(name).counters()["resets"] for name in NODES}


def edit(machine: DemoMachine) -> Path:
    """Write the configuration again with pull-ups: every node has to be configured differently."""
    text = machine.config.read_text()
    path = machine.folder / "edited.cfg"
    path.write_text(text + "".join(f"[output_pin {n}]\npin: {n}:PF7\n" for n in NODES).replace("mcu:", ""))
    return path


# ------------------------------------------------------------------------------------ edits and shutdowns


def test_the_first_run_after_an_edit_of_the_configuration(tmp_path: Path) -> None:
    """Nodes on CAN and on USB are reset and waited for in the same start."""
    machine = DemoMachine(tmp_path, nodes=ONLY_RESET, buses=USB)
    machine.print(SQUARE)
    assert resets(machine) == dict.fromkeys(NODES, 0)
    machine.print(SQUARE, edit(machine))
    assert resets(machine) == dict.fromkeys(NODES, 1), "each once"
    machine.print(SQUARE, edit(machine))
    assert resets(machine) == dict.fromkeys(NODES, 1), "they are configured as they should be"


def test_the_first_run_after_a_shutdown(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path, nodes=ONLY_RESET, buses=USB)

    async def stop(stage: Served) -> None:
        await stage.call("machine.emergency_stop")
        await stage.until(lambda: len(stage.service.confirmed_s) == len(NODES), "nodes in shutdown")

    machine.serve(stop)
    assert machine.shut_down == set(NODES)
    machine.print(SQUARE)
    assert resets(machine) == dict.fromkeys(NODES, 1)


def test_firmware_restarts_in_a_row(tmp_path: Path) -> None:
    """Ten of them, while the main board is also the USB adapter of the bus, and one node is on USB."""
    buses = USB | {"can0": BusSetting(usb_of="mcu", usb_gone_s=Range(1.5, 1.5))}
    machine = DemoMachine(tmp_path, nodes=ONLY_RESET, buses=buses)

    async def restart(stage: Served) -> None:
        for number in range(1, 11):
            await stage.call("gcode.run", script="FIRMWARE_RESTART")
            await stage.until(lambda: stage.service.starts == number + 1, "the next start")  # noqa: B023
            await stage.until_state("ready")
        await stage.call("gcode.run", script="G28\nG1 X5 F6000")
        await stage.check_positions()

    machine.serve(restart)
    assert machine.node("mcu").counters()["resets"] == 10
    assert machine.node("zboard").counters()["resets"] == 10
    assert machine.node("toolhead").counters()["resets"] >= 10


@pytest.mark.parametrize("script", ["RESTART", "FIRMWARE_RESTART"])
def test_a_service_begins_again_after_an_emergency_stop(tmp_path: Path, script: str) -> None:
    machine = DemoMachine(tmp_path, nodes=ONLY_RESET, buses=USB)

    async def restart(stage: Served) -> None:
        await stage.call("machine.emergency_stop")
        await stage.until_state("shutdown")
        await stage.call("gcode.run", script=script)
        await stage.until(lambda: stage.service.starts == 2, "the next start")
        await stage.until_state("ready")

    machine.serve(restart)


def test_a_service_reads_an_edited_configuration(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path, nodes=ONLY_RESET, buses=USB)
    config = machine.config

    async def main() -> None:
        stage = Served(tmp_path, lambda: load_machine(str(config)), machine.host)
        async with running(stage):
            config.write_text(edit(machine).read_text())
            await stage.call("gcode.run", script="RESTART")
            await stage.until(lambda: stage.service.starts == 2, "the next start")
            await stage.until_state("ready")

    machine.run(main)
    assert resets(machine) == dict.fromkeys(NODES, 1)


def test_a_linux_process_that_is_cleared_starts_again(tmp_path: Path) -> None:
    """Its ``config_reset`` ends the process; the next one has another pseudo-terminal."""
    machine = DemoMachine(tmp_path, nodes={"zboard": NodeSetting(config_reset="restarts")}, buses=USB)
    machine.print(SQUARE)
    machine.print(SQUARE, edit(machine))
    assert resets(machine) == {"mcu": 0, "toolhead": 0, "zboard": 1}


def test_an_edit_that_concerns_the_adapter_of_the_bus_alone(tmp_path: Path) -> None:
    """Other nodes of the bus are being configured, or ready, when the interface disappears."""
    buses = {"can0": BusSetting(usb_of="mcu", usb_gone_s=Range(2.5, 2.5))}
    machine = DemoMachine(tmp_path, nodes=ONLY_RESET, buses=buses)
    machine.print(SQUARE)
    edited = tmp_path / "edited.cfg"
    edited.write_text(machine.config.read_text() + "[output_pin lamp]\npin: PF7\n")
    machine.print(SQUARE, edited)
    assert resets(machine) == {"mcu": 1, "toolhead": 0, "zboard": 0}


# ---------------------------------------------------------------------------------- devices that come and go


def test_a_device_that_is_away_when_the_firmware_is_restarted_is_waited_for(tmp_path: Path) -> None:
    """Its process was killed, or its cable is being plugged: the pseudo-terminal is replaced."""
    machine = DemoMachine(tmp_path, nodes=ONLY_RESET, buses=USB)
    zboard = machine.node("zboard")

    async def replug(stage: Served) -> None:
        zboard.power_off()
        await stage.until_state("shutdown")
        machine.at(4.0, zboard.power_on)
        await stage.call("gcode.run", script="FIRMWARE_RESTART")
        await stage.until(lambda: stage.service.starts == 2, "the next start")
        await stage.until_state("ready")
        said = [line for line in stage.lines if "waiting until it is back" in line]
        assert said[0] == (
            "node zboard: a restart of its firmware was requested; waiting until it is back "
            f"({DEVICE}: there is no such device; 1 of 10 s)"
        )
        assert any(re.fullmatch(r"node zboard is back after [45]\.\d s", line) for line in stage.lines)

    machine.serve(replug)


def test_a_node_of_policy_pause_comes_back_by_the_same_start(tmp_path: Path) -> None:
    """It restarts by itself, then shuts down: only then it has to be reset."""
    sections = "[mcu light]\nserial: /dev/light\npolicy: pause\n[output_pin lamp]\npin: light:PA1\n"
    machine = DemoMachine(
        tmp_path,
        nodes=ONLY_RESET | {"light": NodeSetting(config_reset="unknown")},
        buses=USB | {"/dev/light": BusSetting(usb_of="light", usb_gone_s=Range(2, 2))},
        sections=sections,
    )
    light = machine.node("light")

    async def lose(stage: Served) -> None:
        for times in (1, 2):
            light.reset()
            await stage.until(lambda: stage.tree.get("nodes.light.state") == "lost", "the loss")
            await stage.until(lambda: stage.tree.get("nodes.light.state") == "ready", "the return")
            assert light.counters()["resets"] == times, "it was not configured: nothing to reset"
        assert sum("node light is back after" in line for line in stage.lines) == 2
        await stage.call("node.command", node="light", command="emergency_stop")
        await stage.until(lambda: light.counters()["resets"] == 3, "its reset")
        await stage.until(lambda: stage.tree.get("nodes.light.state") == "ready", "the return")
        assert str(stage.service.state) == "ready"

    machine.serve(lose, node_commands=True)


def test_a_board_that_does_not_come_back_is_reported_as_that(tmp_path: Path) -> None:
    buses = {DEVICE: BusSetting(usb_of="zboard", usb_gone_s=Range(60, 60))}
    machine = DemoMachine(tmp_path, nodes=ONLY_RESET, buses=buses)
    machine.print(SQUARE)
    began_s = machine.now_s()
    with pytest.raises(CanductorError) as failed:
        machine.print(SQUARE, edit(machine))
    assert BACK_WITHIN_S < machine.now_s() - began_s < BACK_WITHIN_S + 3
    assert str(failed.value) == (
        "node zboard did not come back within 10 s: it was reset because it had another configuration, "
        f"and now {DEVICE}: there is no such device"
    )


def test_firmware_that_does_not_start_again_is_not_called_a_matter_of_wiring(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path, nodes=ONLY_RESET)
    machine.print(SQUARE)
    machine.node("zboard").set_boot(60.0)
    with pytest.raises(CanductorError) as failed:
        machine.print(SQUARE, edit(machine))
    assert str(failed.value) == (
        "node zboard did not come back within 10 s: it was reset because it had another configuration, "
        f"and now nothing answers on {DEVICE}"
    )


# ---------------------------------------------------------------------------------------- restart_method


@pytest.mark.parametrize("method", ["arduino", "cheetah"])
def test_a_board_with_dtr_and_a_deaf_boot_loader(tmp_path: Path, method: str) -> None:
    """It restarts whenever its device is opened, and is deaf then; a firmware restart pulses DTR."""
    machine = DemoMachine(
        tmp_path,
        nodes={"zboard": DEAF},
        buses={DEVICE: BusSetting(dtr=True)},
        changes={METHOD: f"restart_method: {method}"},
    )
    machine.print(SQUARE)
    assert resets(machine)["zboard"] == 1, "by opening its device"

    async def restart(stage: Served) -> None:
        machine.node("zboard").power_off()  # its firmware hangs: no command reaches it
        await stage.until_state("shutdown")
        machine.node("zboard").power_on()
        await stage.call("gcode.run", script="FIRMWARE_RESTART")
        await stage.until(lambda: stage.service.starts == 2, "the next start")
        await stage.until_state("ready")

    before = resets(machine)["zboard"]
    machine.serve(restart)
    assert resets(machine)["zboard"] == before + 3, "device opened twice, DTR pulsed once"


def test_a_board_that_ignores_dtr_is_reset_by_command(tmp_path: Path) -> None:
    """As boards with a USB of their own do, whose owners never heard of restart_method."""
    machine = DemoMachine(tmp_path, nodes=ONLY_RESET, buses=USB, changes={METHOD: ""})
    machine.host.reset_by_dtr[DEVICE] = lambda: None
    machine.print(SQUARE)
    machine.print(SQUARE, edit(machine))
    assert resets(machine) == dict.fromkeys(NODES, 1)


@pytest.mark.parametrize("switch", [True, False])
def test_usb_power_where_the_computer_switches_it(tmp_path: Path, *, switch: bool) -> None:
    machine = DemoMachine(tmp_path, nodes=ONLY_RESET, buses=USB, changes={METHOD: "restart_method: rpi_usb"})
    zboard = machine.node("zboard")
    switched: list[bool] = []

    def set_power(on: bool) -> None:
        switched.append(on)
        (zboard.power_on if on else zboard.power_off)()

    machine.host.usb_switch = set_power if switch else None
    machine.print(SQUARE)
    machine.print(SQUARE, edit(machine))
    assert switched == ([False, True] if switch else [])
    assert resets(machine)["zboard"] == (0 if switch else 1), "else by command"
