"""``canductor can doctor`` on a kernel's interface, whose settings are the faults."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from canbus_tools.bus.link_facts import NoInterface, read_link
from canbus_tools.doctor.gather import ASKED
from nodes.virtual.processes import NodeProcess
from tests.canbus_tools.command import Command, Said
from tests.canbus_tools.findings import examine, expect, findings, problems
from tests.vcan.kernel import (
    INTERFACE,
    bad_wire,
    control,
    netem_dropped,
    set_down,
    set_nodeid,
    tiny_queue,
    why_no_control,
    why_no_netem,
)

controls_interface = pytest.mark.skipif(bool(why_no_control()), reason=why_no_control())
has_ip = pytest.mark.skipif(shutil.which("ip") is None, reason="needs the package iproute2")

MAIN = "90a4ae022dfc"
MAIN_ID = 4
SHORTLY = ("--listen", "0.2")
SLOW = "round-trip-spread"
"""What a kernel that runs as a process on a busy computer may be found to be."""


def doctor_of(interface: str, captured: pytest.CaptureFixture[str]) -> Command:
    return Command(None, captured, ("-c", interface))


@pytest.fixture
def doctor(capsys: pytest.CaptureFixture[str]) -> Command:
    return doctor_of(INTERFACE, capsys)


@pytest.fixture
def node() -> Iterator[NodeProcess]:
    with NodeProcess("mainboard", uuid=MAIN, socketcan=INTERFACE) as node:
        node.wait_ready()
        yield node


@contextmanager
def queue_of(length: int) -> Iterator[None]:
    before = read_link(INTERFACE).txqueuelen
    control("ip", "link", "set", INTERFACE, "txqueuelen", str(length))
    try:
        yield
    finally:
        control("ip", "link", "set", INTERFACE, "txqueuelen", str(before))


def the_finding(said: Said, name: str) -> dict[str, str]:
    """Return the one problem there is."""
    return expect(said, name)[name]


@has_ip
def test_no_such_interface(capsys: pytest.CaptureFixture[str]) -> None:
    said = examine(doctor_of("can7", capsys))
    assert "there is no network interface can7" in the_finding(said, "interface-missing")["seen"]
    with pytest.raises(NoInterface):
        read_link("can7")


@has_ip
def test_an_interface_of_another_kind(capsys: pytest.CaptureFixture[str]) -> None:
    if not os.path.exists("/sys/class/net/lo"):  # noqa: PTH110 (a name of the kernel's)
        pytest.skip("no interface lo here")
    the_finding(examine(doctor_of("lo", capsys)), "not-can")


@controls_interface
@pytest.mark.usefixtures("node")
def test_a_vcan_with_a_node_is_well(doctor: Command) -> None:
    said = examine(doctor, *SHORTLY)
    assert problems(said) <= {SLOW}, said.out
    assert said.json["checked"] == ["interface", "traffic", "nodes"]


@controls_interface
def test_bit_rates_are_the_systems_to_change(doctor: Command) -> None:
    said = examine(doctor, "--try-bitrates", *SHORTLY)
    the_finding(said, "no-nodes")
    assert "listen-only on" in findings(said)["bitrates-by-hand"]["do"]


@controls_interface
def test_interface_down(doctor: Command) -> None:
    with set_down():
        said = examine(doctor, *SHORTLY)
    assert f"sudo ip link set {INTERFACE} up" in the_finding(said, "interface-down")["do"]


@controls_interface
@pytest.mark.parametrize(("length", "name"), [(2, "txqueuelen-small"), (10_000, "txqueuelen-large")])
def test_txqueuelen(doctor: Command, length: int, name: str) -> None:
    with queue_of(length):
        said = examine(doctor, "--quiet-bus", *SHORTLY)
    assert f"holds {length} frames" in the_finding(said, name)["seen"]


@controls_interface
@pytest.mark.usefixtures("node")
def test_a_send_queue_that_is_full(doctor: Command) -> None:
    with tiny_queue(rate_kbit=1):  # so slow that a burst, however slowly it is sent, does not fit
        said = examine(doctor, *SHORTLY)
    assert said.status == 1
    assert "send-queue-full" in problems(said), said.out
    assert "ENOBUFS" in findings(said)["send-queue-full"]["seen"]


@pytest.mark.skipif(bool(why_no_netem()), reason=why_no_netem())
@pytest.mark.usefixtures("node")
def test_lost_frames(doctor: Command) -> None:
    set_nodeid(MAIN, MAIN_ID)
    with bad_wire("loss 4%"):
        said = examine(doctor, *SHORTLY)
        dropped = netem_dropped()
    assert said.status == 1
    assert "frames-lost" in problems(said), said.out
    ping = said.json["pings"][0]
    assert 0 < ping["asked"] <= ASKED, "as many as the time allows"
    assert ping["lost"] + ping["invalid_bytes"] > 0
    assert ping["lost"] <= dropped


@controls_interface
def test_no_permission(doctor: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sandbox may forbid sockets of CAN: the kernel's refusal is put in place of its socket."""

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("can.interfaces.socketcan.socketcan.create_socket", refuse)
    assert "sudo" in the_finding(examine(doctor, *SHORTLY), "no-permission")["do"]
