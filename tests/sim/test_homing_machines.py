"""G28 of every example machine, and of axes with two sides, in a world that knows where all truly is."""

import asyncio
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.simulate.scenario import NodeSetting
from coordinator.support.examples import EXAMPLES
from tests.stages.plant_stage import STEP_MM, PlantStage
from tests.stages.printer_text import MCU, TOOLHEAD, printer_section, stepper_section
from tests.stages.served import running

MACHINES = ("polar", "rotary_delta")


@pytest.mark.parametrize("name", MACHINES)
def test_every_machine_finds_its_endstops(tmp_path: Path, name: str) -> None:
    stage = PlantStage(tmp_path, EXAMPLES / f"{name}.cfg", None)

    async def go() -> None:
        async with running(stage.served):
            await stage.served.call("gcode.run", script="G28")
            assert stage.served.tree.get("position.homed") == "XYZ"
            await stage.check_all()
            await stage.served.call("gcode.run", script="G1 X30 Y-60 Z100 F6000")
            await stage.check_all()

    with asyncio.Runner(loop_factory=stage.stage.make_loop) as runner:
        runner.run(go())


def test_both_carriages_find_their_own_endstops(tmp_path: Path) -> None:
    stage = PlantStage(tmp_path, EXAMPLES / "idex.cfg", None)

    async def go() -> None:
        async with running(stage.served):
            await stage.served.call("gcode.run", script="G28\nG1 X120 F6000\nSET_DUAL_CARRIAGE CARRIAGE=1")
            await stage.check_all()
            await stage.served.call("gcode.run", script="G1 X260 F6000")
            await stage.check_all()
            assert stage.true_mm("x") == pytest.approx(120, abs=0.02)
            assert stage.true_mm("dual_carriage") == pytest.approx(260, abs=0.02)
            told = await stage.served.call("gcode.run", script="M119")
            assert told["replies"] == ["x:open y:pressed z:pressed dual_carriage:open"]
            await stage.served.call("gcode.run", script="G28 X\nG1 X130 F6000")
            assert stage.true_mm("x") == pytest.approx(130, abs=0.02)
            assert stage.true_mm("dual_carriage") == pytest.approx(350, abs=0.02)

    with asyncio.Runner(loop_factory=stage.stage.make_loop) as runner:
        runner.run(go())


def two_sides(kinematics: str) -> str:
    """Return a machine whose Z has a motor and an endstop on each side, on two nodes."""
    ends = {"position_endstop": 0, "position_max": 250, "homing_speed": 50}
    return (
        MCU
        + TOOLHEAD
        + printer_section(kinematics, max_accel=5000)
        + stepper_section("stepper_x", "PB0", "PB1", position_max=250)
        + stepper_section("stepper_z", "PB3", "PB4", endstop_pin="^PC5", **ends)
        + stepper_section("stepper_z1", "toolhead:PB3", "!toolhead:PB4", endstop_pin="^toolhead:PC6")
        + stepper_section("stepper_y", "PB6", "PB7", rotation_distance=8, position_max=250)
    )


def test_a_gantry_is_squared_by_the_endstops_of_its_sides(tmp_path: Path) -> None:
    """Its nodes cannot stop each other: the host relays, up to 20 ms late, which is a millimetre."""
    path = tmp_path / "two.cfg"
    path.write_text(two_sides("cartesian"))
    nodes = {"toolhead": NodeSetting(legacy=True)}
    stage = PlantStage(tmp_path, path, (100.0, 50.0, 40.0), nodes=nodes, stepper_z1=2.5)

    async def go() -> None:
        async with running(stage.served):
            await stage.served.call("gcode.run", script="G28")
            await stage.check_all()
            await stage.served.call("gcode.run", script="G1 Z77 F6000")
            await stage.check_all()
            sides = [stage.true_mm(name) for name in ("stepper_z", "stepper_z1")]
            assert sides == pytest.approx([77, 77], abs=1.7 * STEP_MM)
            told = await stage.served.call("gcode.run", script="QUERY_ENDSTOPS")
            assert told["replies"] == ["z:open z1:open"]

    with asyncio.Runner(loop_factory=stage.stage.make_loop) as runner:
        runner.run(go())


def test_endstops_that_cannot_act_are_told(tmp_path: Path) -> None:
    path = tmp_path / "two.cfg"
    for kinematics, acts in (("cartesian", True), ("corexy", True), ("corexz", False)):
        path.write_text(two_sides(kinematics))
        machine = load_machine(str(path))
        waiting = [(entry.section, entry.options) for entry in machine.unsupported]
        assert waiting == ([] if acts else [("stepper_z1", ("endstop_pin",))])
        assert len(machine.rails[2].pieces) == (2 if acts else 1)
        assert [rail.axis for rail in machine.stops] == (["z", "z1"] if acts else ["z"])
    path.write_text(two_sides("cartesian").replace("^toolhead:PC6", "^PC5"))
    machine = load_machine(str(path))
    assert not machine.unsupported
    assert [rail.axis for rail in machine.stops] == ["z"]
