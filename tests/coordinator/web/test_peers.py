"""Which names, pages and programs are taken for our own."""

import os
import socket
import subprocess
import sys

import pytest

from coordinator.web.peers import is_own_host, is_own_origin, is_own_program, own_names


@pytest.mark.parametrize(
    "host",
    [
        "localhost",
        "localhost:8080",
        "LOCALHOST:1",
        "127.0.0.1",
        "127.0.0.1:8080",
        "[::1]:8080",
        "192.168.7.3",
    ],
)
def test_own_hosts(host: str) -> None:
    assert is_own_host(host, own_names())


@pytest.mark.parametrize(
    "host",
    [
        "",
        "evil.example",
        "localhost.evil.example:8080",
        "127.0.0.1.evil.example",
        "evil@",
        "[::1",
        "a b",
        ":80",
    ],
)
def test_foreign_hosts(host: str) -> None:
    assert not is_own_host(host, own_names())


def test_the_computers_name_is_its_own() -> None:
    assert is_own_host(f"{socket.gethostname()}:80", own_names())


def test_origins() -> None:
    assert is_own_origin("http://127.0.0.1:8080", "127.0.0.1:8080")
    assert is_own_origin("https://Printer.local", "printer.local")
    for origin in (
        None,
        "null",
        "http://127.0.0.1:8081",
        "http://evil.example",
        "file://127.0.0.1:8080",
        "http://[::1",
    ):
        assert not is_own_origin(origin, "127.0.0.1:8080")


@pytest.mark.parametrize(
    ("family", "address"), [(socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")], ids=["IPv4", "IPv6"]
)
def test_who_connects_over_loopback(family: socket.AddressFamily, address: str) -> None:
    with socket.socket(family) as listener:
        try:
            listener.bind((address, 0))
        except OSError:
            pytest.skip(f"this computer has no {address}")
        listener.listen()
        with socket.create_connection(listener.getsockname()[:2]) as client:
            accepted, peer = listener.accept()
            with accepted:
                here = accepted.getsockname()[:2]
                assert is_own_program(peer[:2], here)
                assert not is_own_program((address, peer[1] ^ 1), here), "nobody is there"
                assert not is_own_program(("192.0.2.1", peer[1]), here), "not this computer"
                assert client.getsockname()[:2] == peer[:2]


def test_another_user_is_not_this_one() -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can be another user")
    program = "import socket, sys; s = socket.create_connection(('127.0.0.1', int(sys.argv[1]))); s.recv(1)"
    with socket.create_server(("127.0.0.1", 0)) as listener:
        words = [sys.executable, "-I", "-S", "-c", program, str(listener.getsockname()[1])]
        with subprocess.Popen(
            ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", *words]
        ) as other:
            accepted, peer = listener.accept()
            with accepted:
                assert not is_own_program(peer, accepted.getsockname())
            assert other.wait(20) == 0
