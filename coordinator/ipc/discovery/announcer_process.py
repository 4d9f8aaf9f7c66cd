"""The coordinator's side of announcing its machine: a process of its own that does it (docs/adr/0013)."""

import asyncio
import contextlib
import dataclasses
import json
import os
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Final

from coordinator.ipc.discovery.announcement import Announcement
from coordinator.support.realtime import end_realtime

RESTART_S: Final = 60.0
"""Before a process that ended by itself is started again."""
END_S: Final = 3.0
"""For the process to withdraw the announcement."""
LINE_MAX: Final = 4_096
_ROOT: Final = Path(__file__).parents[3]


async def launch_process(bound: list[str]) -> asyncio.subprocess.Process:
    """Start the process for a machine whose sockets are BOUND to these addresses; raises OSError."""
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-P",
        "-m",
        "coordinator.ipc.discovery.announcer",
        *bound,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        limit=LINE_MAX,
        env=os.environ | {"PYTHONPATH": str(_ROOT)},
    )
    end_realtime(process.pid)
    return process


class AnnouncerProcess:
    """Announces MACHINE, whose sockets are BOUND to these addresses, from ``start`` to ``close``.

    REPORT gets a sentence when something changes. Lives on one loop; ``set_state`` never waits.
    """

    def __init__(
        self,
        machine: Announcement,
        bound: list[str],
        report: Callable[[str], None],
        *,
        launch: Callable[[list[str]], Awaitable[asyncio.subprocess.Process]] = launch_process,
    ) -> None:
        self._machine = machine
        self._bound = bound
        self._report = report
        self._launch = launch
        self._changed = asyncio.Event()
        self._keeper: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start the process, and again whenever it ends."""
        self._keeper = asyncio.ensure_future(self._keep())

    def set_state(self, state: str) -> None:
        """Announce STATE."""
        self._machine = dataclasses.replace(self._machine, state=state, change=self._machine.change + 1)
        self._changed.set()

    async def close(self) -> None:
        """Withdraw the announcement and end the process."""
        if self._keeper is not None:
            self._keeper.cancel()
            await asyncio.gather(self._keeper, return_exceptions=True)

    async def _keep(self) -> None:
        while True:
            try:
                await self._run(await self._launch(self._bound))
                self._report(f"announcing the machine ended; it starts again in {RESTART_S:g} s")
            except OSError as error:
                self._report(f"the machine cannot be announced: {error.strerror or error}")
            except ValueError:  # it was killed in the middle of a line
                self._report(f"announcing the machine failed; it starts again in {RESTART_S:g} s")
            await asyncio.sleep(RESTART_S)

    async def _run(self, process: asyncio.subprocess.Process) -> None:
        """Work with PROCESS until it ends by itself, or until cancelled."""
        sending = asyncio.ensure_future(self._send_changes(process))
        try:
            assert process.stdout is not None
            while line := await process.stdout.readline():
                self._report(json.loads(line))
        finally:
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            await _end(process)

    async def _send_changes(self, process: asyncio.subprocess.Process) -> None:
        assert process.stdin is not None
        with contextlib.suppress(OSError):  # it has ended: its output ends, too
            while True:
                self._changed.clear()
                process.stdin.write(json.dumps(dataclasses.asdict(self._machine)).encode() + b"\n")
                await process.stdin.drain()
                await self._changed.wait()


async def _end(process: asyncio.subprocess.Process) -> None:
    assert process.stdin is not None
    process.stdin.close()
    try:
        async with asyncio.timeout(END_S):
            await process.wait()
    except TimeoutError:
        process.kill()
        await process.wait()
