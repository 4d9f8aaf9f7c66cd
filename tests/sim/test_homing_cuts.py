"""Stopped and cancelled between homing and the moves behind it: no step comes late, no place gets lost.

What the service believes about the head is compared with the plant, which counts the motors' steps.
"""

import asyncio
import functools
from pathlib import Path

import pytest

from coordinator.ipc.protocol.methods import ApiError
from tests.stages.plant_stage import STEP_MM, PlantStage
from tests.stages.safety_rig import Rig
from tests.stages.served import running

LINES = ("G28 X Y", "M118 homed", "G1 X60 Y200 F6000", "G1 X20", "M118 read", "G4 P5000")


@functools.cache
def homed_ns() -> int:
    """Return the true time at which a program learns that homing is over."""
    seen_ns = 0

    def over(rig: Rig) -> bool:
        nonlocal seen_ns
        seen_ns = rig.stage.now_ns()
        return rig.since_s("homed") >= 0

    Rig(LINES).run(over, Rig.stop)
    return seen_ns


@pytest.mark.parametrize("offset_s", [0.0, 0.2])
def test_after_an_emergency_stop_there_is_no_step(offset_s: float) -> None:
    """The offset is that from the end of homing; the first move begins a quarter of a second later."""
    at_ns = homed_ns() + round(offset_s * 1e9)
    found = Rig(LINES).run(lambda rig: rig.stage.now_ns() >= at_ns, Rig.stop)
    assert found.last_step_after_s < 0.001
    assert found.told == "emergency stop"


@pytest.mark.parametrize("after_s", [-0.02, 0.0, 0.3])
def test_after_a_cancel_the_place_is_known_or_said_to_be_unknown(tmp_path: Path, after_s: float) -> None:
    """At a time from the end of homing; before that the homing itself is ended."""
    machine = PlantStage(tmp_path)
    served = machine.served

    async def cut() -> None:
        """Cancel the job; its homing takes as long as that of a program that began as the job did."""
        await served.call("job.start", file="job.gcode")
        if after_s < 0:
            await served.until(lambda: machine.second_approach, "the second approach of Y")
            await asyncio.sleep(-after_s)
        else:
            await served.until(lambda: "echo: homed" in served.lines, "the end of homing")
            await asyncio.sleep(after_s)
        await served.call("job.cancel")
        await served.until_job("cancelled")

    async def go() -> None:
        async with running(served):
            served.write_job("\n".join((*LINES, *LINES)))
            await cut()
            machine.check_place()
            try:
                await served.call("gcode.run", script="G1 X50 Y210 F6000")
                assert after_s >= 0
            except ApiError as error:
                assert "before it is homed" in str(error)  # noqa: PT017  either is right
            machine.check_place()
            await served.call("gcode.run", script="G28 X Y\nG1 X40 Y220 F6000")
            machine.check_place()
            assert machine.true_mm("x") == pytest.approx(40, abs=1.6 * STEP_MM)
            assert machine.true_mm("y") == pytest.approx(220, abs=1.6 * STEP_MM)

    with asyncio.Runner(loop_factory=machine.stage.make_loop) as runner:
        runner.run(go())
