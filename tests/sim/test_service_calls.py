"""The machine as a service in virtual time: whatever clients do, every stepper is where the plan says."""

import asyncio
import gc
import weakref
from pathlib import Path

import pytest

from coordinator.ipc.protocol.methods import ApiError
from coordinator.simulate.scenario import NodeSetting
from coordinator.support.toml_values import Range
from tests.stages.demo_machine import SQUARE, DemoMachine
from tests.stages.served import Served, zigzag


def test_lines_and_moves_between_jobs(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path)

    async def go(stage: Served) -> None:
        told = await stage.call("gcode.run", script="G28\nG1 X10 Y10 F6000\nM114")
        assert told["replies"] == ["X:10.000 Y:10.000 Z:0.000 E:0.000"]
        await stage.check_positions()
        moved = await stage.call("move.by", x=5, z=1, speed_mm_s=50)
        assert moved["position"] == {"x": 15.0, "y": 10.0, "z": 1.0, "e": 0.0}
        moved = await stage.call("move.to", y=20, speed_mm_s=50)
        assert moved["position"]["y"] == 20.0
        assert any((await stage.check_positions()).values())
        with pytest.raises(ApiError, match="at most at"):
            await stage.call("move.by", x=1, speed_mm_s=1e5)
        with pytest.raises(ApiError, match="outside") as error:
            await stage.call("move.by", x=-100, speed_mm_s=50)
        assert error.value.code == "bad_move"
        with pytest.raises(ApiError, match="client:2: G5") as error:
            await stage.call("gcode.run", script="G91\nG5 X1")
        assert error.value.code == "bad_gcode"
        # The modes of a client's lines are not those of a job.
        stage.write_job(SQUARE.replace("G90\n", ""))
        await stage.homing_comes()
        await stage.call("job.start", file="job.gcode")
        await stage.until_job("done")
        await stage.check_positions()
        assert stage.planned == (20.0, 30.0, 0.6, 4.0)

    machine.serve(go)


LONG_WAY = "G28\nG1 X150 Y150 F1200\nG1 X10 Y10 F1200\n"
"""Some twenty seconds of one move after another."""


def test_cancel_ends_in_order_and_leaves_the_machine_ready(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path)

    async def go(stage: Served) -> None:
        stage.write_job(zigzag(400, 7))
        await stage.call("job.start", file="job.gcode")
        await stage.until(lambda: bool(stage.tree.get("job.line")), "a line being carried out")
        with pytest.raises(ApiError) as error:
            await stage.call("gcode.run", script="G28")
        assert error.value.code == "busy"
        with pytest.raises(ApiError) as error:
            await stage.call("job.start", file="job.gcode")
        assert error.value.code == "busy"
        told = await stage.call("gcode.run", script="M220 S120\nM114")
        assert told["replies"][0].startswith("X:")
        await stage.call("job.cancel")
        await stage.until_job("cancelled")
        assert str(stage.service.state) == "ready"
        await stage.homing_comes()
        assert stage.tree.get("position.speed_factor") == 1.2
        told = await stage.call("gcode.run", script="G28\nG1 X30 F6000")
        await stage.check_positions()

    machine.serve(go)


def test_cancelled_lines_leave_the_rest_undone(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path)

    async def go(stage: Served) -> None:
        script = "G28\n" + "G1 X150 F1200\nG1 X10 F1200\n" * 20
        running = asyncio.ensure_future(stage.call("gcode.run", script=script))
        await stage.until(lambda: stage.tree.get("position.moving") is True, "motion")
        running.cancel()
        await asyncio.wait((running,))
        assert running.cancelled()
        assert stage.service.motion is not None
        motion = stage.service.motion
        await stage.until(lambda: not motion.feeder.busy and motion.standing, "a standstill")
        await stage.check_positions()

    machine.serve(go)


def test_emergency_stop_and_restart(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path)

    async def go(stage: Served) -> None:
        stage.write_job(LONG_WAY)
        await stage.call("job.start", file="job.gcode")
        await stage.until(lambda: stage.tree.get("position.moving") is True, "motion")
        waiting = asyncio.ensure_future(stage.call("gcode.run", script="M114"))
        told = await stage.call("machine.emergency_stop", who="the tester")
        assert told == {"state": "shutdown", "cause": "emergency stop by 'the tester'"}
        with pytest.raises(ApiError, match="the tester"):
            await waiting
        await stage.until(lambda: len(stage.service.confirmed_s) == 3, "three confirmations")
        assert max(stage.service.confirmed_s.values()) < 0.02
        assert stage.job_state == "stopped"
        assert "the tester" in (await stage.call("job.status"))["message"]
        states = {name: stage.tree.get(f"nodes.{name}.state") for name in ("mcu", "toolhead", "zboard")}
        await stage.until(
            lambda: all(stage.tree.get(f"nodes.{name}.state") == "shutdown" for name in states),
            "shutdown",
        )
        for name in ("gcode.run", "job.start", "job.pause", "position.get"):
            with pytest.raises(ApiError, match="the tester") as error:
                await stage.call(name, **_ENOUGH.get(name, {}))
            assert error.value.code == "stopped"
        await stage.call("machine.restart")
        await stage.until_state("ready")
        await stage.call("gcode.run", script="G28\nG1 X5 F6000")
        assert stage.tree.get("machine.starts") == 2

    machine.serve(go)


def test_the_collector_passes_by_a_machine_while_it_is_there(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path)

    async def go(stage: Served) -> None:
        await stage.until_state("ready")
        assert gc.get_freeze_count() > 0
        assert stage.service.machine is not None
        first = weakref.ref(stage.service.machine)
        await stage.call("machine.emergency_stop", who="the tester")
        await stage.call("machine.restart")
        await stage.until(lambda: stage.tree.get("machine.starts") == 2, "the second start")
        await stage.until_state("ready")
        assert first() is None

    try:
        machine.serve(go, own_process=True)
    finally:
        gc.unfreeze()


_ENOUGH = {"gcode.run": {"script": "M114"}, "job.start": {"file": "job.gcode"}}


def test_a_bad_line_fails_the_job_and_a_missing_node_the_start(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path)

    async def go(stage: Served) -> None:
        stage.write_job("G28\nG1 X10 F6000\nG1 X9999\n")
        await stage.call("job.start", file="job.gcode")
        await stage.until_job("failed")
        assert "job.gcode:3: the move goes to X 9999" in (await stage.call("job.status"))["message"]
        await stage.check_positions()
        assert str(stage.service.state) == "ready"
        machine.node("toolhead").power_off()
        await stage.until_state("shutdown")
        assert "toolhead" in stage.service.cause
        await stage.call("machine.restart")
        await stage.until(lambda: str(stage.service.state) == "error", "error")
        assert "5e1ec7ab1e02" in stage.service.cause
        with pytest.raises(ApiError) as error:
            await stage.call("gcode.run", script="M114")
        assert error.value.code == "not_ready"

    machine.serve(go)


def test_what_front_ends_see(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path, nodes={"toolhead": NodeSetting(ppm=Range(80, 80))})

    async def go(stage: Served) -> None:
        await stage.call("gcode.run", script="G28\nG1 X40 Y20 Z2 E2 F6000")
        told = await stage.call("motion.dump", seconds=10)
        assert told["moves"]["print_time"]
        assert [queue["node"] for queue in told["queues"]] == ["mcu", "toolhead", "zboard"]
        steps: dict[str, int] = {}
        for queue in told["queues"]:
            for stepper, count in zip(queue["stepper"], queue["count"], strict=True):
                steps[stepper] = steps.get(stepper, 0) + count
            assert queue["due_s"] == sorted(queue["due_s"])
        counted = await stage.check_positions()
        assert {name: abs(count) for name, count in counted.items()} == steps

        await asyncio.sleep(60)  # at 20 s exchanges may still be 8 ppm off, whatever the seed
        nodes = (await stage.call("nodes.list"))["nodes"]
        assert [node["name"] for node in nodes] == ["mcu", "toolhead", "zboard"]
        assert all(node["state"] == "ready" and node["mcu"] for node in nodes)
        assert all(sum(node["lead_histogram"]) and node["lead_min_ms"] > 0 for node in nodes)
        assert abs(nodes[1]["clock_drift_ppm"] - 80) < 1
        buses = (await stage.call("buses.list"))["buses"]
        assert len(buses) == 2
        assert buses[0]["bitrate"] == 1_000_000
        assert buses[0]["frames_sent"]
        config = await stage.call("config.get")
        assert config["sections"]["printer"]["kinematics"]
        answer = await stage.call("node.command", node="mcu", command="get_uptime", response="uptime")
        assert answer["response"]["clock"] > 0
        log = await stage.call("log.tail")
        assert any("get_uptime" in line["text"] for line in log["lines"])
        info = await stage.call("machine.info")
        assert info["machine"]["nodes"] == ["mcu", "toolhead", "zboard"]

    machine.serve(go, node_commands=True)


def test_dumps_rest_by_the_clock_of_the_loop(tmp_path: Path) -> None:
    """A dump takes no virtual time; failed before, as the next one waited for the computer's clock."""
    machine = DemoMachine(tmp_path)

    async def go(stage: Served) -> None:
        await stage.call("gcode.run", script="G28\nG1 X40 Y20 Z2 E2 F6000")
        for _ in range(2):
            assert (await stage.call("motion.dump", seconds=10))["moves"]["print_time"]

    machine.serve(go)


def test_motion_is_told_before_it_has_begun(tmp_path: Path) -> None:
    """In the first moments of a start; failed before, as the clocks of the nodes were not mapped yet."""
    machine = DemoMachine(tmp_path)

    async def go(stage: Served) -> None:
        old = stage.service.motion
        await stage.call("machine.restart")
        while (motion := stage.service.motion) is None or motion is old:  # noqa: ASYNC110 (virtual time)
            await asyncio.sleep(0.0005)
        told = await stage.call("motion.dump", seconds=10)
        assert not motion.begun.is_set(), "this is what is tested"
        assert told["moves"]["print_time"] == []

    machine.serve(go)
