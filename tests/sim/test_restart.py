"""A machine that begins anew: by command and by method, with its nodes reset or not, with what was saved."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.ipc.protocol.methods import ApiError
from coordinator.modules.programs.save_config import SaveConfig
from coordinator.runtime.module_context import ModuleContext
from coordinator.simulate.scenario import NodeSetting, load
from coordinator.simulate.stage import Stage
from coordinator.support.toml_values import Range
from coordinator.virtual_machine.plant import PlantSettings
from nodes.support.can_protocol import BUS_STOP_ID
from tests.stages.machine_stage import MachineStage
from tests.stages.served import Served, running

CLEAN = Path("coordinator/simulate/scenarios/clean.toml")
HEATED = Path("coordinator/simulate/machines/heated.cfg")
HEATER, FAN, LAMP, ENABLE = "PA3", "PA8", "PA9", "PA2"
"""Pins of its toolhead."""
BOOTED_S = 3.5


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


@pytest.mark.parametrize("section", ["stepper_z", "printer"])
def test_values_that_no_start_accepts_are_not_saved(tmp_path: Path, section: str) -> None:
    """They were: the machine was in error after every start until somebody edited the file."""
    config = tmp_path / "printer.cfg"
    option = {"stepper_z": "position_endstop", "printer": "max_velocity"}[section]

    async def go(stage: Served) -> None:
        before = config.read_bytes()
        live(stage).save(section, option, "-1000")
        for _ in range(2):
            with pytest.raises(ApiError, match=f"nothing was saved, .*{option}.*drop .* with RESTART"):
                await run(stage, "SAVE_CONFIG")
            assert config.read_bytes() == before
        assert str(stage.service.state) == "ready"
        assert stage.service.starts == 1
        await run(stage, "RESTART")
        await begun_anew(stage, 2)
        assert config.read_bytes() == before

    on_stage(tmp_path, go)


def test_a_mistake_in_an_included_file_is_not_blamed_on_what_was_calibrated(tmp_path: Path) -> None:
    config, part = tmp_path / "printer.cfg", tmp_path / "part.cfg"

    async def go(stage: Served) -> None:
        config.write_text(config.read_text() + "[include part.cfg]\n")
        part.write_text("[printer]\nmax_velocity: 100\n")
        await run(stage, "RESTART")
        await begun_anew(stage, 2)
        before = config.read_bytes()
        live(stage).save("printer", "max_accel", "123")
        part.write_text("[printer]\nmax_velocity: fast\n")
        with pytest.raises(ApiError, match=r"nothing was saved, .*part\.cfg:2: .*max_velocity"):
            await run(stage, "SAVE_CONFIG")
        assert config.read_bytes() == before
        part.write_text("[printer]\nmax_velocity: 100\n")
        await run(stage, "SAVE_CONFIG")
        await begun_anew(stage, 3)
        assert stage.service.machine is not None
        assert stage.service.machine.description.limits.max_accel == 123

    on_stage(tmp_path, go)


# ------------------------------------------------------------------------------ what nodes keep, and do not


def heated(folder: Path, changes: str, nodes: Mapping[str, NodeSetting] | None = None) -> MachineStage:
    """Return a machine with a heater that has the options CHANGES, described by a file in FOLDER."""
    config = folder / "printer.cfg"
    config.write_text(HEATED.read_text().replace("min_temp: 0", f"{changes}\nmin_temp: 0"))
    return MachineStage(config, nodes=nodes, plant=PlantSettings())


def serve(machine: MachineStage, folder: Path, go: Callable[[Served], Awaitable[None]]) -> None:
    """Run GO while a service of MACHINE runs, which reads its configuration again at every start."""

    async def main() -> None:
        await asyncio.sleep(BOOTED_S)
        async with running(Served(folder, lambda: load_machine(str(machine.config)), machine.host)) as stage:
            await go(stage)

    machine.run(main)


@pytest.mark.parametrize("max_duration_s", [1.5, 2.4, 5.0])
def test_outputs_of_nodes_that_keep_their_configuration_begin_again(
    tmp_path: Path, max_duration_s: float
) -> None:
    """The heater's node shut down, as nobody renewed its power; fan, lamp and motor remained as they were."""
    machine = heated(tmp_path, f"enable_pin: !toolhead:{ENABLE}\nmax_duration: {max_duration_s}")

    async def go(stage: Served) -> None:
        await run(stage, "G28\nM83\nG1 X20 E1 F6000\nM104 S210\nM106 S255\nSET_PIN PIN=lamp VALUE=0")
        await asyncio.sleep(2.0)
        assert machine.edges(LAMP, "toolhead")[-1][1] == machine.edges(ENABLE, "toolhead")[-1][1] == 0
        assert machine.edges(HEATER, "toolhead")[-1][1] == machine.edges(FAN, "toolhead")[-1][1] == 1
        await run(stage, "RESTART")
        await begun_anew(stage, 2)
        await asyncio.sleep(0.3)
        assert machine.edges(HEATER, "toolhead")[-1][1] == 0
        assert machine.edges(FAN, "toolhead")[-1][1] == 0
        assert machine.edges(ENABLE, "toolhead")[-1][1] == 1, "its motor is off"
        assert machine.edges(LAMP, "toolhead")[-1][1] == 1, "as at first"
        await asyncio.sleep(2 * max_duration_s)
        assert str(stage.service.state) == "ready"
        assert (await counts(stage))["stepper_x"] != 0, "no node was reset"

    serve(machine, tmp_path, go)


def test_a_node_that_shuts_down_while_others_still_start(tmp_path: Path) -> None:
    """It was ready already: the same start resets all nodes, as it does for one that was not."""
    slow = NodeSetting(config_reset="unknown", boot_s=Range(BOOTED_S, BOOTED_S))
    stranger = NodeSetting(uuid="aaaaaaaaaaaa", bus="can0")
    machine = heated(tmp_path, "", {"mcu": slow, "stranger": stranger})

    async def go(stage: Served) -> None:
        machine.config.write_text(machine.config.read_text() + "[output_pin other]\npin: PF7\n")
        stops_bus = machine.node("stranger").controller
        assert stops_bus is not None
        machine.at(3.0, lambda: stops_bus.send(BUS_STOP_ID, bytes(6)))
        await run(stage, "RESTART")
        await begun_anew(stage, 2)
        assert any("reset and started again" in line for line in stage.lines), stage.lines

    serve(machine, tmp_path, go)


@pytest.mark.parametrize(
    "broken",
    [
        "tests.sim.test_restart.load_machine",
        "coordinator.modules.module_set.ModuleSet.connect",
        "coordinator.service.core.motion.Planner",
    ],
)
def test_a_bug_that_a_start_meets_ends_the_start_and_not_the_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    """The process ended, and with it its clients: the configuration said `max_velocity: 0.0005`."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    machine = heated(tmp_path, "")
    causes: list[str] = []

    def fail(*_: object) -> None:
        raise ValueError("of a\nbug")

    async def go(stage: Served) -> None:
        await run(stage, "M104 S210\nG4 P2000")
        assert machine.edges(HEATER, "toolhead")[-1][1] == 1
        with monkeypatch.context() as patched:
            patched.setattr(broken, fail)
            await stage.call("machine.restart")
            await stage.until(lambda: str(stage.service.state) == "error", "error")
        causes.append(stage.service.cause)
        await asyncio.sleep(1.0)
        assert machine.edges(HEATER, "toolhead")[-1][1] == 0
        await stage.call("machine.restart")
        await stage.until(lambda: stage.service.starts == 3, "error")
        await stage.until_state("ready")

    serve(machine, tmp_path, go)
    (log,) = tmp_path.glob("canductor-*.log")
    assert causes == [f"internal error: ValueError: of a bug; please report it with {log}"]
    assert "Traceback" in log.read_text()


@pytest.mark.parametrize(
    ("script", "sentence"),
    [
        ("M109 S200", "waits, such as M109 .* cancel that call"),
        ("G28\nG1 X50 F60", "the machine moves; .*, or"),
    ],
)
def test_a_restart_that_is_refused_says_what_it_waits_for(tmp_path: Path, script: str, sentence: str) -> None:
    """It asked to cancel a job when there was none, and said that a machine that stood moves."""

    async def go(stage: Served) -> None:
        motion = stage.service.motion
        assert motion is not None
        waiting = asyncio.ensure_future(run(stage, script))
        stands = script.startswith("M109")
        await stage.until(lambda: motion.feeder.busy if stands else not motion.standing, "the script")
        with pytest.raises(ApiError, match=sentence) as error:
            await stage.call("machine.restart")
        assert error.value.code == "busy"
        assert "job" not in error.value.sentence
        await stage.call("machine.emergency_stop")
        await asyncio.gather(waiting, return_exceptions=True)
        await stage.call("machine.restart")
        await begun_anew(stage, 2)

    serve(heated(tmp_path, ""), tmp_path, go)
