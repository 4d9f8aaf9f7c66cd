"""Clients of the Klippy API of a service in virtual time: the real gateway, with lines in memory."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from coordinator.klippy_api.gateway import Connection, Gateway
from tests.stages.interface import MemoryTransport
from tests.stages.served import Served

LIMIT_S = 60.0
HIGH_WATER = 65_536
"""As asyncio's: with more unread the protocol is asked to pause."""


class KlippyTransport(MemoryTransport):
    """What the gateway writes to; a client that reads at once, unless it is BLOCKED."""

    def __init__(self) -> None:
        super().__init__()
        self.blocked = False
        self.unread = 0
        self.connection: Connection
        self.held = False

    def write(self, data: Any) -> None:
        if not self.blocked:
            super().write(data)
            return
        before, self.unread = self.unread, self.unread + len(data)
        if before <= HIGH_WATER < self.unread:
            self.connection.pause_writing()

    def get_write_buffer_size(self) -> int:
        return self.unread

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        del name
        return default

    def pause_reading(self) -> None:
        self.held = True

    def resume_reading(self) -> None:
        self.held = False

    def write_eof(self) -> None:
        if not self.ended:
            super().write_eof()
            asyncio.get_running_loop().call_soon(self.connection.connection_lost, None)


class KlippyClient:
    """A client that sends whatever it is asked to."""

    def __init__(self, gateway: Gateway) -> None:
        self.transport = KlippyTransport()
        self.connection = self.transport.connection = gateway.make_connection()
        self.connection.connection_made(self.transport)
        self.events: list[dict[str, Any]] = []
        """Messages that answer nothing."""
        self._answers: dict[str, dict[str, Any]] = {}
        self._ids = 0

    def send(self, method: str, params: dict[str, Any] | None = None) -> int:
        """Send a call; return its id."""
        self._ids += 1
        message = {"id": self._ids, "method": method, "params": params or {}}
        self.send_bytes(json.dumps(message).encode() + b"\x03")
        return self._ids

    def send_bytes(self, data: bytes) -> None:
        """Send DATA in the pieces that a socket would give."""
        for begin in range(0, len(data), 65_536):
            if self.transport.ended:
                return
            self.connection.receive(data[begin : begin + 65_536])

    async def answer(self, number: int) -> dict[str, Any]:
        """Return the answer to call NUMBER: with ``result`` or ``error``."""
        await self.until(lambda: json.dumps(number) in self._answers, f"the answer {number}")
        return self._answers.pop(json.dumps(number))

    async def ask(self, method: str, params: dict[str, Any] | None = None) -> dict[str, Any]:
        """Return the result of a call."""
        answer = await self.answer(self.send(method, params))
        assert "result" in answer, answer
        return dict(answer["result"])

    async def error(self, method: str, params: dict[str, Any] | None = None) -> str:
        """Return the message of a call that fails."""
        answer = await self.answer(self.send(method, params))
        assert answer["error"]["error"] == "WebRequestError", answer
        return str(answer["error"]["message"])

    async def script(self, *lines: str) -> None:
        """Have lines of g-code done."""
        assert await self.ask("gcode/script", {"script": "\n".join(lines)}) == {}

    async def until(self, true: Callable[[], bool], what: str, limit_s: float = LIMIT_S) -> None:
        """Wait until TRUE after something came."""
        async with asyncio.timeout(limit_s):
            while True:
                self._read()
                if true():
                    return
                assert not self.transport.ended, f"the connection ended before {what}"
                self.transport.news.clear()
                await self.transport.news.wait()

    def said(self) -> list[str]:
        """Return the lines that g-code has answered so far, and forget them."""
        self._read()
        lines = [
            line
            for event in self.events
            if event.get("method") == "said"
            for line in event["params"]["response"].split("\n")
        ]
        self.events = [event for event in self.events if event.get("method") != "said"]
        return lines

    async def updates(self, seconds: float) -> list[dict[str, Any]]:
        """Return what has changed within the next so many seconds, one map for each update."""
        await asyncio.sleep(seconds)
        self._read()
        found = [event["params"]["status"] for event in self.events if event.get("method") == "changed"]
        self.events = [event for event in self.events if event.get("method") != "changed"]
        return found

    async def listen(self) -> None:
        """Listen to what g-code answers."""
        assert await self.ask("gcode/subscribe_output", {"response_template": {"method": "said"}}) == {}

    async def watch(self, objects: dict[str, list[str] | None]) -> dict[str, Any]:
        """Watch OBJECTS; return how they are."""
        params = {"objects": objects, "response_template": {"method": "changed"}}
        return dict((await self.ask("objects/subscribe", params))["status"])

    async def query(self, *names: str) -> dict[str, Any]:
        """Return the objects of NAMES."""
        return dict((await self.ask("objects/query", {"objects": dict.fromkeys(names)}))["status"])

    def _read(self) -> None:
        written = self.transport.written
        *messages, rest = bytes(written).split(b"\x03")
        written[:] = rest
        for body in messages:
            message = json.loads(body)
            if "id" in message:
                self._answers[json.dumps(message["id"])] = message
            else:
                self.events.append(message)


class KlippyApi:
    """The gateway of a service, without sockets."""

    def __init__(self, gateway: Gateway, notices: list[str]) -> None:
        self.gateway = gateway
        self.notices = notices
        """What the machine's owner reads about clients."""

    @classmethod
    @asynccontextmanager
    async def of(cls, served: Served, config: Path) -> AsyncIterator["KlippyApi"]:
        """Serve SERVED, of the configuration file CONFIG."""
        notices: list[str] = []
        gateway = Gateway(served.service, config, on_notice=notices.append)
        served.listeners.append(gateway.note)
        await gateway.start(None)
        try:
            yield cls(gateway, notices)
        finally:
            served.listeners.remove(gateway.note)
            await gateway.close()

    def connect(self) -> KlippyClient:
        """Connect a client."""
        return KlippyClient(self.gateway)
