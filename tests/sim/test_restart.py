"""A machine that begins anew: by command and by method, with its nodes reset or not, with what was saved."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.ipc.protocol.methods import ApiError
from coordinator.modules.programs.save_config import SaveConfig
from coordinator.runtime.module_context import ModuleContext
from coordinator.simulate.scenario import load
from coordinator.simulate.stage import Stage
from tests.stages.served import Served, running

CLEAN = Path("coordinator/simulate/scenarios/clean.toml")


def on_stage(folder: Path, go: Callable[[Served], Awaitable[None]]) -> Stage:
    """Run GO with a service of a machine that is described by a file in FOLDER; return its boards."""
    world = Stage(load(CLEAN), 1)
    config = folder / "printer.cfg"
    config.write_text(Path(world.description.path).read_text())

    async def main() -> None:
        async with running(Served(folder, lambda: load_machine(str(config)), world.host)) as stage:
            await go(stage)

    with asyncio.Runner(loop_factory=world.make_loop) as runner:
        runner.run(main())
    return world


async def run(stage: Served, script: str) -> None:
    await stage.call("gcode.run", script=script)


async def begun_anew(stage: Served, starts: int) -> None:
    await stage.until(lambda: stage.service.starts == starts, "the next start")
    await stage.until_state("ready")


async def counts(stage: Served) -> dict[str, int]:
    told = await stage.call("position.get", ask_nodes=True)
    steps: dict[str, int] = told["nodes_steps"]
    return steps


def live(stage: Served) -> ModuleContext:
    assert stage.service.machine is not None
    (module,) = stage.service.machine.modules.of(SaveConfig)
    assert module._live is not None
    return module._live


def test_restart_ends_the_script_and_leaves_the_nodes_as_they_are(tmp_path: Path) -> None:
    async def go(stage: Served) -> None:
        await run(stage, "G28\nG1 X20 F6000\nRESTART\nG1 X30")
        await begun_anew(stage, 2)
        assert (await counts(stage))["stepper_x"] != 0
        assert stage.tree.get("position.homed") == ""

    on_stage(tmp_path, go)


@pytest.mark.parametrize("by_method", [False, True])
def test_firmware_restart_resets_nodes_that_are_configured_as_they_should_be(
    tmp_path: Path, *, by_method: bool
) -> None:
    async def go(stage: Served) -> None:
        await run(stage, "G28\nG1 X20 F6000")
        assert any((await counts(stage)).values())
        if by_method:
            await stage.call("machine.restart", firmware=True)
        else:
            await run(stage, "FIRMWARE_RESTART")
        await begun_anew(stage, 2)
        assert not any((await counts(stage)).values())
        await run(stage, "G28\nG1 X5 F6000\nRESTART")
        await begun_anew(stage, 3)
        assert (await counts(stage))["stepper_x"] != 0, "a restart after it resets no node"

    on_stage(tmp_path, go)


@pytest.mark.parametrize("paused", [False, True])
def test_a_restart_ends_the_job_that_prints(tmp_path: Path, *, paused: bool) -> None:
    async def go(stage: Served) -> None:
        stage.write_job("G28\n" + "G1 X100 F6000\nG1 X20 F6000\n" * 200)
        await stage.call("job.start", file="job.gcode")
        await stage.until(lambda: stage.tree.get("position.moving") is True, "motion")
        if paused:
            await stage.call("job.pause")
            await stage.until_state("paused")
        with pytest.raises(ApiError, match="a job prints"):
            await run(stage, "M105\nRESTART")
        assert stage.service.active_job is not None
        await run(stage, "FIRMWARE_RESTART")
        await begun_anew(stage, 2)
        assert stage.service.active_job is None
        await run(stage, "G28\nG1 X5 F6000")
        assert (await counts(stage))["stepper_x"] != 0

    on_stage(tmp_path, go)


@pytest.mark.parametrize("command", ["RESTART", "FIRMWARE_RESTART"])
def test_nodes_that_are_shut_down_come_back(tmp_path: Path, command: str) -> None:
    async def go(stage: Served) -> None:
        await stage.call("machine.emergency_stop")
        await stage.until_state("shutdown")
        await stage.until(lambda: len(stage.service.confirmed_s) > 0, "nodes in shutdown")
        for script in (f"{command}\nG28", "G28"):
            with pytest.raises(ApiError, match=r"machine\.restart starts it again"):
                await run(stage, script)
        await run(stage, command)
        await begun_anew(stage, 2)
        await run(stage, "G28\nG1 X5 F6000")
        assert (await counts(stage))["stepper_x"] != 0

    on_stage(tmp_path, go)


def test_nothing_begins_between_the_call_and_the_restart(tmp_path: Path) -> None:
    """What began then was never carried out: its job printed for ever, its caller waited for ever."""

    async def go(stage: Served) -> None:
        job = stage.write_job("G28\nG1 X5 F6000\n")
        for number in range(2, 8):
            await stage.call("machine.restart")
            while stage.service.starts < number:
                for call in (stage.call("job.start", file=job), run(stage, "G28")):
                    with pytest.raises(ApiError) as refused:
                        await call
                    assert refused.value.code == "not_ready"
                await asyncio.sleep(0.003 * number)
            await begun_anew(stage, number)
            assert stage.service.active_job is None
            await asyncio.sleep(0.01 * number)
        await run(stage, "G28")

    on_stage(tmp_path, go)


@pytest.mark.parametrize("after_s", [0.0, 0.2, 0.35, 1.0])
def test_a_stop_after_the_call_is_not_undone_by_the_restart(tmp_path: Path, after_s: float) -> None:
    async def go(stage: Served) -> None:
        await stage.call("machine.restart")
        await asyncio.sleep(after_s)
        await stage.call("machine.emergency_stop")
        await stage.until(lambda: stage.service.starts == 2, "the next start")
        await stage.until_state("shutdown")
        assert "emergency stop by" in stage.service.cause
        await stage.call("machine.restart")
        await begun_anew(stage, 3)
        await stage.call("machine.restart")
        await asyncio.sleep(after_s)
        await stage.call("machine.emergency_stop")
        await stage.until(lambda: stage.service.starts == 4, "the next start")
        await stage.until_state("shutdown")
        await asyncio.sleep(0.1)

    world = on_stage(tmp_path, go)
    assert all(world.node(name).counters()["is_shutdown"] for name in ("mcu", "toolhead"))


def test_a_firmware_restart_may_follow_a_plain_one_that_has_not_begun(tmp_path: Path) -> None:
    async def go(stage: Served) -> None:
        await run(stage, "G28\nG1 X20 F6000")
        for firmware in (False, True, False):
            await stage.call("machine.restart", firmware=firmware)
        await begun_anew(stage, 2)
        assert not any((await counts(stage)).values())

    on_stage(tmp_path, go)


def test_an_error_is_left_by_restart_once_the_file_is_put_right(tmp_path: Path) -> None:
    config = tmp_path / "printer.cfg"

    async def go(stage: Served) -> None:
        good = config.read_text()
        config.write_text(good + "[nonsense]\n")
        await run(stage, "RESTART")
        await stage.until(lambda: str(stage.service.state) == "error", "error")
        assert "there is no section [nonsense]" in stage.service.cause
        config.write_text(good)
        await run(stage, "FIRMWARE_RESTART")
        await stage.until(lambda: stage.service.starts == 3, "error")
        await stage.until_state("ready")

    on_stage(tmp_path, go)


def test_a_job_does_not_begin_anew(tmp_path: Path) -> None:
    async def go(stage: Served) -> None:
        stage.write_job("G28\nG1 X5 F6000\nRESTART\nG1 X6\n")
        await stage.call("job.start", file="job.gcode")
        await stage.until_job("failed")
        message = (await stage.call("job.status"))["message"]
        assert message.startswith("job.gcode:3: a job prints; wait for its end")
        assert stage.service.starts == 1
        stage.write_job("G28\n" + "G1 X50 F600\nG1 X5\n" * 20)
        await stage.call("job.start", file="job.gcode")
        await stage.until(lambda: bool(stage.tree.get("position.moving")), "motion")
        with pytest.raises(ApiError, match="job") as error:
            await stage.call("machine.restart")
        assert error.value.code == "busy"
        await stage.call("job.cancel")
        await stage.until_job("cancelled")

    on_stage(tmp_path, go)


def test_what_was_calibrated_is_saved_and_acts_after_the_restart(tmp_path: Path) -> None:
    config = tmp_path / "printer.cfg"

    async def go(stage: Served) -> None:
        before = config.read_text()
        told = await stage.call("gcode.run", script="SAVE_CONFIG")
        assert told["replies"] == ["nothing to save: nothing was calibrated since the machine started"]
        live(stage).save("printer", "max_velocity", "123")
        assert stage.service.machine is not None
        assert stage.service.machine.modules.status()["configfile"] == {
            "save_config_pending": True,
            "save_config_pending_items": {"printer": {"max_velocity": "123"}},
        }
        await run(stage, "G28\nG1 X20 F6000\nSAVE_CONFIG\nG1 X30")
        await begun_anew(stage, 2)
        assert config.read_text().startswith(before)
        assert any(line.startswith(f"saved into {config}") for line in stage.lines)
        assert stage.service.machine.description.limits.max_velocity == 123
        assert stage.service.machine.modules.status()["configfile"]["save_config_pending"] is False

    on_stage(tmp_path, go)


def test_a_file_that_was_edited_is_not_overwritten(tmp_path: Path) -> None:
    config = tmp_path / "printer.cfg"

    async def go(stage: Served) -> None:
        live(stage).save("printer", "max_velocity", "123")
        edited = config.read_text() + "# edited\n"
        config.write_text(edited)
        with pytest.raises(ApiError, match="has changed since it was read, so nothing was saved"):
            await run(stage, "SAVE_CONFIG")
        assert config.read_text() == edited
        assert stage.service.starts == 1

    on_stage(tmp_path, go)
