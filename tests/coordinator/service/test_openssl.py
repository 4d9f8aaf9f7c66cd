"""A service loads OpenSSL, which takes 5 MB, only where a way in has TLS or the page's server asks for it."""

import hashlib
import http.client
import json
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from coordinator.ipc.client.blocking import BlockingClient
from tests.coordinator.certificates import make_certificate
from tests.stages.printer_text import DEMO_CFG, write
from tests.stages.processes import END_S, ROOT, own_port

TOKEN = "t" * 32
ENTRY = "from coordinator.cli.entry import main; raise SystemExit(main())"
LINES_MAX = 20


@contextmanager
def service(folder: Path, *words: object) -> Iterator[tuple[Path, list[str]]]:
    """Run a service without a machine; yield its folder in /proc and what it said until it waits."""
    config = write(folder, DEMO_CFG.replace("can0", f"virtual:{folder}/none"))
    command = [sys.executable, "-c", ENTRY, *map(str, ("run", config, "--ipc", folder / "s", *words))]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        said: list[str] = []
        while not (said and said[-1].startswith("error: ")):
            assert len(said) < LINES_MAX, said
            said.append(process.stdout.readline())
            assert said[-1], said
        yield Path(f"/proc/{process.pid}"), said
    finally:
        process.terminate()
        process.communicate(timeout=END_S)
    assert process.returncode == 0


def test_a_service_without_tls_has_none(tmp_path: Path) -> None:
    with service(tmp_path) as (process, _):
        with BlockingClient(str(tmp_path / "s")) as client:
            assert client.call("machine.state")["state"] == "error"
        assert "libcrypto" not in (process / "maps").read_text()


def test_tcp_has_tls_and_the_page_is_served(tmp_path: Path) -> None:
    pem, key = make_certificate(tmp_path)
    tokens = tmp_path / "tokens"
    tokens.touch(0o600)
    tokens.write_text(f"admin me {TOKEN}\n", encoding="ascii")
    tcp, web = (f"127.0.0.1:{own_port(number)}" for number in (5, 6))
    words = ("--tcp", tcp, "--web", web, "--tokens", tokens)
    trusting = ssl.create_default_context(cafile=str(pem))
    with service(tmp_path, *words, "--tls-certificate", pem, "--tls-key", key) as (_, said):
        assert f"the live page is at http://{web}/\n" in said
        plain = socket.create_connection(("127.0.0.1", own_port(5)))
        reader = trusting.wrap_socket(plain, server_hostname="127.0.0.1")
        hello = {"id": 1, "method": "api.hello", "params": {"version": 1, "token": TOKEN}}
        reader.sendall(json.dumps(hello).encode() + b"\n")
        with reader, reader.makefile("rb") as lines:
            assert json.loads(lines.readline())["id"] == 1
        asked = http.client.HTTPConnection(web)
        asked.request("GET", "/")
        assert asked.getresponse().status == 200
        asked.close()


PROGRAM = """
import sys
from coordinator.support.without_openssl import import_without_openssl
{before}
import_without_openssl()
import asyncio, hashlib, hmac, secrets
print("libcrypto" in open("/proc/self/maps").read(), hashlib.sha256(b"canductor").hexdigest())
print(hmac.compare_digest("a", "a"), hmac.compare_digest("a", "b"), len(secrets.token_hex(8)))
import ssl
print(ssl.create_default_context().verify_mode.name, asyncio.run(asyncio.sleep(0, "slept")))
"""


@pytest.mark.parametrize(("before", "loaded"), [("", False), ("import ssl", True), ("import hmac", True)])
def test_libraries_calculate_the_same(before: str, *, loaded: bool) -> None:
    """What was imported before stays as it is."""
    words = [sys.executable, "-c", PROGRAM.format(before=before)]
    said = subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    assert said == [
        f"{loaded} {hashlib.sha256(b'canductor').hexdigest()}",
        "True False 16",
        "CERT_REQUIRED slept",
    ]
