"""The machine as a service, on virtual nodes: whatever clients do, every stepper stands where the plan says."""

import asyncio
import random

import pytest

from coordinator.ipc.methods import ApiError
from tests.system.service_stage import served
from tests.system.stage import SQUARE, Hardware


def zigzag(moves: int, seed: int) -> str:
    """Return a job of short moves in all axes, at random, with extrusion; some tenth of a second each."""
    chance = random.Random(seed)
    lines = ["G28", "G90", "M83", "G1 Z1 F900", "G1 X50 Y50 F6000"]
    for _ in range(moves):
        x, y = chance.uniform(20, 80), chance.uniform(20, 80)
        lines.append(f"G1 X{x:.3f} Y{y:.3f} E{chance.uniform(0, 1):.4f} F{chance.randrange(9000, 15000)}")
    return "\n".join(lines) + "\n"


def test_lines_and_moves_between_jobs(machine: Hardware) -> None:
    async def go() -> None:
        async with served(machine) as stage:
            told = await stage.call("gcode.run", script="G28\nG1 X10 Y10 F6000\nM114")
            assert told["replies"] == ["X:10.000 Y:10.000 Z:0.000 E:0.000"]
            await stage.check_positions()
            moved = await stage.call("move.by", x=5, z=1, speed_mm_s=50)
            assert moved["position"] == {"x": 15.0, "y": 10.0, "z": 1.0, "e": 0.0}
            moved = await stage.call("move.to", y=20, speed_mm_s=50)
            assert moved["position"]["y"] == 20.0
            counts = await stage.check_positions()
            assert any(counts.values())
            with pytest.raises(ApiError, match="at most at"):
                await stage.call("move.by", x=1, speed_mm_s=1e5)
            with pytest.raises(ApiError, match="outside") as error:
                await stage.call("move.by", x=-100, speed_mm_s=50)
            assert error.value.code == "bad_move"
            with pytest.raises(ApiError, match="client:2: G2") as error:
                await stage.call("gcode.run", script="G91\nG2 X1")
            assert error.value.code == "bad_gcode"
            # The modes of a client's lines are not those of a job.
            stage.write_job(SQUARE.replace("G90\n", ""))
            await stage.call("job.start", file="job.gcode")
            await stage.until_job("done")
            await stage.check_positions(counts)
            assert stage.service.motion is not None
            assert stage.service.motion.planned.position == (20.0, 30.0, 0.6, 4.0)

    asyncio.run(go())


@pytest.mark.parametrize("seed", range(3))
def test_pause_and_resume_at_random_moments(machine: Hardware, seed: int) -> None:
    chance = random.Random(seed)

    async def go() -> None:
        async with served(machine) as stage:
            job = zigzag(150, seed)
            stage.write_job(job)
            await stage.call("job.start", file="job.gcode")
            standing = 0
            while stage.job_state == "printing" and standing < 3:
                await asyncio.sleep(chance.uniform(0.05, 1.5))
                if stage.job_state != "printing":
                    break
                await stage.call("job.pause")
                if chance.random() < 0.3:  # taken back before it stands
                    await asyncio.sleep(chance.uniform(0, 1))
                else:
                    await stage.until_job("paused", "done")
                    if stage.job_state == "paused":
                        standing += 1
                        assert str(stage.service.state) == "paused"
                        before = await stage.check_positions()
                        await asyncio.sleep(0.3)
                        assert await stage.check_positions() == before
                if stage.job_state != "done":
                    await stage.call("job.resume")
            await stage.until_job("done")
            await stage.check_positions()
            assert standing
            told = await stage.call("job.status")
            assert told["progress"] == 1.0
            last = job.splitlines()[-1].split()
            assert stage.service.motion is not None
            x, y, *_ = stage.service.motion.planned.position
            assert (f"X{x:.3f}", f"Y{y:.3f}") == (last[1], last[2])

    asyncio.run(go())
