"""A machine that heats, in a simulated world: the real coordinator, links and firmware, and a plant."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

from coordinator.assembly.load import load_machine
from coordinator.gcode.commands import AtStandstill, Call, Immediate, Reading, Synchronized
from coordinator.gcode.events import Done
from coordinator.gcode.parser import parse
from coordinator.modules.module_set import ModuleSet, build_modules
from coordinator.runtime.machine import Machine, MachineStopped
from coordinator.simulate.scenario import BusSetting
from coordinator.support.toml_values import Range
from coordinator.support.values import Value
from coordinator.virtual_machine.plant import PlantSettings
from coordinator.virtual_machine.plant_heat import HeatSettings
from nodes.node.config import NodeConfig
from nodes.virtual.firmware import firmware_dictionary
from nodes.virtual.plant_page import PlantFault, PlantItemKind, PlantPage
from tests.stages.machine_stage import MachineStage
from tests.stages.printer_text import printer_section, section, stepper_section

BASE = (
    section("mcu", canbus_uuid="0123456789ab", canbus_interface="can0")
    + section("mcu toolhead", canbus_uuid="0123456789ac", canbus_interface="can0")
    + printer_section(max_velocity=300)
    + stepper_section("stepper_x", "PA1", "PA2", position_max=200)
    + stepper_section("stepper_y", "PA3", "PA4", position_max=200)
    + stepper_section("stepper_z", "PA5", "PA6", rotation_distance=8, position_max=200)
    + stepper_section(
        "extruder",
        "toolhead:PB1",
        "toolhead:PB2",
        rotation_distance=22,
        nozzle_diameter=0.4,
        filament_diameter=1.75,
        heater_pin="toolhead:PB3",
        sensor_type="EPCOS 100K B57560G104F",
        sensor_pin="toolhead:PB4",
        min_temp=0,
        max_temp=300,
    )
).rstrip("\n") + "\n"
"""More options of the extruder may follow."""
HOTEND_PID = "control: pid\npid_kp: 22.2\npid_ki: 1.08\npid_kd: 114\n"
BED = """
[heater_bed]
heater_pin: PC1
sensor_type: Generic 3950
sensor_pin: PC2
min_temp: 0
max_temp: 130
control: watermark
"""
FAN = "\n[fan]\npin: toolhead:PB5\ntachometer_pin: toolhead:PB6\n"


def build(folder: Path, text: str) -> ModuleSet:
    """Return the modules of BASE and TEXT, which is written to FOLDER."""
    path = folder / "printer.cfg"
    path.write_text(BASE + text)
    machine = load_machine(str(path))
    return build_modules(machine)


def configured(modules: ModuleSet, node: str) -> list[str]:
    """Return the commands that configure NODE, a main board, for MODULES."""
    config = NodeConfig(node, firmware_dictionary("canductor-node-mainboard"))
    modules.configure(config)
    return [*config.config_commands, *config.init_commands]


class HeatMachine(MachineStage):
    """The machine of TEXT, which follows BASE. HURRY: how many times faster all gets hot and cold."""

    def __init__(
        self,
        folder: Path,
        text: str,
        *,
        base: str = BASE,
        seed: int = 1,
        hurry: float = 1.0,
        loss: float = 0.0,
    ) -> None:
        path = folder / "printer.cfg"
        path.write_text(base + text)
        plant = PlantSettings(seed=seed, heat=HeatSettings(hurry=hurry))
        super().__init__(path, seed=seed, buses={"can0": BusSetting(loss=Range(loss, loss))}, plant=plant)
        self.notices: list[str] = []
        self.machine: Machine

    def connected(self, main: Callable[[], Awaitable[None]]) -> None:
        """Run MAIN with the machine connected."""

        async def whole() -> None:
            self.machine = Machine(
                self.description,
                self.host,
                build_modules(self.description),
                on_notice=self.notices.append,
            )
            await self.machine.start()
            try:
                await main()
            finally:
                await self.machine.close()

        self.run(whole)

    def print(self, *lines: str, ready: Callable[[Machine], None] = lambda _: None) -> None:
        """Run a program to its end, as a job; READY gets the machine when it begins."""
        self.print_lines(lines, on_output=lambda told: self.notices.append(str(told)), on_ready=ready)

    # ------------------------------------------------------------------------------------------ commands

    def read(self, line: str) -> Reading:
        command = parse(line.encode())
        assert command is not None
        return self.machine.modules.vocabulary.commands[command.name].read(Call(command, 1, (0, 0, 0, 0), ""))

    async def do(self, line: str) -> tuple[str, ...]:
        """Carry out a line as at rest; return what it answers."""
        reading = self.read(line)
        if isinstance(reading, AtStandstill):
            done: Done | None = await reading.perform()
            return done.replies if done is not None else ()
        if isinstance(reading, Synchronized):
            reading.act(0.0)
            return ()
        assert isinstance(reading, Immediate)
        return reading.replies

    def status(self, section: str) -> dict[str, Value]:
        return dict(self.machine.modules.status()[section])

    async def stopped(self, limit_s: float = 600.0) -> str:
        """Wait until the machine is stopped; return why."""
        async with asyncio.timeout(limit_s):
            stopped: MachineStopped = await self.machine.wait_stopped()
        return str(stopped)

    # --------------------------------------------------------------------------------------------- truth

    def page(self, node: str = "toolhead") -> PlantPage:
        return super().page(node)

    def true_c(self, body: str = "extruder", node: str = "toolhead") -> float:
        return self.page(node).temperature(body)

    def edges(self, pin: str, node: str = "toolhead") -> list[tuple[float, int]]:
        return super().edges(pin, node)

    def fault(
        self, kind: PlantItemKind, fault: PlantFault, name: str = "extruder", node: str = "toolhead"
    ) -> None:
        self.page(node).set_fault(kind, name, fault)

    async def true_range(
        self, seconds: float, body: str = "extruder", node: str = "toolhead"
    ) -> tuple[float, float]:
        """Return the lowest and the highest temperature that BODY truly has for SECONDS."""
        seen = []
        for _ in range(round(seconds / 0.25)):
            await asyncio.sleep(0.25)
            seen.append(self.true_c(body, node))
        return min(seen), max(seen)

    def heater_off_after(self, since_s: float, pin: str = "PB3", node: str = "toolhead") -> float:
        """Return how long after SINCE_S (true time) the heater's pin went low for good, by the pin's log."""
        at_s, level = self.edges(pin, node)[-1]
        assert level == 0, "the heater is on"
        return at_s - since_s
