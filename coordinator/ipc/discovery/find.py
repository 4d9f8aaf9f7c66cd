"""Finds machines: this user's on this computer, and those announced on its networks."""

import asyncio
import contextlib
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from coordinator.ipc.client.client import Client
from coordinator.ipc.discovery.announcement import Announcement, host_word
from coordinator.ipc.discovery.browser import Browser, OpenServices
from coordinator.ipc.discovery.multicast import interface_addresses
from coordinator.ipc.protocol.methods import Scope
from nodes.support.errors import CanductorError
from nodes.support.host_sockets import folder_problems, host_sockets
from nodes.support.terminal import printable

SOCKETS_MAX: Final = 64
"""Sockets that are queried; with more of them, name one."""
WORD_MAX: Final = 48


@dataclass(frozen=True, slots=True)
class Found:
    """One machine; AT: values for ``--at``, the best first."""

    name: str
    state: str
    host: str
    version: str
    api: int
    at: tuple[str, ...]
    here: bool
    """Whether it is one of this user's, by its socket."""
    id: str

    def to_json(self) -> Mapping[str, object]:
        """Return the fields by name, without the id."""
        values = asdict(self)
        del values["id"]
        return values | {"at": list(self.at)}


@dataclass(frozen=True, slots=True)
class Discovered:
    """The machines that were found, and what was left out."""

    machines: Sequence[Found]
    silent: Sequence[Path]
    """Sockets at which no machine answered."""
    refused: Sequence[str]
    """Why folders for sockets were not looked into."""
    skipped: int
    """Announcements without a reachable machine."""
    problem: str | None
    """Why the network could not be searched."""

    @property
    def ok(self) -> bool:
        """Always True: finding no machine is not a failure."""
        return True

    def to_json(self) -> Mapping[str, object]:
        """Return all of it by name."""
        return {
            "machines": [machine.to_json() for machine in self.machines],
            "silent_sockets": [str(path) for path in self.silent],
            "refused_folders": list(self.refused),
            "skipped": self.skipped,
            "problem": self.problem,
        }

    def to_text(self) -> str:
        """Return a table, and a line for each thing left out."""
        lines = _table(self.machines) if self.machines else ["no machine was found"]
        if self.silent:
            lines.append(f"no machine answers at {', '.join(map(str, self.silent))}")
        lines += self.refused
        if self.skipped:
            lines.append(f"invalid announcements: {self.skipped}")
        if self.problem is not None:
            lines.append(f"only this computer was searched: {self.problem}")
        return "\n".join(lines)


def _table(machines: Sequence[Found]) -> list[str]:
    rows = [("name", "state", "computer", "version", "api", "--at")]
    for machine in machines:
        first = (machine.name, machine.state, machine.host, machine.version, str(machine.api), machine.at[0])
        rows.append(first)
        rows += [("", "", "", "", "", address) for address in machine.at[1:]]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(f"{word:{width}}" for word, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


async def find_machines(timeout_s: float, listen: OpenServices | None = None) -> Discovered:
    """Return the machines that answer within TIMEOUT_S; LISTEN as of Browser."""
    paths = host_sockets()[:SOCKETS_MAX]
    asking = asyncio.gather(*(_ask(path, timeout_s) for path in paths))
    announced, skipped, problem = await _browse(timeout_s, listen)
    asked = await asking
    found = [machine for machine in asked if machine is not None]
    silent = [path for path, machine in zip(paths, asked, strict=True) if machine is None]
    own = {str(each.address) for each in interface_addresses()}
    for machine in announced:
        _add(found, machine, own)
    found.sort(key=lambda machine: (not machine.here, machine.name, machine.host, machine.at))
    return Discovered(found, silent, folder_problems(), skipped, problem)


def _add(found: list[Found], announced: Announcement, own: set[str]) -> None:
    """Add a machine, or its addresses to the one that was found already.

    Only addresses of this computer are added to a machine of this computer: an announcement proves nothing.
    """
    if own.issuperset(announced.addresses):
        for place, machine in enumerate(found):
            if machine.here and machine.id == announced.id:
                found[place] = replace(machine, at=machine.at + announced.at)
                return
    a = announced
    found.append(Found(a.name, a.state, a.host, a.version, a.api, a.at, here=False, id=a.id))


async def _browse(
    timeout_s: float, listen: OpenServices | None
) -> tuple[list[Announcement], int, str | None]:
    try:
        async with Browser(listen) as browser:
            await asyncio.sleep(timeout_s)
            return browser.machines, browser.skipped, None
    except CanductorError as error:
        return [], 0, str(error)


async def _ask(path: Path, timeout_s: float) -> Found | None:
    """Return the machine that serves at PATH; None without a valid answer."""
    with contextlib.suppress(
        CanductorError, TimeoutError, LookupError, TypeError, AttributeError, ValueError
    ):
        async with asyncio.timeout(timeout_s):
            async with Client(str(path), scope=Scope.WATCH, timeout_s=timeout_s) as client:
                info: dict[str, Any] = await client.call("machine.info")
                api = 0 if client.hello is None else int(client.hello.version)
                return Found(
                    name=_word(info["name"]),
                    state=_word(info["state"]),
                    host=host_word(_word(info.get("host", platform.node()))),
                    version=_word(info["version"]),
                    api=api,
                    at=(str(path),),
                    here=True,
                    id=_word(info.get("id", "")),
                )
    return None


def _word(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError
    return printable(value[:WORD_MAX])
