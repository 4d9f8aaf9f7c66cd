"""A network in memory: who announces registers records with it, who browses hears of them. Takes no time."""

import asyncio
from collections.abc import Iterable
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any, cast

from coordinator.ipc.discovery.announcement import Announcement
from coordinator.ipc.discovery.announcer import Announcer, follow
from coordinator.ipc.discovery.browser import ChangeHandler
from coordinator.ipc.discovery.multicast import InterfaceAddress
from nodes.support.errors import CanductorError

if TYPE_CHECKING:
    from zeroconf import ServiceInfo
    from zeroconf.asyncio import AsyncZeroconf


class MemoryNetwork:
    """Its records, and those who listen."""

    def __init__(self) -> None:
        self.addresses: tuple[InterfaceAddress, ...] = (InterfaceAddress(ip_address("127.0.0.1"), 1),)
        self.problem = ""
        """Why nobody can speak; empty: they can."""
        self.records: dict[str, ServiceInfo] = {}
        self.sent_s: list[float] = []
        """When a record was sent to all, by the loop's time."""
        self.listeners: list[ChangeHandler] = []

    def find_addresses(self) -> tuple[InterfaceAddress, ...]:
        return self.addresses

    def open_dns(self, addresses: Iterable[str]) -> "AsyncZeroconf":
        """Stand where zeroconf does."""
        if self.problem:
            raise CanductorError(self.problem)
        assert list(addresses)
        return cast("AsyncZeroconf", _Speaker(self))

    async def listen(self, on_change: ChangeHandler) -> "_Listener":
        """Stand where a browser of zeroconf does."""
        self.listeners.append(on_change)
        for name in self.records:
            on_change(name, True)
        return _Listener(self, on_change)

    def put(self, info: "ServiceInfo") -> None:
        self.records[info.name] = info
        self.sent_s.append(asyncio.get_running_loop().time())
        for on_change in self.listeners:
            on_change(info.name, True)

    def remove(self, name: str) -> None:
        del self.records[name]
        for on_change in self.listeners:
            on_change(name, False)


class _Speaker:
    """What an announcer asks of AsyncZeroconf."""

    def __init__(self, network: MemoryNetwork) -> None:
        self._network = network
        self._own: list[str] = []

    async def async_register_service(self, info: "ServiceInfo", *, allow_name_change: bool) -> Any:
        assert allow_name_change
        self._own.append(info.name)
        self._network.put(info)
        return asyncio.sleep(0)

    async def async_update_service(self, info: "ServiceInfo") -> None:
        assert info.name in self._own
        self._network.put(info)

    async def async_unregister_all_services(self) -> None:
        for name in self._own:
            self._network.remove(name)
        self._own.clear()

    async def async_close(self) -> None:
        assert not self._own, "others would believe in it until its time to live is over"


class _Listener:
    def __init__(self, network: MemoryNetwork, on_change: ChangeHandler) -> None:
        self._network = network
        self._heard = on_change

    async def resolve(self, instance: str) -> Announcement | None:
        await asyncio.sleep(0)
        info = self._network.records.get(instance)
        if info is None:
            return None
        return Announcement.read(info.properties, info.port, info.parsed_scoped_addresses())

    async def close(self) -> None:
        self._network.listeners.remove(self._heard)


class MemoryProcess:
    """Stands where the process of an announcer does: its code on this loop, its pipes in memory."""

    def __init__(self, network: MemoryNetwork, bound: list[str]) -> None:
        self.stdin = _Pipe()
        self.stdout = asyncio.StreamReader()
        self._task = asyncio.ensure_future(self._run(network, bound))

    async def _run(self, network: MemoryNetwork, bound: list[str]) -> None:
        def report(sentence: str) -> None:
            self.stdout.feed_data(f'"{sentence}"\n'.encode())

        announcer = Announcer(bound, report, find_addresses=network.find_addresses, open_dns=network.open_dns)
        try:
            await follow(self.stdin.reader, announcer)
        finally:
            self.stdout.feed_eof()

    def kill(self) -> None:
        """End it without a good-bye being awaited by anybody."""
        self._task.cancel()

    async def wait(self) -> int:
        await asyncio.wait([self._task])
        return 0


class _Pipe:
    """A writer and the reader at its other end."""

    def __init__(self) -> None:
        self.reader = asyncio.StreamReader()

    def write(self, data: bytes) -> None:
        self.reader.feed_data(data)

    async def drain(self) -> None:
        await asyncio.sleep(0)

    def close(self) -> None:
        self.reader.feed_eof()
