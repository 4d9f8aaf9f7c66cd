"""Announces one machine by multicast DNS: in a process of its own, for a coordinator that is its parent.

Whatever strangers send to the port of multicast DNS costs the coordinator nothing (docs/adr/0013). When the
coordinator dies of anything at all, standard input ends, and the announcement is withdrawn.

Arguments: the addresses that the machine's sockets are bound to. Input: the machine (Announcement) as a line
of JSON, again after each change. Output: sentences, each as a line of JSON.
"""

import asyncio
import contextlib
import dataclasses
import json
import signal
import sys
from collections.abc import Callable, Iterable
from typing import Final

from zeroconf import Error
from zeroconf.asyncio import AsyncServiceInfo, AsyncZeroconf

from coordinator.ipc.discovery.announcement import SERVICE_TYPE, Announcement, usable_addresses
from coordinator.ipc.discovery.multicast import (
    InterfaceAddress,
    interface_addresses,
    mdns_addresses,
    open_mdns,
    reachable_addresses,
)
from nodes.support.errors import CanductorError
from nodes.support.terminal import show
from nodes.support.termination import TERMINATION

RESCAN_S: Final = 10.0
"""Between checks whether this computer's addresses are still the same."""
UPDATE_SPACING_S: Final = 1.0
"""No record is sent more often to all (RFC 6762, section 6)."""
TTL_S: Final = 120
"""For how long others believe in a machine that vanished without withdrawing its announcement."""


class Announcer:
    """Keeps a machine announced at the addresses through which its sockets, BOUND to some, are reached.

    REPORT gets a sentence when something changes. FIND_ADDRESSES and OPEN_DNS are this computer's networks.
    """

    def __init__(
        self,
        bound: list[str],
        report: Callable[[str], None],
        *,
        find_addresses: Callable[[], tuple[InterfaceAddress, ...]] = interface_addresses,
        open_dns: Callable[[Iterable[str]], AsyncZeroconf] = open_mdns,
    ) -> None:
        self._bound = bound
        self._report_to = report
        self._find_addresses = find_addresses
        self._open_dns = open_dns
        self._machine: Announcement
        self._addresses: tuple[str, ...] = ()
        self._here: tuple[InterfaceAddress, ...] | None = None
        self._mdns: AsyncZeroconf | None = None
        self._info: AsyncServiceInfo | None = None
        self._changed = asyncio.Event()
        self._reported = ""

    def announce(self, machine: Announcement) -> None:
        """Announce MACHINE, whatever its addresses, from now on; changes that follow fast are merged."""
        self._machine = machine
        self._changed.set()

    async def run(self) -> None:
        """Announce until cancelled, then withdraw the announcement."""
        await self._changed.wait()
        try:
            while True:
                self._changed.clear()
                await self._update()
                await asyncio.sleep(UPDATE_SPACING_S)
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(RESCAN_S):
                        await self._changed.wait()
        finally:
            await self._close()

    async def _update(self) -> None:
        """Announce what is not announced yet, on the networks that there are now."""
        here = self._find_addresses()
        try:
            if here != self._here:
                self._here = None
                await self._close()
                await self._register(here)
                self._here = here
            elif self._info is not None and self._mdns is not None:
                fresh = self._service(self._info.name)
                if fresh.text != self._info.text:
                    self._info = fresh
                    await self._mdns.async_update_service(fresh)
        except CanductorError as error:
            self._report(str(error))

    async def _register(self, here: tuple[InterfaceAddress, ...]) -> None:
        reachable = reachable_addresses(self._bound, here)
        addresses = usable_addresses(str(each.address) for each in reachable)
        if not addresses:
            raise CanductorError(
                "there is no network to announce the machine on; it will be announced when there is one"
            )
        self._addresses = addresses
        self._mdns = self._open_dns(mdns_addresses(reachable, here))
        # With a part of the id, so that machines of one name stay apart, also those on two networks.
        info = self._service(f"{self._machine.name}-{self._machine.id[:8]}.{SERVICE_TYPE}")
        try:
            await (await self._mdns.async_register_service(info, allow_name_change=True))
        except (Error, OSError) as error:
            await self._close()
            raise CanductorError(
                f"multicast DNS refused the announcement: {error or type(error).__name__}"
            ) from None
        self._info = info
        label = info.name.removesuffix(f".{SERVICE_TYPE}")
        at = dataclasses.replace(self._machine, addresses=addresses).at
        self._report(f"announced as {label}: {', '.join(at)}")

    def _service(self, instance: str) -> AsyncServiceInfo:
        machine = self._machine
        return AsyncServiceInfo(
            SERVICE_TYPE,
            instance,
            port=machine.port,
            parsed_addresses=[*self._addresses],
            properties=machine.txt(),
            # Not the computer's own name: others announce that, with all its addresses.
            server=f"canductor-{machine.id}.local.",
            host_ttl=TTL_S,
            other_ttl=TTL_S,
        )

    async def _close(self) -> None:
        mdns, self._mdns, self._info = self._mdns, None, None
        if mdns is not None:
            await mdns.async_unregister_all_services()
            await mdns.async_close()

    def _report(self, sentence: str) -> None:
        """Report SENTENCE, once."""
        if sentence != self._reported:
            self._reported = sentence
            self._report_to(sentence)


async def follow(lines: asyncio.StreamReader, announcer: Announcer) -> None:
    """Have ANNOUNCER announce what LINES say, until they end; raises whatever ends announcing before."""
    running = asyncio.ensure_future(announcer.run())
    reading = asyncio.ensure_future(_read(lines, announcer))
    try:
        await asyncio.wait((running, reading), return_when=asyncio.FIRST_COMPLETED)
    finally:
        running.cancel()
        reading.cancel()
        ended = await asyncio.gather(running, reading, return_exceptions=True)
    for failure in ended:
        if isinstance(failure, Exception):
            raise failure


async def _read(lines: asyncio.StreamReader, announcer: Announcer) -> None:
    while line := await lines.readline():
        announcer.announce(Announcement(**json.loads(line)))


async def _main() -> None:
    lines = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(lines), sys.stdin.buffer
    )
    await follow(lines, Announcer(sys.argv[1:], _print))


def _print(sentence: str) -> None:
    show(json.dumps(sentence))


if __name__ == "__main__":
    # Ctrl-C, SIGHUP and a service manager's SIGTERM reach the parent, too, and end this when that is done.
    for number in (signal.SIGINT, *TERMINATION):
        signal.signal(number, signal.SIG_IGN)
    asyncio.run(_main())
