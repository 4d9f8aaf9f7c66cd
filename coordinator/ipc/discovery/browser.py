"""Finds the machines that are announced on the networks of this computer, and sees them change and go."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import Any, Final, Protocol, Self

from zeroconf import Error
from zeroconf.asyncio import AsyncServiceBrowser, AsyncServiceInfo, AsyncZeroconf

from coordinator.ipc.discovery.announcement import SERVICE_TYPE, Announcement
from coordinator.ipc.discovery.multicast import interface_addresses, open_mdns

INSTANCES_MAX: Final = 256
"""Announcements that are looked at; further ones are counted."""
RESOLVE_S: Final = 10.0
"""For an announcement to tell its port, addresses and TXT record."""


class Services(Protocol):
    """The services of our type that are announced on the networks."""

    async def resolve(self, instance: str) -> Announcement | None:
        """Return what INSTANCE says, within RESOLVE_S; None: nothing that is a machine one could reach."""
        ...

    async def close(self) -> None:
        """Listen no more."""
        ...


Heard = Callable[[str, bool], None]
"""Gets the name of an instance, and whether it is there (it was added, or updated) or gone."""
Listen = Callable[[Heard], Awaitable[Services]]
"""Begins to listen to the networks; raises CanductorError when there is none."""


class Browser:
    """Machines as they come, change and go; ``async with Browser() as browser``.

    LISTEN is for other networks than this computer's. Raises CanductorError on entering when there is no
    network to ask. Garbage is skipped and counted.
    """

    def __init__(self, listen: Listen | None = None) -> None:
        self._listen: Listen = _Multicast.listen if listen is None else listen
        self._told: dict[str, Announcement | None] = {}  # by instance; None: not known yet, or garbage
        self._beyond: set[str] = set()
        self._asking: dict[str, asyncio.Task[None]] = {}
        self._stale: set[str] = set()  # instances that said something since they were last asked
        self._changed = asyncio.Event()
        self._services: Services

    @property
    def machines(self) -> list[Announcement]:
        """All that are there now, by name and computer."""
        known = (machine for machine in self._told.values() if machine is not None)
        return sorted(known, key=lambda machine: (machine.name, machine.host, machine.at))

    @property
    def skipped(self) -> int:
        """Announcements that told no machine one could reach (yet), and those beyond the most."""
        return sum(1 for machine in self._told.values() if machine is None) + len(self._beyond)

    async def change(self) -> None:
        """Wait for ``machines`` or ``skipped`` to be others than when this was last waited for."""
        await self._changed.wait()
        self._changed.clear()

    async def __aenter__(self) -> Self:
        self._services = await self._listen(self._hear)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        asking = list(self._asking.values())
        for task in asking:
            task.cancel()
        await asyncio.gather(*asking, return_exceptions=True)
        await self._services.close()

    def _hear(self, name: str, there: bool) -> None:
        """Take that the instance NAME was added or updated, or is not THERE any more."""
        if not there:
            self._forget(name)
            return
        if name not in self._told and len(self._told) >= INSTANCES_MAX:
            if len(self._beyond) < INSTANCES_MAX:
                self._beyond.add(name)
                self._changed.set()
            return
        if name not in self._told:
            self._told[name] = None
            self._changed.set()
        self._stale.add(name)
        if name not in self._asking:
            self._asking[name] = asyncio.ensure_future(self._ask(name))

    def _forget(self, name: str) -> None:
        if (task := self._asking.pop(name, None)) is not None:
            task.cancel()
        self._stale.discard(name)
        self._beyond.discard(name)
        self._told.pop(name, None)
        self._changed.set()

    async def _ask(self, name: str) -> None:
        """Learn what the instance NAME says, and again whatever it says meanwhile."""
        while name in self._stale:
            self._stale.discard(name)
            machine = await self._services.resolve(name)
            if machine != self._told.get(name):
                self._told[name] = machine
                self._changed.set()
        del self._asking[name]


class _Multicast:
    """Multicast DNS on all networks of this computer."""

    def __init__(self, mdns: AsyncZeroconf, heard: Heard) -> None:
        def handle(*, name: str, state_change: Any, **_: object) -> None:
            heard(name, state_change.name != "Removed")

        self._mdns = mdns
        self._browser: AsyncServiceBrowser = AsyncServiceBrowser(
            mdns.zeroconf, SERVICE_TYPE, handlers=[handle]
        )

    @classmethod
    async def listen(cls, heard: Heard) -> Self:
        """Begin; raises CanductorError when there is no network."""
        here = await asyncio.to_thread(interface_addresses)
        return cls(open_mdns(str(each.address) for each in here), heard)

    async def resolve(self, instance: str) -> Announcement | None:
        """Ask the network."""
        # What strangers call themselves need not be a name of the type asked for.
        with contextlib.suppress(Error, ValueError):
            info = AsyncServiceInfo(SERVICE_TYPE, instance)
            if await info.async_request(self._mdns.zeroconf, RESOLVE_S * 1e3):
                return Announcement.read(info.properties, info.port, info.parsed_scoped_addresses())
        return None

    async def close(self) -> None:
        """Listen no more."""
        await self._browser.async_cancel()
        await self._mdns.async_close()
