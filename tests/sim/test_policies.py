"""Nodes that may come and go lose their power in the middle of a print, in virtual time."""

import os
from pathlib import Path

import pytest

from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program
from coordinator.modules.module_set import build_modules
from coordinator.motion.planner.planner import Planner
from coordinator.runtime.machine import Machine
from coordinator.streaming.move_source import Planned
from coordinator.streaming.streamer import Streamer
from tests.stages.demo_machine import NODES, DemoMachine

JOB = "G28\n" + "".join(f"G1 X{20 + 2 * (n % 2)} F1200\n" for n in range(65))
"""Six and a half seconds of short moves, of which three are planned ahead."""
MIDST_S = 5.0


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Keep what commands cache out of the user's home."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "canductor" / "dictionaries"


def section(name: str, uuid: str, policy: str) -> str:
    """Return the configuration of a node that carries nothing."""
    return f"\n[mcu {name}]\ncanbus_uuid: {uuid}\ncanbus_interface: can0\npolicy: {policy}\n"


LIGHT, SCALE = section("light", "0102030405aa", "optional"), section("scale", "0102030405bb", "pause")


def test_nodes_without_power_for_a_while_in_mid_print(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    machine = DemoMachine(tmp_path, sections=LIGHT + SCALE)
    for name, back_s in (("light", 3.0), ("scale", 5.0)):
        machine.at(MIDST_S, machine.node(name).power_off)
        machine.at(MIDST_S + back_s, machine.node(name).power_on)
    report = machine.print(JOB)
    assert report.ok
    assert report.outcome.positions["stepper_x"] != 0
    assert {node.name for node in report.outcome.nodes} == {*NODES, "light", "scale"}, "READY at the end"
    lines = capfd.readouterr().out.splitlines()
    for name, policy in (
        ("light", "its features are off until it is back"),
        ("scale", "the job pauses until the node is back"),
    ):
        gone, back = (line for line in lines if f"node {name}" in line)
        assert gone.startswith(f"lost node {name}")
        assert policy in gone
        assert f"node {name} is back after " in back
    assert machine.shut_down == set()


def test_a_job_that_is_held_reads_no_further_until_it_is_released(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path)
    gcode = machine.write_gcode("G28\nG1 X5 F3000\nG1 X1\n")

    async def main() -> None:
        held_cycles = 0

        def look(_: Planned) -> None:
            nonlocal held_cycles
            if streamer.held is None:
                return
            held_cycles += 1
            assert (program.done_bytes, streamer.worker.pipeline.moves) == (0, 0)
            if held_cycles == 10:
                streamer.release()

        real = Machine(machine.description, machine.host, build_modules(machine.description))
        await real.start()
        try:
            with Program.open(gcode) as program:
                job = Job(program, Planner(real.description.limits), real.description.homed_position)
                streamer = Streamer(real, job, on_output=lambda _: None, on_state=look)
                streamer.hold("a node is away")
                await streamer.run()
            assert held_cycles == 10
            assert streamer.worker.pipeline.moves == 2
            assert real.stopped is None
        finally:
            await real.close()

    machine.run(main)


def test_a_machine_starts_without_an_optional_node_and_knows_the_dictionaries_the_next_time(
    tmp_path: Path, own_cache: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    machine = DemoMachine(tmp_path, sections=LIGHT)
    machine.node("light").power_off()
    alone = machine.write_config("alone.cfg")
    kept: list[dict[Path, int]] = []
    for config, is_known in ((machine.config, False), (alone, True)):
        report = machine.print("G28\nG1 X5 F3000\n", config)
        assert ("node 0102030405aa not found" in capfd.readouterr().out) == (not is_known)
        assert {node.name for node in report.outcome.nodes} == set(NODES)
        kept.append({path: path.stat().st_ino for path in own_cache.glob("*.dict")})
        assert all(path.stat().st_mtime_ns > 0 for path in kept[-1])  # written, or known again
        for path in kept[-1]:
            os.utime(path, ns=(0, 0))
    assert kept[1] == kept[0], "a dictionary that is read again would be another file"
    assert kept[0]
