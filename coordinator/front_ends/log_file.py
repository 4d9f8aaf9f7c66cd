"""The log file of a service: banner, configuration, every line of the log, figures; old ones are kept.

All of it is formatted and written by a thread of its own. When the disk is slower than the log, lines are
left out and counted; the service never waits.
"""

import asyncio
import os
import platform
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from coordinator.front_ends.writing_thread import Text, WritingThread
from coordinator.service.core.machine_service import MachineService, ServiceState
from coordinator.service.state.log_ring import Entry
from coordinator.support.values import Value
from coordinator.support.version import VERSION
from nodes.support.regular_file import open_regular

FILE_BYTES_MAX: Final = 10_485_760
"""A larger file is renamed to NAME.1, that to NAME.2, and so on."""
KEPT: Final = 5
"""Older files."""
STATISTICS_S: Final = 30.0
CLOSE_S: Final = 1.0
"""A disk that does not answer must not keep the service from ending."""
_SHOWN: Final = (
    "nodes.",
    "buses.",
    "machine.lead",
    "job.state",
    "job.line",
    "job.progress",
    "position.moving",
)
"""Fields of the state tree that go into statistics."""
_HEAT: Final = (".temperature", ".target", ".power")
_QUIET: Final = (
    ".bus",
    ".nodeid",
    ".policy",
    ".state_text",
    ".failure",
    ".histogram",
    ".lead_histogram",
    ".name",
    ".uuid",
)


class LogFile:
    """Writes to PATH; ON_FAILURE gets a sentence, once for each time that the file could not be written."""

    def __init__(self, path: Path, on_failure: Callable[[str], None]) -> None:
        self._path = path
        self._on_failure = on_failure
        self._failed = False
        self._thread = WritingThread("log file", self._try_to_write, "the disk is slow")

    def add(self, text: Text) -> None:
        """Have the lines written that TEXT returns; without effect when too many wait."""
        self._thread.add(text)

    def close(self, wait_s: float | None = CLOSE_S) -> None:
        """Wait until all is written, WAIT_S at most (None: as long as it takes)."""
        self._thread.close(wait_s)

    # -------------------------------------------------------------------------------------- the thread

    def _try_to_write(self, text: str) -> None:
        try:
            self._write(text)
            self._failed = False
        except OSError as error:
            self._fail(error)

    def _write(self, text: str) -> None:
        data = text.encode(errors="replace")
        try:
            size = self._path.stat().st_size
        except FileNotFoundError:
            size = 0
        if size and size + len(data) > FILE_BYTES_MAX:
            self._rotate()
        with open(self._path, "ab", opener=open_regular) as file:  # a FIFO would be waited for
            file.write(data)

    def _rotate(self) -> None:
        for number in range(KEPT - 1, 0, -1):
            with suppress(FileNotFoundError):
                self._older(number).replace(self._older(number + 1))
        self._path.replace(self._older(1))

    def _older(self, number: int) -> Path:
        return self._path.with_name(f"{self._path.name}.{number}")

    def _fail(self, error: OSError) -> None:
        if not self._failed:
            self._failed = True
            reason = (error.strerror or str(error)).lower()
            self._on_failure(f"the log file {self._path} cannot be written: {reason}")


class ServiceLog:
    """Keeps the log file of SERVICE, of the configuration file CONFIG, at PATH; on the loop."""

    def __init__(self, service: MachineService, config: Path, path: Path) -> None:
        self._service = service
        self._loop = asyncio.get_running_loop()
        self._file = LogFile(path, self._report)
        self._file.add(lambda: _banner(config))
        self._starts = -1
        """The start whose configuration was written."""
        self._statistics = self._loop.create_task(self._follow())

    async def close(self) -> None:
        """Wait until all is written."""
        self._statistics.cancel()
        await asyncio.gather(self._statistics, return_exceptions=True)
        self._file.add(lambda: f"{_now()} the service ends")
        await asyncio.to_thread(self._file.close)

    def note(self, entry: Entry) -> None:
        """Write a line of the service's log, and the configuration when a machine has become ready."""
        self._file.add(lambda: _log_lines(entry))
        service = self._service
        machine = service.machine
        if machine is not None and service.state is ServiceState.READY and service.starts != self._starts:
            self._starts = service.starts
            config = machine.modules.config
            self._file.add(lambda: _configuration(config))

    async def _follow(self) -> None:
        while True:
            await asyncio.sleep(STATISTICS_S)
            values = self._service.tree.snapshot().values
            self._file.add(lambda values=values: _statistics(values))  # type: ignore[misc]

    def _report(self, sentence: str) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._service.log.add, "notice", sentence)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _banner(config: Path) -> str:
    return "\n".join(
        (
            f"======== canductor {VERSION}, {_now()}",
            f"configuration file: {config.absolute()}",
            f"Python {platform.python_version()}, {platform.platform()}, {os.cpu_count() or 1} processors",
            f"process {os.getpid()} of user {os.getuid()}: {' '.join(sys.argv)}".replace("\n", " "),
        )
    )


def _log_lines(entry: Entry) -> str:
    first, *others = str(entry["text"]).split("\n")
    return "\n".join((f"{entry['time']} {entry['kind']}: {first}", *(f"    {line}" for line in others)))


def _configuration(config: Mapping[str, Mapping[str, str]]) -> str:
    lines = ["======== configuration"]
    for section, options in config.items():
        lines.append(f"[{section}]")
        for name, value in options.items():
            first, *others = value.split("\n")
            lines += [f"{name} = {first}", *(f"    {line}" for line in others)]
    return "\n".join((*lines, "========"))


def _statistics(values: Mapping[str, Value]) -> str:
    shown = (
        f"{name}={value:g}" if isinstance(value, float) else f"{name}={value}"
        for name, value in values.items()
        if value is not None
        and (name.startswith(_SHOWN) or name.endswith(_HEAT))
        and not (name.endswith(_QUIET) or isinstance(value, dict | list))
    )
    return f"{_now()} statistics: {' '.join(shown)}"
