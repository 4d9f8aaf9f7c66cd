"""The SocketCAN interface vcan0: whether it is there, and what tests do to it. See docs/vcan.md."""

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

INTERFACE = "vcan0"


def why_no_socketcan() -> str:
    """Return why tests cannot use vcan0, or nothing."""
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sock:
            sock.bind((INTERFACE,))
    except OSError as error:
        return (
            f"no SocketCAN interface {INTERFACE} here ({error.strerror}); 'make vcan' boots a kernel with one"
        )
    return ""


def why_no_control() -> str:
    """Return why tests cannot set vcan0 down or slow it, or nothing."""
    if reason := why_no_socketcan():
        return reason
    if os.geteuid() != 0 or shutil.which("ip") is None or shutil.which("tc") is None:
        return f"needs root and the package iproute2 to control {INTERFACE}; 'make vcan' has both"
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
