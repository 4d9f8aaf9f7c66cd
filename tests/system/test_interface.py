"""The interface of a machine that runs, over its real sockets: who may do what, and who is shown the door."""

import json
import socket
import ssl
import struct
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import msgpack
import pytest

from coordinator.ipc.blocking import BlockingClient
from coordinator.ipc.client import Refused
from tests.stages.processes import Command, Hardware
from tests.stages.served import zigzag

PATIENCE_S = 60.0
TOKENS = {scope: f"{scope}-" + "t" * 32 for scope in ("watch", "operate", "admin")}
RANK = {"watch": 1, "operate": 2, "admin": 3}

MATRIX: dict[str, tuple[str, dict[str, Any], str]] = {
    "api.hello": ("watch", {"version": 1}, "bad_params"),  # it was said already
    "api.methods": ("watch", {}, "result"),
    "api.ping": ("watch", {}, "result"),
    "api.cancel": ("watch", {"id": 99}, "result"),
    "api.watch": ("watch", {"fields": ["machine.state"], "rate_hz": 0.01}, "result"),
    "api.unwatch": ("watch", {"subscription": 1}, "result"),
    "api.listen": ("watch", {"events": ["none"]}, "result"),
    "state.get": ("watch", {"fields": ["machine.*"]}, "result"),
    "machine.info": ("watch", {}, "result"),
    "machine.state": ("watch", {}, "result"),
    "machine.emergency_stop": ("operate", {"who": 1}, "result"),  # whoever may does so after all the others
    "machine.restart": ("operate", {"x": 1}, "bad_params"),
    "log.tail": ("watch", {}, "result"),
    "config.get": ("watch", {}, "result"),
    "gcode.run": ("operate", {"script": "G28"}, "result"),
    "move.home": ("operate", {}, "result"),
    "move.to": ("operate", {"x": 1}, "result"),
    "move.by": ("operate", {"x": 0.5}, "result"),
    "position.get": ("watch", {"ask_nodes": True}, "result"),
    "job.list": ("watch", {}, "result"),
    "job.upload": ("operate", {"file": "a.gcode", "offset": 0, "text": "G28\n"}, "result"),
    "job.start": ("operate", {"file": "none.gcode"}, "no_such_file"),
    "job.stream": ("operate", {"name": "\n"}, "bad_params"),
    "job.feed": ("operate", {"name": "none", "first_line": 1, "text": ""}, "no_job"),
    "job.pause": ("operate", {}, "no_job"),
    "job.recover": ("operate", {}, "no_job"),
    "job.resume": ("operate", {}, "no_job"),
    "job.cancel": ("operate", {}, "no_job"),
    "job.status": ("watch", {}, "result"),
    "nodes.list": ("watch", {}, "result"),
    "buses.list": ("watch", {}, "result"),
    "node.command": ("admin", {"node": "mcu", "command": "get_uptime", "response": "uptime"}, "result"),
    "motion.dump": ("watch", {"seconds": 0.1}, "result"),
    "motion.path": ("watch", {}, "result"),
    "table.status": ("watch", {}, "result"),
    "table.send": ("operate", {"x": 1}, "bad_params"),
    "table.remove": ("operate", {"x": 1}, "bad_params"),
}
"""By method: the scope that it needs, what to call it with, and what it answers to one who may."""

STOP = "machine.emergency_stop"


class Line:
    """A connection that says what it is told to, in JSON or msgpack."""

    def __init__(self, place: "Place", *, tcp: bool = False, packed: bool = False) -> None:
        if tcp:
            self.socket = socket.create_connection(("127.0.0.1", place.port), PATIENCE_S)
        else:
            self.socket = socket.socket(socket.AF_UNIX)
            self.socket.settimeout(PATIENCE_S)
            self.socket.connect(str(place.path))
        self._packed = packed
        self._left = b""

    def write(self, message: dict[str, Any]) -> bytes:
        if not self._packed:
            return json.dumps(message).encode() + b"\n"
        body: bytes = msgpack.packb(message)
        return struct.pack(">I", len(body)) + body

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        """Return the answer."""
        self.send(self.write({"id": 1, "method": method, "params": params}))
        while "id" not in (message := self.receive()):
            pass
        return message

    def outcome(self, method: str, params: dict[str, Any]) -> str:
        """Return "result", or the error's code."""
        answer = self.ask(method, **params)
        return "result" if "result" in answer else str(answer["error"]["code"])

    def receive(self) -> dict[str, Any]:
        while (message := self._next()) is None:
            data = self.socket.recv(1 << 18)
            assert data, "the server ended it"
            self._left += data
        return message

    def _next(self) -> dict[str, Any] | None:
        if not self._packed:
            text, end, rest = self._left.partition(b"\n")
            if not end:
                return None
            self._left = rest
            return dict(json.loads(text))
        size = 4 + struct.unpack_from(">I", self._left)[0] if len(self._left) >= 4 else 1 << 30
        if len(self._left) < size:
            return None
        body, self._left = self._left[4:size], self._left[size:]
        return dict(msgpack.unpackb(body))

    def last_words(self) -> dict[str, Any]:
        """Read to the end that the server makes, and return why."""
        while data := self.socket.recv(1 << 18):
            self._left += data
        message: dict[str, Any] = {}
        while self._left:
            following = self._next()
            assert following is not None, "it ended within a message"
            message = following
        assert message.keys() == {"error"}, message
        return dict(message["error"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()


@dataclass(frozen=True)
class Place:
    """Where `canductor run` serves."""

    path: Path
    port: int
    tokens: Path
    command: Command


@contextmanager
def serving(machine: Hardware, *more: str | Path) -> Iterator[Place]:
    """Run it with both sockets; it must end in order."""
    jobs, tokens, path = machine.folder / "jobs", machine.folder / "tokens", machine.folder / "run.sock"
    jobs.mkdir()
    (jobs / "zigzag.gcode").write_text(zigzag(10, 3), encoding="utf-8")
    tokens.touch(0o600)
    tokens.write_text("".join(f"{scope} {scope}er {token}\n" for scope, token in TOKENS.items()))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    words = ("--ipc", path, "--jobs", jobs, "--tcp", f"127.0.0.1:{port}", "--tokens", tokens)
    with Command("run", machine.config, *words, "--node-commands", *more) as command:
        command.stdout.wait_for("ready")
        command.stdout.wait_for(f"://127.0.0.1:{port}")
        yield Place(path, port, tokens, command)
        command.process.terminate()
        ended = command.end()
        assert ended.status == 0, ended
        assert ended.stderr == ""


CALLERS = {
    "the owner": (False, None, None, "admin"),
    "the owner, as one who watches": (False, None, "watch", "watch"),
    "the owner, as one who operates": (False, None, "operate", "operate"),
    "a token to watch": (True, "watch", None, "watch"),
    "a token to watch that asks for more": (True, "watch", "admin", "watch"),
    "a token to operate": (True, "operate", None, "operate"),
    "a token of an administrator": (True, "admin", None, "admin"),
}
"""Over TCP or not, whose token, which scope is asked for, and which one comes of it."""


def test_the_scope_matrix_of_the_machine(machine: Hardware) -> None:
    """Every method of the machine, for every kind of caller; a method that is not in the matrix fails."""
    with serving(machine, "--no-tls-on-loopback") as place:
        with Line(place) as owner:
            owner.ask("api.hello", version=1)
            listed = owner.ask("api.methods")["result"]["methods"]
            assert {m["name"]: m["scope"] for m in listed} == {
                n: scope for n, (scope, _, _) in MATRIX.items()
            }
        for name, caller in CALLERS.items():
            _check_caller(place, name, caller)
        for method, (_, params, _) in MATRIX.items():
            _check_stranger(place, method, params)
        for name, caller in CALLERS.items():
            _check_stop(place, name, caller)


@contextmanager
def _line_of(place: Place, name: str, caller: tuple[bool, str | None, str | None, str]) -> Iterator[Line]:
    """Say hello as CALLER."""
    tcp, token, asked, scope = caller
    with Line(place, tcp=tcp, packed="token" in name) as line:
        hello: dict[str, Any] = {"version": 1}
        hello |= {"token": TOKENS[token]} if token is not None else {}
        hello |= {"scope": asked} if asked is not None else {}
        assert line.ask("api.hello", **hello)["result"]["scope"] == scope
        yield line


def _check_caller(place: Place, name: str, caller: tuple[bool, str | None, str | None, str]) -> None:
    scope = caller[3]
    with _line_of(place, name, caller) as line:
        expected = {
            method: outcome if RANK[needed] <= RANK[scope] else "not_allowed"
            for method, (needed, _, outcome) in MATRIX.items()
            if method != STOP or scope == "watch"
        }
        found = {method: line.outcome(method, MATRIX[method][1]) for method in expected}
        assert found == expected, name


def _check_stop(place: Place, name: str, caller: tuple[bool, str | None, str | None, str]) -> None:
    """Who may stops the machine, though a parameter is wrong; who may only watch does not."""
    with _line_of(place, name, caller) as line:
        answer = line.ask(STOP, **MATRIX[STOP][1])
        if caller[3] == "watch":
            assert answer["error"]["code"] == "not_allowed"
        else:
            assert answer["result"]["state"] == "shutdown"
            assert "who is 1, must be a string" in answer["result"]["ignored"]


def _check_stranger(place: Place, method: str, params: dict[str, Any]) -> None:
    """Who has no token gets nothing from METHOD, with a hello before it or without."""
    with Line(place, tcp=True) as line:
        hello = {"version": 1} if method != "api.hello" else params
        line.send(line.write({"id": 1, "method": "api.hello", "params": hello}))
        line.send(line.write({"id": 2, "method": method, "params": params}))
        assert line.last_words()["code"] == "no_token"
    if method == "api.hello":
        return
    with Line(place, tcp=True, packed=True) as line:
        line.send(line.write({"id": 2, "method": method, "params": params}))
        assert line.last_words()["code"] == "no_hello"


DEEP = {
    False: b'{"a":' + b"[" * 5000 + b"]" * 5000 + b"}\n",
    True: b"\x00\x00\x13\x8b\x81\xa1a" + b"\x91" * 5000,
}
HUGE = {False: b'{"a":"' + b"x" * 300_000, True: struct.pack(">I", 2**24 - 1) + b"\x81"}
SENTENCES = {
    "bad_token": "the token is not known here",
    "too_long": "is too long; 262,144 bytes at most",
    "too_deep": "nested more than 16 deep",
    "timeout": "a message was not complete 5 s after its first byte",
}


def _attack(place: Place, code: str, *, tcp: bool, packed: bool) -> tuple[str, str]:
    """Do what must end with CODE, after a sound hello where that can be; return what the server says."""
    with Line(place, tcp=tcp, packed=packed) as line:
        if code == "bad_token":
            line.send(
                line.write({"id": 1, "method": "api.hello", "params": {"version": 1, "token": "x" * 40}})
            )
        else:
            assert "result" in line.ask("api.hello", version=1, **({"token": TOKENS["watch"]} if tcp else {}))
            half = line.write({"id": 2, "method": "machine.emergency_stop"})[:-1]
            line.send({"too_long": HUGE[packed], "too_deep": DEEP[packed], "timeout": half}[code])
        said = line.last_words()
        return str(said["code"]), str(said["message"])


class _Progress:
    """Watches a job: what is carried out is where its line begins in the file, and what is read is ahead."""

    def __init__(self, file: Path) -> None:
        self._lines = file.read_bytes().splitlines(keepends=True)
        self._fields: dict[str, Any] = {}
        self._before = 0

    def look(self, changed: dict[str, Any]) -> bool:
        """Return whether it goes on."""
        self._fields |= changed
        done, read = self._fields["job.done_bytes"], self._fields["job.read_bytes"]
        assert self._before <= done <= read
        self._before = done
        if self._fields["job.state"] != "printing":
            return False
        begin = sum(map(len, self._lines[: max(0, self._fields["job.line"] - 1)]))
        assert abs(done - begin) <= 3 * max(map(len, self._lines))
        return True


def test_what_is_wrong_ends_that_client_only_while_the_machine_prints(machine: Hardware) -> None:
    with serving(machine, "--no-tls-on-loopback") as place, BlockingClient(str(place.path)) as bystander:
        bystander.call("job.start", {"file": "zigzag.gcode"})
        progress = _Progress(machine.folder / "jobs" / "zigzag.gcode")
        kinds = [(tcp, packed) for tcp in (False, True) for packed in (False, True)]
        attacks = [(code, *kind) for code in SENTENCES for kind in kinds if code != "bad_token" or kind[0]]
        with ThreadPoolExecutor(len(attacks)) as pool:
            ends = pool.map(lambda a: _attack(place, a[0], tcp=a[1], packed=a[2]), attacks)
            for update in bystander.watch(["job.*"], rate_hz=20):
                if not progress.look(update.values):
                    break
        for (code, *kind), (said, sentence) in zip(attacks, ends, strict=True):
            assert said == code, kind
            assert SENTENCES[code] in sentence
        done = bystander.call("job.status")
        assert (done["state"], done["progress"]) == ("done", 1.0)
        assert done["done_bytes"] == done["read_bytes"] == done["size_bytes"]
        told = bystander.call("position.get", {"ask_nodes": True})
        assert told["nodes_steps"] == {n: s["steps_sent"] for n, s in told["steppers"].items()}


def test_tls_and_a_token_that_is_taken_away(machine: Hardware, tmp_path: Path) -> None:
    certificate, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    words = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    words += ["-subj", "/CN=test", "-addext", "subjectAltName=IP:127.0.0.1", "-days", "2"]
    try:
        made = subprocess.run([*words, "-keyout", key, "-out", certificate], capture_output=True, check=False)
    except FileNotFoundError:
        pytest.skip("openssl, which makes the certificate, is not installed")
    assert made.returncode == 0, made.stderr
    tls = ("--tls-certificate", certificate, "--tls-key", key)
    with serving(machine, *tls) as place:
        place.command.stdout.wait_for(f"tls://127.0.0.1:{place.port}")
        address = f"tls://127.0.0.1:{place.port}"
        trusted = ssl.create_default_context(cafile=certificate)
        with BlockingClient(address, token=TOKENS["operate"], tls=trusted) as client:
            assert client.call("gcode.run", {"script": "G28\nM114"})["replies"]
            with Line(place, tcp=True) as plain:  # who speaks no TLS is heard by nobody
                plain.send(plain.write({"id": 1, "method": "machine.emergency_stop"}))
                while plain.socket.recv(1000):
                    pass
            assert client.call("machine.state")["state"] == "ready"
            place.tokens.write_text(f"watch watcher {TOKENS['watch']}\n")
            place.command.stdout.wait_for("the tokens of tokens were read again")
        late = BlockingClient(address, token=TOKENS["operate"], tls=trusted)
        with pytest.raises(Refused, match="not known here"), late:
            pass


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--tcp", "127.0.0.1:1"), "TCP needs a certificate and its private key"),
        (("--tcp", "0.0.0.0:7125", "--no-tls-on-loopback"), "TCP without TLS is for loopback only"),
    ],
)
def test_tcp_that_is_not_safe_is_not_opened(
    machine: Hardware, tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    tokens = tmp_path / "tokens"
    tokens.touch(0o600)
    with Command("run", machine.config, "--ipc", tmp_path / "s", "--tokens", tokens, *words) as command:
        assert sentence in command.end().sentence()
    assert not (tmp_path / "s").exists()
