"""``canductor run --ipc`` and ``canductor demo --serve``, with clients on their sockets."""

import asyncio
import http.client
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from coordinator.ipc.client.blocking import BlockingClient
from coordinator.ipc.discovery.browser import Browser
from tests.stages.processes import (
    LONG,
    MCU_UUID,
    SLOW,
    TOOLHEAD_UUID,
    Command,
    Hardware,
    canductor,
    own_port,
    write_gcode,
)

LIMIT_S = 60.0
PIPE_BYTES = 1 << 16


def until(client: BlockingClient, path: str, value: object) -> dict[str, Any]:
    """Watch the state until PATH has VALUE; return all that was seen of it."""
    seen: dict[str, Any] = {}
    updates = client.watch(["machine.*", "job.*", "nodes.*.state", "position.moving"], rate_hz=20)
    for update in updates:
        seen.update(update.values)
        if seen.get(path) == value:
            break
        assert "failed" not in (seen["job.state"], seen["machine.state"]), seen
        assert value != "done" or seen["job.state"] != "stopped", seen
    updates.close()
    assert seen.get(path) == value
    return seen


@contextmanager
def served(*words: str | Path, path: Path) -> Iterator[tuple[Command, BlockingClient]]:
    """Serve by a command, with a client."""
    with Command(*words, "--ipc", path) as command:
        command.stdout.wait_for("ready")
        with BlockingClient(str(path)) as client:
            yield command, client


def as_planned(client: BlockingClient) -> None:
    told = client.call("position.get", {"ask_nodes": True})
    assert told["nodes_steps"] == {n: s["steps_sent"] for n, s in told["steppers"].items()}


def test_a_machine_is_served(machine: Hardware, tmp_path: Path) -> None:
    """By a client, by the commands of the command line, by the CAN tools, and to Prometheus."""
    path, jobs = Path(os.environ["XDG_RUNTIME_DIR"]) / "canductor" / "mine.sock", tmp_path / "jobs"
    path.parent.mkdir(mode=0o700)
    jobs.mkdir()
    part = write_gcode(tmp_path, SLOW)
    words = ("run", machine.config, "--jobs", jobs, "--metrics", f"127.0.0.1:{own_port(0)}")
    with served(*words, path=path) as (command, client):
        assert "ready" in canductor("status", "--at", path).stdout
        sent = canductor("send", part, "--at", path)
        assert sent.status == 0, sent
        until(client, "job.state", "done")
        as_planned(client)
        files = Path(f"/proc/{command.process.pid}/maps").read_text()
        assert "numpy" not in files, "10 MB that a machine which prints has no use for"
        # Asked on the bus, the nodes are told apart by what their host knows.
        found = canductor("can", "nodes", "-i", "canductor", "-c", machine.folder / "bus", "--json")
        nodes = {node["uuid"]: node["state"] for node in json.loads(found.stdout.splitlines()[-1])["nodes"]}
        assert nodes == {MCU_UUID: "in use", TOOLHEAD_UUID: "in use"}
        assert command.stdout.word_after("metrics are at ") == f"http://127.0.0.1:{own_port(0)}/metrics"
        scraped = http.client.HTTPConnection("127.0.0.1", own_port(0), timeout=LIMIT_S)
        scraped.request("GET", "/metrics")
        assert b'canductor_machine_state{state="ready"} 1.0' in scraped.getresponse().read()
        scraped.close()
        command.signal(signal.SIGTERM)
        ended = command.end()
    assert (ended.status, ended.stderr) == (0, "")
    assert not path.exists()


def test_an_output_that_nobody_reads_holds_nothing(machine: Hardware, tmp_path: Path) -> None:
    """As where Ctrl-S was pressed in its terminal: it held the control loop, and so the heaters, for ever."""
    path = tmp_path / "run.sock"
    words = (sys.executable, "-m", "coordinator.cli.main", "run", machine.config, "--ipc", path)
    with subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        while process.stdout.readline() != b"ready\n":
            assert process.poll() is None
        with BlockingClient(str(path), timeout_s=LIMIT_S) as client:
            for _ in range(PIPE_BYTES // 500):
                client.call("gcode.run", {"script": f"M118 {'x' * 1000}"})
            assert (
                client.call("state.get", {"fields": ["machine.state"]})["values"]["machine.state"] == "ready"
            )
        process.send_signal(signal.SIGTERM)
        assert process.wait(LIMIT_S) == 0


def test_emergency_stop_and_restart(machine: Hardware, tmp_path: Path) -> None:
    path, jobs = tmp_path / "run.sock", tmp_path / "jobs"
    jobs.mkdir()
    (jobs / "long.gcode").write_text(LONG)
    (jobs / "slow.gcode").write_text(SLOW)
    with served("run", machine.config, "--jobs", jobs, path=path) as (command, client):
        client.call("job.start", {"file": "long.gcode"})
        until(client, "position.moving", True)
        assert canductor("estop", "--at", path).status == 0
        seen = until(client, "machine.state", "shutdown")
        assert seen["job.state"] == "stopped"
        for name in ("mcu", "toolhead", "zboard"):
            until(client, f"nodes.{name}.state", "shutdown")
        client.call("machine.restart")
        until(client, "machine.state", "ready")
        client.call("job.start", {"file": "slow.gcode"})
        until(client, "job.state", "done")
        as_planned(client)
        # A motion that SIGTERM cuts off is no orderly end.
        client.call("job.start", {"file": "long.gcode"})
        until(client, "position.moving", True)
        command.signal(signal.SIGTERM)
        ended = command.end()
    assert ended.sentence(143) == "stopped by SIGTERM"


def test_a_demo_is_served_announced_and_seen_to_go(tmp_path: Path) -> None:
    name, path = f"demo_{os.getpid()}", tmp_path / "demo.sock"
    tokens = tmp_path / "tokens"
    tokens.touch(0o600)
    link, log = tmp_path / "printer", tmp_path / "canductor.log"
    words = ("demo", "--serve", "--name", name, "--announce", "--pty", link, "--log-file", log)
    tcp = ("--tcp", f"127.0.0.1:{own_port(1)}", "--tokens", tokens, "--no-tls-on-loopback")

    async def announced(state: str | None) -> None:
        """Wait until the demo is announced with STATE; None: not at all."""
        async with asyncio.timeout(LIMIT_S), Browser() as browser:
            while state != next((each.state for each in browser.machines if each.name == name), None):
                await browser.change()

    with served(*words, *tcp, path=path) as (command, client):
        assert client.call("job.list")["files"][0]["name"] == "part.gcode"
        asyncio.run(announced("ready"))
        port = os.open(link, os.O_RDWR | os.O_NOCTTY)
        os.write(port, b"N0 M110 N0*125\nN1 M115*39\n")
        assert "\nok FIRMWARE_NAME:canductor " in until_ok(port)
        os.close(port)
        client.call("machine.emergency_stop", {"who": "a test"})
        asyncio.run(announced("shutdown"))
        command.signal(signal.SIGINT)
        command.end()
    asyncio.run(announced(None))
    assert not link.is_symlink()
    assert "shutdown: emergency stop by 'a test'" in log.read_text(encoding="utf-8")


def until_ok(port: int) -> str:
    """Return what a serial host gets from PORT, up to the answer of its second line."""
    data = b""
    while data.count(b"ok") < 2 or not data.endswith(b"\n"):
        data += os.read(port, 1000)
    return data.decode().rstrip()
