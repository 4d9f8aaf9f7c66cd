"""What the coordinator costs in real time: processor, wake-ups, memory, and how fast it answers at rest.

Virtual nodes with a plant play a machine; `canductor run` is a process of its own, and only that is measured,
all its threads, from /proc. Processor time is in % of one core; a wake-up is a voluntary context switch.
States: waiting (connected, nothing to do), heating (both heaters hold a temperature), printing, watched
(printing, with a Moonraker that two browsers use: a connection that watches all objects and the answers of
G-code, with four queries and two `info` a second; --clients 3: as many connections that share these requests;
by turns with printing, twice, each time the same part of a new print). One node is
config/cartesian_uart.cfg on a pseudo-terminal, three are the demo's machine. Each state begins with some
seconds that are left out. A script at rest is one G-code line of a client of the Klippy API, from its sending
to its answer.

With --peer PATH (the peer's klippy.py) the same happens with that host on the same node, configuration file
and program; its Python is --peer-python. The peer is not a part of this project: without the option its
figures of PEER_FIGURES are printed. Three nodes are measured with ours only: the peer cannot reach a virtual
CAN bus.

With --compare PATH (a checkout of an earlier version, set up) that version and this one print the same
program alternately, one node, both heaters on, by `run --gcode`: so figures of two computers compare.

With --limit the hosts run in a control group of 15 % of one core and 200 MB (as root).

The first line says how fast the computer is: a host that is woken some ten times a second does little, but
finds nothing of what it needs in the caches.

Usage: python bench/realtime.py [--seconds S] [--only STATE ...] [--limit] [--peer PATH [--peer-python PATH]]
       python bench/realtime.py [--seconds S] --compare PATH
"""

import argparse
import contextlib
import json
import os
import random
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from control_group import ControlGroup, limited

from coordinator.assembly.load import load_machine
from coordinator.ipc.client.blocking import BlockingClient
from coordinator.virtual_machine.virtual_machine import VirtualMachine, VirtualMachineOptions

ROOT = Path(__file__).resolve().parents[1]
ONE_NODE = ROOT / "config" / "cartesian_uart.cfg"
THREE_NODES = ROOT / "config" / "demo" / "machine.cfg"
PROGRAM = ROOT / "config" / "demo" / "part.gcode"
HEATERS_ON = "M140 S60\nM104 S200\n"
HOMED_S = 30.0
"""After the start of `run --gcode` the machine has homed, and prints."""
SETTLE_S = 6.0
"""Left out at the start of each state; the nodes' clocks have settled by then."""
FILAMENT_MM = 5.0
"""Once the print has taken so much it is not homing any more."""
SCRIPTS = 40
"""Also how often memory is timed."""
START_S = 60.0
STATES = ("waiting", "heating", "script", "printing", "watched")
PRINTS = 3
"""One after the other: long enough for all states."""
ROUNDS = 2
"""Of printing and watched by turns."""
WATCHED_S = 0.25
"""Between two queries of all clients together."""
PEER_FIGURES = "waiting 0.3 %, printing 0.8 % of a core, 34 MB resident"
"""One node, the same file; measured on another computer beside e013306, which took 2 %, 2.7 %, 59 MB."""
LIMIT_CORE_SHARE = 0.15
LIMIT_BYTES = 200_000_000
LOOP_ROUNDS = 10_000_000
SCATTERED = 4096
"""Numbers that are added, each in a line of the caches of its own."""
REST_S = 0.02
CARD = "\n[virtual_sdcard]\npath: {folder}\n[pause_resume]\n"


@dataclass(frozen=True, slots=True)
class Sample:
    """Counters of a process at one moment."""

    at_s: float
    cpu_s: dict[str, float]
    """By thread: its id and name."""
    process_cpu_s: float
    wakeups: dict[str, int]
    """Voluntary context switches, by thread."""

    @classmethod
    def of(cls, pid: int) -> "Sample":
        """Read the counters of the process PID."""
        cpu_s: dict[str, float] = {}
        wakeups: dict[str, int] = {}
        for task in sorted(Path(f"/proc/{pid}/task").iterdir()):
            with contextlib.suppress(OSError):  # a thread may end meanwhile
                name = f"{task.name} {(task / 'comm').read_text().strip()}"
                cpu_s[name] = int((task / "schedstat").read_text().split()[0]) * 1e-9
                status = dict(
                    line.split(":", 1) for line in (task / "status").read_text().splitlines() if ":" in line
                )
                wakeups[name] = int(status["voluntary_ctxt_switches"])
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks = int(fields[11]) + int(fields[12])
        return cls(time.monotonic(), cpu_s, ticks / os.sysconf("SC_CLK_TCK"), wakeups)


def loop_s() -> float:
    """Return the processor time of LOOP_ROUNDS of Python's plainest loop."""
    before_s = time.thread_time()
    for _ in range(LOOP_ROUNDS):
        pass
    return time.thread_time() - before_s


def scattered_ns(rest_s: float) -> float:
    """Return the processor time in which a number is added that lies anywhere, after a rest of REST_S."""
    apart = [0.5 + number for number in range(4 * SCATTERED)][::4]
    random.Random(1).shuffle(apart)
    taken_ns = []
    for _ in range(SCRIPTS):
        time.sleep(rest_s)
        before_ns = time.thread_time_ns()
        sum(apart)
        taken_ns.append(time.thread_time_ns() - before_ns)
    return statistics.median(taken_ns) / SCATTERED


def print_computer() -> None:
    """Print how fast this computer is."""
    print(
        f"this computer: {LOOP_ROUNDS / 1e6:.0f} million rounds of a Python loop take {loop_s():.2f} s;"
        f" a number from memory {scattered_ns(0):.0f} ns, {scattered_ns(REST_S):.0f} ns after a rest of"
        f" {REST_S * 1e3:.0f} ms",
        flush=True,
    )


def memory_mb(pid: int) -> tuple[float, float]:
    """Return the resident and the proportional set size of PID, in MB (10^6 bytes)."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    kib = {line.split(":")[0]: int(line.split()[1]) for line in lines}
    return kib["Rss"] * 1024e-6, kib["Pss"] * 1024e-6


def children(pid: int) -> list[int]:
    """Return the processes that PID has started."""
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        found += [int(child) for child in (task / "children").read_text().split()]
    return found


class KlippyClient:
    """A client of the API that both hosts serve at a Unix socket."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX)
        self._socket.settimeout(START_S)
        self._socket.connect(str(path))
        self._received = b""
        self._number = 0

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Return the result of METHOD; raises RuntimeError."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        self._socket.sendall(json.dumps(message).encode() + b"\x03")
        while True:
            while b"\x03" not in self._received:
                data = self._socket.recv(1 << 16)
                if not data:
                    raise RuntimeError("the host has closed the connection")
                self._received += data
            body, _, self._received = self._received.partition(b"\x03")
            answer = json.loads(body)
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return dict(answer["result"])

    def watch(self) -> None:
        """Watch all objects and what G-code answers."""
        objects = dict.fromkeys(self.call("objects/list")["objects"])
        self.call("objects/subscribe", objects=objects, response_template={"method": "changed"})
        self.call("gcode/subscribe_output", response_template={"method": "said"})

    def script(self, line: str) -> None:
        """Run LINE."""
        self.call("gcode/script", script=line)

    def close(self) -> None:
        """Hang up."""
        self._socket.close()


@contextlib.contextmanager
def machine(config: Path, folder: Path) -> Iterator[Path]:
    """Play the nodes of CONFIG; yield a configuration file that leads to them, in FOLDER."""
    description = load_machine(str(config))
    text = config.read_text(encoding="utf-8")
    with VirtualMachine(description, VirtualMachineOptions(logs=False), folder) as stage:
        for before, after in zip(description.nodes, stage.description.nodes, strict=True):
            for field in ("path", "interface"):
                if hasattr(before.connection, field):
                    old, new = getattr(before.connection, field), getattr(after.connection, field)
                    key = "serial" if field == "path" else "canbus_interface"
                    text = text.replace(f"{key}: {old}", f"{key}: {new}")
        jobs = folder / "jobs"
        jobs.mkdir()
        # Without waits for heat, and cold extrusion allowed: the print begins at once.
        if "min_extrude_temp" not in text:
            text = text.replace("[extruder]\n", "[extruder]\nmin_extrude_temp: 0\n")
        lines = PROGRAM.read_text(encoding="utf-8").splitlines(keepends=True)
        (jobs / "part.gcode").write_text(
            "".join(line for line in lines if not line.startswith("M1")) * PRINTS
        )
        played = folder / "printer.cfg"
        played.write_text(text + CARD.format(folder=jobs), encoding="utf-8")
        yield played


@contextlib.contextmanager
def running(command: list[str], folder: Path) -> Iterator["subprocess.Popen[bytes]"]:
    """Run COMMAND, its output in a file in FOLDER, until the block ends."""
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "HOME": str(folder)}
    with (folder / "host.log").open("wb") as log:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@contextlib.contextmanager
def host(command: list[str], api: Path, folder: Path) -> Iterator[tuple[int, KlippyClient]]:
    """Run a host with COMMAND; yield its process id and a client once the machine is ready."""
    with running(command, folder) as process:
        try:
            yield process.pid, connect(process, api, folder)
        except ProcessLookupError:
            sys.exit(f"the host ended:\n{(folder / 'host.log').read_text()}")


def connect(process: "subprocess.Popen[bytes]", api: Path, folder: Path) -> KlippyClient:
    """Return a client of the host once its machine is ready; ends the benchmark when it never is."""
    until_s = time.monotonic() + START_S
    while time.monotonic() < until_s and process.poll() is None:
        with contextlib.suppress(OSError, RuntimeError):
            client = KlippyClient(api)
            while time.monotonic() < until_s:
                if client.call("info", client_info={"program": "bench", "version": "1"})["state"] == "ready":
                    return client
                time.sleep(0.2)
        time.sleep(0.2)
    sys.exit(f"the host did not get ready:\n{(folder / 'host.log').read_text()}")


def measure(name: str, pid: int, seconds: float, *, threads: bool) -> None:
    """Print what the process PID takes in SECONDS of the state NAME, and by each of its THREADS."""
    before = Sample.of(pid)
    time.sleep(seconds)
    after = Sample.of(pid)
    took_s = after.at_s - before.at_s
    # Both clocks of the kernel: by thread to the ns, of the process in ticks of 10 ms.
    cpu = {n: (s - before.cpu_s.get(n, 0.0)) / took_s for n, s in after.cpu_s.items()}
    woken = {n: (c - before.wakeups.get(n, 0)) / took_s for n, c in after.wakeups.items()}
    process = (after.process_cpu_s - before.process_cpu_s) / took_s
    rss, pss = memory_mb(pid)
    print(
        f"  {name:<10} {100 * process:5.2f} % of a core ({100 * sum(cpu.values()):.2f} by its threads),"
        f" {sum(woken.values()):6.1f} wake-ups/s, {rss:.1f} MB (PSS {pss:.1f})",
        flush=True,
    )
    for thread in sorted(cpu, key=lambda n: -cpu[n]) if threads else []:
        print(f"    {thread:<26} {100 * cpu[thread]:6.2f} % {woken[thread]:7.1f} wake-ups/s")


def measure_script(client: KlippyClient) -> None:
    """Print how long a line of a client takes at rest."""
    taken_ms = []
    for index in range(SCRIPTS):
        time.sleep(0.1 + 0.0037 * index)  # not in step with anything
        before_s = time.perf_counter()
        client.script("SET_VELOCITY_LIMIT VELOCITY=200")
        taken_ms.append((time.perf_counter() - before_s) * 1e3)
    print(
        f"  script     median {statistics.median(taken_ms):.1f} ms, worst {max(taken_ms):.1f} ms"
        f" (n {SCRIPTS}, at rest)",
        flush=True,
    )


@contextlib.contextmanager
def watched(api: Path, clients: int) -> Iterator[None]:
    """Ask and watch as Moonraker and two browsers do, by as many CLIENTS, until the block ends."""
    over = threading.Event()

    def ask() -> None:
        client = KlippyClient(api)
        client.watch()
        asked = {"toolhead": None, "print_stats": None, "extruder": ["temperature", "target"]}
        count = 0
        while not over.wait(WATCHED_S * clients):
            count += 1
            client.call("objects/query", objects=asked)
            if count % 2 == 0:
                client.call("info")
        client.close()

    threads = [threading.Thread(target=ask) for _ in range(clients)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()


def print_lead(ipc: Path) -> None:
    """Print the smallest lead so far, of a host that says it."""
    if ipc.exists():
        with BlockingClient(str(ipc)) as client:
            values = client.call("state.get", {"fields": ["machine.lead_min_ms"]})["values"]
        print(f"             smallest lead since the start: {values['machine.lead_min_ms']} ms", flush=True)


def print_stats(client: KlippyClient) -> dict[str, Any]:
    """Return how the print does; ends the benchmark when the machine has stopped."""
    info = client.call("info")
    if info["state"] != "ready":
        sys.exit(f"the machine stopped: {info['state_message']}")
    return dict(client.call("objects/query", objects={"print_stats": None})["status"]["print_stats"])


def wait_for(client: KlippyClient, condition: Callable[[dict[str, Any]], bool]) -> None:
    """Wait until the print's CONDITION holds; ends the benchmark when it does not in time."""
    until_s = time.monotonic() + START_S
    while not condition(stats := print_stats(client)):
        if time.monotonic() > until_s:
            sys.exit(f"the print does not do what it should: {stats}")
        time.sleep(0.5)


def run_print(
    client: KlippyClient, state: Callable[[str], None], api: Path, chosen: argparse.Namespace
) -> None:
    """Measure a host in the states of a print."""
    client.script(HEATERS_ON)
    rounds = ROUNDS if "watched" in chosen.only else 1
    for name in [name for name in ("printing", "watched") if name in chosen.only] * rounds:
        client.script("SDCARD_PRINT_FILE FILENAME=part.gcode")
        wait_for(client, lambda stats: stats["state"] == "printing")
        wait_for(client, lambda stats: stats["filament_used"] >= FILAMENT_MM)
        with watched(api, chosen.clients) if name == "watched" else contextlib.nullcontext():
            state(name)
        if print_stats(client)["state"] != "printing":
            sys.exit("the print ended before it was measured; take fewer --seconds")
        client.script("CANCEL_PRINT")
        wait_for(client, lambda stats: stats["state"] == "cancelled")
    print_lead(api.parent / "ipc")


def run_states(command: list[str], api: Path, folder: Path, chosen: argparse.Namespace) -> None:
    """Measure a host in all chosen states."""
    with host(command, api, folder) as (pid, client):

        def state(name: str) -> None:
            time.sleep(SETTLE_S)
            measure(name, pid, chosen.seconds, threads=chosen.threads)

        if "waiting" in chosen.only:
            state("waiting")
            for child in children(pid):
                print(f"    and a process of its own: {memory_mb(child)[0]:.1f} MB resident")
        if "script" in chosen.only:
            measure_script(client)
        if "heating" in chosen.only:
            client.script(HEATERS_ON)
            state("heating")
        if {"printing", "watched"} & set(chosen.only):
            run_print(client, state, api, chosen)
        client.close()


def ours(config: Path, api: Path) -> list[str]:
    """Return the command line of this host."""
    begin = "from coordinator.cli.entry import main; raise SystemExit(main())"
    return [
        sys.executable,
        "-c",
        begin,
        "run",
        str(config),
        "--klippy-api",
        str(api),
        "--ipc",
        str(api.parent / "ipc"),
    ]


def peers(python: str, peer: Path, config: Path, api: Path) -> list[str]:
    """Return the command line of the peer."""
    log = config.parent / "klippy.log"
    return [python, str(peer), str(config), "-a", str(api), "-l", str(log)]


def play(config: Path, title: str, command: Any, chosen: argparse.Namespace) -> None:
    """Measure the host of COMMAND on the machine of CONFIG."""
    print(title, flush=True)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        played = stack.enter_context(machine(config, folder))
        api = folder / "api.sock"
        hosted = command(played, api)
        group: ControlGroup | None = None
        if chosen.limit:
            group = stack.enter_context(limited(LIMIT_CORE_SHARE, LIMIT_BYTES))
            hosted = group.running(hosted)
        run_states(hosted, api, folder, chosen)
        if group is not None:
            print(f"             it was held back in {group.throttled} periods of 100 ms, start included")


def compare(earlier: Path, seconds: float) -> None:
    """Measure the version in the checkout EARLIER and this one alternately while they print a file."""
    for title, checkout in (("earlier", earlier), ("this one", ROOT)) * ROUNDS:
        with tempfile.TemporaryDirectory() as name, machine(ONE_NODE, Path(name)) as played:
            folder = Path(name)
            played.write_text(played.read_text().partition(CARD.partition("{")[0])[0])
            program = folder / "part.gcode"
            program.write_text(HEATERS_ON + (folder / "jobs" / "part.gcode").read_text())
            command = [str(checkout / ".venv" / "bin" / "canductor"), "run", str(played)]
            with running([*command, "--gcode", str(program)], folder) as process:
                time.sleep(HOMED_S)
                if process.poll() is not None:
                    sys.exit(f"the host ended:\n{(folder / 'host.log').read_text()}")
                measure(title, process.pid, seconds, threads=False)


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0, help="measured of each state")
    parser.add_argument("--only", nargs="+", choices=STATES, default=list(STATES))
    parser.add_argument("--nodes", type=int, nargs="+", choices=(1, 3), default=[1, 3])
    parser.add_argument("--clients", type=int, default=1, help="that watch a print")
    parser.add_argument("--threads", action="store_true", help="print each thread, too")
    parser.add_argument("--limit", action="store_true", help="15 %% of one core and 200 MB; as root")
    parser.add_argument("--compare", type=Path, help="a checkout of an earlier version, set up")
    parser.add_argument("--peer", type=Path, help="klippy.py of the peer")
    parser.add_argument(
        "--peer-python", default=sys.executable, help="the Python that has what the peer needs"
    )
    chosen = parser.parse_args()
    os.chdir(ROOT)
    print_computer()
    if chosen.compare is not None:
        compare(chosen.compare.resolve(), chosen.seconds)
        return
    if 1 in chosen.nodes:
        play(ONE_NODE, "canductor, one node on a UART:", ours, chosen)
    if 3 in chosen.nodes:
        play(THREE_NODES, "canductor, three nodes (two on CAN, one on a UART):", ours, chosen)
    if chosen.peer is None:
        print(f"the peer, on another computer: {PEER_FIGURES}; to measure it here: --peer KLIPPY.PY")
        return

    def peer_command(config: Path, api: Path) -> list[str]:
        return peers(chosen.peer_python, chosen.peer.resolve(), config, api)

    play(ONE_NODE, "the peer, one node on a UART:", peer_command, chosen)


if __name__ == "__main__":
    main()
