"""The plant of simulated boards: true time whatever the clock, resets and power, and who needs whom."""

import numpy as np
import pytest

from nodes.support.errors import CanductorError
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
from nodes.virtual.plant_page import PlantFault, PlantItemKind
from nodes.virtual.sim_plant import connect_plants
from nodes.virtual.world import NodeSettings, World
from tests.firmware.host import Host
from tests.nodes.virtual.plants import HOT
from tests.stages.sim_node import SimNode

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
    plant.page.set_fault(PlantItemKind.HEATER, "tank", PlantFault.STUCK_ON)
    assert plant.page.item(PlantItemKind.HEATER, "tank").value == 1
    world.run_for(10.0)
    warm_c = 220.0 + (cooled(20.0) - 220.0) * np.exp(-10.0 / TAU_S)
    assert plant.page.temperature("tank") == pytest.approx(warm_c, abs=1e-6)
    node.power_off()  # the world goes on without it
    plant.page.set_fault(PlantItemKind.HEATER, "tank", PlantFault.SOUND)
    assert plant.page.item(PlantItemKind.HEATER, "tank").value == 0
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
    with pytest.raises(CanductorError, match="cannot have name 'two words'; give 1 to 63 characters without"):
        NodePlant(node="n", fans=(Fan(name="two words", pin="PA0"),)).text()
    needy = NodePlant(
        node="n",
        bodies=(Body(name="b", capacity=1.0, loss=1.0),),
        coolings=(Cooling(body="b", node="far", fan="f", conductance=1.0),),
    )
    with pytest.raises(CanductorError, match="plant of node n refers to node 'far', which has no plant"):
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


# ----------------------------------------------------------------------------- what the firmware sees of it


def test_a_heater_that_is_on_warms_its_sensor_as_the_formula_says() -> None:
    # Over the 32-bit rollover of the clock, too.
    host = Host(start_clock=2**32 - 20_000_000)
    freq, plant = host.node.clock_freq, host.node.start_plant(HOT)
    host.configure(
        "config_digital_out oid=0 pin=0 value=0 default_value=0 max_duration=0",
        "config_analog_in oid=1 pin=16",
    )
    begin, rest = host.now + freq // 10, freq // 20
    host.send(
        f"query_analog_in oid=1 clock={begin % 2**32} sample_ticks=1000 sample_count=8 rest_ticks={rest} "
        "bytes_per_report=2 min_value=0 max_value=65535 range_check_count=4"
    )
    on = begin + freq // 8
    host.send(f"queue_digital_out oid=0 clock={on % 2**32} on_ticks=1")
    answers = [answer for answer in host.run(freq * 8 // 5) if answer.name == "analog_in_state"]
    assert host.now > 2**32
    assert len(answers) >= 29
    for answer in answers:
        since = (answer["next_clock"] - rest - begin) % 2**32 + begin + 3500 - on  # the middle of 8 samples
        values = answer.args["values"]
        assert isinstance(values, bytes)
        # Each of the eight samples is rounded.
        assert int.from_bytes(values, "little") == pytest.approx(8 * sample_of_hot(since / freq), abs=4.5)
    assert plant.page.temperature("block") > 70


def sample_of_hot(since_s: float) -> float:
    """Return what the converter reads of HOT's sensor, SINCE_S after its heater went on: by formula."""
    tau, lag, end = 2.0 / 0.4, 0.15, 90.0 / 0.4
    rise = 1 - (tau * np.exp(-since_s / tau) - lag * np.exp(-since_s / lag)) / (tau - lag)
    kelvin = 20.0 + (end * rise if since_s > 0 else 0.0) + 273.15
    ohm = 100_000.0 * np.exp(3950.0 * (1 / kelvin - 1 / 298.15))
    return float(4095 * ohm / (ohm + 4700.0))


def test_without_its_host_a_heater_ends_by_itself() -> None:
    host = Host()
    freq, plant = host.node.clock_freq, host.node.start_plant(HOT)
    host.configure(f"config_digital_out oid=0 pin=0 value=0 default_value=0 max_duration={freq // 4}")
    on = host.now + freq // 10
    host.send(f"queue_digital_out oid=0 clock={on} on_ticks=1")
    # And now nobody says anything any more.
    host.run(freq // 10)
    assert plant.page.item(PlantItemKind.HEATER, "block").value == 1
    assert "Missed scheduling" in host.dies(run=freq)
    assert host.steps(0).tolist() == [on, on + freq // 4]
    assert plant.page.item(PlantItemKind.HEATER, "block").value == 0
    assert plant.page.item(PlantItemKind.HEATER, "block").extra == pytest.approx(22.5, rel=1e-6)


def test_what_breaks_at_run_time() -> None:
    host = Host()
    freq, plant = host.node.clock_freq, host.node.start_plant(HOT)
    host.configure(
        "config_digital_out oid=0 pin=0 value=1 default_value=0 max_duration=0",
        "config_analog_in oid=1 pin=16",
    )

    def set_fault(kind: PlantItemKind, fault: PlantFault) -> None:
        plant.page.set_fault(kind, "block", fault)
        assert plant.page.item(kind, "block").fault is fault  # the plant has seen it now

    host.run(freq)
    assert plant.page.temperature("block") > 50
    set_fault(PlantItemKind.HEATER, PlantFault.DEAD)
    host.run(freq // 10)
    assert plant.page.item(PlantItemKind.HEATER, "block").value == 0
    set_fault(PlantItemKind.HEATER, PlantFault.STUCK_ON)
    host.send("update_digital_out oid=0 value=0")
    warm_c = plant.page.temperature("block")
    host.run(freq)
    assert plant.page.temperature("block") > warm_c + 10
    set_fault(PlantItemKind.SENSOR, PlantFault.FALLEN)
    host.run(3 * freq)
    assert plant.page.item(PlantItemKind.SENSOR, "block").value < 21
    assert plant.page.temperature("block") > 40
    # A broken wire is out of the range a host allows: the firmware shuts down.
    host.send(
        f"query_analog_in oid=1 clock={host.now + freq // 100} sample_ticks=1000 sample_count=8 "
        f"rest_ticks={freq // 50} bytes_per_report=2 min_value=800 max_value=32700 range_check_count=4"
    )
    assert host.run(freq // 10)[0].name == "analog_in_state"
    set_fault(PlantItemKind.SENSOR, PlantFault.OPEN)
    assert host.dies(run=freq) == "ADC out of range"
    assert plant.page.item(PlantItemKind.SENSOR, "block").extra == 4095
    with pytest.raises(CanductorError, match="a sensor cannot be stuck_on; it can be open, shorted, fallen"):
        plant.page.set_fault(PlantItemKind.SENSOR, "block", PlantFault.STUCK_ON)
    with pytest.raises(CanductorError, match="there is no fan 'fan'; there is part"):
        plant.page.item(PlantItemKind.FAN, "fan")


def test_a_motor_that_is_off_moves_nothing() -> None:
    stepper = Stepper(name="m", step_pin="PA0", dir_pin="PA1", enable_pin="PA2", enable_inverted=True)
    axis = Axis(name="x", terms=(Term("n", "m", 1.0),), max=3.0)
    host = Host()
    plant = host.node.start_plant(NodePlant(node="n", steppers=(stepper,), axes=(axis,)))

    def step(times: int) -> None:
        for _ in range(times):
            host.send("set_digital_out pin=0 value=1", "set_digital_out pin=0 value=0")

    host.send("set_digital_out pin=1 value=1")
    step(2)
    host.send("set_digital_out pin=2 value=1")
    step(1)
    assert (plant.page.motors["m"].count, plant.page.motors["m"].lost) == (2, 1)
    host.send("set_digital_out pin=2 value=0")
    step(4)
    assert (plant.page.motors["m"].count, plant.page.motors["m"].lost) == (3, 4)  # against its stop
