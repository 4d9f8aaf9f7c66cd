"""An interface that goes down in the middle of a print ends it in a sentence, and the next print works."""

import asyncio
import errno
from pathlib import Path

import pytest

from coordinator.gcode.program import Program
from coordinator.service.core.job_runner import run_job
from coordinator.service.jobs.outcome import Outcome
from coordinator.simulate.scenario import Scenario
from coordinator.simulate.stage import Stage
from coordinator.support.progress import Progress
from nodes.support.errors import CanductorError

GCODE = "G28\nM83\nG1 X10 Y5 F1800\nG1 X30 Y25 E1.5 F1800\nG1 X12 Y40 E1 F1800\n"
MACHINE = Path(__file__).parents[2] / "coordinator" / "simulate" / "machines" / "pair.cfg"


def print_on(stage: Stage, cut_at_s: float | None = None) -> Outcome:
    """Print GCODE; from CUT_AT_S of print time on, the interface is down."""
    (port,) = stage.host._ports.values()

    def see(progress: Progress) -> None:
        if cut_at_s is not None and progress.print_time_s > cut_at_s:
            port.fail(errno.ENETDOWN)

    with (
        Program.from_lines(GCODE.splitlines(keepends=True)) as program,
        asyncio.Runner(loop_factory=stage.make_loop) as runner,
    ):
        job = run_job(stage.description, program, see, on_output=lambda _: None, host=stage.host)
        return runner.run(job)


def test_a_print_whose_interface_goes_down() -> None:
    scenario = Scenario(
        name="adapter gone",
        given="adapter gone",
        about="The interface is set down in the middle of a print.",
        machine=MACHINE,
        expect="stops",
        causes=(),
        weight=0.0,
        nodes={},
    )
    stage = Stage(scenario, 3)
    with pytest.raises(CanductorError, match=r"can0: the connection ended \(Network is down\)") as caught:
        print_on(stage, cut_at_s=0.5)
    assert "\n" not in str(caught.value)
    assert "set it up with 'ip link set can0 up'" in str(caught.value)
    outcome = print_on(stage)
    assert outcome.positions == outcome.issued
    assert outcome.print_time_s > 2
