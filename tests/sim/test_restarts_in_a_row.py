"""Plain restarts, again and again, from whatever the machine does: each one succeeds at the first try."""

import asyncio
import random
from pathlib import Path
from typing import Final

import pytest
from hypothesis import given, settings
from hypothesis.strategies import integers

from coordinator.assembly.load import load_machine
from coordinator.simulate.scenario import load
from coordinator.simulate.stage import Stage
from tests.profiles import examples
from tests.sim.restarts import search
from tests.stages.served import Served, running

SCENARIOS: Final = Path("coordinator/simulate/scenarios")
RESTARTS: Final = 12
SILENT_S: Final = 1.3
"""A node that does not acknowledge is lost after a second."""
JOB: Final = "G28\n" + "G1 X100 F6000\nG1 X20 F6000\n" * 500


async def act(stage: Served, chance: random.Random) -> None:
    """Print for a while, or rest; then stop, and wait for the nodes to report that, or for less, or go on."""
    if chance.random() < 0.75:
        await stage.call("job.start", file="job.gcode")
        await asyncio.sleep(chance.choice((0.0, 0.01, 0.3, 1.0, chance.uniform(0.0, 8.0))))
    printing = stage.service.active_job is not None
    if printing or chance.random() < 0.5:
        await stage.call("machine.emergency_stop")
        await stage.until_state("shutdown")
        await asyncio.sleep(chance.choice((0.0, 0.001, 0.05, 0.5, 2.0)))


@pytest.mark.parametrize(
    ("scenario", "seed"),
    [("clean", 1), ("corexy_mixed", 2), ("legacy_mixed", 3), ("loss_5_percent", 4), ("uart_noise", 5)],
)
def test_each_restart_succeeds_at_the_first_try(tmp_path: Path, scenario: str, seed: int) -> None:
    world = Stage(load(SCENARIOS / f"{scenario}.toml"), seed)
    config = tmp_path / "printer.cfg"
    config.write_text(Path(world.description.path).read_text())
    chance = random.Random(seed)

    async def main() -> None:
        async with running(Served(tmp_path, lambda: load_machine(str(config)), world.host)) as stage:
            stage.write_job(JOB)
            for number in range(1, RESTARTS + 1):
                await act(stage, chance)
                await stage.call("machine.restart")
                await stage.until(lambda: stage.service.starts == number + 1, "the next start")  # noqa: B023
                await stage.until_state("ready")

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        runner.run(main())


@pytest.mark.parametrize("node", ["mcu", "toolhead", "zboard"])
@pytest.mark.parametrize("kind", ["cut", "stall"])
@pytest.mark.parametrize("at_s", [0.0, 0.32, 0.4, 0.6, 1.0])
def test_a_node_that_is_silent_for_a_moment_in_the_start(
    tmp_path: Path, node: str, kind: str, at_s: float
) -> None:
    """It is lost, whatever the start is at, but the same start brings it back."""
    world = Stage(load(SCENARIOS / "corexy_mixed.toml"), 1)

    async def main() -> None:
        async with running(Served(tmp_path, lambda: world.description, world.host)) as stage:
            world.faults.add(kind, node=node, at_s=at_s, for_s=SILENT_S)
            await stage.call("machine.restart")
            await stage.until(lambda: stage.service.starts == 2, "the next start")
            await stage.until(lambda: str(stage.service.state) != "startup", "its end")
            assert str(stage.service.state) == "ready", stage.lines

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        runner.run(main())


@pytest.mark.timeout(1800)  # of all seeds of profile ``full`` together
@given(seed=integers(1, 2**32 - 1))  # 0, which would be the first, takes as long as 50 others
@settings(max_examples=examples(4))
def test_the_first_plain_restart_is_enough_when_all_is_sound_again(seed: int) -> None:
    """Whatever went wrong before it, also in other starts."""
    found = search(seed)
    assert found.ok, "\n".join([f"python -m tests.sim.restarts {seed}:{seed + 1}", *found.log])
