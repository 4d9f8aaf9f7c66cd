"""Two coordinators in processes of their own, found on the loopback, seen to stop and to go."""

import asyncio
import json
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from coordinator.ipc.discovery import Browser
from tests.stages.own_networks import need_own_networks
from tests.system.stage import CANDUCTOR, ROOT, Command, Hardware, canductor

if TYPE_CHECKING:
    from coordinator.ipc.announcement import Announcement

LIMIT_S = 90.0
REAL, DEMO = f"real_{os.getpid()}", f"demo_{os.getpid()}"
"""Others may test on this loopback at the same time."""
TOKEN = "a-token-for-tests-that-is-long-enough"  # noqa: S105 (of this test)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        assert isinstance(port, int)
        return port


def secrets_of(folder: Path) -> tuple[Path, Path]:
    """Return the file of tokens for the server, and that of one for a client."""
    tokens, token = folder / "tokens", folder / "token"
    tokens.write_text(f"operate me {TOKEN}\n", encoding="utf-8")
    token.write_text(TOKEN, encoding="utf-8")
    tokens.chmod(0o600)
    token.chmod(0o600)
    return tokens, token


def found_by_command(*names: str) -> Mapping[str, Any]:
    """Return what ``canductor discover`` tells, by name, once it tells of all NAMES and their TCP ports."""
    until_s = time.monotonic() + LIMIT_S
    while time.monotonic() < until_s:  # a busy machine may answer late
        ended = canductor("discover", "--json")  # others' questions put answers off for a second or two
        assert ended.status == 0, ended.stderr
        machines = {each["name"]: each for each in ended.json["machines"]}
        if all(len(machines.get(name, {"at": ()})["at"]) == 2 for name in names):
            return machines
    raise AssertionError(f"{names} were not found, but {machines}")


def test_two_coordinators(machine: Hardware, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    tokens, token = secrets_of(tmp_path)

    def words(name: str, *config: str | Path) -> tuple[str | Path, ...]:
        at = f"127.0.0.1:{free_port()}"
        return (
            *config,
            "--name",
            name,
            "--tcp",
            at,
            "--tokens",
            tokens,
            "--no-tls-on-loopback",
            "--announce",
        )

    async def go(real: Command, demo: Command) -> None:
        seen: dict[str, Announcement] = {}

        async def until(browser: Browser, states: Mapping[str, str | None]) -> None:
            while True:
                seen.clear()
                seen.update({each.name: each for each in browser.machines if each.name in states})
                told = {name: seen[name].state if name in seen else None for name in states}
                if told == states:
                    return
                await browser.change()

        async with asyncio.timeout(LIMIT_S), Browser() as browser:
            await until(browser, {REAL: "ready", DEMO: "ready"})
            machines = await asyncio.to_thread(found_by_command, REAL, DEMO)
            for name in (REAL, DEMO):
                assert (machines[name]["state"], machines[name]["here"]) == ("ready", True)
                assert machines[name]["at"] == [f"{tmp_path}/canductor/{name}.sock", *seen[name].at]
            at = machines[REAL]["at"][1]
            ended = await asyncio.to_thread(canductor, "estop", "--at", at, "--token-file", token)
            assert ended.status == 0, ended.stderr
            await until(browser, {REAL: "shutdown", DEMO: "ready"})
            demo.signal(signal.SIGTERM)
            await until(browser, {REAL: "shutdown", DEMO: None})
            real.signal(signal.SIGKILL)
            await until(browser, {REAL: None, DEMO: None})

    with (
        Command("run", *words(REAL, machine.config)) as real,
        Command("demo", *words(DEMO, "--serve")) as demo,
    ):
        asyncio.run(go(real, demo))
        assert demo.end().status == 0
        real.end()
    left = tmp_path / "canductor" / f"{REAL}.sock"
    assert str(left) in json.loads(canductor("discover", "--timeout", "1", "--json").stdout)["silent_sockets"]


def test_a_port_for_others_is_announced_without_being_asked(machine: Hardware, tmp_path: Path) -> None:
    if (openssl := shutil.which("openssl")) is None:
        pytest.skip("openssl is not installed, which makes the certificate for this test")
    need_own_networks()
    pem, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    how = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj /CN=x"
    subprocess.run([openssl, *how.split(), "-out", pem, "-keyout", key], check=True, capture_output=True)
    tokens, _ = secrets_of(tmp_path)
    words: list[str | Path] = [
        *CANDUCTOR,
        "run",
        machine.config,
        "--ipc",
        tmp_path / "s",
        "--tcp",
        "0.0.0.0:7125",
    ]
    words += ["--tokens", tokens, "--tls-certificate", pem, "--tls-key", key]
    command = subprocess.Popen(["unshare", "-rn", *words], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert command.stdout is not None
        said = next((line for line in command.stdout if "to announce" in line), "")
    finally:
        command.terminate()
        command.communicate(timeout=LIMIT_S)
    assert said == "there is no network to announce the machine on; it will be when there is\n"
    assert command.returncode == 0
