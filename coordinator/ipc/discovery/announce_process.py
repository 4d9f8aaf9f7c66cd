"""The process that announces one machine on the network, for a coordinator that is its parent.

A process of its own: whatever strangers send to the port of multicast DNS costs the coordinator nothing, and
when that dies of anything at all, its end of standard input closes and the network is told good-bye.

Lines of JSON. In: first the machine (all of Announcement but ``addresses``) with ``bound``, the addresses of
its sockets; then ``{"state": …, "change": …}``. Out: ``{"announced": …}`` or ``{"failed": …}``, sentences.
"""

import asyncio
import dataclasses
import json
import signal
import sys
from collections.abc import AsyncIterator, Callable, Iterable
from typing import Any, Final

from zeroconf import Error
from zeroconf.asyncio import AsyncServiceInfo, AsyncZeroconf

from coordinator.ipc.discovery.announcement import SERVICE_TYPE, Announcement, usable_addresses
from coordinator.ipc.discovery.multicast import Place, open_mdns, places, reached_at, spoken_on
from nodes.support.errors import CanductorError

RESCAN_S: Final = 10.0
"""How often it is looked whether this computer's addresses are still the same."""
UPDATE_SPACING_S: Final = 1.0
"""No record is sent more often to all (RFC 6762, section 6)."""
TTL_S: Final = 120
"""For how long others believe in a machine that vanished without a good-bye."""


class Announcing:
    """Keeps MACHINE announced at the addresses through which its sockets, BOUND to some, are reached.

    SAY gets a kind and a sentence. FIND_PLACES and OPEN_DNS are this computer's networks.
    """

    def __init__(
        self,
        machine: Announcement,
        bound: list[str],
        say: Callable[[str, str], None],
        *,
        find_places: Callable[[], tuple[Place, ...]] = places,
        open_dns: "Callable[[Iterable[str]], AsyncZeroconf]" = open_mdns,
    ) -> None:
        self._machine = machine
        self._bound = bound
        self._say_to = say
        self._find_places = find_places
        self._open_dns = open_dns
        self._here: tuple[Place, ...] | None = None
        self._mdns: AsyncZeroconf | None = None
        self._info: AsyncServiceInfo | None = None
        self._woken = asyncio.Event()
        self._said = ""

    def state(self, state: str, change: int) -> None:
        """Have STATE announced; states that follow fast are merged."""
        self._machine = dataclasses.replace(self._machine, state=state, change=change)
        self._woken.set()

    async def run(self) -> None:
        """Announce until cancelled, then say good-bye."""
        try:
            while True:
                await self._look()
                await asyncio.sleep(UPDATE_SPACING_S)
                try:
                    async with asyncio.timeout(RESCAN_S):
                        await self._woken.wait()
                except TimeoutError:
                    pass
                self._woken.clear()
        finally:
            await self._close()

    async def _look(self) -> None:
        """Announce what is not announced yet, on the networks that there are now."""
        here = self._find_places()
        try:
            if here != self._here:
                self._here = None
                await self._close()
                await self._begin(here)
                self._here = here
            elif self._info is not None and self._mdns is not None:
                fresh = self._service(self._info.name)
                if fresh.text != self._info.text:
                    self._info = fresh
                    await self._mdns.async_update_service(fresh)
        except CanductorError as error:
            self._say("failed", str(error))

    async def _begin(self, here: tuple[Place, ...]) -> None:
        reached = reached_at(self._bound, here)
        addresses = usable_addresses(str(place.address) for place in reached)
        if not addresses:
            raise CanductorError("there is no network to announce the machine on; it will be when there is")
        self._machine = dataclasses.replace(self._machine, addresses=addresses)
        self._mdns = self._open_dns(spoken_on(reached, here))
        # With a part of the id, so that machines of one name stay apart, also those on two networks.
        info = self._service(f"{self._machine.name}-{self._machine.id[:8]}.{SERVICE_TYPE}")
        try:
            await (await self._mdns.async_register_service(info, allow_name_change=True))
        except (Error, OSError) as error:
            await self._close()
            raise CanductorError(
                f"multicast DNS took no announcement: {error or type(error).__name__}"
            ) from None
        self._info = info
        label = info.name.removesuffix(f".{SERVICE_TYPE}")
        self._say("announced", f"announced as {label}: {', '.join(self._machine.at)}")

    def _service(self, instance: str) -> "AsyncServiceInfo":
        machine = self._machine
        return AsyncServiceInfo(
            SERVICE_TYPE,
            instance,
            port=machine.port,
            parsed_addresses=[*machine.addresses],
            properties=machine.txt(),
            # Not the computer's own name: that is for whoever else announces it, with all its addresses.
            server=f"canductor-{machine.id}.local.",
            host_ttl=TTL_S,
            other_ttl=TTL_S,
        )

    async def _close(self) -> None:
        mdns, self._mdns, self._info = self._mdns, None, None
        if mdns is not None:
            await mdns.async_unregister_all_services()
            await mdns.async_close()

    def _say(self, kind: str, sentence: str) -> None:
        """Tell the parent, once."""
        if sentence != self._said:
            self._said = sentence
            self._say_to(kind, sentence)


async def follow(lines: AsyncIterator[dict[str, Any]], announce: Callable[..., Announcing]) -> None:
    """Announce the machine of the first of LINES, with the states of the others, until they end.

    ANNOUNCE gets the machine and the addresses of its sockets.
    """
    first = await anext(lines)
    bound = first.pop("bound")
    announcing = announce(Announcement(**first, addresses=()), bound)
    running = asyncio.ensure_future(announcing.run())
    running.add_done_callback(_end_with)
    try:
        async for line in lines:
            announcing.state(line["state"], line["change"])
    finally:
        running.remove_done_callback(_end_with)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def lines_of(reader: asyncio.StreamReader) -> AsyncIterator[dict[str, Any]]:
    """Read lines of JSON."""
    while line := await reader.readline():
        yield json.loads(line)


async def _main() -> None:
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), sys.stdin.buffer
    )
    await follow(lines_of(reader), lambda machine, bound: Announcing(machine, bound, _say))


def _say(kind: str, sentence: str) -> None:
    sys.stdout.write(json.dumps({kind: sentence}) + "\n")
    sys.stdout.flush()


def _end_with(running: "asyncio.Future[None]") -> None:
    """End the process when announcing ends by a mistake: the parent begins anew."""
    sys.stderr.write(f"canductor: announcing ended: {running.exception()!r}\n")
    sys.exit(1)


if __name__ == "__main__":
    # Ctrl-C and a service manager's SIGTERM reach the parent, too, and end this when that is done.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    asyncio.run(_main())
