"""A job that its service's death cuts off goes on in the next one: hot, homed, where nothing is guessed."""

import asyncio
import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from coordinator.demo.plant import PlantSettings, machine_plants
from coordinator.demo.plant_heat import HeatSettings
from coordinator.ipc.client import Client
from coordinator.ipc.methods import ApiError
from coordinator.machine.description import load_machine
from nodes.virtual.plant_page import PlantPage
from nodes.virtual.processes import BusProcess, Flavour, NodeProcess
from tests.stages.processes import Command, Hardware
from tests.stages.served import LIMIT_S, served, zigzag

PLANT = PlantSettings(
    start=(20.0, 230.0, 5.0), heat=HeatSettings(hurry=4, warm_c={"extruder": 200.0, "heater_bed": 58.0})
)
"""Near the endstops; not so quick that a heater that is looked at every 0.3 s leaves its target."""
NODES = {"mcu": "11aa22bb33cc", "toolhead": "44dd55ee66ff"}
SECTIONS = """
[pause_resume]
[gcode_macro COUNT]
variable_n: 0
gcode:
    SET_GCODE_VARIABLE MACRO=COUNT VARIABLE=n VALUE={n + 1}
"""
HEAT = "M140 S60\nM104 S210\nG28\nM190 S60\nM109 S210\nM106 S102\n"
JOB = (
    HEAT
    + zigzag(22, 3).replace("G28\n", "").replace("M83\n", "M82\nG92 E5\nCOUNT\nM83\n", 1)
    + zigzag(12, 4).split("\n", 1)[1]
    + "COUNT\n"
)


@pytest.fixture
def printer(tmp_path: Path) -> Iterator[Hardware]:
    """The example machine with a toolhead board, as processes with all that is around their pins."""
    text = Path("config/corexy_toolhead.cfg").read_text(encoding="utf-8").replace("pid_", "# pid_")
    text = text.replace("control: pid", "control: watermark").replace("can0", f"virtual:{tmp_path / 'bus'}")
    config = tmp_path / "printer.cfg"
    config.write_text(text + SECTIONS, encoding="utf-8")
    plants = machine_plants(load_machine(str(config)), PLANT)
    with ExitStack() as stack:
        bus = BusProcess(tmp_path / "bus")
        stack.callback(bus.kill)
        bus.wait_ready()
        nodes = {}
        for name, uuid in NODES.items():
            flavour: Flavour = "mainboard" if name == "mcu" else "toolhead"
            node = NodeProcess(flavour, uuid=uuid, can=tmp_path / "bus", plant=plants[name].write(tmp_path))
            stack.callback(node.kill)
            node.wait_ready()
            nodes[name] = node
        yield Hardware(tmp_path, config, bus, nodes)


def true_mm(printer: Hardware) -> list[float]:
    """Return where the head truly is."""
    plants = machine_plants(load_machine(str(printer.config)), PLANT)
    motors = {name: PlantPage.at(printer.folder, name).motors for name in NODES}
    axes = {axis.name: axis for plant in plants.values() for axis in plant.axes}
    return [
        axes[name].origin + sum(t.mm_per_step * motors[t.node][t.stepper].count for t in axes[name].terms)
        for name in "xyz"
    ]


def true_c(printer: Hardware) -> float:
    return PlantPage.at(printer.folder, "toolhead").temperature("extruder")


def test_a_hot_job_goes_on_after_its_service_was_killed(printer: Hardware) -> None:
    jobs, path = printer.folder / "jobs", printer.folder / "run.sock"
    jobs.mkdir()
    (jobs / "job.gcode").write_text(JOB, encoding="utf-8")

    async def print_part(service: Command) -> None:
        async with asyncio.timeout(2 * LIMIT_S), Client.connect(str(path)) as client:
            await client.call("gcode.run", {"script": "SET_GCODE_OFFSET Z=0.3"})
            await client.call("job.start", {"file": "job.gcode"})
            async for update in client.watch(["job.line", "job.state", "machine.cause"], rate_hz=20):
                assert update.values.get("job.state") not in {"failed", "stopped"}, update
                assert not update.values.get("machine.cause"), update
                line = update.values.get("job.line")
                if isinstance(line, int) and line > 22:
                    service.process.kill()  # at once: there are two seconds more to print
                    return

    with Command("run", printer.config, "--ipc", path, "--jobs", jobs) as command:
        command.stdout.wait_for("ready")
        asyncio.run(print_part(command))
        command.process.wait()

    async def go_on() -> None:
        async with served(printer) as stage:
            line = stage.tree.get("job.interrupted_line")
            assert stage.tree.get("job.interrupted_file") == "job.gcode"
            assert isinstance(line, int)
            assert 12 < line < 46
            assert any(f"interrupted at line {line}" in told for told in stage.lines)
            z_mm = true_mm(printer)[2]
            assert z_mm == pytest.approx(1.3, abs=0.01)
            with pytest.raises(ApiError, match="X and Y and Z must be homed"):
                await stage.call("job.recover")
            with pytest.raises(ApiError, match="was interrupted at line"):
                await stage.call("job.recover", line=line + 1)
            written = (jobs / "job.gcode").stat().st_mtime_ns
            os.utime(jobs / "job.gcode", ns=(1, 1))
            with pytest.raises(ApiError, match="the file has changed"):
                await stage.call("job.recover", home=True)
            os.utime(jobs / "job.gcode", ns=(written, written))

            lowest = z_mm

            async def watch() -> None:
                nonlocal lowest
                while True:
                    lowest = min(lowest, true_mm(printer)[2])
                    await asyncio.sleep(0.05)

            watching = asyncio.ensure_future(watch())
            told = await stage.call("job.recover", home=True)
            assert told["state"] == "printing"
            assert true_c(printer) > 190
            assert stage.tree.get("job.interrupted_file") is None
            await stage.until(lambda: bool(stage.tree.get("job.line")), "a line being carried out")
            assert int(str(stage.tree.get("job.line"))) >= line
            await stage.until_job("done", limit_s=2 * LIMIT_S)
            watching.cancel()
            assert lowest > z_mm - 0.01
            last = JOB.strip().split("\n")[-2].split()
            assert stage.planned[:3] == (float(last[1][1:]), float(last[2][1:]), 1.3)
            await stage.until(lambda: true_mm(printer) == pytest.approx(stage.planned[:3], abs=0.02), "rest")
            assert stage.service.machine is not None
            status = stage.service.machine.modules.status()
            assert status["gcode_macro COUNT"] == {"n": 2}
            assert status["fan"]["speed"] == 0.4
            with pytest.raises(ApiError, match="no job was interrupted"):
                await stage.call("job.recover")

    asyncio.run(go_on())
