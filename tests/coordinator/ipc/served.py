"""A server with one method of each scope, for tests."""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from coordinator.ipc.protocol.methods import Caller, Kind, Method, Param, Registry, Scope
from coordinator.ipc.protocol.overtaken import is_overtaken
from coordinator.ipc.server.server import IpcServer
from coordinator.ipc.server.settings import IpcSettings, TcpSettings
from coordinator.ipc.server.state import StateTree
from coordinator.ipc.server.stop_lane import StopLane
from coordinator.support.values import Value
from tests.stages import jump_loop

TOKENS = {scope: f"{scope.word}-token-of-at-least-32-characters" for scope in Scope}


@dataclass
class Served:
    """What the methods did."""

    server: IpcServer
    state: StateTree
    path: Path
    settings: IpcSettings
    stops: list[str] = field(default_factory=list)
    order: list[str] = field(default_factory=list)
    cancelled: asyncio.Event = field(default_factory=asyncio.Event)
    notices: asyncio.Queue[str] = field(default_factory=asyncio.Queue)
    writers: list[asyncio.StreamWriter] = field(default_factory=list)

    @property
    def at(self) -> str:
        return str(self.path)

    async def dial(self, *, tcp: bool = False) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Connect, and say nothing."""
        if tcp:
            opened = await asyncio.open_connection("127.0.0.1", self.server.tcp_port)
        else:
            opened = await asyncio.open_unix_connection(self.at, limit=2**24)
        self.writers.append(opened[1])
        return opened

    async def server_has(self, entering: int) -> None:
        """Wait until so many connections are on their way in."""
        assert self.server._listener is not None
        while self.server._listener.entering != entering:  # noqa: ASYNC110 (there is no event for it)
            await asyncio.sleep(0.01)

    async def script(self, **hello: Any) -> "Script":
        """Connect and say hello."""
        script = Script(*await self.dial())
        assert "result" in await script.ask("api.hello", version=1, **hello)
        return script


def registry_of(served: Served) -> Registry:
    registry = Registry()

    def info(caller: Caller, _: dict[str, Any]) -> Value:
        served.order.append("info, overtaken" if is_overtaken() else "info")
        return {"caller": caller.name, "scope": caller.scope.word}

    def move(_: Caller, params: dict[str, Any]) -> Value:
        return {"to": params["x_mm"]}

    def raw(_: Caller, params: dict[str, Any]) -> Value:
        return {"said": params["command"]}

    def who_stops(caller: Caller, params: dict[str, Any]) -> str:
        return str(params["who"] or caller.name)

    def stop(caller: Caller, params: dict[str, Any]) -> Value:
        served.stops.append(who_stops(caller, params))
        served.order.append("stop")
        return {"state": "shutdown"}

    async def wait(_: Caller, __: dict[str, Any]) -> Value:
        try:
            await asyncio.get_running_loop().create_future()
        except asyncio.CancelledError:
            served.cancelled.set()
            raise
        return None

    def broken(_: Caller, __: dict[str, Any]) -> Value:
        raise ZeroDivisionError

    def unsendable(_: Caller, __: dict[str, Any]) -> Value:
        return {"x": float("nan"), "y": 2**80}

    x = Param("x_mm", Kind.FLOAT, "where to", "mm", low=0, high=200)
    whom = (Param("who", Kind.STR, required=False, high=100), Param("why", Kind.STR, required=False, high=9))
    for method in (
        Method("machine.info", Scope.WATCH, "Tell.", info),
        Method("move.to", Scope.OPERATE, "Move.", move, (x,)),
        Method("node.command", Scope.ADMIN, "Command.", raw, (Param("command", Kind.STR),)),
        Method("machine.emergency_stop", Scope.OPERATE, "Stop.", stop, whom, urgent=True, stops=who_stops),
        Method("wait", Scope.WATCH, "Wait for ever.", wait),
        Method("broken", Scope.WATCH, "Fail.", broken),
        Method("unsendable", Scope.WATCH, "Return too much.", unsendable),
    ):
        registry.add(method)
    return registry


@contextlib.asynccontextmanager
async def serving(
    folder: Path, *, stop_lane: StopLane | None = None, **settings: Any
) -> AsyncIterator[Served]:
    """Serve at FOLDER/m.sock with SETTINGS."""
    path = folder / "m.sock"
    served = Served(None, StateTree(), path, IpcSettings(unix_path=path, **settings))  # type: ignore[arg-type]
    served.server = IpcServer(
        registry_of(served),
        served.state,
        served.settings,
        on_notice=served.notices.put_nowait,
        stop_lane=stop_lane,
    )
    await served.server.start()
    try:
        yield served
    finally:
        await served.server.close()
        for writer in served.writers:
            writer.transport.abort()
        await asyncio.sleep(0)


def run(
    folder: Path, body: Callable[[Served], Awaitable[None]], *, look_s: float = 0.0, **settings: Any
) -> None:
    """Serve at FOLDER/m.sock and let BODY test what is served, in virtual time; LOOK_S as of JumpLoop."""

    async def main() -> None:
        async with serving(folder, **settings) as served:
            await body(served)

    jump_loop.run(main(), look_s=look_s)


def tokens_file(folder: Path, mode: int = 0o600) -> Path:
    path = folder / "tokens"
    path.write_text("# ours\n" + "".join(f"{s.word} of-{s.word} {t}\n" for s, t in TOKENS.items()))
    path.chmod(mode)
    return path


def plain_tcp(folder: Path, host: str = "127.0.0.1") -> TcpSettings:
    return TcpSettings(host=host, port=0, tokens=tokens_file(folder), plain_on_loopback=True)


class Script:
    """A client that speaks JSON lines, byte by byte as the test wants."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    def send(self, method: str, request_id: int = 1, **params: Any) -> None:
        self.writer.write(json.dumps({"id": request_id, "method": method, "params": params}).encode() + b"\n")

    async def receive(self) -> Any:
        async with asyncio.timeout(30):
            return json.loads(await self.reader.readline())

    async def ask(self, method: str, request_id: int = 1, **params: Any) -> Any:
        self.send(method, request_id, **params)
        return await self.receive()

    async def rest(self) -> list[Any]:
        """Return what comes until the server closes."""
        async with asyncio.timeout(30):
            return [json.loads(line) for line in (await self.reader.read()).splitlines()]
