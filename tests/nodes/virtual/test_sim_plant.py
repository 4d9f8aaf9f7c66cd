"""The plant of simulated boards: true time whatever the clock, resets and power, and who needs whom."""

import numpy as np
import pytest

from nodes.errors import CanductorError
from nodes.virtual.plant import (
    Axis,
    Body,
    Cooling,
    Fan,
    Heater,
    Linear,
    NodePlant,
    Sensor,
    Stepper,
    Switch,
    Term,
)
from nodes.virtual.plant_page import Fault, Kind
from nodes.virtual.sim import SimNode
from nodes.virtual.sim_plant import connect_plants
from nodes.virtual.world import NodeSettings, World

START_CLOCK = 2**32 - 1000
TANK = NodePlant(
    node="tank",
    ambient=20.0,
    bodies=(Body(name="tank", capacity=50.0, loss=0.5, start=60.0),),
    heaters=(Heater(name="tank", pin="PA0", body="tank", power=100.0),),
    sensors=(Sensor(name="tank", pin="PB0", node="tank", body="tank", curve=Linear(zero=0.0, slope=0.002)),),
)
TAU_S = 50.0 / 0.5


def cooled(seconds: float) -> float:
    return float(20.0 + 40.0 * np.exp(-seconds / TAU_S))


def test_time_is_that_of_the_nominal_clock_over_its_rollover() -> None:
    node = SimNode(start_clock=START_CLOCK)
    plant = node.start_plant(TANK)
    node.run_until(START_CLOCK + 30 * node.clock_freq)
    assert plant.page.temperature("tank") == pytest.approx(cooled(30.0), abs=1e-6)
    assert plant.page.updated_ns == pytest.approx((START_CLOCK / node.clock_freq + 30) * 1e9, abs=2)
    node.reset()
    node.run_until(START_CLOCK + 31 * node.clock_freq)
    assert plant.page.temperature("tank") == pytest.approx(cooled(31.0), abs=1e-6)


def test_in_a_world_time_is_true_whatever_the_nodes_crystal() -> None:
    world = World(3)
    wire = world.add_can()
    node = world.add_node(wire, "000000000001", settings=NodeSettings(ppm=50_000.0), start_clock=START_CLOCK)
    world.run_for(0.1)
    plant = node.start_plant(TANK)
    world.run_for(20.0)
    assert plant.page.updated_ns == world.now_ns
    assert plant.page.temperature("tank") == pytest.approx(cooled(20.0), abs=1e-6)
    plant.page.set_fault(Kind.HEATER, "tank", Fault.STUCK_ON)
    assert plant.page.item(Kind.HEATER, "tank").value == 1
    world.run_for(10.0)
    warm_c = 220.0 + (cooled(20.0) - 220.0) * np.exp(-10.0 / TAU_S)
    assert plant.page.temperature("tank") == pytest.approx(warm_c, abs=1e-6)
    node.power_off()  # the world goes on without it
    plant.page.set_fault(Kind.HEATER, "tank", Fault.SOUND)
    assert plant.page.item(Kind.HEATER, "tank").value == 0
    world.run_for(10.0)
    cold_c = 20.0 + (warm_c - 20.0) * np.exp(-10.0 / TAU_S)
    assert plant.page.temperature("tank") == pytest.approx(cold_c, abs=1e-6)


def test_only_one_plant_and_only_a_right_one() -> None:
    node = SimNode()
    node.start_plant(TANK)
    with pytest.raises(CanductorError, match="the plant of node tank: it has a plant already"):
        node.start_plant(TANK)
    bad = NodePlant(node="n", heaters=(Heater(name="h", pin="PA0", body="b", power=1.0),))
    with pytest.raises(CanductorError, match="the plant of node n: line 2: body=b: expected a body"):
        SimNode().start_plant(bad)
    with pytest.raises(CanductorError, match="cannot have name 'two words'; use 1 to 63 characters without"):
        NodePlant(node="n", fans=(Fan(name="two words", pin="PA0"),)).text()
    needy = NodePlant(
        node="n",
        bodies=(Body(name="b", capacity=1.0, loss=1.0),),
        coolings=(Cooling(body="b", node="far", fan="f", conductance=1.0),),
    )
    with pytest.raises(CanductorError, match="plant of node n speaks of node 'far', which has no plant"):
        connect_plants({"n": SimNode().start_plant(needy)})


def test_the_text_is_what_the_parts_say() -> None:
    plant = NodePlant(
        node="a",
        seed=4,
        steppers=(Stepper(name="m", step_pin="PA0", dir_pin="PA1", dir_inverted=True),),
        axes=(Axis(name="x", terms=(Term("a", "m", 0.01), Term("b", "m", -0.01)), max=5.0),),
        switches=(Switch(name="x", pin="PB0", axis="x", at=-1.5, direction=-1),),
        bodies=(Body(name="hot", capacity=2.0, loss=0.5),),
        fans=(Fan(name="f", pin="PA3"),),
        coolings=(Cooling(body="hot", node="a", fan="f", conductance=0.1),),
    )
    assert plant.text().splitlines() == [
        "plant node=a seed=4 ambient=25.0",
        "stepper name=m step=PA0 dir=PA1 step_inverted=0 dir_inverted=1 enable_inverted=0 both_edges=0",
        "axis name=x origin=0.0 min=-inf max=5.0",
        "term axis=x node=- stepper=m mm=0.01",
        "term axis=x node=b stepper=m mm=-0.01",
        "switch name=x pin=PB0 axis=x at=-1.5 direction=-1 hysteresis=0.0 noise=0.0 inverted=0",
        "body name=hot capacity=2.0 loss=0.5",
        "fan name=f pin=PA3 inverted=0 rpm=6000.0 lag=0.3 pulses=2.0",
        "cooling body=hot node=- fan=f conductance=0.1",
    ]
    assert plant.peers == ("b",)
