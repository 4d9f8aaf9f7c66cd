"""A simulated machine that heats and moves, to which something is done; and what its pins did then.

The real coordinator, links and firmware run a real program in virtual time. What is told of a case comes from
the log of the boards' pins, which none of them can reach, and from the plant.
"""

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from coordinator.gcode.program import Program
from coordinator.runtime.machine import Machine, MachineStopped
from coordinator.service.core.job_runner import run_job
from coordinator.simulate.scenario import Scenario
from coordinator.simulate.stage import Stage
from coordinator.virtual_machine.plant import PlantSettings, machine_plants
from coordinator.virtual_machine.plant_heat import HeatSettings
from nodes.support.errors import CanductorError
from nodes.virtual.plant_page import PlantFault, PlantItemKind

MACHINE: Final = Path(__file__).parent / "machines" / "safety.cfg"
START: Final = (30.0, 230.0, 20.0)
"""Where the head begins, mm: some way from its endstops."""
HEATERS: Final = {"extruder": ("toolhead", "PA3"), "heater_bed": ("mcu", "PA3")}
"""Node and pin."""
WARM_C: Final = {"extruder": 190.0, "heater_bed": 50.0}
STEP_PINS: Final = {"mcu": ("PB0", "PB6"), "toolhead": ("PB3", "PA1")}
LOOK_S: Final = 0.005
"""How often it is looked whether the moment has come, in virtual time."""
AFTER_S: Final = 4.0
"""How long it is watched after the host has taken note."""
PATIENCE_S: Final = 600.0
NS: Final = 1e-9


@dataclass(frozen=True, slots=True)
class HeaterFound:
    """What the log says of one heater's pin."""

    name: str
    was_on: bool
    """Whether its pin was on in the second before the cause: whether there was anything to end."""
    off_after_s: float
    """From the cause to its last falling edge; 0 when that was before."""


@dataclass(frozen=True, slots=True)
class Found:
    """What became of it."""

    heaters: tuple[HeaterFound, ...]
    last_step_after_s: float
    """From the cause to the last step of any motor; 0 when that was before."""
    steps_after: int
    stopped_after_s: float
    """From the cause to when the host had stopped the machine."""
    told: str
    """What the user reads."""


class Rig:
    """The machine, made by SEED; it runs LINES. HURRY: how many times faster all gets hot and cold.

    WARM: the hotend begins near to where the programs heat it.
    """

    def __init__(
        self, lines: tuple[str, ...], *, seed: int = 1, hurry: float = 5.0, warm: bool = True
    ) -> None:
        scenario = Scenario(
            name="safety",
            given="safety",
            about="Something goes wrong.",
            machine=MACHINE,
            expect="stops",
            causes=(),
            weight=0.0,
        )
        self.stage = Stage(scenario, seed)
        settings = PlantSettings(
            seed=seed, start=START, heat=HeatSettings(hurry=hurry, warm_c=WARM_C if warm else {})
        )
        plants = machine_plants(self.stage.description, settings).values()
        self.plants = self.stage.start_plants(plants)
        self.machine: Machine | None = None
        self._told_ns: dict[str, int] = {}
        self._lines = lines
        self._cause_ns = 0

    # ------------------------------------------------------------------------------------------- the case

    def run(self, moment: "Callable[[Rig], bool]", cause: "Callable[[Rig], None]") -> Found:
        """Run the program, do CAUSE as soon as MOMENT is there, and return what became of it."""

        async def main() -> Found:
            running = asyncio.ensure_future(self._run())
            await self.until(running, lambda: moment(self), "the moment comes")
            self._cause_ns = self.stage.now_ns()
            cause(self)
            stopped = await self._stopped()
            stopped_ns = self.stage.now_ns()
            with contextlib.suppress(CanductorError):
                await running
            await asyncio.sleep(AFTER_S)
            return self._found(str(stopped), stopped_ns)

        with asyncio.Runner(loop_factory=self.stage.make_loop) as runner:
            return runner.run(main())

    async def _run(self) -> None:
        def ready(machine: Machine) -> None:
            self.machine = machine

        program = Program.from_lines(self._lines, "safety.gcode")
        await run_job(
            self.stage.description,
            program,
            on_output=lambda told: self._told_ns.update({told.text: self.stage.now_ns()}),
            on_ready=ready,
            host=self.stage.host,
        )

    async def until(self, running: "asyncio.Future[None]", true: Callable[[], bool], what: str) -> None:
        """Wait until TRUE; raises CanductorError when the program ends before that, or never."""
        deadline_s = asyncio.get_running_loop().time() + PATIENCE_S
        while self.machine is None or not true():
            await asyncio.sleep(LOOK_S)
            if running.done():
                running.result()
                raise CanductorError(f"the program has ended before {what}")
            if asyncio.get_running_loop().time() > deadline_s:
                raise CanductorError(f"it took more than {PATIENCE_S:g} s until {what}")

    async def _stopped(self) -> MachineStopped:
        try:
            async with asyncio.timeout(PATIENCE_S):
                return await self._known_machine().wait_stopped()
        except TimeoutError:
            raise CanductorError(f"nobody has stopped the machine within {PATIENCE_S:g} s") from None

    def _known_machine(self) -> Machine:
        assert self.machine is not None
        return self.machine

    # ---------------------------------------------------------------------------------------------- causes

    def fault(self, kind: PlantItemKind, fault: PlantFault, name: str = "extruder") -> None:
        """Break a sensor or a heater."""
        self.plants[HEATERS[name][0]].page.set_fault(kind, name, fault)

    def cut(self, node: str) -> None:
        """Cut a node's wires."""
        self.stage.cut(node)

    def stall(self, seconds: float, *, io: bool = True) -> None:
        """Let the host stand still; IO: also the threads of its links."""
        self.stage.stall(seconds, io=io)

    def stop(self) -> None:
        """Stop as a client's emergency stop does."""
        self._known_machine().stop("emergency stop")

    # ---------------------------------------------------------------------------------------------- truth

    def since_s(self, word: str) -> float:
        """Return how long ago the program said WORD (M118); -1: not yet."""
        told_ns = self._told_ns.get(f"echo: {word}")
        return -1.0 if told_ns is None else (self.stage.now_ns() - told_ns) * NS

    def celsius(self, name: str = "extruder") -> float:
        """Return how hot a heated thing truly is."""
        return self.plants[HEATERS[name][0]].page.temperature(name)

    def steps_of(self, stepper: str, node: str) -> int:
        """Return where a motor stands, in steps from the begin."""
        return int(self.plants[node].page.motors[stepper].count)

    def steps_since(self, since_ns: int) -> list[int]:
        """Return the true times (ns) of all motors' steps after SINCE_NS."""
        found: list[int] = []
        for node, names in STEP_PINS.items():
            truth, numbers = self.stage.board(node), self.stage.pins(node)
            pins = [numbers[name] for name in names]
            chosen = (truth.level == 1) & (truth.at_ns > since_ns) & np.isin(truth.pin, pins)
            found += truth.at_ns[chosen].tolist()
        return found

    def _found(self, told: str, stopped_ns: int) -> Found:
        steps = self.steps_since(self._cause_ns)
        return Found(
            heaters=tuple(self._heater(name) for name in HEATERS),
            last_step_after_s=(max(steps) - self._cause_ns) * NS if steps else 0.0,
            steps_after=len(steps),
            stopped_after_s=(stopped_ns - self._cause_ns) * NS,
            told=told,
        )

    def _heater(self, name: str) -> HeaterFound:
        node, pin = HEATERS[name]
        truth, number = self.stage.board(node), self.stage.pins(node)[pin]
        chosen = truth.pin == number
        times, levels = truth.at_ns[chosen], truth.level[chosen]
        before = times <= self._cause_ns
        is_on = bool(before.any()) and bool(levels[before][-1])
        recent = bool((times[before] > self._cause_ns - 1e9).any())
        if not len(times):
            return HeaterFound(name, was_on=False, off_after_s=0.0)
        off_s = (int(times[-1]) - self._cause_ns) * NS if not levels[-1] else float("inf")
        return HeaterFound(name, was_on=is_on or recent, off_after_s=max(0.0, off_s))
