"""``canductor can doctor`` on a kernel's interface, whose settings are the faults."""

import os
import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from canbus_tools import doctor_facts
from canbus_tools.link_facts import NoInterface, read_link
from tests.canbus_tools.command import Command, Said
from tests.canbus_tools.stage import MAIN, MAIN_ID, PATIENCE_S, Place, set_nodeid
from tests.canbus_tools.test_doctor import expect, findings, problems, run
from tests.vcan.kernel import (
    INTERFACE,
    bad_wire,
    control,
    netem_dropped,
    set_down,
    tiny_queue,
    why_no_control,
    why_no_netem,
)

controls_interface = pytest.mark.skipif(bool(why_no_control()), reason=why_no_control())
has_ip = pytest.mark.skipif(shutil.which("ip") is None, reason="needs the package iproute2")

KERNEL = Place("socketcan", INTERFACE)


@pytest.fixture
def doctor(capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(KERNEL, capsys)


@contextmanager
def queue_of(length: int) -> Iterator[None]:
    before = read_link(INTERFACE).txqueuelen
    control("ip", "link", "set", INTERFACE, "txqueuelen", str(length))
    try:
        yield
    finally:
        control("ip", "link", "set", INTERFACE, "txqueuelen", str(before))


def the_finding(said: Said, name: str) -> dict[str, str]:
    return expect(said, name)[name]


@has_ip
def test_no_such_interface(capsys: pytest.CaptureFixture[str]) -> None:
    said = run(Command(Place("socketcan", "can7"), capsys))
    assert "there is no network interface can7" in the_finding(said, "interface-missing")["seen"]
    with pytest.raises(NoInterface):
        read_link("can7")


@has_ip
def test_an_interface_of_another_kind(capsys: pytest.CaptureFixture[str]) -> None:
    if not os.path.exists("/sys/class/net/lo"):  # noqa: PTH110 (a name of the kernel's)
        pytest.skip("no interface lo here")
    the_finding(run(Command(Place("socketcan", "lo"), capsys)), "not-can")


@controls_interface
def test_a_vcan_with_a_node_is_well(doctor: Command) -> None:
    with KERNEL.start_node("mainboard", MAIN) as node:
        node.wait_ready()
        said = run(doctor)
    expect(said)
    assert said.json["checked"] == ["interface", "traffic", "nodes"]


@controls_interface
def test_bit_rates_are_the_systems_to_change(doctor: Command) -> None:
    said = run(doctor, "--try-bitrates")
    the_finding(said, "no-nodes")
    assert "listen-only on" in findings(said)["bitrates-by-hand"]["do"]


@controls_interface
def test_interface_down(doctor: Command) -> None:
    with set_down():
        said = run(doctor)
    assert f"sudo ip link set {INTERFACE} up" in the_finding(said, "interface-down")["do"]


@controls_interface
@pytest.mark.parametrize(("length", "name"), [(2, "txqueuelen-small"), (10_000, "txqueuelen-large")])
def test_txqueuelen(doctor: Command, length: int, name: str) -> None:
    with queue_of(length):
        said = run(doctor, "--quiet-bus")
    assert f"holds {length} frames" in the_finding(said, name)["seen"]


@controls_interface
def test_a_send_queue_that_is_full(doctor: Command) -> None:
    with KERNEL.start_node("mainboard", MAIN) as node:
        node.wait_ready()
        with tiny_queue(rate_kbit=16):
            said = run(doctor)
    assert said.status == 1
    assert "send-queue-full" in problems(said), said.out
    assert "ENOBUFS" in findings(said)["send-queue-full"]["seen"]


@pytest.mark.skipif(bool(why_no_netem()), reason=why_no_netem())
def test_lost_frames(doctor: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor_facts, "PING_S_MAX", PATIENCE_S)  # all questions, however long each takes
    with KERNEL.start_node("mainboard", MAIN) as node:
        node.wait_ready()
        with closing(KERNEL.open()) as host:
            set_nodeid(host, MAIN, MAIN_ID)
        with bad_wire("loss 4%"):
            said = run(doctor)
            dropped = netem_dropped()
    assert said.status == 1
    assert "frames-lost" in problems(said), said.out
    ping = said.json["pings"][0]
    assert ping["asked"] == doctor_facts.ASKED
    # Once in a hundred runs no question got lost, but then pieces of answers did.
    assert ping["lost"] + ping["invalid_bytes"] > 0
    assert ping["lost"] <= dropped


@controls_interface
def test_no_permission(doctor: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sandbox may forbid sockets of CAN: the kernel's refusal is put in place of its socket."""

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("can.interfaces.socketcan.socketcan.create_socket", refuse)
    assert "sudo" in the_finding(run(doctor), "no-permission")["do"]
