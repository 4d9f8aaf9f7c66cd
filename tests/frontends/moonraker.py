"""Drives an unmodified Moonraker over HTTP, which drives `canductor demo --serve --klippy-api`.

`python -m tests.frontends.moonraker MOONRAKER` (the program, of a virtual environment of its own) prints one
line per step and ends with status 0 when all went as a user expects.
"""

import argparse
import asyncio
import contextlib
import http.client
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.parse
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import aiohttp

from coordinator.support.examples import DEMO_MACHINE

START_S: Final = 60.0
STEP_S: Final = 60.0
LOOK_S: Final = 0.1
STOP_S: Final = 20.0
LOG_LINES: Final = 60
"""Of each program's log, after a failure."""
SECTIONS: Final = """
[virtual_sdcard]
path: {gcodes}
[pause_resume]
[display_status]
[respond]
[exclude_object]
[gcode_macro PAUSE]
rename_existing: BASE_PAUSE
gcode:
    BASE_PAUSE
[gcode_macro RESUME]
rename_existing: BASE_RESUME
gcode:
    BASE_RESUME
[gcode_macro CANCEL_PRINT]
rename_existing: BASE_CANCEL_PRINT
gcode:
    BASE_CANCEL_PRINT
"""
MOONRAKER: Final = """
[server]
host: 127.0.0.1
port: {port}
klippy_uds_address: {socket}
[machine]
provider: none
validate_service: False
validate_config: False
[authorization]
trusted_clients:
    127.0.0.1
cors_domains:
    *
[file_manager]
enable_object_processing: False
[history]
[octoprint_compat]
"""
JOB: Final = "G28\nG90\nM83\nG1 Z1 F600\n" + "".join(
    f"G1 X{20 + 20 * (n % 2)} Y{20 + n % 40} E0.05 F1800\n" for n in range(400)
)


class Failed(Exception):  # noqa: N818 (a step did not go as it should)
    """What a user would complain about."""


class Moonraker:
    """Its HTTP interface at PORT."""

    def __init__(self, port: int) -> None:
        self.port = port

    def ask(self, path: str, *, post: bool = False, body: bytes = b"", kind: str = "", **values: str) -> Any:
        """Return ``result``; raises Failed with what Moonraker says."""
        where = path + ("?" + urllib.parse.urlencode(values) if values else "")
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=STEP_S)
        with contextlib.closing(connection):
            headers = {"Content-Type": kind} if kind else {}
            connection.request("POST" if post or body else "GET", where, body or None, headers)
            answer = connection.getresponse()
            text = answer.read().decode()
        if answer.status >= http.client.BAD_REQUEST:
            raise Failed(f"{where}: {answer.status}: {text[:300]}")
        found = json.loads(text)
        return found.get("result", found)

    def upload(self, name: str, text: str) -> None:
        """Upload a job, into the folder that NAME begins with."""
        folder, _, file = name.rpartition("/")
        border = "canductor"
        parts = [
            f'--{border}\r\nContent-Disposition: form-data; name="path"\r\n\r\n{folder}\r\n',
            f'--{border}\r\nContent-Disposition: form-data; name="file"; filename="{file}"\r\n',
            f"Content-Type: application/octet-stream\r\n\r\n{text}\r\n--{border}--\r\n",
        ]
        kind = f"multipart/form-data; boundary={border}"
        self.ask("/server/files/upload", body="".join(parts).encode(), kind=kind)

    def query(self, *names: str) -> dict[str, Any]:
        """Return objects by name."""
        found = self.ask("/printer/objects/query?" + "&".join(map(urllib.parse.quote, names)))
        return dict(found["status"])

    def objects(self) -> list[str]:
        """Return the names of all objects."""
        return list(self.ask("/printer/objects/list")["objects"])

    def script(self, *lines: str) -> None:
        """Have lines done."""
        self.ask("/printer/gcode/script", post=True, script="\n".join(lines))

    def print_state(self) -> str:
        """Return how the job is."""
        return str(self.query("print_stats")["print_stats"]["state"])

    def state(self) -> str:
        """Return how Moonraker says that the machine is; raises Failed and OSError while nothing answers."""
        return str(self.ask("/server/info")["klippy_state"])


def until(true: Callable[[], bool], what: str, limit_s: float = STEP_S) -> None:
    """Wait until TRUE, which also may fail for a while, as a host restarts; raises Failed."""
    end_s = time.monotonic() + limit_s
    while True:
        why = ""
        try:
            if true():
                return
        except (Failed, OSError) as failure:
            why = f": {failure}"
        if time.monotonic() > end_s:
            raise Failed(f"{what} did not come within {limit_s:g} s{why}")
        time.sleep(LOOK_S)


def history(api: Moonraker) -> list[tuple[str, str]]:
    """Return the jobs that Moonraker knows and how they ended, by name."""
    jobs = api.ask("/server/history/list")["jobs"]
    return sorted((job["filename"], job["status"]) for job in jobs)


HISTORY: Final = [("short.gcode", "completed"), ("sub/part.gcode", "cancelled")]


def drive(api: Moonraker, gcodes: Path) -> Iterator[str]:
    """Do what users do; yield what was seen to work. Raises Failed."""
    until(lambda: api.state() == "ready", "ready", START_S)
    server = api.ask("/server/info")
    _check(server["klippy_connected"] and server["klippy_state"] == "ready", "Moonraker is ready", server)
    _check(not server["failed_components"], "no component failed", server["failed_components"])
    _check(not server["warnings"], "no warnings", server["warnings"])
    yield "connected, ready, no warnings"
    objects = api.objects()
    status = api.query(*objects)
    _check(set(status) == set(objects), "all objects", set(objects) ^ set(status))
    yield f"{len(objects)} objects"
    yield asyncio.run(watch(api.port))
    api.script("G28", "M400")
    _check(api.query("toolhead")["toolhead"]["homed_axes"] == "xyz", "homed", api.query("toolhead"))
    api.script("M105")
    store = [line["message"] for line in api.ask("/server/gcode_store")["gcode_store"]]
    _check(any(line.startswith("B:") for line in store), "M105 is shown as it is", store)
    yield "homed, and M105 is shown"
    api.upload("sub/part.gcode", JOB)
    _check((gcodes / "sub" / "part.gcode").read_text() == JOB, "uploaded", "another text")
    api.ask("/printer/print/start", post=True, filename="sub/part.gcode")
    until(lambda: api.query("print_stats")["print_stats"]["print_duration"] > 1.0, "printing")
    api.ask("/printer/print/pause", post=True)
    until(lambda: api.print_state() == "paused", "paused")
    api.ask("/printer/print/resume", post=True)
    until(lambda: api.print_state() == "printing", "printing again")
    api.ask("/printer/print/cancel", post=True)
    until(lambda: api.print_state() == "cancelled", "cancelled")
    yield "uploaded into a folder, printed, paused, resumed, cancelled"
    api.upload("short.gcode", "\n".join(JOB.splitlines()[:12]) + "\n")
    api.ask("/printer/print/start", post=True, filename="short.gcode")
    until(lambda: api.print_state() == "complete", "complete")
    until(lambda: history(api) == HISTORY, "the history")
    yield "printed to the end; the history has both"
    for path in ("/printer/restart", "/printer/firmware_restart"):
        api.ask(path, post=True)
        until(lambda: api.state() != "ready", "a restart")
        until(lambda: api.state() == "ready", "ready again")
        _check(api.print_state() == "standby", "standby after a restart", api.print_state())
    yield "both restarts"
    began_s = time.monotonic()
    api.ask("/printer/emergency_stop", post=True)
    took_ms = (time.monotonic() - began_s) * 1e3
    until(lambda: api.state() == "shutdown", "shutdown")
    yield f"emergency stop, answered after {took_ms:.0f} ms: {api.ask('/printer/info')['state_message']!r}"
    api.ask("/printer/firmware_restart", post=True)
    until(lambda: api.state() == "ready", "ready after the stop")
    yield "ready again"


async def watch(port: int) -> str:
    """Do over the websocket what a browser does; return what was seen to work. Raises Failed."""
    async with (
        asyncio.timeout(STEP_S),
        aiohttp.ClientSession() as session,
        session.ws_connect(f"http://127.0.0.1:{port}/websocket") as line,
    ):
        ids = itertools.count(1)
        heard: list[tuple[str, Any]] = []

        async def ask(method: str, **params: Any) -> Any:
            number = next(ids)
            await line.send_json({"jsonrpc": "2.0", "id": number, "method": method, "params": params})
            while (message := await line.receive_json()).get("id") != number:
                heard.append((message["method"], message.get("params")))
            if "error" in message:
                raise Failed(f"{method}: {message['error']}")
            return message["result"]

        objects = (await ask("printer.objects.list"))["objects"]
        shown = (await ask("printer.objects.subscribe", objects=dict.fromkeys(objects)))["status"]
        _check(set(shown) == set(objects), "all objects are shown", set(objects) ^ set(shown))
        helped = await ask("printer.gcode.help")
        _check("G28" in helped or "PAUSE" in helped, "help", helped)
        for script in ("SET_VELOCITY_LIMIT ACCEL=1234", "M115", "SET_VELOCITY_LIMIT ACCEL=3000"):
            await ask("printer.gcode.script", script=script)
        accelerations: list[float] = []
        while 3000 not in accelerations[1:] and len(heard) < 1000:
            message = await line.receive_json()
            heard.append((message["method"], message.get("params")))
            updates = [params[0] for method, params in heard if method == "notify_status_update"]
            accelerations = [
                u["toolhead"]["max_accel"] for u in updates if "max_accel" in u.get("toolhead", {})
            ]
            accelerations = [shown["toolhead"]["max_accel"], *accelerations]
        replies = [params[0] for method, params in heard if method == "notify_gcode_response"]
        _check(any(text.startswith("FIRMWARE_NAME:") for text in replies), "M115 is shown", replies)
    return f"websocket: {len(shown)} objects, {len(replies)} replies, updates"


def _check(true: object, what: str, found: object) -> None:
    if not true:
        raise Failed(f"{what}: {found}")


def last_lines(log: Path) -> str:
    """Return the end of LOG, without Moonraker's lines about requests."""
    lines = [line for line in log.read_text(errors="replace").splitlines() if "log_request" not in line]
    return "\n".join(lines[-LOG_LINES:])


def free_port() -> int:
    """Return a port of this computer that nothing serves."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


@contextlib.contextmanager
def running(words: list[str], log: Path, environment: Mapping[str, str]) -> Iterator[None]:
    """Run a program, its output in LOG, until the block ends."""
    with log.open("wb") as out:
        process = subprocess.Popen(
            words, stdin=subprocess.DEVNULL, stdout=out, stderr=out, env={**os.environ, **environment}
        )
    try:
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def main() -> int:
    """Run all; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("moonraker", help="the program")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="canductor-frontends-") as name:
        folder = Path(name)
        data, gcodes = folder / "data", folder / "data" / "gcodes"
        for part in ("config", "gcodes", "comms", "logs"):
            (data / part).mkdir(parents=True)
        config = data / "config" / "printer.cfg"
        config.write_text(DEMO_MACHINE.read_text() + SECTIONS.format(gcodes=gcodes))
        path, port = data / "comms" / "klippy.sock", free_port()
        (data / "config" / "moonraker.conf").write_text(MOONRAKER.format(port=port, socket=path))
        host = [sys.executable, "-c", "from coordinator.cli.main import main; raise SystemExit(main())"]
        serve = [
            *host,
            "demo",
            "--machine",
            str(config),
            "--serve",
            "--klippy-api",
            str(path),
            "--ipc",
            str(folder / "ipc"),
        ]
        with (
            running(serve, folder / "canductor.log", {}),
            running([given.moonraker, "-d", str(data)], folder / "moonraker.log", {}),
        ):
            try:
                for step in drive(Moonraker(port), gcodes):
                    sys.stdout.write(f"ok: {step}\n")
                    sys.stdout.flush()
            except Failed as failure:
                sys.stdout.write(f"FAILED: {failure}\n")
                for log in (folder / "canductor.log", folder / "moonraker.log"):
                    sys.stdout.write(f"--- {log.name}\n{last_lines(log)}\n")
                return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
