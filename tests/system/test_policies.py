"""Nodes that may come and go, killed and started again in the middle of a print, as real processes."""

import asyncio
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from coordinator.app import Machine
from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program
from coordinator.host import LinuxHost
from coordinator.machine.description import load_machine
from coordinator.motion.planner import Planner
from coordinator.move_source import JobState
from coordinator.streamer import Streamer
from nodes.virtual.processes import NodeProcess
from tests.stages.processes import Command, Hardware, write_config, write_gcode

MOVING = "taken as already home"
LIGHT_UUID, SCALE_UUID = "0102030405aa", "0102030405bb"
JOB = "G28\n" + "".join(f"G1 X{20 + 2 * (n % 2)} F1200\n" for n in range(65))
"""Six and a half seconds of short moves, of which three are planned ahead."""


def section(machine: Hardware, name: str, uuid: str, policy: str) -> str:
    """Return the configuration of a node that carries nothing."""
    bus = machine.folder / "bus"
    return f"[mcu {name}]\ncanbus_uuid: {uuid}\ncanbus_interface: virtual:{bus}\npolicy: {policy}\n\n"


def config_with(machine: Hardware, *sections: str) -> Path:
    path = write_config(machine.folder, name="with_more.cfg")
    path.write_text("".join(sections) + path.read_text(encoding="utf-8"), encoding="utf-8")
    return path


@contextmanager
def node(machine: Hardware, uuid: str) -> Iterator[NodeProcess]:
    process = NodeProcess("toolhead", uuid=uuid, can=machine.folder / "bus", rate_ppm=35)
    try:
        process.wait_ready()
        yield process
    finally:
        process.kill()


def test_nodes_killed_and_started_again_in_mid_print(machine: Hardware) -> None:
    light = section(machine, "light", LIGHT_UUID, "optional")
    scale = section(machine, "scale", SCALE_UUID, "pause")
    words = ("run", config_with(machine, light, scale), "--gcode", write_gcode(machine.folder, JOB), "--json")
    with Command(*words) as command:
        with node(machine, LIGHT_UUID), node(machine, SCALE_UUID):
            command.stdout.wait_for(MOVING)
        command.stdout.wait_for("lost node light")
        command.stdout.wait_for("lost node scale")
        with node(machine, LIGHT_UUID) as new_light, node(machine, SCALE_UUID) as new_scale:
            command.stdout.wait_for("node light is back")
            ended = command.end()
            assert not any(process.stop()["is_shutdown"] for process in (new_light, new_scale))
    assert ended.status == 0, ended
    for name, policy in (
        ("light", "its features are off until it is back"),
        ("scale", "the job pauses until the node is back"),
    ):
        gone, back = (line for line in ended.stdout.splitlines() if f"node {name}" in line)
        assert policy in gone
        assert f"node {name} is back after " in back
    assert ended.json["ok"] is True
    assert {"light", "scale"} <= set(ended.json["nodes"])  # READY at the end
    assert all(s["steps_moved"] == s["steps_sent"] for s in ended.json["steppers"].values())
    assert ended.json["steppers"]["stepper_x"]["steps_sent"] != 0
    assert not any(stats["is_shutdown"] for stats in machine.stop())


def test_a_job_that_is_held_reads_no_further_until_it_is_released(machine: Hardware) -> None:
    gcode = write_gcode(machine.folder, "G28\nG1 X5 F3000\nG1 X1\n")

    async def main() -> None:
        held_cycles = 0

        def look(state: JobState) -> None:
            nonlocal held_cycles
            if streamer.held is None:
                return
            held_cycles += 1
            assert (state.done_bytes, state.moves) == (0, 0)
            if held_cycles == 10:
                streamer.release()

        real = Machine(load_machine(str(machine.config)), LinuxHost())
        await real.start()
        try:
            with Program.open(gcode) as program:
                planner = Planner(real.description.limits)
                job = Job(program, planner, real.description.homed_position)
                streamer = Streamer(real, job, on_told=lambda _: None, on_state=look)
                streamer.hold("a node is away")
                await streamer.run()
                assert held_cycles == 10
                assert streamer.worker.pipeline.moves == 2
            assert real.stopped is None
        finally:
            await real.close()

    asyncio.run(main())


def test_a_machine_starts_without_an_optional_node_and_knows_the_dictionaries_the_next_time(
    machine: Hardware,
) -> None:
    gcode = write_gcode(machine.folder, "G28\nG1 X5 F3000\n")
    dictionaries = Path(os.environ["XDG_CACHE_HOME"]) / "canductor" / "dictionaries"
    kept: list[dict[Path, int]] = []
    light = section(machine, "light", LIGHT_UUID, "optional")
    for config, is_known in ((config_with(machine, light), False), (machine.config, True)):
        with Command("run", config, "--gcode", gcode, "--json") as command:
            ended = command.end()
        assert ended.status == 0, ended
        assert (f"node {LIGHT_UUID} not found" in ended.stdout) == (not is_known)
        assert set(ended.json["nodes"]) == {"mcu", "toolhead", "zboard"}
        kept.append({path: path.stat().st_ino for path in dictionaries.iterdir()})
        assert all(path.stat().st_mtime_ns > 0 for path in kept[-1])  # written, or known again
        for path in kept[-1]:
            os.utime(path, ns=(0, 0))
    assert kept[1] == kept[0]  # a dictionary read again would be another file
    assert len(kept[0]) == 3
