"""A serial CAN adapter that speaks slcan, at a pseudo-terminal: by the kernel's driver, by python-can's."""

import json
import select
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from coordinator.cli import main
from nodes.assign import Uuid
from nodes.transport import open_can
from nodes.virtual.processes import ChildProcess, NodeProcess
from tests.canbus_tools.stage import set_nodeid
from tests.vcan.kernel import SECOND_INTERFACE, control, why_no_control, why_no_socketcan
from tests.vcan.test_print import END, GCODE, MAINBOARD, TOOLHEAD, run_print

BUS = SECOND_INTERFACE
"""Where the adapter is connected and the nodes are."""
REASON = why_no_socketcan(BUS) or why_no_control()
pytestmark = pytest.mark.skipif(bool(REASON), reason=REASON)
SLCAN = "slcan0"
WAIT_S = 20.0
ADAPTER = Path(__file__).parent / "slcan_adapter.py"


@pytest.fixture
def adapter() -> Iterator[ChildProcess]:
    """Yield an adapter at a pseudo-terminal; two nodes are on its bus."""
    with ExitStack() as stack:
        adapter = stack.enter_context(ChildProcess("slcan adapter", [sys.executable, ADAPTER, BUS]))
        nodes = [
            stack.enter_context(NodeProcess("mainboard", uuid=MAINBOARD, socketcan=BUS, rate_ppm=40)),
            stack.enter_context(NodeProcess("toolhead", uuid=TOOLHEAD, socketcan=BUS, rate_ppm=-80)),
        ]
        for process in (adapter, *nodes):
            process.wait_ready()
        yield adapter


@pytest.fixture
def interface(adapter: ChildProcess) -> Iterator[str]:
    """Yield the interface that the kernel's slcan driver makes of the adapter, as a user would have it."""
    if shutil.which("slcand") is None:
        pytest.skip("needs slcand of the package can-utils")
    assert adapter.ready is not None
    with open_links() as links:
        slcand = subprocess.Popen(["slcand", "-F", "-o", "-s8", adapter.ready["path"], SLCAN])
        try:
            wait_for_interface(links, SLCAN)
            control("ip", "link", "set", SLCAN, "txqueuelen", "1000", "up")
            yield SLCAN
        finally:
            slcand.terminate()
            slcand.wait(WAIT_S)


def open_links() -> socket.socket:
    """Open the kernel's news of interfaces (RTMGRP_LINK)."""
    links = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE)
    links.bind((0, 1))
    return links


def wait_for_interface(links: socket.socket, name: str) -> None:
    while name not in {known for _, known in socket.if_nameindex()}:
        assert select.select([links], [], [], WAIT_S)[0], f"there is no {name} after {WAIT_S} s"
        links.recv(65536)


def test_print_through_the_kernels_driver(interface: str, adapter: ChildProcess, tmp_path: Path) -> None:
    outcome = run_print(tmp_path, GCODE, interface=interface)
    assert outcome.positions == outcome.issued == END
    assert all(node.link.bytes_invalid == 0 for node in outcome.nodes)
    counts = adapter.stop()
    assert counts["to_bus"] > 200
    assert counts["from_bus"] > 200
    assert counts["refused"] == 0


def test_tools_through_python_cans_backend(adapter: ChildProcess, capsys: pytest.CaptureFixture[str]) -> None:
    assert adapter.ready is not None
    place = ("--interface", "slcan", "--channel", adapter.ready["path"], "--bitrate", "1000000")
    assert main(["can", "query", *place, "--json"]) == 0
    report = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {node["uuid"] for node in report["nodes"]} == {MAINBOARD, TOOLHEAD}
    with closing(open_can(BUS)) as host:
        set_nodeid(host, Uuid.parse(MAINBOARD), 9)
    assert main(["console", "--node", "9", "-e", "get_uptime", *place, "--force"]) == 0
    assert "uptime high=0 clock=" in capsys.readouterr().out
    assert adapter.stop()["refused"] == 0
