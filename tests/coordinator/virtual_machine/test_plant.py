"""The plant of configured machines: where endstops stand, whichever the kinematics, and what gets warm."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription
from coordinator.demo.run import DemoOptions
from coordinator.kinematics.base import Point
from coordinator.support.examples import EXAMPLES
from coordinator.virtual_machine.plant import START_MM, PlantSettings, machine_plants, start_point
from coordinator.virtual_machine.plant_heat import HeatSettings, steinhart, table_of
from coordinator.virtual_machine.virtual_machine import VirtualMachine
from nodes.virtual.plant import Axis, Beta, NodePlant, Rtd, Steinhart
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from nodes.virtual.sim_plant import SimPlant, connect_plants
from tests.stages.printer_text import printer_section, section, stepper_section
from tests.stages.sim_node import SimNode

CONFIGS = sorted(EXAMPLES.rglob("*.cfg"))
SHARED = Path(__file__).parents[4] / "shared" / "data" / "config"


class Truth:
    """Where a machine's axes are when its rails are moved from its start to POINT."""

    def __init__(self, description: MachineDescription) -> None:
        self.description = description
        self.plants = machine_plants(description)
        kinematics = description.kinematics
        self._begin = kinematics.inverse(start_point(description))
        self._motors = {}
        for index, name in enumerate(kinematics.rails):
            rails = {rail.axis: rail for rail in description.rails}
            for stepper in rails[name].steppers if name in rails else [description.motors[index]]:
                self._motors[stepper.name] = (index, stepper.step_distance)

    def pressed(self, point: Point) -> dict[str, bool]:
        """Return which switches are pressed, and which stops that motors feel, without rounding to steps."""
        there = self.description.kinematics.inverse(point)
        felt = {rail.axis: rail.homing for rail in self.description.rails if rail.homing.virtual_endstop}
        found = {}
        for plant in self.plants.values():
            axes = {axis.name: axis for axis in plant.axes}
            for switch in plant.switches:
                place = self._place(axes[switch.axis], there)
                found[switch.name] = switch.direction * (place - switch.at) >= -1e-6
            for name in felt.keys() & axes.keys():
                axis, place = axes[name], self._place(axes[name], there)
                found[name] = (
                    place >= axis.max - 1e-6 if felt[name].positive_dir else place <= axis.min + 1e-6
                )
        return found

    def _place(self, axis: Axis, there: Sequence[float]) -> float:
        place = axis.origin
        for term in axis.terms:
            index, distance = self._motors[term.stepper]
            place += term.mm_per_step * (there[index] - self._begin[index]) / distance
        return place


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_endstops_of_every_example_switch_at_its_home_and_not_on_the_way(path: Path) -> None:
    description = load_machine(str(path))
    plants = machine_plants(description)
    for plant in plants.values():
        node = SimNode()  # the firmware takes the description
        node.start_plant(plant)
    if description.dual_carriage is not None:
        return  # its second carriage is elsewhere than the head
    truth = Truth(description)
    begin, home = np.array(start_point(description)), np.array(description.home)
    named = {rail.axis for rail in description.rails if rail.homing.endstop_pin is not None}
    assert len(truth.pressed(description.home)) == len(named)
    assert all(truth.pressed(description.home).values())
    nearly = home + (begin - home) * 1e-3
    for share in (1.0, 0.5, 1e-3):
        x, y, z = home + (begin - home) * share
        assert not any(truth.pressed((float(x), float(y), float(z))).values()), nearly


def test_the_second_carriage_has_an_endstop_of_its_own() -> None:
    (plant,) = machine_plants(load_machine(str(EXAMPLES / "idex.cfg"))).values()
    axes = {axis.name: axis for axis in plant.axes}
    (switch,) = [switch for switch in plant.switches if switch.axis == "dual_carriage"]
    assert (switch.at, switch.direction, axes["dual_carriage"].origin) == (350.0, 1, 350.0 - START_MM)
    assert [term.stepper for term in axes["dual_carriage"].terms] == ["dual_carriage"]
    assert [term.stepper for term in axes["x"].terms] == ["stepper_x"]


ENDS = {"position_endstop": 0, "position_max": 200}
CONFIG = (
    section("mcu", serial="/dev/ttyA", restart_method="command")
    + section("mcu tool", serial="/dev/ttyB", restart_method="command")
    + section("board_pins tool", mcu="tool", aliases="HOT=PA2")
    + printer_section(max_velocity=100, max_accel=1000, max_z_velocity=10, max_z_accel=100)
    + stepper_section("stepper_x", "PD0", "PD1", **ENDS)
    + stepper_section("stepper_y", "PD2", "PD3", **ENDS)
    + stepper_section("stepper_z", "PD4", "PD5", rotation_distance=8, **ENDS)
    + """
[extruder]
step_pin: PA8
dir_pin: PA9
microsteps: 16
rotation_distance: 20
nozzle_diameter: 0.4
filament_diameter: 1.75
heater_pin: !tool:HOT
sensor_type: my probe
sensor_pin: PB0
pullup_resistor: 2200
control: watermark
min_temp: 0
max_temp: 300
[thermistor my probe]
temperature1: 20
resistance1: 126800
temperature2: 150
resistance2: 1360
temperature3: 300
resistance3: 80.65
[heater_bed]
heater_pin: PB2
sensor_type: PT1000
sensor_pin: PB1
control: watermark
min_temp: 0
max_temp: 130
[fan]
pin: PC0
[heater_fan hotend]
pin: !tool:PC1
tachometer_pin: ^tool:PC2
tachometer_ppr: 4
[temperature_sensor chamber]
sensor_type: Generic 3950
sensor_pin: PB3
"""
)


@pytest.fixture
def plants(tmp_path: Path) -> dict[str, NodePlant]:
    (tmp_path / "machine.cfg").write_text(CONFIG)
    settings = PlantSettings(heat=HeatSettings(hurry=4.0, adc_noise=0.0, ambient_c=20.0))
    return machine_plants(load_machine(str(tmp_path / "machine.cfg")), settings)


def test_heat_is_as_the_sections_say(plants: dict[str, NodePlant]) -> None:
    tool, main = plants["tool"], plants["mcu"]
    assert [(h.name, h.pin, h.inverted, h.body) for h in tool.heaters] == [
        ("extruder", "PA2", True, "extruder_heater")
    ]
    assert {body.name: body.capacity for body in tool.bodies} == {"extruder": 2.75, "extruder_heater": 0.5}
    assert [(f.name, f.pin, f.inverted, f.tach_pin, f.pulses) for f in tool.fans] == [
        ("heater_fan_hotend", "PC1", True, "PC2", 4.0)
    ]
    assert [(c.body, c.node, c.fan) for c in tool.coolings] == [("extruder", "mcu", "fan")]
    sensors = {sensor.name: sensor for sensor in main.sensors}
    assert set(sensors) == {"extruder", "heater_bed", "temperature_sensor_chamber"}
    assert (sensors["extruder"].node, sensors["extruder"].body) == ("tool", "extruder")
    assert isinstance(sensors["extruder"].curve, Steinhart)
    assert sensors["extruder"].curve.pullup == 2200
    assert isinstance(sensors["heater_bed"].curve, Rtd)
    assert main.peers == ("tool",)
    assert tool.peers == ("mcu",)


def test_nodes_that_need_each_other_live_together(plants: dict[str, NodePlant]) -> None:
    # The hotend's heater is on one board; its sensor, and the fan that blows at it, on the other.
    nodes = {name: SimNode() for name in plants}
    started = {name: nodes[name].start_plant(plants[name]) for name in plants}
    connect_plants(started)
    begun_c = started["mcu"].page.item(PlantItemKind.SENSOR, "extruder").value
    assert begun_c == pytest.approx(20.0)

    def run(seconds: float) -> None:
        for _ in range(round(seconds / 0.05)):
            for node in nodes.values():
                node.run_until(node.clock + node.clock_freq // 20)
            _pages(started)

    run(1.0)
    assert started["tool"].page.temperature("extruder") == pytest.approx(20.0)
    hot = started["tool"].page
    hot.set_fault(PlantItemKind.HEATER, "extruder", PlantFault.STUCK_ON)
    run(20.0)
    true_c = started["tool"].page.temperature("extruder")
    assert 120 < true_c < 300
    read_c = started["mcu"].page.item(PlantItemKind.SENSOR, "extruder").value
    assert true_c - 10 < read_c < true_c  # it follows


def _pages(started: dict[str, SimPlant]) -> None:
    for plant in started.values():
        assert plant.page.updated_ns > 0


@pytest.mark.parametrize(
    "points",
    [((25, 100_000), (150, 1641.9), (250, 226.15)), ((25, 100_000), (150, 1711), (250, 231))],
)
def test_a_thermistor_goes_through_the_points_of_its_data_sheet(
    points: tuple[tuple[float, float], ...],
) -> None:
    curve = steinhart(*points)
    for celsius, ohm in points:
        if isinstance(curve, Steinhart):
            log = math.log(ohm)
            kelvin = 1 / (curve.c1 + curve.c2 * log + curve.c3 * log**3)
        else:
            assert isinstance(curve, Beta)
            kelvin = 1 / (1 / (curve.t0 + 273.15) + math.log(ohm / curve.r0) / curve.beta)
        exact = isinstance(curve, Steinhart) or celsius != 150
        assert kelvin - 273.15 == pytest.approx(celsius, abs=1e-6 if exact else 2.0)


def test_a_sensor_may_be_given_by_what_it_reads(tmp_path: Path) -> None:
    (tmp_path / "machine.cfg").write_text(CONFIG)
    curve = table_of(lambda celsius: 0.1 + celsius * 0.002, -50.0, 400.0)
    heat = HeatSettings(curves={"Generic 3950": curve}, ambient_c=30.0, adc_noise=0.0)
    plants = machine_plants(load_machine(str(tmp_path / "machine.cfg")), PlantSettings(heat=heat))
    node = SimNode()
    node.start_plant(plants["mcu"])  # the firmware takes the table
    (chamber,) = [s for s in plants["mcu"].sensors if s.pin == "PB3"]
    assert chamber.curve is curve
    assert curve.points[0] == (-50.0, 0.0)
    assert curve.points[-1] == pytest.approx((400.0, 0.9))


def test_three_points_of_no_thermistor_give_the_one_by_beta_of_the_outer_two() -> None:
    assert isinstance(steinhart((25, 100_000), (150, 1200), (250, 226)), Beta)


def test_the_machines_of_the_shared_data_have_plants() -> None:
    if not SHARED.is_dir():
        pytest.skip(f"no shared data in {SHARED}")
    for path in sorted(SHARED.glob("*.cfg")):
        plants = machine_plants(load_machine(str(path)))
        assert sum(len(plant.switches) for plant in plants.values()) == 3
        heaters = {heater.name for plant in plants.values() for heater in plant.heaters}
        sensors = {sensor.name for plant in plants.values() for sensor in plant.sensors}
        assert heaters == sensors == {"extruder", "heater_bed"}


def test_the_stage_of_the_demo_has_it(tmp_path: Path) -> None:
    options = DemoOptions(machine=EXAMPLES / "demo" / "machine.cfg")
    description = load_machine(str(options.machine))
    with VirtualMachine(description, options, tmp_path) as stage:
        page = stage.plant_page("mcu")
        assert set(page.motors) == {s.name for s in description.steppers if s.node == "mcu"}
        stage.stop_nodes()
        assert all(event.kind == "body" for event in stage.plant_log("mcu"))
