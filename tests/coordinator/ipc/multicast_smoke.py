"""Announces a machine from one process, browses in another, and kills the first; prints what was seen.

To be run on networks of its own: it listens for everything of its type.
"""

import asyncio
import os
import random
import signal
import socket
import sys

from coordinator.ipc.discovery.announcement import Announcement
from coordinator.ipc.discovery.announcer_process import AnnouncerProcess
from coordinator.ipc.discovery.browser import Browser

_MACHINE = Announcement(
    name="mini",
    host="here",
    version="1",
    state="startup",
    api=1,
    tls=False,
    id="0" * 16,
    port=7125,
    addresses=("127.0.0.1",),
)
# A question for the instances of our type, as an answer.
_SOUND = b"\0\0\x84\0\0\0\0\1\0\0\0\0\x0b_canductor\x04_tcp\x05local\0\0\x0c\0\1\0\0\x11\x94\0\2\xc0\x0c"


def main() -> None:
    child = os.fork()
    asyncio.run(_announce() if child == 0 else _browse(child))
    sys.stdout.write("seen to come and to go\n")


async def _announce() -> None:
    announcer = AnnouncerProcess(_MACHINE, ["127.0.0.1"], lambda _: None)
    announcer.start()
    announcer.set_state("ready")
    await asyncio.Event().wait()


async def _browse(child: int) -> None:
    async with Browser() as browser:
        while [each.state for each in browser.machines] != ["ready"]:
            await browser.change()
        _send_noise()
        os.kill(child, signal.SIGKILL)  # its announcer sees that, and withdraws the announcement
        while browser.machines:
            await browser.change()


def _send_noise() -> None:
    """Send what is no DNS at all, and what nearly is, to everybody on the loopback."""
    chance = random.Random(6)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        for n in range(200):
            noise = bytearray(_SOUND if n % 2 else chance.randbytes(chance.randrange(1500)))
            for _ in range(n % 7):
                if noise:
                    noise[chance.randrange(len(noise))] = chance.randrange(256)
            sender.sendto(noise, ("224.0.0.251", 5353))
