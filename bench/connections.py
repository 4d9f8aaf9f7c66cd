"""Connection floods at each socket during a print: rates, delays of other clients, the smallest lead.

The demo's machine prints as a service. Two programs flood one socket after the other: they connect, send a
first message with an unknown token, and disconnect. Exit status 1: the print was stopped.
"""

import contextlib
import multiprocessing
import os
import secrets
import socket
import ssl
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event
from pathlib import Path

from coordinator.ipc.client.blocking import BlockingClient

ROOT = Path(__file__).resolve().parents[1]
FLOODERS = 2
FLOOD_S = 12.0
ASK_S = 0.05
START_S = 60.0
HELLO = b'{"id":1,"method":"api.hello","params":{"version":1,"client":"flood","token":"nobody"}}\n'
REQUEST = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
JOB = "G28\nG90\nG1 Z0.3 F600\n" + "".join(
    f"G1 X{20 + number * 37 % 60} Y{20 + number * 53 % 60} F9000\n" for number in range(4000)
)


def free_port() -> int:
    """Return a port of the loopback that was free a moment ago."""
    with socket.socket() as opened:
        opened.bind(("127.0.0.1", 0))
        return int(opened.getsockname()[1])


def flood(address: str | int, data: bytes, secret: bool, over: Event, count: "Synchronized[int]") -> None:
    """Connect to ADDRESS, a path or a port, send DATA, leave, until OVER; add to COUNT how often."""
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    tls.check_hostname, tls.verify_mode = False, ssl.CERT_NONE
    done = 0
    while not over.is_set():
        try:
            if isinstance(address, str):
                opened = socket.socket(socket.AF_UNIX)
                opened.connect(address)
            else:
                opened = socket.create_connection(("127.0.0.1", address))
            with tls.wrap_socket(opened) if secret else opened as carried:
                carried.sendall(data)
        except OSError:
            time.sleep(0.001)
        else:
            done += 1
    with count.get_lock():
        count.value += done


def measure(client: BlockingClient, name: str, address: str | int, data: bytes, *, secret: bool) -> bool:
    """Print what a flood does to CLIENT and the print; return whether that goes on."""
    over, count = multiprocessing.Event(), multiprocessing.Value("i", 0)
    flooders = [
        multiprocessing.Process(target=flood, args=(address, data, secret, over, count))
        for _ in range(FLOODERS)
    ]
    for flooder in flooders:
        flooder.start()
    waited_ms = []
    until_s = time.monotonic() + FLOOD_S
    while time.monotonic() < until_s:
        before_s = time.perf_counter()
        client.call("machine.state")
        waited_ms.append((time.perf_counter() - before_s) * 1e3)
        time.sleep(ASK_S)
    over.set()
    for flooder in flooders:
        flooder.join()
    values = client.call("state.get", {"fields": ["machine.lead_min_ms", "job.state"]})["values"]
    print(
        f"{name:<22} {count.value / FLOOD_S:6.0f} connections/s; an answer takes"
        f" {statistics.median(waited_ms):.1f} ms, worst {max(waited_ms):.1f} ms (n {len(waited_ms)});"
        f" {values['job.state']}, smallest lead so far {values['machine.lead_min_ms']} ms",
        flush=True,
    )
    return bool(values["job.state"] == "printing")


@contextlib.contextmanager
def service(folder: Path, options: list[str]) -> Iterator[BlockingClient]:
    """Run the demo's machine as a service with OPTIONS; yield a client of it once it prints."""
    command = [sys.executable, "-m", "coordinator.cli.main", "demo", "--serve"]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "HOME": str(folder)}
    process = subprocess.Popen([*command, *options], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL)
    try:
        wait_for((folder / "ipc").exists, "there is a socket")
        with BlockingClient(str(folder / "ipc")) as client:
            wait_for(lambda: client.call("machine.state")["state"] == "ready", "the machine is ready")
            client.call("job.start", {"file": "job.gcode"})
            time.sleep(10.0)  # it homes
            yield client
    finally:
        process.terminate()
        process.wait()


def wait_for(true: Callable[[], bool], what: str) -> None:
    """Wait until TRUE; ends the benchmark when it does not come true."""
    until_s = time.monotonic() + START_S
    while not true():
        if time.monotonic() > until_s:
            sys.exit(f"no end of waiting until {what}")
        time.sleep(0.1)


def make_certificate(folder: Path) -> list[str]:
    """Make a certificate and its key in FOLDER; return the options that give them to a service."""
    key, certificate = str(folder / "key.pem"), str(folder / "certificate.pem")
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=flood"]
    subprocess.run([*command, "-keyout", key, "-out", certificate], check=True, capture_output=True)
    return ["--tls-certificate", certificate, "--tls-key", key]


def main() -> int:
    """Measure all ways in, one after the other; return the exit status."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tokens, jobs, ipc = folder / "tokens", folder / "jobs", folder / "ipc"
        jobs.mkdir()
        (jobs / "job.gcode").write_text(JOB)
        tokens.write_text(f"operate me {secrets.token_urlsafe(32)}\n")
        tokens.chmod(0o600)
        common = ["--ipc", str(ipc), "--jobs", str(jobs), "--tokens", str(tokens)]
        tcp, web = free_port(), free_port()
        plain = ["--tcp", f"127.0.0.1:{tcp}", "--web", str(web), "--no-tls-on-loopback"]
        with service(folder, [*common, *plain]) as client:
            sound = measure(client, "Unix socket", str(ipc), HELLO, secret=False)
            sound &= measure(client, "TCP", tcp, HELLO, secret=False)
            sound &= measure(client, "page", web, REQUEST, secret=False)
        # The page has TLS where other computers reach it.
        tls = ["--tcp", f"127.0.0.1:{tcp}", "--web", f"0.0.0.0:{web}", *make_certificate(folder)]
        with service(folder, [*common, *tls]) as client:
            sound &= measure(client, "TCP, TLS", tcp, HELLO, secret=True)
            sound &= measure(client, "page, TLS", web, REQUEST, secret=True)
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main())
