"""Announcing and finding machines: multicast DNS on loopback, with strangers who talk nonsense."""

import asyncio
import dataclasses
import os
import random
import shutil
import socket
import subprocess
import sys
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from ipaddress import ip_address
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from zeroconf import ServiceInfo
from zeroconf.asyncio import AsyncZeroconf

from coordinator.discover import Discovered, Found, find_machines
from coordinator.ipc.announcement import ADDRESSES_MAX, SERVICE_TYPE, Announcement, usable_addresses
from coordinator.ipc.announcer import Announcer
from coordinator.ipc.discovery import INSTANCES_MAX, Browser
from coordinator.ipc.multicast import Place, reached_at, spoken_on
from tests.coordinator.ipc.served import Served, serving
from tests.profiles import examples

EVERYWHERE = "0.0.0.0"  # noqa: S104 (the word, not a socket)
LIMIT_S = 60.0
"""Patience for a busy machine; it takes a twentieth of it."""


def machine(name: str, **other: Any) -> Announcement:
    plain = Announcement(
        name=name,
        host="here",
        version="0.1.0",
        state="startup",
        api=1,
        tls=False,
        id=f"{random.getrandbits(64):016x}",
        port=7125,
        addresses=("127.0.0.1",),
    )
    return dataclasses.replace(plain, **other)


def run(body: Callable[[], Coroutine[Any, Any, None]]) -> None:
    async def main() -> None:
        async with asyncio.timeout(LIMIT_S):
            await body()

    asyncio.run(main())


@asynccontextmanager
async def announced(*machines: Announcement) -> AsyncIterator[list[Announcer]]:
    announcers = [Announcer(each, ["127.0.0.1"], lambda _: None) for each in machines]
    try:
        for announcer in announcers:
            announcer.start()
        yield announcers
    finally:
        for announcer in announcers:
            await announcer.close()


async def until(browser: Browser, *wanted: Announcement) -> None:
    """Wait until BROWSER sees exactly those of WANTED, and none of the same ids that are others."""
    ids = {each.id for each in wanted}
    while {dataclasses.replace(each, change=0) for each in browser.machines if each.id in ids} != set(wanted):
        await browser.change()


# ------------------------------------------------------------------------------------------- the records


def test_what_is_written_is_read() -> None:
    one = machine("mini", tls=True, addresses=("10.0.0.7", "fd00::2"))
    txt = {key.encode(): value.encode() for key, value in one.txt().items()}
    assert Announcement.read(txt, one.port, reversed(one.addresses)) == one
    assert one.at == ("tls://10.0.0.7:7125", "tls://[fd00::2]:7125")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        (b"name", b""),
        (b"name", b"a b"),
        (b"name", b"\x1b[2J"),
        (b"name", b"n" * 49),
        (b"host", "größe".encode()),
        (b"host", b"\xff\xfe"),
        (b"version", b"1\n2"),
        (b"state", b"READY"),
        (b"state", None),
        (b"api", b"0"),
        (b"api", b"9" * 250),
        (b"tls", b"yes"),
        (b"id", b"0123"),
        (b"change", b"-1"),
    ],
)
def test_a_bad_word_makes_it_no_machine(key: bytes, value: bytes | None) -> None:
    one = machine("mini")
    txt: dict[bytes, bytes | None] = {k.encode(): v.encode() for k, v in one.txt().items()}
    assert Announcement.read(txt, one.port, one.addresses) == one
    assert Announcement.read(txt | {key: value}, one.port, one.addresses) is None
    del txt[key]
    assert Announcement.read(txt, one.port, one.addresses) is None


def test_without_port_or_address_it_is_no_machine() -> None:
    one = machine("mini")
    txt = {key.encode(): value.encode() for key, value in one.txt().items()}
    good = ["127.0.0.1"]
    assert Announcement.read(txt, 1, good) is not None
    for port, addresses in ((0, good), (None, good), (65536, good), (1, [EVERYWHERE])):
        assert Announcement.read(txt, port, addresses) is None
    there = Announcement.read(txt, 1, ["10.0.0.7", "127.0.0.1"])
    assert there is not None
    assert there.at == ("tcp://127.0.0.1:1",)  # nobody is told to send a token in the clear
    useless = ["fe80::1%eth0", "fe80::1", "224.0.0.251", "::", "nonsense", "", "fd00::2%eth0"]
    assert usable_addresses(useless) == ()
    assert len(usable_addresses(f"10.0.0.{n}" for n in range(100))) == ADDRESSES_MAX


@settings(max_examples=examples(50))
@given(
    st.dictionaries(st.sampled_from(sorted(machine("m").txt())), st.none() | st.binary(max_size=300)),
    st.none() | st.integers(),
    st.lists(st.text(max_size=50), max_size=20),
)
def test_reading_is_total(txt: dict[str, bytes | None], port: int | None, addresses: list[str]) -> None:
    assert Announcement.read({key.encode(): value for key, value in txt.items()}, port, addresses) is None


HERE = tuple(
    Place(ip_address(text), interface)
    for text, interface in (("127.0.0.1", 1), ("10.0.0.2", 2), ("10.0.1.2", 3), ("::1", 1), ("fd00::2", 2))
)


@pytest.mark.parametrize(
    ("bound", "reached", "spoken"),
    [
        (["127.0.0.1"], ["127.0.0.1"], ["127.0.0.1", "::1"]),
        (["::1"], ["::1"], ["127.0.0.1", "::1"]),
        ([EVERYWHERE], ["10.0.0.2", "10.0.1.2"], ["10.0.0.2", "10.0.1.2", "fd00::2"]),
        (["::"], ["fd00::2"], ["10.0.0.2", "fd00::2"]),
        ([EVERYWHERE, "::"], ["10.0.0.2", "10.0.1.2", "fd00::2"], ["10.0.0.2", "10.0.1.2", "fd00::2"]),
        (["10.0.1.2"], ["10.0.1.2"], ["10.0.1.2"]),
        (["192.168.7.7"], [], []),
    ],
)
def test_it_is_announced_where_its_sockets_are_reached(
    bound: list[str], reached: list[str], spoken: list[str]
) -> None:
    places = reached_at(bound, HERE)
    assert [str(place.address) for place in places] == reached
    assert list(spoken_on(places, HERE)) == spoken


# ------------------------------------------------------------------------------------- on the loopback


def test_machines_come_change_and_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coordinator.ipc.announcer.RESTART_S", 0.0)
    one, other = machine("same"), machine("same", port=7126)  # of one name, and stay apart

    async def body() -> None:
        async with Browser() as browser, announced(one, other) as (first, second):
            await until(browser, one, other)
            for state in ("ready", "printing", "shutdown"):
                first.state(state)
            await until(browser, dataclasses.replace(one, state="shutdown"), other)
            await second.close()
            await until(browser, dataclasses.replace(one, state="shutdown"))
            assert all(seen.id != other.id for seen in browser.machines)
            assert first.process is not None
            first.process.kill()  # and is begun again, with the state of now
            first.state("startup")
            await until(browser, one)

    run(body)


def test_a_coordinator_that_is_killed_is_seen_to_go() -> None:
    one = machine("killed")
    code = (
        "import asyncio; from coordinator.ipc.announcement import Announcement; "
        "from coordinator.ipc.announcer import Announcer\n"
        "async def main():\n"
        f"    Announcer({one!r}, ['127.0.0.1'], lambda line: print(line, flush=True)).start()\n"
        "    await asyncio.Event().wait()\n"
        "asyncio.run(main())"
    )

    async def body() -> None:
        async with Browser() as browser:
            process = await asyncio.create_subprocess_exec(sys.executable, "-c", code)
            try:
                await until(browser, one)
            finally:
                process.kill()
                await process.wait()
            while any(seen.id == one.id for seen in browser.machines):
                await browser.change()

    run(body)


def test_nonsense_is_skipped_and_counted() -> None:
    one = machine("sound")
    txt = one.txt()
    nonsense: list[tuple[dict[str, Any], list[str]]] = [
        ({}, ["127.0.0.1"]),
        (txt | {"name": "x" * 200, "more": "y" * 200}, ["127.0.0.1"]),
        (txt | {"state": b"\x00\xff\x1b[2J"}, ["127.0.0.1"]),
        (txt, [EVERYWHERE]),
    ]

    async def body() -> None:
        strangers = AsyncZeroconf(interfaces=["127.0.0.1"])
        try:
            infos = [
                ServiceInfo(
                    SERVICE_TYPE,
                    f"stranger-{number}-{one.id}.{SERVICE_TYPE}",
                    port=9,
                    properties=properties,
                    parsed_addresses=addresses,
                    server=f"stranger-{number}-{one.id}.local.",
                )
                for number, (properties, addresses) in enumerate(nonsense)
            ]
            await asyncio.gather(*(_register(strangers, info) for info in infos))
            async with Browser() as browser, announced(one):
                _send_noise()
                await until(browser, one)
                while browser.skipped < len(nonsense):
                    await browser.change()
                assert all("stranger" not in seen.name for seen in browser.machines)
        finally:
            await strangers.async_unregister_all_services()
            await strangers.async_close()

    run(body)


async def _register(mdns: AsyncZeroconf, info: ServiceInfo) -> None:
    await (await mdns.async_register_service(info, cooperating_responders=True))


def _send_noise() -> None:
    """Send what is no DNS at all, and what nearly is, to everybody on the loopback."""
    chance = random.Random(6)
    sound = b"\0\0\x84\0\0\0\0\1\0\0\0\0\x0b_canductor\x04_tcp\x05local\0\0\x0c\0\1\0\0\x11\x94\0\2\xc0\x0c"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        for n in range(200):
            noise = bytearray(sound if n % 2 else chance.randbytes(chance.randrange(1500)))
            for _ in range(n % 7):
                if noise:
                    noise[chance.randrange(len(noise))] = chance.randrange(256)
            sender.sendto(noise, ("224.0.0.251", 5353))


def test_more_announcements_than_anybody_has_are_counted_only() -> None:
    async def body() -> None:
        async with Browser() as browser:
            already = len(browser.machines) + browser.skipped

            class Added:
                name = "Added"

            for n in range(2 * INSTANCES_MAX + 50):
                browser._hear(name=f"flood-{n}.{SERVICE_TYPE}", state_change=Added)
            assert 2 * INSTANCES_MAX - already <= browser.skipped <= 2 * INSTANCES_MAX
            assert len(browser._asking) <= INSTANCES_MAX

    run(body)


# ----------------------------------------------------------------------------------- canductor discover


async def discover(ready: Callable[[Discovered], bool]) -> Discovered:
    """Discover until what is found is READY: a busy machine may answer late."""
    while not ready(found := await find_machines(1.0)):
        pass
    return found


def test_sockets_and_announcements_in_one_table(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = tmp_path / "canductor"
    folder.mkdir()
    here, other = machine("here", state="ready"), machine("else", tls=True, port=7127)

    async def body(served: Served) -> None:
        info = served.server._common.registry.methods["machine.info"]
        told = {"name": "here", "state": "ready", "host": "box", "version": "0.1.0", "id": here.id}
        object.__setattr__(info, "call", lambda _caller, _params: told)
        with socket.socket(socket.AF_UNIX) as nobody:
            nobody.bind(str(folder / "left-behind.sock"))  # and nobody listens

        def ready(found: Discovered) -> bool:
            addresses = {address for each in found.machines for address in each.at}
            return {str(served.path), here.at[0], other.at[0]} <= addresses

        async with announced(here, other):
            found = await discover(ready)
        first = found.machines[0]
        assert first == Found(
            "here", "ready", "box", "0.1.0", 1, (str(served.path), *here.at), here=True, id=here.id
        )
        assert any(each.at == other.at and each.name == "else" for each in found.machines)
        assert found.silent == [folder / "left-behind.sock"]
        text = found.to_text().splitlines()
        assert text[0].split() == ["name", "state", "computer", "version", "api", "--at"]
        assert text[1].split() == ["here", "ready", "box", "0.1.0", "1", str(served.path)]
        assert text[2].split() == [here.at[0]]
        assert any(line.startswith("nobody answers at") for line in text)

    async def main() -> None:
        async with serving(folder) as served:
            await body(served)

    run(main)


# ------------------------------------------------------------------------- computers with other networks


def need_own_networks() -> None:
    """Skip the test where nobody may make networks of his own, without any interface that is up."""
    if shutil.which("unshare") is None:
        pytest.skip("unshare is not installed: it makes a computer without networks")
    if subprocess.run(["unshare", "-rn", "true"], check=False, capture_output=True).returncode:
        pytest.skip("this system lets nobody make networks of his own (unshare -rn)")


def on_other_networks(code: str) -> str:
    """Run CODE where there is only a loopback that is down; return what it prints."""
    need_own_networks()
    ended = subprocess.run(
        ["unshare", "-rn", sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT_S,
        env=os.environ | {"XDG_RUNTIME_DIR": "/nowhere"},
    )
    assert not ended.stderr, ended.stderr
    assert ended.returncode == 0
    return ended.stdout


_DISCOVER = "from coordinator.cli import main; main(['discover', '--timeout', '0.2'])\n"


def test_a_computer_without_networks() -> None:
    said = on_other_networks(_DISCOVER)
    assert "no machine was found\nonly this computer was asked: this computer has no network address" in said


_LOOPBACK_UP = """
import fcntl, socket, struct
taken = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
fcntl.ioctl(taken, 0x8914, struct.pack("16sH14x", b"lo", 0x49))
taken.bind(("", 5353))
"""


def test_the_port_is_taken() -> None:
    said = on_other_networks(_LOOPBACK_UP + _DISCOVER)
    assert "multicast DNS (UDP port 5353) cannot be used: Address already in use" in said


def test_an_announcer_waits_for_a_network() -> None:
    code = """
import asyncio
from coordinator.ipc.announcement import Announcement
from coordinator.ipc.announcer import Announcer
async def main():
    told = asyncio.Queue()
    machine = Announcement(name="m", host="h", version="1", state="ready", api=1, tls=False, id="0" * 16,
                           port=7125, addresses=())
    announcer = Announcer(machine, ["0.0.0.0"], told.put_nowait)
    announcer.start()
    print(await told.get())
    announcer.state("printing")
    await announcer.close()
asyncio.run(main())
"""
    assert "it will be when there is" in on_other_networks(code)


def test_no_other_command_pays_for_it() -> None:
    code = (
        "import sys; from coordinator.cli import main; main(['plan', '--help']); main(['estop', '--help']); "
        "import coordinator.front_ends, coordinator.service.serve;"
        "sys.exit(any(m.split('.')[0] in ('zeroconf', 'ifaddr', 'prometheus_client') for m in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0
