"""The coordinator's side of announcing its machine: starts the process that does it, tells it the state."""

import asyncio
import contextlib
import dataclasses
import json
import os
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final

from coordinator.ipc.discovery.announcement import Announcement

RESTART_S: Final = 60.0
"""Before the process is started again that ended by itself."""
END_S: Final = 3.0
"""For it to say good-bye to the network."""
LINE_MAX: Final = 4_096
_ROOT: Final = Path(__file__).parents[3]


async def launch_process() -> asyncio.subprocess.Process:
    """Start the process that announces a machine; raises OSError."""
    return await asyncio.create_subprocess_exec(
        sys.executable,
        "-P",
        "-m",
        "coordinator.ipc.discovery.announce_process",
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        limit=LINE_MAX,
        env=os.environ | {"PYTHONPATH": str(_ROOT)},
    )


class Announcer:
    """Announces MACHINE, whose sockets are BOUND to these addresses, from ``start`` to ``close``.

    TELL hears in a sentence what becomes of it. Lives on one loop; ``state`` never waits.
    """

    def __init__(
        self,
        machine: Announcement,
        bound: list[str],
        tell: Callable[[str], None],
        *,
        launch: Callable[[], Awaitable[asyncio.subprocess.Process]] = launch_process,
    ) -> None:
        self._launch = launch
        self._machine = machine
        self._bound = bound
        self._tell = tell
        self._news = asyncio.Event()
        self._keeper: asyncio.Task[None] | None = None
        self._closing = False
        self.process: asyncio.subprocess.Process | None = None
        """What announces; None while there is none."""

    def start(self) -> None:
        """Begin."""
        self._keeper = asyncio.ensure_future(self._keep())

    def state(self, state: str) -> None:
        """Have STATE announced."""
        self._machine = dataclasses.replace(self._machine, state=state, change=self._machine.change + 1)
        self._news.set()

    async def close(self) -> None:
        """Have the network told that the machine goes."""
        if self._keeper is not None:
            self._keeper.cancel()
            await asyncio.gather(self._keeper, return_exceptions=True)

    async def _keep(self) -> None:
        while True:
            try:
                await self._announce()
                self._tell(f"announcing the machine ended; it begins again in {RESTART_S:g} s")
            except OSError as error:
                self._tell(f"the machine cannot be announced: {error.strerror or error}")
            await asyncio.sleep(RESTART_S)

    async def _announce(self) -> None:
        """Run the process until it ends by itself, or until cancelled."""
        self.process = process = await self._launch()
        told = asyncio.ensure_future(self._tell_it(process))
        try:
            await self._hear_it(process)
        finally:
            told.cancel()
            await asyncio.gather(told, return_exceptions=True)
            await _end(process)
            self.process = None

    async def _tell_it(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdin is not None
        described: dict[str, Any] = dataclasses.asdict(self._machine)
        del described["addresses"]
        line: dict[str, Any] = {**described, "bound": self._bound}
        with contextlib.suppress(OSError):  # it has ended, as reading from it will tell
            while True:
                process.stdin.write(json.dumps(line).encode() + b"\n")
                await process.stdin.drain()
                await self._news.wait()
                self._news.clear()
                line = {"state": self._machine.state, "change": self._machine.change}

    async def _hear_it(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdout is not None
        while line := await process.stdout.readline():
            for sentence in json.loads(line).values():
                self._tell(sentence)


async def _end(process: asyncio.subprocess.Process) -> None:
    assert process.stdin is not None
    process.stdin.close()
    try:
        async with asyncio.timeout(END_S):
            await process.wait()
    except TimeoutError:
        process.kill()
        await process.wait()
