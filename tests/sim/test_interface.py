"""The interface of a machine that runs, in virtual time: who may do what, and who is cut off."""

import asyncio
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from coordinator.ipc.protocol.methods import Scope
from tests.stages.demo_machine import DemoMachine
from tests.stages.interface import Interface, Line
from tests.stages.served import Served, zigzag

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
    "gcode.macros": ("watch", {}, "result"),
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
    "job.history": ("watch", {}, "result"),
    "job.thumbnail": ("watch", {"file": "none.gcode"}, "no_such_file"),
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


Caller = tuple[bool, str | None, str | None, str]
CALLERS: dict[str, Caller] = {
    "the owner": (False, None, None, "admin"),
    "the owner, as one who watches": (False, None, "watch", "watch"),
    "the owner, as one who operates": (False, None, "operate", "operate"),
    "a token to watch": (True, "watch", None, "watch"),
    "a token to watch that asks for more": (True, "watch", "admin", "watch"),
    "a token to operate": (True, "operate", None, "operate"),
    "a token of an administrator": (True, "admin", None, "admin"),
}
"""Over TCP or not, whose token, which scope is asked for, and which one comes of it."""


def serve(folder: Path, main: Callable[[Served, Interface], Awaitable[None]]) -> None:
    """Serve a machine in virtual time; its tokens are TOKENS, and there is a job to print."""
    machine = DemoMachine(folder)
    tokens = folder / "tokens"
    tokens.touch(0o600)
    tokens.write_text("".join(f"{scope} {scope}er {token}\n" for scope, token in TOKENS.items()))

    async def run(stage: Served) -> None:
        stage.write_job(zigzag(10, 3), "zigzag.gcode")
        async with Interface.of(stage, tokens) as interface:
            await main(stage, interface)

    machine.serve(run, node_commands=True)


@asynccontextmanager
async def line_of(interface: Interface, name: str, caller: Caller) -> AsyncIterator[Line]:
    """Say hello as CALLER."""
    tcp, token, asked, scope = caller
    line = interface.connect(granted=None if tcp else Scope.ADMIN, packed="token" in name)
    hello: dict[str, Any] = {"version": 1}
    hello |= {"token": TOKENS[token]} if token is not None else {}
    hello |= {"scope": asked} if asked is not None else {}
    assert (await line.ask("api.hello", **hello))["result"]["scope"] == scope
    yield line
    line.leave()


def test_the_scope_matrix_of_the_machine(tmp_path: Path) -> None:
    """Every method of the machine, for every kind of caller; a method that is not in the matrix fails."""

    async def main(stage: Served, interface: Interface) -> None:
        owner = interface.connect(granted=Scope.ADMIN)
        await owner.ask("api.hello", version=1)
        listed = (await owner.ask("api.methods"))["result"]["methods"]
        assert {m["name"]: m["scope"] for m in listed} == {n: scope for n, (scope, _, _) in MATRIX.items()}
        for name, caller in CALLERS.items():
            await _check_caller(interface, name, caller)
        for method, (_scope, params, _can) in MATRIX.items():
            await _check_stranger(interface, method, params)
        for name, caller in CALLERS.items():
            await _check_stop(interface, name, caller)

    serve(tmp_path, main)


async def _check_caller(interface: Interface, name: str, caller: Caller) -> None:
    scope = caller[3]
    async with line_of(interface, name, caller) as line:
        expected = {
            method: outcome if RANK[needed] <= RANK[scope] else "not_allowed"
            for method, (needed, _, outcome) in MATRIX.items()
            if method != STOP or scope == "watch"
        }
        found = {method: await line.outcome(method, MATRIX[method][1]) for method in expected}
        assert found == expected, name


async def _check_stop(interface: Interface, name: str, caller: Caller) -> None:
    """Who may stops the machine, though a parameter is wrong; who may only watch does not."""
    async with line_of(interface, name, caller) as line:
        answer = await line.ask(STOP, **MATRIX[STOP][1])
        if caller[3] == "watch":
            assert answer["error"]["code"] == "not_allowed"
        else:
            assert answer["result"]["state"] == "shutdown"
            assert "who is 1, must be a string" in answer["result"]["ignored"]


async def _check_stranger(interface: Interface, method: str, params: dict[str, Any]) -> None:
    """Who has no token gets nothing from METHOD, with a hello before it or without."""
    line = interface.connect(granted=None)
    hello = {"version": 1} if method != "api.hello" else params
    line.send({"id": 1, "method": "api.hello", "params": hello})
    line.send({"id": 2, "method": method, "params": params})
    assert (await line.last_words())["code"] == "no_token"
    if method == "api.hello":
        return
    line = interface.connect(granted=None, packed=True)
    line.send({"id": 2, "method": method, "params": params})
    assert (await line.last_words())["code"] == "no_hello"


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


async def attack(interface: Interface, code: str, tcp: bool, packed: bool) -> tuple[str, str]:
    """Do what must end with CODE, after a sound hello where that can be; return what the server says."""
    line = interface.connect(granted=None if tcp else Scope.ADMIN, packed=packed)
    if code == "bad_token":
        line.send({"id": 1, "method": "api.hello", "params": {"version": 1, "token": "x" * 40}})
    else:
        token = {"token": TOKENS["watch"]} if tcp else {}
        assert "result" in await line.ask("api.hello", version=1, **token)
        half = line.encoded({"id": 2, "method": "machine.emergency_stop"})[:-1]
        line.send_bytes({"too_long": HUGE[packed], "too_deep": DEEP[packed], "timeout": half}[code])
    said = await line.last_words()
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
        assert done == begin or (done > begin and not self._fields["position.moving"])
        return True


def test_what_is_wrong_ends_that_client_only_while_the_machine_prints(tmp_path: Path) -> None:
    kinds = [(tcp, packed) for tcp in (False, True) for packed in (False, True)]
    attacks = [(code, *kind) for code in SENTENCES for kind in kinds if code != "bad_token" or kind[0]]

    async def main(stage: Served, interface: Interface) -> None:
        bystander = interface.connect(granted=Scope.ADMIN)
        await bystander.ask("api.hello", version=1)
        await bystander.ask("job.start", file="zigzag.gcode")
        progress = _Progress(stage.jobs / "zigzag.gcode")
        watched = await bystander.ask("api.watch", fields=["job.*", "position.moving"], rate_hz=20)
        assert progress.look(watched["result"]["values"])
        ends = asyncio.gather(
            *(attack(interface, code, tcp=tcp, packed=packed) for code, tcp, packed in attacks)
        )
        while progress.look((await bystander.next_update())["values"]):
            pass
        for (code, *kind), (said, sentence) in zip(attacks, await ends, strict=True):
            assert said == code, kind
            assert SENTENCES[code] in sentence
        done = (await bystander.ask("job.status"))["result"]
        assert (done["state"], done["progress"]) == ("done", 1.0)
        assert done["done_bytes"] == done["read_bytes"] == done["size_bytes"]
        told = (await bystander.ask("position.get", ask_nodes=True))["result"]
        assert told["nodes_steps"] == {n: s["steps_sent"] for n, s in told["steppers"].items()}

    serve(tmp_path, main)
