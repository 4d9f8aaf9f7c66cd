"""The SocketCAN interface vcan0: whether it is there, and what tests do to it. See docs/can/vcan.md."""

import json
import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from nodes.support.can_protocol import ADMIN_ID, SET_NODEID
from nodes.transport import CanFrame, open_can

INTERFACE = "vcan0"
SECOND_INTERFACE = "vcan1"


def why_no_socketcan(interface: str = INTERFACE) -> str:
    """Return why tests cannot use INTERFACE, or nothing."""
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sock:
            sock.bind((interface,))
    except OSError as error:
        return (
            f"no SocketCAN interface {interface} here ({error.strerror}); 'make vcan' boots a kernel with one"
        )
    return ""


def why_no_control() -> str:
    """Return why tests cannot set vcan0 down or slow it, or nothing."""
    if reason := why_no_socketcan():
        return reason
    if os.geteuid() != 0 or shutil.which("ip") is None or shutil.which("tc") is None:
        return f"needs root and the package iproute2 to control {INTERFACE}; 'make vcan' has both"
    return ""


def why_no_netem() -> str:
    """Return why tests cannot have vcan0 lose and delay what local programs send, or nothing."""
    if reason := why_no_control():
        return reason
    echo = Path("/sys/module/vcan/parameters/echo")
    if not echo.exists() or echo.read_text().strip() not in {"1", "Y"}:
        return "vcan passes frames on before they are queued; load it with 'modprobe vcan echo=1'"
    return ""


def control(tool: str, *words: str) -> None:
    subprocess.run([tool, *words], check=True)


@contextmanager
def tiny_queue(rate_kbit: int = 128) -> Iterator[None]:
    """Let vcan0 queue two frames and send only RATE_KBIT: a vcan itself takes everything at once.

    A frame counts as 16 bytes here, so 128 kbit/s are 1,000 frames/s. It needs a queueing discipline:
    txqueuelen has no effect on a vcan.
    """
    words = f"root tbf rate {rate_kbit}kbit burst 100 limit 40".split()
    control("tc", "qdisc", "add", "dev", INTERFACE, *words)
    try:
        yield
    finally:
        control("tc", "qdisc", "del", "dev", INTERFACE, "root")


@contextmanager
def set_down() -> Iterator[None]:
    control("ip", "link", "set", INTERFACE, "down")
    try:
        yield
    finally:
        control("ip", "link", "set", INTERFACE, "up")


@contextmanager
def bad_wire(*rules: str, interface: str = INTERFACE) -> Iterator[None]:
    """Have netem treat the frames on INTERFACE by RULES, in tc's words: "loss 5%", "delay 2ms"."""
    words = [word for rule in rules for word in rule.split()]
    control("tc", "qdisc", "add", "dev", interface, "root", "netem", *words)
    try:
        yield
    finally:
        control("tc", "qdisc", "del", "dev", interface, "root")


def netem_dropped(interface: str = INTERFACE) -> int:
    """Return how many frames the queueing discipline of INTERFACE dropped."""
    said = subprocess.run(
        ["tc", "-statistics", "-json", "qdisc", "show", "dev", interface, "root"],
        check=True,
        capture_output=True,
    )
    return int(json.loads(said.stdout)[0]["drops"])


def set_nodeid(uuid: str, nodeid: int, interface: str = INTERFACE) -> None:
    """Give the node with UUID its id."""
    with closing(open_can(interface)) as host:
        host.send(CanFrame(ADMIN_ID, bytes([SET_NODEID, *bytes.fromhex(uuid), nodeid])))


def frames_sent(interface: str) -> int:
    """Return how many frames local programs have sent by INTERFACE."""
    return int(Path(f"/sys/class/net/{interface}/statistics/tx_packets").read_text())
