"""A serial CAN adapter that speaks slcan, at a pseudo-terminal: by the kernel's driver, by python-can's."""

import select
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from nodes.virtual.processes import ChildProcess, NodeProcess
from tests.canbus_tools.command import Command
from tests.vcan.kernel import SECOND_INTERFACE, control, set_nodeid, why_no_control, why_no_socketcan

BUS = SECOND_INTERFACE
"""Where the adapter is connected and the nodes are."""
REASON = why_no_socketcan(BUS) or why_no_control()
pytestmark = pytest.mark.skipif(bool(REASON), reason=REASON)
SLCAN = "slcan0"
WAIT_S = 60.0
MAINBOARD, TOOLHEAD = "90a4ae022dfc", "5e1ec7ab1e02"
ADAPTER = Path(__file__).parent / "slcan_adapter.py"


@pytest.fixture
def adapter() -> Iterator[ChildProcess]:
    """Yield an adapter at a pseudo-terminal; two nodes are on its bus."""
    with ExitStack() as stack:
        adapter = stack.enter_context(ChildProcess("slcan adapter", [sys.executable, ADAPTER, BUS]))
        nodes = [
            stack.enter_context(NodeProcess("mainboard", uuid=MAINBOARD, socketcan=BUS)),
            stack.enter_context(NodeProcess("toolhead", uuid=TOOLHEAD, socketcan=BUS)),
        ]
        for process in (adapter, *nodes):
            process.wait_ready()
        yield adapter


@pytest.fixture
def interface(adapter: ChildProcess) -> Iterator[str]:
    """Yield the interface that the kernel's slcan driver makes of the adapter."""
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


def test_tools_through_the_kernels_driver(
    interface: str, adapter: ChildProcess, capsys: pytest.CaptureFixture[str]
) -> None:
    check_tools(Command(None, capsys, ("-c", interface)))
    counts = adapter.stop()
    assert counts["to_bus"] > 100
    assert counts["from_bus"] > 100
    assert counts["refused"] == 0


def test_tools_through_python_cans_backend(adapter: ChildProcess, capsys: pytest.CaptureFixture[str]) -> None:
    assert adapter.ready is not None
    words = ("--interface", "slcan", "--channel", adapter.ready["path"], "--bitrate", "1000000")
    check_tools(Command(None, capsys, words))
    assert adapter.stop()["refused"] == 0


def check_tools(tool: Command) -> None:
    """Find both nodes, and talk to one."""
    nodes = tool("query", "--json").json["nodes"]
    assert {node["uuid"] for node in nodes} == {MAINBOARD, TOOLHEAD}
    set_nodeid(MAINBOARD, 9, BUS)
    said = tool.console("--node", "9", "-e", "get_uptime", "--force")
    assert "uptime high=0 clock=" in said.out, said
