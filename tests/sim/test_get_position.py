"""GET_POSITION and position.get on a corexy with its motors on two boards, against the plant's own counts."""

import asyncio
from pathlib import Path

import pytest

from tests.stages.plant_stage import STEP_MM, PlantStage
from tests.stages.served import running


def frames(replies: list[str]) -> dict[str, dict[str, float]]:
    """Return the numbers of GET_POSITION's answer, by frame."""
    found = {}
    for line in replies:
        name, _, numbers = line.partition(": ")
        words = [word.partition(":") for word in numbers.split()]
        found[name] = {key: float(value) for key, _, value in words}
    return found


def test_all_frames_follow_from_what_the_nodes_count(tmp_path: Path) -> None:
    stage = PlantStage(tmp_path)
    nodes = {"stepper_x": "mcu", "stepper_y": "toolhead", "stepper_z": "mcu"}

    def plant_counts() -> dict[str, int]:
        return {name: int(stage.plants[node].page.motors[name].count) for name, node in nodes.items()}

    async def ask() -> dict[str, dict[str, float]]:
        told = await stage.served.call("gcode.run", script="GET_POSITION")
        return frames(told["replies"])

    async def go() -> None:
        async with running(stage.served):
            told = await stage.served.call("gcode.run", script="GET_POSITION")
            assert told["replies"][1:3] == [
                "stepper: unknown; home the machine with G28",
                "kinematic: unknown; home the machine with G28",
            ]
            await stage.served.call("gcode.run", script="G28\nG1 X60 Y200 Z11 F6000")
            before, counted_before = await ask(), plant_counts()
            await stage.served.call(
                "gcode.run", script="SET_GCODE_OFFSET Z=0.25\nG92 X0\nG1 X33.3 Y101.7 Z4 F9000"
            )
            after, counted = await ask(), plant_counts()
            check(before, after, counted_before, counted)
            got = await stage.served.call("position.get", ask_nodes=True)
            assert {name: got["nodes_steps"][name] for name in nodes} == {n: after["mcu"][n] for n in nodes}
            assert got["rails"] == after["stepper"]
            assert got["kinematic"] == {axis.lower(): at for axis, at in after["kinematic"].items()}
            assert got["offset"] == {"x": 0, "y": 0, "z": 0.25, "e": 0}

    def check(
        before: dict[str, dict[str, float]],
        after: dict[str, dict[str, float]],
        counted_before: dict[str, int],
        counted: dict[str, int],
    ) -> None:
        steps = {name: after["mcu"][name] - before["mcu"][name] for name in nodes}
        assert steps == {name: counted[name] - counted_before[name] for name in nodes}
        for axis in "XY":
            at = stage.true_mm(axis.lower())
            assert after["kinematic"][axis] == pytest.approx(at, abs=1.6 * STEP_MM), axis
            assert after["kinematic"][axis] == pytest.approx(after["toolhead"][axis], abs=STEP_MM)
        x, y = after["kinematic"]["X"], after["kinematic"]["Y"]
        motors = after["stepper"]
        assert (motors["stepper_x"], motors["stepper_y"]) == pytest.approx((x + y, x - y), abs=1e-5)
        assert after["toolhead"] == pytest.approx({"X": 93.3, "Y": 101.7, "Z": 4.25, "E": 0})
        assert after["gcode"] == pytest.approx({"X": 33.3, "Y": 101.7, "Z": 4, "E": 0})
        assert after["gcode base"] == pytest.approx({"X": 60, "Y": 0, "Z": 0.25, "E": 0})
        assert after["gcode homing"] == pytest.approx({"X": 0, "Y": 0, "Z": 0.25})

    with asyncio.Runner(loop_factory=stage.stage.make_loop) as runner:
        runner.run(go())


def test_beside_a_job_it_tells_the_frames_of_the_program(tmp_path: Path) -> None:
    stage = PlantStage(tmp_path)

    async def go() -> None:
        async with running(stage.served):
            stage.served.write_job("G28 X Y\nG1 X60 Y200 F6000\nG4 P3000\nG1 X61\n")
            await stage.served.call("job.start", file="job.gcode")
            await stage.served.until(lambda: bool(stage.served.tree.get("position.moving")), "motion")
            told = await stage.served.call("gcode.run", script="GET_POSITION")
            assert [line.partition(":")[0] for line in told["replies"]] == [
                "toolhead",
                "gcode",
                "gcode base",
                "gcode homing",
            ]
            await stage.served.until_job("done")

    with asyncio.Runner(loop_factory=stage.stage.make_loop) as runner:
        runner.run(go())
