"""A host that is killed with the heater on, as processes: the node ends the heat by itself."""

import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from coordinator.demo.plant import machine_plants
from coordinator.machine.description import load_machine
from nodes.virtual.edge_log import EdgeLog
from nodes.virtual.firmware import firmware_dictionary
from nodes.virtual.hub import VirtualBus
from nodes.virtual.plant_page import Kind, PlantPage
from nodes.virtual.processes import NodeProcess
from tests.coordinator.modules.heat_stage import BASE, HOTEND_PID

ROOT = Path(__file__).parents[2]
PATIENCE_S = 60.0
MAX_DURATION_S = 1.5
AHEAD_S = 0.4
"""How far ahead of their time the host sends values; and a little for the clocks' estimates."""
UNCERTAIN_S = 0.05
STILL_S = 1.5
NODES = {"mcu": "0123456789ab", "toolhead": "0123456789ac"}


def heat_given_j(page: PlantPage) -> float:
    return page.item(Kind.HEATER, "extruder").extra


def test_the_heater_ends_within_its_max_duration_when_the_host_is_killed(tmp_path: Path) -> None:
    config = tmp_path / "printer.cfg"
    bus = tmp_path / "can.bus"
    config.write_text(BASE.replace("canbus_interface: can0", f"canbus_interface: virtual:{bus}") + HOTEND_PID)
    plants = machine_plants(load_machine(str(config)))
    with ExitStack() as stack:
        stack.enter_context(VirtualBus(bus))
        nodes = {
            name: stack.enter_context(
                NodeProcess(
                    "mainboard" if name == "mcu" else "toolhead",
                    uuid=uuid,
                    can=bus,
                    edge_log=tmp_path / f"{name}.edges",
                    plant=plants[name].write(tmp_path),
                )
            )
            for name, uuid in NODES.items()
        }
        for node in nodes.values():
            node.wait_ready()
        page = PlantPage.at(tmp_path, "toolhead")
        kill_ns = kill_a_heating_host(config, page)
        wait_until_it_is_off(page)
        for node in nodes.values():
            node.stop()
    log = EdgeLog(tmp_path / "toolhead.edges")
    pin = plants["toolhead"].heaters[0].pin
    clocks, levels = last_edge(log, pin)
    assert levels == 0
    off_s = (int(log.ticks_to_monotonic_ns(clocks)) - kill_ns) * 1e-9
    assert off_s <= MAX_DURATION_S + AHEAD_S + UNCERTAIN_S


def kill_a_heating_host(config: Path, page: PlantPage) -> int:
    """Let a host heat until the block gets warm, kill it, and return when it was dead (CLOCK_MONOTONIC)."""
    script = Path(__file__).with_name("heating_host.py")
    command = [sys.executable, str(script), str(config)]
    host = subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT, env={"PYTHONPATH": str(ROOT)})
    try:
        assert host.stdout is not None
        assert host.stdout.readline() == b"heating\n"
        wait_for(lambda: page.temperature("extruder") > 27)
    finally:
        host.kill()
        host.wait()
        if host.stdout is not None:
            host.stdout.close()
    return time.monotonic_ns()


def wait_until_it_is_off(page: PlantPage) -> None:
    """Wait until the heater has given nothing for longer than a cycle of its PWM lasts."""
    given, since_s = heat_given_j(page), time.monotonic()

    def off() -> bool:
        nonlocal given, since_s
        now = heat_given_j(page)
        if now != given:
            given, since_s = now, time.monotonic()
        return time.monotonic() - since_s > STILL_S

    wait_for(off)


def wait_for(true: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < deadline_s, "it does not happen"
        time.sleep(0.02)


def last_edge(log: EdgeLog, pin: str) -> tuple[int, int]:
    number = firmware_dictionary("canductor-node-toolhead").enumerations["pin"].values[pin]
    *_, (clocks, _, levels) = log.edges(number)
    return int(clocks[-1]), int(levels[-1])
