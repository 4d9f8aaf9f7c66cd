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
"""For the port, addresses and TXT record of an announcement to arrive."""


class Services(Protocol):
    """The services of our type that are announced on the networks."""

    async def resolve(self, instance: str) -> Announcement | None:
        """Return what INSTANCE says, within RESOLVE_S; None: nothing that is a machine one could reach."""
        ...

    async def close(self) -> None:
        """Stop listening."""
        ...


ChangeHandler = Callable[[str, bool], None]
"""Gets the name of an instance, and whether it is there (it was added, or updated) or gone."""
OpenServices = Callable[[ChangeHandler], Awaitable[Services]]
"""Starts listening to the networks; raises CanductorError when there is none."""


class Browser:
    """Machines as they come, change and go; ``async with Browser() as browser``.

    LISTEN is for other networks than this computer's. Raises CanductorError on entering when there is no
    network to ask. Garbage is skipped and counted.
    """

    def __init__(self, listen: OpenServices | None = None) -> None:
        self._listen: OpenServices = _Multicast.listen if listen is None else listen
        self._known: dict[str, Announcement | None] = {}  # by instance; None: not known yet, or garbage
        self._beyond: set[str] = set()
        self._resolving: dict[str, asyncio.Task[None]] = {}
        self._stale: set[str] = set()  # instances that said something since they were last asked
        self._changed = asyncio.Event()
        self._services: Services

    @property
    def machines(self) -> list[Announcement]:
        """All that are there now, by name and computer."""
        known = (machine for machine in self._known.values() if machine is not None)
        return sorted(known, key=lambda machine: (machine.name, machine.host, machine.at))

    @property
    def skipped(self) -> int:
        """Announcements of no machine that can be reached (yet), and those beyond the most."""
        return sum(1 for machine in self._known.values() if machine is None) + len(self._beyond)

    async def change(self) -> None:
        """Wait for ``machines`` or ``skipped`` to be others than when this was last waited for."""
        await self._changed.wait()
        self._changed.clear()

    async def __aenter__(self) -> Self:
        self._services = await self._listen(self._handle_change)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        asking = list(self._resolving.values())
        for task in asking:
            task.cancel()
        await asyncio.gather(*asking, return_exceptions=True)
        await self._services.close()

    def _handle_change(self, name: str, there: bool) -> None:
        """Take that the instance NAME was added or updated, or is not THERE any more."""
        if not there:
            self._forget(name)
            return
        if name not in self._known and len(self._known) >= INSTANCES_MAX:
            if len(self._beyond) < INSTANCES_MAX:
                self._beyond.add(name)
                self._changed.set()
            return
        if name not in self._known:
            self._known[name] = None
            self._changed.set()
        self._stale.add(name)
        if name not in self._resolving:
            self._resolving[name] = asyncio.ensure_future(self._resolve(name))

    def _forget(self, name: str) -> None:
        if (task := self._resolving.pop(name, None)) is not None:
            task.cancel()
        self._stale.discard(name)
        self._beyond.discard(name)
        self._known.pop(name, None)
        self._changed.set()

    async def _resolve(self, name: str) -> None:
        """Learn what the instance NAME says, and again whatever it says meanwhile."""
        while name in self._stale:
            self._stale.discard(name)
            machine = await self._services.resolve(name)
            if machine != self._known.get(name):
                self._known[name] = machine
                self._changed.set()
        del self._resolving[name]


class _Multicast:
    """Multicast DNS on all networks of this computer."""

    def __init__(self, mdns: AsyncZeroconf, on_change: ChangeHandler) -> None:
        def handle(*, name: str, state_change: Any, **_: object) -> None:
            on_change(name, state_change.name != "Removed")

        self._mdns = mdns
        self._browser: AsyncServiceBrowser = AsyncServiceBrowser(
            mdns.zeroconf, SERVICE_TYPE, handlers=[handle]
        )

    @classmethod
    async def listen(cls, on_change: ChangeHandler) -> Self:
        """Begin; raises CanductorError when there is no network."""
        here = await asyncio.to_thread(interface_addresses)
        return cls(open_mdns(str(each.address) for each in here), on_change)

    async def resolve(self, instance: str) -> Announcement | None:
        """Ask the network."""
        # What strangers call themselves need not be a name of the type asked for.
        with contextlib.suppress(Error, ValueError):
            info = AsyncServiceInfo(SERVICE_TYPE, instance)
            if await info.async_request(self._mdns.zeroconf, RESOLVE_S * 1e3):
                return Announcement.read(info.properties, info.port, info.parsed_scoped_addresses())
        return None

    async def close(self) -> None:
        """Stop listening."""
        await self._browser.async_cancel()
        await self._mdns.async_close()
