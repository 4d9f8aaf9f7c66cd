"""Stops a machine that prints, again and again, while fuzzers are at all of its ways in; takes the times.

Usage, from the project's root: python -m tests.fuzz.live_stops [--minutes M] [--seed N]

Services on virtual nodes print, each in a process of its own (stopped_service.py). Clients that are random,
wrong, slow or rude come and go on the Unix socket and TCP (live_visits.py), and random bytes come on all
other ways in (live_noise.py), always at the machine that is stopped next. An emergency stop is sent by the
next way in, by turns while the control loop is free, while it is held by what waits, and while it is held by
what calculates. A plain restart follows, and meanwhile the next machine is stopped: with five machines, there
is a stop about every second. With --machines 1 the fuzzers are there during restarts, too.

The machine that is stopped has the priority that docs/examples/systemd/canductor.service gives a service.
All others stand for other computers. Its nodes, and whoever stops it, do not wait for a processor while it
has them: their priority is higher. Fuzzers and machines that restart get the processor time that nobody wants
(SCHED_IDLE). Without root all compete, and bounds may be missed on a computer with few processors.

Each time is from before the stop's last bytes are sent to the edge of the node's pin. It ends with status 1
when a stop has no effect, comes later than its bound or does not name who stopped, or when a restart fails.
A stop that would have come in time had the computer itself not stood still meanwhile (standstill.py) is shown
and not judged. Run it on a computer that does nothing else.
"""

import argparse
import asyncio
import contextlib
import json
import os
import pty
import socket
import ssl
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

import aiohttp
from yarl import URL

from coordinator.ipc.client.blocking import BlockingClient
from coordinator.ipc.protocol.methods import ApiError
from coordinator.web.stop_request import STOP_PATH
from tests.fuzz.ipc_target import line
from tests.fuzz.live import ROOT
from tests.fuzz.proved_service import ADMIN_TOKEN, SERVICE_PRIORITY, WATCH_TOKEN
from tests.fuzz.standstill import Span, Standstills, stood_still_ms
from tests.stages.held_service import fan_turns, stopped_after_ms

BOUNDS_MS: Final = {"free": 10.0, "held": 50.0, "calculating": 50.0}
"""Of the time to the node's pin, by the state of the loop."""
OWN_ADDRESS: Final = "127.0.0.9"
"""From here stops come over TCP: wrong tokens lock the fuzzers' addresses out."""
OTHERS_PRIORITY: Final = SERVICE_PRIORITY + 1
"""Of nodes and of who stops a machine."""
LEAST_PRIORITY: Final = ("chrt", "--idle", "0")
PATIENCE_S: Final = 60.0
LOOK_S: Final = 0.005
PROGRAM: Final = "SET_KINEMATIC_POSITION X=100 Y=100 Z=10\n" + "G1 X20 F3000\nG1 X180\n" * 500


@dataclass(frozen=True, slots=True)
class Stop:
    """One emergency stop."""

    way: str
    loop: str
    """Its state, as in ``BOUNDS_MS``."""
    sent_ns: int
    """CLOCK_MONOTONIC."""
    machine: Path = Path()
    """Its folder."""
    waited_ms: float = 0.0
    """How long the loop's thread was ready and waited for a processor meanwhile."""


@dataclass
class Found:
    """What came out."""

    stops: list[Stop] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    stood_still: list[Span] = field(default_factory=list)
    """When a processor of the computer did."""


def schedule(task: int, policy: int, priority: int = 0) -> None:
    """Have TASK (a thread; 0: this one) compete for the processor as POLICY says, if it is permitted."""
    if os.geteuid() == 0:  # nobody else gets back from SCHED_IDLE
        with contextlib.suppress(ProcessLookupError):
            os.sched_setscheduler(task, policy, os.sched_param(priority))


@contextlib.contextmanager
def on_another_computer() -> Iterator[None]:
    """Wait for no processor that a machine has, inside."""
    schedule(0, os.SCHED_RR, OTHERS_PRIORITY)
    try:
        yield
    finally:
        schedule(0, os.SCHED_OTHER)


class Machine:
    """The machine in FOLDER, and its operator; a context manager."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.terminal = -1
        """Where a user types."""
        self.ways: dict[str, Any] = {}
        """As stopped_service.py prints them."""
        self.browser: Browser
        self.operator: BlockingClient
        self._process: subprocess.Popen[str]
        self._prints = False
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        self.terminal, theirs = pty.openpty()
        self._stack.callback(os.close, self.terminal)
        command = [sys.executable, "-m", "tests.fuzz.stopped_service", str(self.folder), str(theirs)]
        self._process = self._stack.enter_context(with_terminal(command, theirs))
        self._stack.callback(self._process.communicate)
        os.close(theirs)
        self.ways = json.loads(self._answer())
        self._schedule_nodes()
        self.operator = self._stack.enter_context(BlockingClient(str(self.folder / "api.sock")))
        self.browser = self._stack.enter_context(Browser(self.ways["pages"]))
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def _answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()

    def _tell(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    @contextlib.contextmanager
    def loop(self, state: str) -> Iterator[None]:
        """Have the control loop be in STATE inside."""
        if state == "free":
            yield
            return
        self._tell("waiting" if state == "held" else state)
        assert self._answer() == "held\n"
        try:
            yield
        finally:
            self._tell("free")

    @property
    def state(self) -> dict[str, str]:
        """The machine's state and its cause."""
        found: dict[str, str] = self.operator.call("machine.state")
        return found

    def wait_for(self, true: Callable[[], bool], what: str) -> None:
        """Wait until TRUE."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not true():
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"no end of waiting until {what}; the machine: {self.state}")
            time.sleep(LOOK_S)

    @property
    def waited_ms(self) -> float:
        """How long the thread of its loop has waited for a processor so far."""
        number = self._process.pid
        return int(Path(f"/proc/{number}/task/{number}/schedstat").read_text().split()[1]) * 1e-6

    def _schedule(self, policy: int, priority: int = 0) -> None:
        """Have the service compete for the processor as POLICY says, as far as the system permits it."""
        for task in self._tasks():
            schedule(int(task.name), policy, priority)

    def _tasks(self) -> list[Path]:
        return list(Path(f"/proc/{self._process.pid}/task").iterdir())

    def _schedule_nodes(self) -> None:
        """Have no node wait for a processor that a service has: they are all children that it has yet."""
        for task in self._tasks():
            with contextlib.suppress(FileNotFoundError):
                for node in (task / "children").read_text(encoding="ascii").split():
                    schedule(int(node), os.SCHED_RR, OTHERS_PRIORITY)

    def begin(self) -> None:
        """Have it print with the fan on, unless it does already; lines that were typed are done first."""
        if self._prints:
            return
        self.wait_for(lambda: self.state["state"] == "ready", "it is ready")
        self._schedule(os.SCHED_RR, SERVICE_PRIORITY)
        for method, params in (("gcode.run", {"script": "M106 S255"}), ("job.start", {"file": "long.gcode"})):
            self.wait_for(lambda: self._is_done(method, params), f"{method} is done")  # noqa: B023 (at once)
        self.wait_for(lambda: fan_turns(self.folder), "the fan turns")
        self._prints = True

    def _is_done(self, method: str, params: Mapping[str, str]) -> bool:
        try:
            self.operator.call(method, params)
        except ApiError as error:
            if error.code != "busy":
                raise
            return False
        return True

    def restart(self) -> None:
        """Start it again, plainly, after a stop."""
        self._prints = False
        # It is refused while the loop has not read the stop that the stop lane has carried out.
        self.wait_for(lambda: self._is_done("machine.restart", {}), "the restart is accepted")
        self._schedule(os.SCHED_IDLE)


# ------------------------------------------------------------------------------------------ ways to stop

Send = Callable[[], object]
"""Sends the stop's last bytes."""


def hello(token: str | None = None) -> bytes:
    """Return the first message of a client."""
    params = {"version": 1, "client": "stop"} | ({} if token is None else {"token": token})
    return line({"id": 1, "method": "api.hello", "params": params})


def stop_of(who: str) -> dict[str, Any]:
    """Return the request with which WHO stops the machine."""
    return {"id": 2, "method": "machine.emergency_stop", "params": {"who": who}}


def come(opened: socket.socket, address: str | tuple[str, int], data: bytes) -> None:
    """Connect to ADDRESS and send DATA."""
    opened.connect(address)
    opened.sendall(data)


@contextlib.contextmanager
def unix(machine: Machine, who: str) -> Iterator[Send]:
    """A connection to the Unix socket that comes with its stop."""
    with socket.socket(socket.AF_UNIX) as opened:
        yield lambda: come(opened, str(machine.folder / "api.sock"), hello() + line(stop_of(who)))


@contextlib.contextmanager
def unix_open(machine: Machine, who: str) -> Iterator[Send]:
    """A connection to the Unix socket that is served already."""
    with socket.socket(socket.AF_UNIX) as opened:
        come(opened, str(machine.folder / "api.sock"), hello())
        assert opened.recv(1 << 16)
        yield lambda: opened.sendall(line(stop_of(who)))


@contextlib.contextmanager
def tcp(machine: Machine, who: str) -> Iterator[Send]:
    """A connection over TCP that comes with its token and its stop."""
    with socket.socket() as opened:
        opened.bind((OWN_ADDRESS, 0))
        data = hello(ADMIN_TOKEN) + line(stop_of(who))
        yield lambda: come(opened, ("127.0.0.1", machine.ways["tcp"]), data)


def untrusting() -> ssl.SSLContext:
    """Return TLS with whatever certificate."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


@contextlib.contextmanager
def tls(machine: Machine, who: str, *, is_new: bool) -> Iterator[Send]:
    """A connection over TCP with TLS; one that IS_NEW shakes hands only with its stop."""
    data = hello(ADMIN_TOKEN), line(stop_of(who))
    with socket.socket() as plain:
        plain.bind((OWN_ADDRESS, 0))
        with untrusting().wrap_socket(plain, do_handshake_on_connect=True) as opened:
            address = ("127.0.0.1", machine.ways["tls"])
            if is_new:
                yield lambda: come(opened, address, b"".join(data))
            else:
                come(opened, address, data[0])
                assert opened.recv(1 << 16)
                yield lambda: opened.sendall(data[1])


class Browser:
    """Is signed in to PAGES, by one link each; a context manager."""

    def __init__(self, pages: Sequence[str]) -> None:
        self._pages = [tuple(link.split("/#")) for link in pages]
        self._keys: list[str] = []
        self._runner = asyncio.Runner()
        self._http: list[aiohttp.ClientSession] = []

    def __enter__(self) -> Self:
        self._runner.run(self._sign_in())
        return self

    def __exit__(self, *error: object) -> None:
        for http in self._http:
            self._runner.run(http.close())
        self._runner.close()

    async def _sign_in(self) -> None:
        for page, code in self._pages:
            connector = aiohttp.TCPConnector(ssl=False, local_addr=(OWN_ADDRESS, 0))
            http = aiohttp.ClientSession(connector=connector, cookie_jar=aiohttp.CookieJar(unsafe=True))
            self._http.append(http)
            asked = {"token": code, "keep": True}
            async with http.post(f"{page}/login", json=asked, headers={"Origin": page}) as answer:
                self._keys.append((await answer.json())["key"])

    @contextlib.contextmanager
    def stopping(self, number: int, who: str) -> Iterator[Send]:
        """The page with that NUMBER, open."""
        page, key = self._pages[number][0], self._keys[number]

        async def opened() -> aiohttp.ClientWebSocketResponse:
            shown = await self._http[number].ws_connect(f"{page}/socket", headers={"Origin": page})
            params = {"version": 1, "client": "the page", "token": key}
            await shown.send_str(json.dumps({"id": 1, "method": "api.hello", "params": params}))
            assert "result" in json.loads((await shown.receive()).data)
            return shown

        shown = self._runner.run(opened())
        yield lambda: self._runner.run(shown.send_str(json.dumps(stop_of(who))))
        self._runner.run(shown.close())

    @contextlib.contextmanager
    def requesting(self, number: int, who: str) -> Iterator[Send]:
        """The page with that NUMBER, without a connection: its stop is a request, on a new one."""
        page, key = self._pages[number][0], self._keys[number]
        scheme, _, host = page.partition("://")
        cookies = self._http[number].cookie_jar.filter_cookies(URL(page)).values()
        body = json.dumps({"key": key, "who": who}).encode()
        head = (
            f"POST {STOP_PATH} HTTP/1.1\r\nHost: {host}\r\nOrigin: {page}\r\nContent-Length: {len(body)}\r\n"
            f"Cookie: {'; '.join(f'{cookie.key}={cookie.value}' for cookie in cookies)}\r\n\r\n"
        )
        address, _, port = host.partition(":")
        with contextlib.ExitStack() as stack:
            opened = stack.enter_context(socket.socket())
            opened.bind((OWN_ADDRESS, 0))
            if scheme == "https":
                opened = stack.enter_context(untrusting().wrap_socket(opened, do_handshake_on_connect=True))
            yield lambda: come(opened, (address, int(port)), head.encode() + body)


@contextlib.contextmanager
def klippy(machine: Machine, method: str, params: Mapping[str, str]) -> Iterator[Send]:
    """A connection of the Klippy API that comes with its stop."""
    message = json.dumps({"id": 1, "method": method, "params": params}).encode() + b"\x03"
    with socket.socket(socket.AF_UNIX) as opened:
        yield lambda: come(opened, str(machine.folder / "klippy.sock"), message)


@contextlib.contextmanager
def typed(machine: Machine) -> Iterator[Send]:
    """A line at the terminal."""
    yield lambda: os.write(machine.terminal, b"\nM112\n")


@contextlib.contextmanager
def serial(machine: Machine) -> Iterator[Send]:
    """A line of a serial host."""
    opened = os.open(machine.folder / "host.pty", os.O_WRONLY | os.O_NOCTTY)
    try:
        yield lambda: os.write(opened, b"\nM112\n")
    finally:
        os.close(opened)


WHO: Final = "stop number {}"
Way = Callable[[Machine, str], contextlib.AbstractContextManager[Send]]
"""Gets who stops."""
WAYS: Final[Mapping[str, tuple[str, Way]]] = {
    "Unix socket, new": (WHO, unix),
    "Unix socket, open": (WHO, unix_open),
    "TCP, new": (WHO, tcp),
    "TLS, new": (WHO, lambda machine, who: tls(machine, who, is_new=True)),
    "TLS, open": (WHO, lambda machine, who: tls(machine, who, is_new=False)),
    "page": (WHO, lambda machine, who: machine.browser.stopping(0, who)),
    "page with TLS": (WHO, lambda machine, who: machine.browser.stopping(1, who)),
    "page, a request": (WHO, lambda machine, who: machine.browser.requesting(0, who)),
    "page with TLS, a request": (WHO, lambda machine, who: machine.browser.requesting(1, who)),
    "Klippy API, emergency_stop": (
        "by a client of the Klippy API",
        lambda machine, _: klippy(machine, "emergency_stop", {}),
    ),
    "Klippy API, M112": (
        "M112 of a client of the Klippy API",
        lambda machine, _: klippy(machine, "gcode/script", {"script": "M112"}),
    ),
    "terminal, M112": ("M112 of a client", lambda machine, _: typed(machine)),
    "serial host, M112": ("M112 of the serial host", lambda machine, _: serial(machine)),
}
"""Whom the cause must name, and how it is done."""


# --------------------------------------------------------------------------------------------- the fuzzing


def with_terminal(command: Sequence[str], terminal: int) -> subprocess.Popen[str]:
    """Begin COMMAND in a process that has the descriptor TERMINAL, too."""
    return subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, pass_fds=(terminal,)
    )


class Fuzzers:
    """Clients of live_visits.py that come and go at MACHINE, and noise on all other ways.

    They rest until they are told to go. A context manager; what they saw goes to FOUND at its end.
    """

    def __init__(self, machine: Machine, seed: int, found: Found) -> None:
        ports = [page.split("/#")[0].rpartition(":")[2] for page in machine.ways["pages"]]
        visits = [str(machine.folder / "open.sock"), str(machine.ways["tcp"]), WATCH_TOKEN]
        noise = [str(machine.folder), ",".join(ports), str(machine.ways["tls"])]
        noise += [str(machine.ways["metrics"]), str(machine.terminal)]
        self._found = found
        self._running = [
            with_terminal(
                [*LEAST_PRIORITY, sys.executable, "-m", f"tests.fuzz.{name}", *given, str(seed)],
                machine.terminal,
            )
            for name, given in (("live_visits", visits), ("live_noise", noise))
        ]
        self.rest()

    def rest(self) -> None:
        """Let nobody come any more."""
        self._tell("rest")

    def go(self) -> None:
        """Let them come."""
        self._tell("go")

    def _tell(self, order: str) -> None:
        for process in self._running:
            assert process.stdin is not None
            process.stdin.write(order + "\n")
            process.stdin.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        visited, made = (json.loads(process.communicate()[0]) for process in self._running)
        self._found.counts.update(visited["counts"])
        self._found.problems += visited["problems"]
        self._found.counts.update({f"noise: {way}": count for way, count in made.items()})


def stop_again_and_again(machines: Sequence[tuple[Machine, Fuzzers]], minutes: float, found: Found) -> None:
    """Print, stop, restart, for MINUTES, the MACHINES in turn."""
    for machine, _ in machines:
        (machine.folder / "long.gcode").write_text(PROGRAM, encoding="ascii")
    ends_s, turn = time.monotonic() + 60 * minutes, 0
    while time.monotonic() < ends_s:
        machine, fuzzers = machines[turn % len(machines)]
        following, _ = machines[(turn + 1) % len(machines)]
        way, state = list(WAYS)[turn // len(BOUNDS_MS) % len(WAYS)], list(BOUNDS_MS)[turn % len(BOUNDS_MS)]
        turn += 1
        fuzzers.go()
        machine.begin()
        following.begin()
        stop(machine, way, state, f"{turn}", found)
        if len(machines) > 1:
            fuzzers.rest()


def stop(machine: Machine, way: str, state: str, number: str, found: Found) -> None:
    """Stop MACHINE by WAY with its loop in STATE, then restart it."""
    who, stopping = WAYS[way]
    waited_ms = machine.waited_ms
    with stopping(machine, who.format(number)) as send, machine.loop(state):
        with on_another_computer():
            sent_ns = time.monotonic_ns()
            send()
        machine.wait_for(lambda: not fan_turns(machine.folder), f"the node is stopped by {way}")
    found.stops.append(Stop(way, state, sent_ns, machine.folder, machine.waited_ms - waited_ms))
    machine.wait_for(lambda: machine.state["state"] == "shutdown", "it is shut down")
    if who.format(number) not in (cause := machine.state["cause"]):
        found.problems.append(f"stop {number} by {way}, the loop {state}: the cause is {cause!r}")
    machine.restart()


# ---------------------------------------------------------------------------------------------- the figures


def table(stops: Sequence[Stop], taken_ms: Sequence[float]) -> Iterator[str]:
    """Yield a line for each way in and each state of the loop."""
    for state, bound_ms in BOUNDS_MS.items():
        every: list[float] = []
        for way in WAYS:
            found = [
                ms for stop, ms in zip(stops, taken_ms, strict=True) if (stop.way, stop.loop) == (way, state)
            ]
            every += found
            if found:
                yield (
                    f"loop {state:<11}  {way:<27} n {len(found):4},"
                    f" median {statistics.median(found):6.2f} ms, worst {max(found):6.2f} ms"
                )
        if every:
            yield f"loop {state}: n {len(every)}, worst {max(every):.2f} ms; bound {bound_ms:g} ms"


def taken(stops: Sequence[Stop]) -> list[float]:
    """Return how long each of STOPS took to the node's pin, ms; the machines have ended."""
    found: dict[Stop, float] = {}
    for folder in {stop.machine for stop in stops}:
        own = [stop for stop in stops if stop.machine == folder]
        found |= zip(own, stopped_after_ms(folder, [stop.sent_ns for stop in own]), strict=True)
    return [found[stop] for stop in stops]


def late(found: Found, taken_ms: Sequence[float]) -> Iterator[tuple[str, bool]]:
    """Yield a sentence for each stop beyond its bound, and whether it was the computer that stood still."""
    for stop, ms in zip(found.stops, taken_ms, strict=True):
        bound_ms = BOUNDS_MS[stop.loop]
        if ms > bound_ms:
            stood_ms = stood_still_ms(found.stood_still, stop.sent_ns, stop.sent_ns + round(ms * 1e6))
            sentence = (
                f"a stop by {stop.way}, the loop {stop.loop}, took {ms:.2f} ms; bound {bound_ms:g} ms; the"
                f" computer stood still for {stood_ms:.2f} ms of it, and the loop waited {stop.waited_ms:.2f}"
                " ms for a processor"
            )
            yield sentence, ms - stood_ms <= bound_ms


def verdict(found: Found, taken_ms: Sequence[float]) -> list[str]:
    """Return what does not hold, in sentences; TAKEN_MS are the times of the stops."""
    wrong = [f"PROBLEM: {sentence}" for sentence in found.problems]
    wrong += [sentence for sentence, is_excused in late(found, taken_ms) if not is_excused]
    made = {(stop.way, stop.loop) for stop in found.stops}
    missing = [f"{way}, the loop {state}" for way in WAYS for state in BOUNDS_MS if (way, state) not in made]
    if missing:
        wrong.append(f"nobody stopped the machine by {'; '.join(missing)}: give it more minutes")
    if not found.counts["visits"] or not any(name.startswith("noise") for name in found.counts):
        wrong.append("no fuzzer came in")
    return wrong


def main() -> int:
    """Fuzz and stop; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--machines", type=int, default=5, help="that are stopped in turn")
    given = parser.parse_args()
    found = Found()
    with contextlib.ExitStack() as stack:
        standing = Standstills()
        folders = [stack.enter_context(tempfile.TemporaryDirectory()) for _ in range(given.machines)]
        with contextlib.ExitStack() as running:
            machines = [running.enter_context(Machine(Path(folder))) for folder in folders]
            fuzzed = [
                (machine, running.enter_context(Fuzzers(machine, given.seed + number, found)))
                for number, machine in enumerate(machines)
            ]
            begun_s = time.monotonic()
            with standing:
                stop_again_and_again(fuzzed, given.minutes, found)
            each_s = (time.monotonic() - begun_s) / max(1, len(found.stops))
        found.stood_still = standing.spans
        taken_ms = taken(found.stops)
    load = " ".join(f"{value:.1f}" for value in os.getloadavg())
    noise = {name: count for name, count in sorted(found.counts.items()) if name.startswith("noise")}
    rows = [
        *table(found.stops, taken_ms),
        f"{len(found.stops)} stops, one in {each_s:.1f} s; load {load}",
        f"{found.counts['visits']:,} visits, {found.counts['requests sent']:,} requests",
        *(f"{name}: {count:,} bursts" for name, count in noise.items()),
        f"the computer stood still {len(found.stood_still):,} times",
        *(f"not judged: {sentence}" for sentence, is_excused in late(found, taken_ms) if is_excused),
        *(wrong := verdict(found, taken_ms)),
    ]
    sys.stdout.write("\n".join(rows) + "\n")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
