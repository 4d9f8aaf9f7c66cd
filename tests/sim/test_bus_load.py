"""A bus near and beyond what it can carry: motion on four boards, sensors before it, bulk behind."""

import asyncio
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import pytest

from coordinator.gcode.program import Program
from coordinator.runtime.machine import Machine, link_of
from coordinator.service.core.job_runner import run_job
from coordinator.service.jobs.outcome import Outcome
from coordinator.simulate import scenario as scenarios
from coordinator.simulate.stage import Stage
from nodes.link import IOStats, LinkError
from nodes.support.errors import CanductorError

SENSORS = 0x104
"""An id that wins against the data of all nodes."""
NOPS = 25
"""In one block, which fills it; nobody answers them."""
BULK_SAMPLES = 50


def zigzag(speed_mm_s: float, segment_mm: float, count: int) -> str:
    """Return moves of all four steppers whose speeds change at every corner: many step commands."""
    lines = ["G28", "G90", "M83", "G92 E0", "G1 X20 Y20 Z1 F3000"]
    for n in range(count):
        x, y = 20 + segment_mm * (n % 3), 20 + segment_mm * ((n + n // 3) % 2)
        lines.append(
            f"G1 X{x:.3f} Y{y:.3f} Z{1 + 0.02 * (n % 2):.3f} E{segment_mm / 20:.4f} F{speed_mm_s * 60:.0f}"
        )
    return "\n".join([*lines, ""])


@dataclass
class Loaded:
    """A print on four boards at 500 kbit/s beside other traffic."""

    folder: Path
    sensors: float
    speed_mm_s: float
    segment_mm: float = 0.6
    count: int = 700
    bulk: bool = False
    samples: list[IOStats] = field(default_factory=list)

    def run(self) -> Outcome:
        text = 'about = "Load."\nmachine = "quad"\n[buses.can0]\nbitrate = 500_000\n'
        text += f"load = {self.sensors}\nload_id = {SENSORS}\n"
        (self.folder / "load.toml").write_text(text)
        self.stage = Stage(scenarios.find(str(self.folder / "load.toml")), 1)
        with asyncio.Runner(loop_factory=self.stage.make_loop) as runner:
            return runner.run(self._main())

    async def _main(self) -> Outcome:
        program = Program(BytesIO(zigzag(self.speed_mm_s, self.segment_mm, self.count).encode()), "load")
        return await run_job(
            self.stage.description,
            program,
            on_output=lambda _: None,
            on_ready=self._ready,
            host=self.stage.host,
        )

    def late_commands(self) -> list[int]:
        """Return how many step commands each node acknowledged after they were due."""
        return [link.stats().lead_histogram[0] for link in self.links]

    def _ready(self, machine: Machine) -> None:
        self.machine = machine
        self.task = asyncio.get_running_loop().create_task(self._burden(machine))

    async def _burden(self, machine: Machine) -> None:
        """Keep bulk commands waiting for every node, and look at the counters."""
        while machine.stopped is None and all(node.talks for node in machine.nodes.values()):
            bulk = self.bulk and len(self.samples) < BULK_SAMPLES  # the job ends when nothing waits any more
            for node in machine.nodes.values() if bulk else ():
                try:
                    while link_of(node).stats().bulk_commands < 8:
                        link_of(node).send(node.dictionary.encode("debug_nop") * NOPS, bulk=True)
                except (LinkError, CanductorError):
                    return
            self.samples.append(machine.bus_stats()["can0"])
            self.links = [link_of(node) for node in machine.nodes.values()]
            await asyncio.sleep(0.1)


def test_motion_is_in_time_on_a_bus_that_is_nearly_full(tmp_path: Path) -> None:
    loaded = Loaded(tmp_path, sensors=0.60, speed_mm_s=45, count=900, bulk=True)
    outcome = loaded.run()
    busy = [s.load for s in loaded.samples[20:BULK_SAMPLES]]
    motion, data, bulk, total = (
        sum(figures) / len(busy)
        for figures in zip(*((b.motion + b.acks, b.data, b.bulk, b.total) for b in busy), strict=True)
    )
    assert motion > 0.2
    assert data > 0.59
    assert bulk > 0.015  # its guaranteed share at least
    assert 0.85 < total < 0.98
    for node in outcome.nodes:
        assert node.link.lead_histogram[0] == 0
        assert node.link.min_lead_s is None or node.link.min_lead_s > 0.1


def test_a_plan_beyond_the_bus_is_refused_before_the_first_late_step(tmp_path: Path) -> None:
    loaded = Loaded(tmp_path, sensors=0.60, speed_mm_s=100)
    with pytest.raises(CanductorError, match=r"cannot carry what is planned: its motion needs 1[0-9]{2}%"):
        loaded.run()
    for late in loaded.late_commands():
        assert late == 0
