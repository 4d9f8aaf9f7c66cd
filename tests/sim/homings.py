"""How well homing repeats: homes again and again on a lossy bus, each seed with clocks of its own.

``python -m tests.sim.homings --seeds 0:50`` prints what the homings found and the spread of all;
with ``--real`` in real time, on virtual nodes that are processes.
The machine is a corexy with its motors on two boards and the endstop of one axis on each; where the endstops
are, and when they switch, is the plant's, which knows nothing of the host.
"""

import argparse
import asyncio
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from coordinator.assembly.load import load_machine
from coordinator.config.model import MachineDescription, RailDescription
from coordinator.modules.module_set import build_modules
from coordinator.runtime.host import Host
from coordinator.runtime.linux_host import LinuxHost
from coordinator.runtime.machine import Machine
from coordinator.runtime.moves.homing import CYCLE_S, HomingMove
from coordinator.runtime.moves.single import Ramp, SingleMove, ratio_of
from coordinator.simulate.scenario import BusSetting, Scenario
from coordinator.simulate.stage import Stage
from coordinator.support.toml_values import Dice, Range
from coordinator.virtual_machine.plant import AXES, PlantSettings, machine_plants
from nodes.support.errors import CanductorError
from nodes.virtual.plant_page import PlantPage
from tests.stages.real_nodes import CONFIG, real_nodes

MACHINE: Final = Path(__file__).parents[1] / "stages" / "machines" / "homing.cfg"
START: Final = (9.0, 238.0, 30.0)
"""Where the head begins, mm: near its endstops."""
LOSS: Final = 0.01
ACCEL: Final = 3000.0
BACK_MM: Final = (3.0, 9.0)
"""How far it goes back from an endstop; by chance, as its speed is, so that no homing is like another."""
SPEED: Final = (0.4, 1.2)
"""Of the speeds in the configuration."""
SETTLED_S: Final = 0.1


@dataclass(frozen=True, slots=True)
class Homing:
    """One homing, and what the plant knows about it."""

    seed: int
    axis: str
    error_mm: float
    """How far from where the endstop truly is the host believes it to be."""
    beyond_mm: float
    """How far the axis went on behind it."""


def home_repeatedly(seed: int, *, times: int, loss: float = LOSS) -> list[Homing]:
    """Home X and Y so often on a machine that SEED makes; raises CanductorError when a homing fails."""
    scenario = Scenario(
        name="homings",
        given="homings",
        about="Homing again and again.",
        machine=MACHINE,
        expect="completes",
        causes=(),
        weight=0.0,
        buses={"can0": BusSetting(loss=Range(loss, loss))},
    )
    stage = Stage(scenario, seed)
    described = machine_plants(stage.description, PlantSettings(seed=seed + 1, start=START))
    plants = stage.start_plants(described.values())
    performance = _Performance(stage.description, stage.host, lambda node: plants[node].page, seed)
    with asyncio.Runner(loop_factory=stage.make_loop) as runner:
        return runner.run(performance.run(times))


def home_for_real(seed: int, *, times: int, loss: float = LOSS) -> list[Homing]:
    """Do the same in real time, on processes."""
    settings = PlantSettings(seed=seed + 1, start=START)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with real_nodes(MACHINE, folder, settings, loss=loss, seed=seed) as pages:
            described = load_machine(str(folder / CONFIG))
            performance = _Performance(described, LinuxHost(), pages.__getitem__, seed)
            return asyncio.run(performance.run(times))


class _Performance:
    """One seed."""

    def __init__(
        self, described: MachineDescription, host: Host, page: Callable[[str], PlantPage], seed: int
    ) -> None:
        self._described = described
        self._host = host
        self._page = page
        plants = machine_plants(described, PlantSettings(start=START)).values()
        self._axes = {axis.name: axis for plant in plants for axis in plant.axes}
        self._seed = seed
        self._dice = Dice("homings", seed).stream("homings")

    async def run(self, times: int) -> list[Homing]:
        """Home X and Y in turn."""
        machine = Machine(
            self._described, self._host, build_modules(self._described), on_notice=lambda _: None
        )
        await machine.start()
        try:
            return [await self._home(machine, rail) for _ in range(times) for rail in self._described.stops]
        except CanductorError as error:
            raise machine.stopped or error from None  # the cause before what came of it
        finally:
            await machine.close()

    async def _home(self, machine: Machine, rail: RailDescription) -> Homing:
        direction = 1 if rail.homing.positive_dir else -1
        begun_mm = self._place(rail)
        move = HomingMove(
            machine,
            [rail],
            axis=rail.axis,
            direction=direction,
            way_mm=40.0,
            speed=rail.homing.speed * self._dice.uniform(*SPEED),
            accel=ACCEL,
        )
        (result,) = await move.run()
        assert rail.homing.position_endstop is not None
        found_mm = begun_mm + direction * result.way_to_trigger_mm
        await self._go_back(machine, rail, -direction)
        return Homing(
            self._seed,
            rail.axis,
            direction * (found_mm - rail.homing.position_endstop),
            result.beyond_trigger_mm,
        )

    async def _go_back(self, machine: Machine, rail: RailDescription, direction: int) -> None:
        ramp = Ramp(self._dice.uniform(*BACK_MM), rail.homing.speed, ACCEL)
        move = SingleMove(machine, ramp, ratio_of(rail.axis, direction))
        while move.print_time_now() < move.end_s + SETTLED_S:
            move.stream()
            await asyncio.sleep(CYCLE_S)

    def _place(self, rail: RailDescription) -> float:
        """Return where the axis truly is, by the steps that its drivers were given."""
        axis = self._axes[rail.axis]
        counts = {node.name: self._page(node.name).motors for node in self._described.nodes}
        return START[AXES.index(rail.axis)] + sum(
            term.mm_per_step * counts[term.node][term.stepper].count for term in axis.terms
        )


def spread_mm(homings: Sequence[Homing], axis: str) -> float:
    """Return how far apart the places lie where AXIS was found."""
    found = [homing.error_mm for homing in homings if homing.axis == axis]
    return max(found) - min(found)


def report(homings: Sequence[Homing]) -> str:
    """Return a table: what was found of each axis."""
    lines = ["axis  homings  seeds  error mean / least / most  spread       beyond the endstop, most"]
    for axis in sorted({homing.axis for homing in homings}):
        own = [homing for homing in homings if homing.axis == axis]
        errors_um = np.array([homing.error_mm for homing in own]) * 1000
        seeds = len({homing.seed for homing in own})
        beyond_um = max(homing.beyond_mm for homing in own) * 1000
        lines.append(
            f"{axis:4}  {len(own):7}  {seeds:5}  "
            f"{errors_um.mean():+6.2f} / {errors_um.min():+5.2f} / {errors_um.max():+5.2f} µm  "
            f"{spread_mm(own, axis) * 1000:6.2f} µm  {beyond_um:8.1f} µm"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str]) -> int:
    """Run the command line; status 0: all axes repeat within one microstep."""
    parser = argparse.ArgumentParser(prog="python -m tests.sim.homings", description=__doc__)
    parser.add_argument("--seeds", default="0:50", help="FIRST:BEHIND; each has clocks of its own")
    parser.add_argument("--times", type=int, default=1, help="homings of each axis with each seed")
    parser.add_argument("--loss", type=float, default=LOSS, help="share of frames that get lost")
    parser.add_argument("--real", action="store_true", help="in real time, on processes")
    given = parser.parse_args(arguments)
    home = home_for_real if given.real else home_repeatedly
    first, _, behind = given.seeds.partition(":")
    homings: list[Homing] = []
    failed = False
    for seed in range(int(first), int(behind or int(first) + 1)):
        try:
            homings += home(seed, times=given.times, loss=given.loss)
        except CanductorError as error:
            sys.stderr.write(f"seed {seed}: {error}\n")
            failed = True
    sys.stdout.write(f"{report(homings)}\n")
    return int(failed or any(spread_mm(homings, axis) > MICROSTEP_MM for axis in {h.axis for h in homings}))


MICROSTEP_MM: Final = 40 / 200 / 16
"""Of the machine's motors."""


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
