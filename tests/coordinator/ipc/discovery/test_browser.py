"""Announcing and finding machines: on a network in memory, in virtual time; once on multicast DNS itself."""

import asyncio
import dataclasses
import random
import socket
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from zeroconf import ServiceInfo

from coordinator.ipc.discovery.announcement import ADDRESSES_MAX, SERVICE_TYPE, Announcement, usable_addresses
from coordinator.ipc.discovery.announcer import RESCAN_S, UPDATE_SPACING_S, Announcer
from coordinator.ipc.discovery.announcer_process import RESTART_S, AnnouncerProcess
from coordinator.ipc.discovery.browser import INSTANCES_MAX, Browser
from coordinator.ipc.discovery.find import Found, find_machines
from coordinator.ipc.discovery.multicast import (
    InterfaceAddress,
    mdns_addresses,
    reachable_addresses,
)
from tests.coordinator.ipc.memory_network import MemoryNetwork, MemoryProcess
from tests.coordinator.ipc.served import serving
from tests.profiles import examples
from tests.stages import jump_loop
from tests.stages.own_networks import LOOPBACK_UP, on_own_networks
from tests.stages.own_sockets import own_sockets

if TYPE_CHECKING:
    from asyncio.subprocess import Process

EVERYWHERE = "0.0.0.0"  # noqa: S104 (the word, not a socket)


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
    InterfaceAddress(ip_address(text), interface)
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
    found = reachable_addresses(bound, HERE)
    assert [str(each.address) for each in found] == reached
    assert list(mdns_addresses(found, HERE)) == spoken


# -------------------------------------------------------------------------------------------- announcing


class Announced:
    """A machine that is announced in virtual time, without a process."""

    def __init__(self, network: MemoryNetwork, one: Announcement, bound: str = "127.0.0.1") -> None:
        self.said: list[str] = []
        self._machine = dataclasses.replace(one, addresses=())
        self._announcer = Announcer(
            [bound],
            self.said.append,
            find_addresses=network.find_addresses,
            open_dns=network.open_dns,
        )
        self._announcer.announce(self._machine)
        self._task = asyncio.ensure_future(self._announcer.run())

    def set_state(self, state: str, change: int) -> None:
        self._announcer.announce(dataclasses.replace(self._machine, state=state, change=change))

    async def end(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)


def seen(browser: Browser) -> list[Announcement]:
    """Return what BROWSER sees, but for the number of changes."""
    return [dataclasses.replace(each, change=0) for each in browser.machines]


def test_machines_come_change_and_go() -> None:
    one, other = machine("same", id="1" * 16), machine("same", id="2" * 16, port=7126)

    async def main() -> None:
        network = MemoryNetwork()
        async with Browser(network.listen) as browser:
            first, second = Announced(network, one), Announced(network, other)
            await asyncio.sleep(UPDATE_SPACING_S)
            assert seen(browser) == [one, other], "of one name, and apart"
            assert first.said == ["announced as same-11111111: tcp://127.0.0.1:7125"]
            for change, state in enumerate(("ready", "printing", "shutdown"), 1):
                first.set_state(state, change)
            await asyncio.sleep(UPDATE_SPACING_S)
            assert seen(browser) == [dataclasses.replace(one, state="shutdown"), other]
            await second.end()
            assert [each.port for each in browser.machines] == [one.port]
            async with Browser(network.listen) as late:
                await late.change()
                await asyncio.sleep(1)
                assert [each.state for each in late.machines] == ["shutdown"]
            await first.end()
            assert browser.machines == []
            assert (len(first.said), len(second.said)) == (1, 1)

    jump_loop.run(main())


def test_states_that_follow_fast_are_merged() -> None:
    async def main() -> None:
        network = MemoryNetwork()
        announced = Announced(network, machine("mini"))
        for change in range(1, 100):
            announced.set_state("ready" if change % 2 else "printing", change)
            await asyncio.sleep(0.1)
        await asyncio.sleep(2 * UPDATE_SPACING_S)
        spacing_s = [b - a for a, b in zip(network.sent_s, network.sent_s[1:], strict=False)]
        assert len(spacing_s) >= 8
        assert min(spacing_s) == pytest.approx(UPDATE_SPACING_S)
        (info,) = network.records.values()
        assert info.properties[b"change"] == b"99"
        await announced.end()

    jump_loop.run(main())


def test_an_announcer_waits_for_a_network_and_follows_it() -> None:
    async def main() -> None:
        network = MemoryNetwork()
        network.addresses = (InterfaceAddress(ip_address("127.0.0.1"), 1),)
        announced = Announced(network, machine("mini", tls=True), EVERYWHERE)
        await asyncio.sleep(3 * RESCAN_S)
        waits = "there is no network to announce the machine on; it will be announced when there is one"
        assert announced.said == [waits], "once"
        network.addresses += (InterfaceAddress(ip_address("10.0.0.7"), 2),)
        network.problem = "the port is taken"
        await asyncio.sleep(RESCAN_S + UPDATE_SPACING_S)
        assert announced.said[1:] == ["the port is taken"]
        network.problem = ""
        announced.set_state("printing", 1)
        await asyncio.sleep(RESCAN_S + UPDATE_SPACING_S)
        assert len(announced.said) == 3
        assert announced.said[2].endswith(": tls://10.0.0.7:7125")
        network.addresses = (InterfaceAddress(ip_address("10.0.9.9"), 2),)
        await asyncio.sleep(RESCAN_S + UPDATE_SPACING_S)
        async with Browser(network.listen) as browser:
            await asyncio.sleep(1)
            assert [(each.state, each.addresses) for each in browser.machines] == [
                ("printing", ("10.0.9.9",))
            ]
        await announced.end()
        assert network.records == {}

    jump_loop.run(main())


def test_a_process_that_ends_is_begun_again_with_the_state_of_now() -> None:
    one = machine("mini")

    async def main() -> None:
        network, said, processes = MemoryNetwork(), list[str](), list[MemoryProcess]()

        async def launch(bound: list[str]) -> "Process":
            if len(processes) == 1 and len(said) == 2:
                raise PermissionError(13, "Permission denied")
            processes.append(MemoryProcess(network, bound))
            return cast("Process", processes[-1])

        announcer = AnnouncerProcess(one, ["127.0.0.1"], said.append, launch=launch)
        announcer.start()
        announcer.set_state("ready")
        async with Browser(network.listen) as browser:
            await asyncio.sleep(2 * UPDATE_SPACING_S)
            assert [each.state for each in browser.machines] == ["ready"]
            processes[0].kill()
            announcer.set_state("printing")
            await asyncio.sleep(RESTART_S / 2)
            assert browser.machines == []
            await asyncio.sleep(RESTART_S / 2 + UPDATE_SPACING_S)
            assert len(processes) == 1, "it could not be begun"
            await asyncio.sleep(RESTART_S + UPDATE_SPACING_S)
            assert [each.state for each in browser.machines] == ["printing"]
            await announcer.close()
            assert browser.machines == []
        assert [words.split(":")[0] for words in said] == [
            f"announced as mini-{one.id[:8]}",
            f"announcing the machine ended; it starts again in {RESTART_S:g} s",
            "the machine cannot be announced",
            f"announced as mini-{one.id[:8]}",
        ]

    jump_loop.run(main())


def test_a_process_that_is_killed_in_the_middle_of_a_line_is_begun_again() -> None:
    async def main() -> None:
        network, said, processes = MemoryNetwork(), list[str](), list[MemoryProcess]()

        async def launch(bound: list[str]) -> "Process":
            processes.append(MemoryProcess(network, bound))
            return cast("Process", processes[-1])

        announcer = AnnouncerProcess(machine("mini"), ["127.0.0.1"], said.append, launch=launch)
        announcer.start()
        await asyncio.sleep(UPDATE_SPACING_S)
        processes[0].stdout.feed_data(b'"announced as')
        processes[0].kill()
        await asyncio.sleep(RESTART_S + UPDATE_SPACING_S)
        assert len(processes) == 2
        await announcer.close()
        assert said[1] == f"announcing the machine failed; it starts again in {RESTART_S:g} s"

    jump_loop.run(main())


# ---------------------------------------------------------------------------------------------- browsing


def test_nonsense_is_skipped_and_counted() -> None:
    one = machine("sound")
    txt = one.txt()
    nonsense: list[tuple[dict[str, Any], list[str]]] = [
        ({}, ["127.0.0.1"]),
        (txt | {"name": "x" * 200, "more": "y" * 200}, ["127.0.0.1"]),
        (txt | {"state": b"\x00\xff\x1b[2J"}, ["127.0.0.1"]),
        (txt, [EVERYWHERE]),
    ]

    async def main() -> None:
        network = MemoryNetwork()
        for number, (properties, addresses) in enumerate([*nonsense, (txt, ["127.0.0.1"])]):
            name = f"stranger-{number}.{SERVICE_TYPE}"
            network.put(
                ServiceInfo(SERVICE_TYPE, name, 7125, properties=properties, parsed_addresses=addresses)
            )
        async with Browser(network.listen) as browser:
            await asyncio.sleep(1)
            assert browser.machines == [one]
            assert browser.skipped == len(nonsense)
            network.remove(f"stranger-0.{SERVICE_TYPE}")
            await browser.change()
            assert browser.skipped == len(nonsense) - 1

    jump_loop.run(main())


def test_more_announcements_than_anybody_has_are_counted_only() -> None:
    async def main() -> None:
        network = MemoryNetwork()
        async with Browser(network.listen) as browser:
            (on_change,) = network.listeners
            for n in range(2 * INSTANCES_MAX + 50):
                on_change(f"flood-{n}.{SERVICE_TYPE}", True)
            assert browser.skipped == 2 * INSTANCES_MAX
            assert len(browser._resolving) <= INSTANCES_MAX

    jump_loop.run(main())


def test_sockets_and_announcements_in_one_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own_sockets(monkeypatch, tmp_path)
    folder = tmp_path / "canductor"
    (shared := tmp_path / "shared").mkdir()
    shared.chmod(0o777)
    monkeypatch.setattr("nodes.support.host_sockets.SYSTEM_FOLDERS", (str(shared),))
    here, other = machine("here", state="ready"), machine("else", tls=True, port=7127)

    async def main() -> None:
        network = MemoryNetwork()
        async with serving(folder) as served:
            info = served.server._context.registry.methods["machine.info"]
            told = {"name": "here", "state": "ready", "host": "box", "version": "0.1.0", "id": here.id}
            object.__setattr__(info, "call", lambda _caller, _params: told)
            with socket.socket(socket.AF_UNIX) as nobody:
                nobody.bind(str(folder / "left-behind.sock"))  # and nobody listens
            announced = [Announced(network, each) for each in (here, other)]
            found = await find_machines(3.0, network.listen)
            for each in announced:
                await each.end()
        by_socket = (str(served.path), *here.at)
        assert list(found.machines) == [
            Found("here", "ready", "box", "0.1.0", 1, by_socket, here=True, id=here.id),
            Found("else", "startup", "here", "0.1.0", 1, other.at, here=False, id=other.id),
        ]
        assert found.silent == [folder / "left-behind.sock"]
        must = "must be a folder of this user's, no link, that nobody else may write to"
        assert list(found.refused) == [f"{shared} {must}"]
        text = [line.split() for line in found.to_text().splitlines()]
        assert text == [
            ["name", "state", "computer", "version", "api", "--at"],
            ["here", "ready", "box", "0.1.0", "1", str(served.path)],
            [here.at[0]],
            ["else", "startup", "here", "0.1.0", "1", other.at[0]],
            ["no", "machine", "answers", "at", str(folder / "left-behind.sock")],
            [str(shared), *must.split()],
        ]

    jump_loop.run(main())


# ------------------------------------------------------------------- multicast DNS, on networks of its own

_DISCOVER = """
from coordinator.cli.main import main
from nodes.support import host_sockets
host_sockets.SYSTEM_FOLDERS = ()  # machines of who runs this test
main(['discover', '--timeout', '0.2'])
"""


def test_a_computer_without_networks() -> None:
    said = on_own_networks(_DISCOVER)
    assert (
        "no machine was found\nonly this computer was searched: this computer has no network address" in said
    )


_TAKEN = """
taken = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
taken.bind(("", 5353))
"""


def test_the_port_is_taken() -> None:
    said = on_own_networks(LOOPBACK_UP + _TAKEN + _DISCOVER)
    assert "multicast DNS (UDP port 5353) cannot be used: Address already in use" in said


def test_a_coordinator_that_is_killed_is_seen_to_go() -> None:
    """Real processes, and nonsense on the network meanwhile."""
    code = "from tests.coordinator.ipc import multicast_smoke; multicast_smoke.main()"
    assert on_own_networks(LOOPBACK_UP + code) == "seen to come and to go\n"
