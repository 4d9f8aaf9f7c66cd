"""Drives an unmodified OctoPrint over HTTP, which prints on `canductor demo --serve --pty` line by line.

`python -m tests.frontends.octoprint OCTOPRINT` (the program, of a virtual environment of its own) prints one
line per step and ends with status 0 when all went as a user expects.
"""

import argparse
import contextlib
import http.client
import json
import secrets
import socket
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from coordinator.ipc.client.blocking import BlockingClient
from coordinator.support.examples import DEMO_MACHINE
from tests.frontends.moonraker import Failed, running, until

START_S: Final = 180.0
"""OctoPrint reads all its plugins first."""
STEP_S: Final = 120.0
LOG_LINES: Final = 60
CONFIG: Final = """\
accessControl:
  salt: {salt}
api:
  key: {key}
server:
  firstRun: false
  onlineCheck:
    enabled: false
  pluginBlacklist:
    enabled: false
serial:
  additionalPorts:
  - {link}
  autoconnect: false
  log: true
webcam:
  webcamEnabled: false
plugins:
  _disabled:
  - announcements
  - discovery
  - errortracking
  - softwareupdate
  - tracking
"""
MOVES: Final = 400
JOB: Final = "G28\nG90\nM83\nG1 Z1 F600\n" + "".join(
    f"G1 X{20 + 20 * (n % 2)} Y{20 + n % 40} E0.05 F6000 ; a comment\n" for n in range(MOVES)
)
LONG: Final = "G1 X20 F600\nG1 X200\n" * 20


class OctoPrint:
    """Its HTTP interface at PORT, with the access key KEY."""

    def __init__(self, port: int, key: str) -> None:
        self._port = port
        self._key = key

    def ask(self, path: str, body: bytes | None = None, kind: str = "application/json") -> Any:
        """Return the answer, of a POST when there is a BODY; raises Failed with what OctoPrint says."""
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=STEP_S)
        with contextlib.closing(connection):
            headers = {"X-Api-Key": self._key, "Content-Type": kind}
            connection.request("GET" if body is None else "POST", path, body, headers)
            answer = connection.getresponse()
            text = answer.read().decode()
        if answer.status >= http.client.BAD_REQUEST:
            raise Failed(f"{path}: {answer.status}: {text[:300]}")
        return json.loads(text) if text else {}

    def do(self, path: str, **values: object) -> None:
        """Send a command."""
        self.ask(path, json.dumps(values).encode())

    def print_file(self, name: str, text: str) -> None:
        """Upload a job and print it."""
        border = "canductor"
        parts = [
            f'--{border}\r\nContent-Disposition: form-data; name="print"\r\n\r\ntrue\r\n',
            f'--{border}\r\nContent-Disposition: form-data; name="file"; filename="{name}"\r\n',
            f"Content-Type: application/octet-stream\r\n\r\n{text}\r\n--{border}--\r\n",
        ]
        kind = f"multipart/form-data; boundary={border}"
        self.ask("/api/files/local", "".join(parts).encode(), kind)

    def state(self) -> str:
        """Return the state of the connection; empty while nothing answers."""
        try:
            return str(self.ask("/api/connection")["current"]["state"])
        except (Failed, OSError, http.client.HTTPException):
            return ""

    def is_printed(self) -> bool:
        """Return whether the job is done; raises Failed when it has ended otherwise."""
        state = self.state()
        if state not in ("Operational", "Printing", "Starting", "Finishing", "Printing from SD"):
            raise Failed(f"OctoPrint is {state}")
        return state == "Operational" and self.ask("/api/job")["progress"]["completion"] == 100.0


def drive(api: OctoPrint, machine: BlockingClient, link: Path) -> Iterator[str]:
    """Do what users do; yield what was seen to work. Raises Failed."""
    until(lambda: api.state() == "Closed", "OctoPrint", START_S)
    api.do("/api/connection", command="connect", port=str(link), baudrate=115200)
    until(lambda: api.state() == "Operational", "connected")
    yield "connected"
    until(lambda: "tool0" in _temperatures(api), "temperatures")
    heat = _temperatures(api)
    _check({"tool0", "bed"} <= set(heat), "temperatures of nozzle and bed", heat)
    yield f"temperatures: {heat['tool0']['actual']:.1f} and {heat['bed']['actual']:.1f} °C"
    began_s = time.monotonic()
    api.print_file("part.gcode", JOB)
    until(api.is_printed, "the print", STEP_S)
    took_s = time.monotonic() - began_s
    until(lambda: _field(machine, "position.moving") is False, "standstill")
    found = machine.call("position.get", {"ask_nodes": True})
    counted = {name: stepper["steps_sent"] for name, stepper in found["steppers"].items()}
    _check(found["nodes_steps"] == counted, "every node's steps", found)
    end = found["planned"]
    _check((end["x"], end["y"]) == (40.0, 20.0 + (MOVES - 1) % 40), "the end of the job", end)
    yield f"printed {MOVES} moves line by line in {took_s:.0f} s; every stepper stands where it should"
    api.print_file("long.gcode", LONG)
    until(lambda: _field(machine, "position.moving") is True, "motion")
    api.do("/api/printer/command", command="M112")
    until(lambda: _field(machine, "machine.state") == "shutdown", "the emergency stop")
    cause = _field(machine, "machine.cause")
    _check("serial host" in cause, "who stopped it", cause)
    yield f"M112 in the middle of a print: {cause}"


def _field(machine: BlockingClient, name: str) -> Any:
    return machine.call("state.get", {"fields": [name]})["values"].get(name)


def _temperatures(api: OctoPrint) -> Mapping[str, Any]:
    found: Mapping[str, Any] = api.ask("/api/printer")["temperature"]
    return found


def _check(true: object, what: str, found: object) -> None:
    if not true:
        raise Failed(f"{what}: {found}")


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def main() -> int:
    """Run all; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("octoprint", help="the program")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="canductor-octoprint-") as name:
        folder = Path(name)
        base, link, path, port = folder / "base", folder / "printer", folder / "ipc", _free_port()
        base.mkdir()
        key = secrets.token_hex(16)
        (base / "config.yaml").write_text(CONFIG.format(key=key, salt=secrets.token_hex(16), link=link))
        host = [sys.executable, "-c", "from coordinator.cli.main import main; raise SystemExit(main())"]
        serve = [*host, "demo", "--machine", str(DEMO_MACHINE), "--serve", "--pty", str(link)]
        serve += ["--ipc", str(path), "--log-file", str(folder / "canductor.log")]
        octoprint = [given.octoprint, "serve", "--iknowwhatimdoing", "-b", str(base)]
        octoprint += ["--host", "127.0.0.1", "--port", str(port)]
        logs = [folder / "canductor.log", folder / "octoprint.log", base / "logs" / "serial.log"]
        with running(serve, folder / "canductor.out", {}), running(octoprint, logs[1], {}):
            try:
                until(link.exists, "the pseudo-terminal")
                until(path.exists, "the service")
                with BlockingClient(str(path)) as machine:
                    for step in drive(OctoPrint(port, key), machine, link):
                        sys.stdout.write(f"ok: {step}\n")
                        sys.stdout.flush()
            except Failed as failure:
                sys.stdout.write(f"FAILED: {failure}\n")
                for log in logs:
                    if log.exists():
                        lines = log.read_text(errors="replace").splitlines()[-LOG_LINES:]
                        sys.stdout.write(f"--- {log.name}\n" + "\n".join(lines) + "\n")
                return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
