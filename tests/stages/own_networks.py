"""A computer with networks of its own: a process that nobody else on this computer can disturb."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LIMIT_S = 60.0
LOOPBACK_UP = """
import fcntl, socket, struct
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
    fcntl.ioctl(any_socket, 0x8914, struct.pack("16sH14x", b"lo", 0x49))  # SIOCSIFFLAGS: up, running
"""
"""Code that switches its loopback on."""


def need_own_networks() -> None:
    """Skip the test where nobody may make networks of his own."""
    if shutil.which("unshare") is None:
        pytest.skip("unshare is not installed: it makes a computer without networks")
    if subprocess.run(["unshare", "-rn", "true"], check=False, capture_output=True).returncode:
        pytest.skip("this system lets nobody make networks of his own (unshare -rn)")


def on_own_networks(code: str) -> str:
    """Run CODE where there is only a loopback, which is down; return what it prints."""
    need_own_networks()
    ended = subprocess.run(
        ["unshare", "-rn", sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT_S,
        cwd=ROOT,
        env=os.environ | {"XDG_RUNTIME_DIR": "/nowhere"},
    )
    assert not ended.stderr, ended.stderr
    assert ended.returncode == 0
    return ended.stdout
