"""A print over SocketCAN: the coordinator's job and two firmware processes on vcan0."""

import asyncio
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.gcode.program import Program
from coordinator.service.core.job_runner import run_job
from nodes.virtual.processes import NodeProcess
from tests.vcan.kernel import INTERFACE, why_no_socketcan

pytestmark = pytest.mark.skipif(bool(why_no_socketcan()), reason=why_no_socketcan())

MAINBOARD, TOOLHEAD = "90a4ae022dfc", "5e1ec7ab1e02"
MACHINE = f"""\
[mcu]
canbus_uuid: {MAINBOARD}
canbus_interface: {INTERFACE}

[mcu toolhead]
canbus_uuid: {TOOLHEAD}
canbus_interface: {INTERFACE}

[printer]
kinematics: cartesian
max_velocity: 50
max_accel: 500

[stepper_x]
step_pin: PA0
dir_pin: PA1
microsteps: 4
rotation_distance: 40
position_max: 200

[stepper_y]
step_pin: PA2
dir_pin: !PA3
microsteps: 4
rotation_distance: 40
position_max: 200

[stepper_z]
step_pin: PA4
dir_pin: PA5
microsteps: 4
rotation_distance: 8
position_max: 200

[extruder]
step_pin: toolhead:PA0
dir_pin: toolhead:PA1
microsteps: 4
rotation_distance: 20
nozzle_diameter: 0.4
filament_diameter: 1.75
"""
STEPS_PER_MM = 200 * 4 / 40
GCODE = """\
G28
M83
G1 X10 Y5 F1800
G1 X30 Y25 E1.5 F1800
G1 X12.5 Y40 E1 F1800
G1 Z0.4 F300
G1 X20 Y7.5 E0.5 F1800
"""
# Where that ends, in steps from its begin at 0.
END = {
    "stepper_x": 20 * STEPS_PER_MM,
    "stepper_y": 7.5 * STEPS_PER_MM,
    "stepper_z": 0.4 * 100,
    "extruder": 3 * 40,
}


@pytest.fixture
def processes() -> Iterator[list[NodeProcess]]:
    with ExitStack() as stack:
        started = [
            stack.enter_context(NodeProcess("mainboard", uuid=MAINBOARD, socketcan=INTERFACE, rate_ppm=40)),
            stack.enter_context(NodeProcess("toolhead", uuid=TOOLHEAD, socketcan=INTERFACE, rate_ppm=-80)),
        ]
        for process in started:
            process.wait_ready()
        yield started


def test_print_ends_where_the_plan_says(processes: list[NodeProcess], tmp_path: Path) -> None:
    (tmp_path / "machine.cfg").write_text(MACHINE)
    description = load_machine(str(tmp_path / "machine.cfg"))
    with Program.from_lines(GCODE.splitlines(keepends=True)) as program:
        outcome = asyncio.run(run_job(description, program, on_output=lambda _: None))
    assert outcome.positions == outcome.issued == END
    assert outcome.print_time_s > 2
    assert [node.link.bytes_invalid for node in outcome.nodes] == [0, 0]
    ends = [process.stop() for process in processes]
    assert [end["is_shutdown"] for end in ends] == [False] * 2
    # What is sent before a repeat that nobody needed, on a computer that was slow to answer, counts as lost.
    assert all(end["lost"] <= node.link.timeouts for end, node in zip(ends, outcome.nodes, strict=True))
