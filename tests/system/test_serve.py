"""``canductor run --ipc`` as a process of its own, virtual nodes, and real clients over the Unix socket."""

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from coordinator.ipc.client import Client
from coordinator.ipc.methods import ApiError
from coordinator.service.journal import NAME
from tests.stages.processes import (
    CANDUCTOR,
    DEMO_CFG,
    MCU_UUID,
    ROOT,
    SQUARE,
    TOOLHEAD_UUID,
    Command,
    Hardware,
    canductor,
    write_gcode,
)
from tests.stages.served import zigzag

LIMIT_S = 60.0


def with_client(machine: Hardware, go: Callable[[Client, Command], Coroutine[Any, Any, None]]) -> int:
    """Serve MACHINE, and run GO with a client; return the command's exit status."""
    jobs = machine.folder / "jobs"
    jobs.mkdir()
    (jobs / "square.gcode").write_text(SQUARE, encoding="utf-8")
    (jobs / "zigzag.gcode").write_text(zigzag(150, 1), encoding="utf-8")
    path = machine.folder / "run.sock"
    with Command("run", machine.config, "--ipc", path, "--jobs", jobs) as command:
        command.stdout.wait_for("ready")

        async def main() -> None:
            async with asyncio.timeout(LIMIT_S), Client.connect(str(path)) as client:
                await go(client, command)

        asyncio.run(main())
        command.signal(signal.SIGTERM)
        ended = command.end()
        assert "Traceback" not in ended.stderr, ended.stderr
        assert not path.exists()
        return ended.status


async def until(client: Client, path: str, *values: object) -> dict[str, Any]:
    """Watch the state until PATH has one of VALUES; return all that was seen of it."""
    seen: dict[str, Any] = {}
    async for update in client.watch(["machine.*", "job.*", "nodes.*.state", "position.moving"], rate_hz=20):
        seen.update(update.values)
        if seen.get(path) in values:
            return seen
    raise AssertionError(f"the watch ended before {path} was one of {values}")


def test_a_job_from_start_to_end(machine: Hardware) -> None:
    async def go(client: Client, _: Command) -> None:
        assert [f["name"] for f in (await client.call("job.list"))["files"]] == [
            "square.gcode",
            "zigzag.gcode",
        ]
        started = await client.call("job.start", {"file": "square.gcode"})
        assert started["state"] == "printing"
        seen = await until(client, "job.state", "done")
        assert seen["machine.state"] in ("printing", "ready")
        told = await client.call("position.get", {"ask_nodes": True})
        assert told["commanded"] == {"x": 20.0, "y": 30.0, "z": 0.6, "e": 4.0}
        assert told["nodes_steps"] == {n: s["steps_sent"] for n, s in told["steppers"].items()}

    assert with_client(machine, go) == 0


def test_pause_and_a_client_killed_meanwhile(machine: Hardware) -> None:
    async def go(client: Client, _: Command) -> None:
        await client.call("job.start", {"file": "zigzag.gcode"})
        watcher = await asyncio.create_subprocess_exec(
            sys.executable, "-c", _WATCHER, str(client.address), cwd=ROOT, stdout=subprocess.PIPE
        )
        assert watcher.stdout is not None
        assert await watcher.stdout.readline() == b"seen\n"
        watcher.kill()
        await watcher.wait()
        await until(client, "position.moving", True)  # before its first move it stands: paused at once
        assert (await client.call("job.pause"))["state"] == "pausing"
        seen = await until(client, "job.state", "paused")
        assert seen["machine.state"] == "paused"
        stood = await client.call("position.get", {"ask_nodes": True})
        assert (await client.call("position.get", {"ask_nodes": True}))["nodes_steps"] == stood["nodes_steps"]
        moved = await client.call("move.by", {"x": 1, "z": 1})
        assert moved["position"]["x"] == pytest.approx(stood["planned"]["x"] + 1)
        assert (await client.call("job.status"))["state"] == "paused"
        await client.call("job.resume")
        await until(client, "job.state", "printing")
        await client.call("job.cancel")
        await until(client, "job.state", "cancelled")
        assert (await client.call("machine.state"))["state"] == "ready"
        told = await client.call("position.get", {"ask_nodes": True})
        assert told["nodes_steps"] == {n: s["steps_sent"] for n, s in told["steppers"].items()}

    assert with_client(machine, go) == 0


_WATCHER = """
import asyncio, sys
from coordinator.ipc.client import Client
async def main():
    async with Client.connect(sys.argv[1]) as client:
        asked = asyncio.ensure_future(client.call("gcode.run", {"script": "M114"}))
        async for update in client.watch(["*"], rate_hz=50):
            print("seen", flush=True)
asyncio.run(main())
"""


def test_emergency_stop_while_it_prints_then_restart(machine: Hardware) -> None:
    async def go(client: Client, command: Command) -> None:
        await client.call("job.start", {"file": "zigzag.gcode"})
        async for update in client.watch(["position.moving"], rate_hz=20):
            if update.values.get("position.moving"):
                break
        told = await client.call("machine.emergency_stop", {"who": "a test"})
        assert told == {"state": "shutdown", "cause": "emergency stop by 'a test'"}
        seen = await until(client, "nodes.zboard.state", "shutdown")
        assert seen["job.state"] == "stopped"
        nodes = (await client.call("nodes.list"))["nodes"]
        assert {node["state"] for node in nodes} == {"shutdown"}
        with pytest.raises(ApiError, match="a test") as error:
            await client.call("job.start", {"file": "square.gcode"})
        assert error.value.code == "stopped"
        await client.call("machine.restart")
        await until(client, "machine.state", "ready")
        await client.call("job.start", {"file": "square.gcode"})
        await until(client, "job.state", "done")
        command.stdout.wait_for("emergency stop by 'a test'")

    assert with_client(machine, go) == 0


def test_the_demo_is_served_without_hardware(tmp_path: Path) -> None:
    path = tmp_path / "demo.sock"
    with Command("demo", "--serve", "--ipc", path) as command:
        command.stdout.wait_for("ready")

        async def main() -> None:
            async with asyncio.timeout(LIMIT_S), Client.connect(str(path)) as client:
                assert (await client.call("job.list"))["files"][0]["name"] == "part.gcode"
                await client.call("gcode.run", {"script": "G28\nG1 X5 F6000"})
                told = await client.call("position.get", {"ask_nodes": True})
                assert told["nodes_steps"] == {n: s["steps_sent"] for n, s in told["steppers"].items()}
                await client.call("job.start", {"file": "part.gcode"})
                await until(client, "machine.state", "printing")

        asyncio.run(main())
        command.signal(signal.SIGINT)
        command.end()
    assert not list((ROOT / "config").rglob(NAME)), "its journal is where it ran, not beside the program"


def test_a_served_demo_prints_from_the_folder_of_its_machine(tmp_path: Path) -> None:
    path = tmp_path / "demo.sock"
    (tmp_path / "jobs").mkdir()
    (tmp_path / "jobs" / "own.gcode").write_text(SQUARE, encoding="utf-8")
    machine = tmp_path / "machine.cfg"
    machine.write_text(DEMO_CFG + "\n[virtual_sdcard]\npath: jobs\n", encoding="utf-8")
    with Command("demo", "--serve", "--machine", machine, "--ipc", path) as command:
        command.stdout.wait_for("ready")

        async def main() -> None:
            async with asyncio.timeout(LIMIT_S), Client.connect(str(path)) as client:
                assert [file["name"] for file in (await client.call("job.list"))["files"]] == ["own.gcode"]

        asyncio.run(main())
        command.signal(signal.SIGINT)
        assert command.end().status == 0


def test_the_command_line_drives_a_machine_that_runs(machine: Hardware, tmp_path: Path) -> None:
    part = tmp_path / "sent.gcode"
    part.write_text(SQUARE, encoding="utf-8")

    async def go(client: Client, _: Command) -> None:
        def run(*words: str | Path) -> str:
            ended = canductor(*words, "--at", str(client.address))
            assert ended.status == 0, ended.stderr
            return ended.stdout

        say = asyncio.to_thread
        assert "ready" in await say(run, "status")
        await say(run, "send", part)
        await until(client, "job.state", "done")
        assert "x=20" in (await say(run, "call", "position.get")).replace(": ", "=").replace('"', "")
        await say(run, "estop")
        await until(client, "machine.state", "shutdown")

    assert with_client(machine, go) == 0


def test_the_can_tools_ask_the_coordinator_what_its_nodes_are(
    machine: Hardware, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(machine.folder))
    monkeypatch.setenv("XDG_CACHE_HOME", str(machine.folder / "empty"))  # nothing to guess by
    sockets = machine.folder / "canductor"
    sockets.mkdir(mode=0o700)
    with socket.socket(socket.AF_UNIX) as nobody:
        nobody.bind(str(sockets / "left-behind.sock"))  # and nobody listens
    with Command("run", machine.config, "--ipc", sockets / "mine.sock") as command:
        command.stdout.wait_for("ready")
        words = ("can", "nodes", "-i", "canductor", "-c", machine.folder / "bus", "--json")
        ended = canductor(*words)
        assert ended.status == 0, ended.stderr
        found = {node["uuid"]: node for node in json.loads(ended.stdout.splitlines()[-1])["nodes"]}
        assert found.keys() == {MCU_UUID, TOOLHEAD_UUID}
        for uuid, mcu in ((MCU_UUID, "virtual-mainboard"), (TOOLHEAD_UUID, "virtual-toolhead")):
            node = found[uuid]
            assert (node["state"], node["told_by_host"], node["guessed"]) == ("in use", True, False)
            assert (node["firmware"]["mcu"], node["configured"], node["shut_down"]) == (mcu, True, False)
        command.signal(signal.SIGTERM)
        assert command.end().status == 0


def test_a_motion_that_is_cut_off_stops_the_nodes(machine: Hardware) -> None:
    async def go(client: Client, _: Command) -> None:
        await client.call("job.start", {"file": "zigzag.gcode"})
        async for update in client.watch(["position.moving"], rate_hz=20):
            if update.values.get("position.moving"):
                break

    assert with_client(machine, go) == 143
    assert all(counters["is_shutdown"] for counters in machine.stop())


def test_a_file_or_front_ends_but_not_both(tmp_path: Path, machine: Hardware) -> None:
    job = write_gcode(tmp_path, SQUARE)
    ended = canductor("run", machine.config, "--gcode", job, "--ipc", tmp_path / "sock")
    assert "leave it out" in ended.sentence(2)
    ended = canductor("run", machine.config, "--tcp", "127.0.0.1:7125")
    assert "--tokens" in ended.sentence(2)
    ended = canductor("run", machine.config, "--ipc", tmp_path / "sock", "--jobs", tmp_path / "none")
    assert "must be a folder" in ended.sentence(2)


def test_at_a_terminal_lines_may_be_typed(
    tmp_path: Path, machine: Hardware, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    ours, theirs = os.openpty()
    with subprocess.Popen(
        [*CANDUCTOR, "run", str(machine.config), "--name", "typed"],
        cwd=ROOT,
        stdin=theirs,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as command:
        os.close(theirs)
        assert command.stdout is not None
        assert (tmp_path / "canductor" / "typed.sock").name in command.stdout.readline()
        for line in command.stdout:
            if line == "ready\n":
                os.write(ours, b"G28\nG1 X12 F6000\nG1 X9999\nM114\n")
            if line.startswith("X:"):
                break
            assert "Traceback" not in line
        assert line == "X:12.000 Y:0.000 Z:0.000 E:0.000\n"
        command.send_signal(signal.SIGTERM)
        said, failed = command.communicate(timeout=LIMIT_S)
        assert "served at" in said or command.returncode == 143, (said, failed)
        os.close(ours)
