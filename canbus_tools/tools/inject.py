"""``canductor can inject``: a virtual bus with faults, for tests of a host or a board.

It runs the bus, optionally nodes with the project's firmware and a socketcand server for other CAN programs,
shows the status, and prints figures at the end.
"""

import argparse
import asyncio
import contextlib
import json
import math
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import AsyncExitStack, ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final, cast

from canbus_tools.inject.fault_options import declare_faults, read_faults
from canbus_tools.inject.inject_report import InjectReport, StatusLine
from canbus_tools.inject.socketcand_server import PORT, SocketcandServer
from nodes.support.option_values import UsageError, decimal, integer, options_from, parse_int
from nodes.support.terminal import show
from nodes.virtual.faults import BusFault
from nodes.virtual.hub import BITRATE_MAX, BusStats, VirtualBus
from nodes.virtual.processes import Flavour, NodeProcess

FLAVOURS: Final = ("mainboard", "toolhead")
NODES_MAX: Final = 32
TICK_S: Final = 0.5
"""How often the status line is renewed, and nodes and bus are looked after."""
DEFAULT_PATH: Final = Path(tempfile.gettempdir()) / "canductor-bus"


@dataclass(frozen=True, slots=True, kw_only=True)
class InjectOptions:
    """What is to be run."""

    path: Path = DEFAULT_PATH
    """Where the bus's socket goes."""
    bitrate: int = 1_000_000
    """Bit/s; 0: frames take no time."""
    seed: int = 0
    faults: tuple[tuple[str, BusFault], ...] = ()
    """With the words that asked for each."""
    nodes: Mapping[str, Flavour] = field(default_factory=dict)
    """Firmware processes by name, in the order in which they connect."""
    socketcand: tuple[str, int] | None = None
    """Host and port for other CAN programs."""
    socketcand_bus: str = "can0"
    duration_s: float | None = None
    """None: until Ctrl-C."""
    json: bool = False


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options of this tool."""
    add = command.add_argument
    add(
        "-c",
        "--channel",
        dest="path",
        type=Path,
        default=DEFAULT_PATH,
        metavar="PATH",
        help="socket of the bus; other tools use it with -i canductor -c PATH",
    )
    add(
        "-b",
        "--bitrate",
        type=integer(0, BITRATE_MAX),
        default=1_000_000,
        metavar="BIT/S",
        help="bit rate; 0: unlimited",
    )
    add(
        "--seed",
        type=integer(0, 2**64 - 1),
        default=0,
        metavar="N",
        help="selects the frames that the faults affect",
    )
    add(
        "--duration",
        "--for",
        dest="duration_s",
        type=decimal(0, 1e8, "s"),
        metavar="S",
        help="stop after this many seconds (default: at Ctrl-C)",
    )
    add(
        "--nodes",
        type=_nodes,
        default={},
        metavar="BOARD,…",
        help=f"run nodes with canductor's firmware: {' or '.join(FLAVOURS)}; a board may be repeated",
    )
    add(
        "--socketcand",
        type=_address,
        metavar="[HOST:]PORT",
        help=f"serve the socketcand protocol (default host: 127.0.0.1; usual port: {PORT}; 0: any port)",
    )
    add(
        "--socketcand-bus",
        type=_bus_name,
        metavar="NAME",
        default="can0",
        help="name of the bus for socketcand clients",
    )
    declare_faults(command)


def make_job(given: argparse.Namespace) -> Callable[[object], InjectReport]:
    """Check what was given; raises UsageError."""
    places = {node: place for place, node in enumerate(given.nodes)}
    options = options_from(InjectOptions, given, faults=tuple(read_faults(given, places)))
    return lambda _: Injection(options).run()


def _bus_name(text: str) -> str:
    if not 1 <= len(text) <= 16 or not text.isascii() or not text.replace("-", "").replace("_", "").isalnum():
        raise UsageError(f"is '{text}', must be 1 to 16 letters and digits")
    return text


def _nodes(text: str) -> dict[str, Flavour]:
    words = text.split(",")
    for word in words:
        if word not in FLAVOURS:
            raise UsageError(f"has '{word}', must be {' or '.join(FLAVOURS)}, separated by commas")
    if len(words) > NODES_MAX:
        raise UsageError(f"has {len(words)} nodes, must be at most {NODES_MAX}")
    names: dict[str, Flavour] = {}
    seen: Counter[str] = Counter()
    for word in words:
        seen[word] += 1
        names[word if seen[word] == 1 else f"{word}{seen[word]}"] = cast("Flavour", word)
    return names


def _address(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if colon and not host:
        raise UsageError(f"is '{text}', must be a port, or HOST:PORT")
    return host.strip("[]") or "127.0.0.1", parse_int(port, 0, 65535, name="port")


def uuid_of(index: int) -> str:
    """Return the uuid of the node at place INDEX: recognisable, and the same in every run."""
    return f"ca4d{index + 1:08x}"


class Injection:
    """One run, from the bus's start to its figures."""

    def __init__(self, options: InjectOptions) -> None:
        """Nothing happens before run(); raises CanductorError for a bus that cannot be."""
        self._options = options
        self._bus = VirtualBus(options.path, bitrate=options.bitrate, seed=options.seed)
        self._processes: dict[str, NodeProcess] = {}
        self._server: SocketcandServer | None = None
        self._stats: BusStats | None = None
        self._ran_s = 0.0

    def run(self) -> InjectReport:
        """Run until the time is over or Ctrl-C, which is the usual end, and report."""
        options = self._options
        with ExitStack() as stack:
            stack.enter_context(self._bus)
            self._start_nodes(stack)
            with contextlib.suppress(KeyboardInterrupt):  # the user has seen enough
                asyncio.run(self._serve())
            figures = {name: process.stop() for name, process in self._processes.items()}
        return InjectReport(
            path=str(options.path),
            bitrate=options.bitrate,
            seed=options.seed,
            ran_s=self._ran_s,
            stats=self._stats or self._bus.stats,
            faults=tuple(words for words, _ in options.faults),
            nodes=figures,
            socketcand=None if self._server is None else asdict(self._server.stats),
        )

    def _start_nodes(self, stack: ExitStack) -> None:
        """One after the other, so that each has the place on the bus that its order says."""
        for place, (name, flavour) in enumerate(self._options.nodes.items()):
            process = NodeProcess(flavour, name=f"node {name}", uuid=uuid_of(place), can=self._options.path)
            self._processes[name] = stack.enter_context(process)
            process.wait_ready()

    async def _serve(self) -> None:
        options = self._options
        async with AsyncExitStack() as stack:
            if options.socketcand is not None:
                host, port = options.socketcand
                server = SocketcandServer(options.path, host, port, options.socketcand_bus)
                self._server = await stack.enter_async_context(server)
            self._bus.set_faults([fault for _, fault in options.faults])
            begin_s = time.monotonic()
            self._say_ready()
            line = StatusLine(sys.stderr, self._bus) if not options.json and sys.stderr.isatty() else None
            try:
                await self._watch(begin_s, line)
            finally:
                self._ran_s = time.monotonic() - begin_s
                self._stats = self._bus.stats  # while the clients of socketcand are still there
                if line is not None:
                    line.clear()

    async def _watch(self, begin_s: float, line: StatusLine | None) -> None:
        duration_s = math.inf if self._options.duration_s is None else self._options.duration_s
        while (left_s := begin_s + duration_s - time.monotonic()) > 0 and self._bus.running:
            for process in self._processes.values():
                if not process.running:
                    process.stop()  # raises what it said when it died
            if line is not None:
                line.show(0 if self._server is None else self._server.stats.connected)
            await asyncio.sleep(min(TICK_S, left_s))

    def _say_ready(self) -> None:
        """Print how to attach to the bus: in JSON on a line of its own, for programs that start this one."""
        path, server = self._options.path, self._server
        uuids = {name: uuid_of(place) for place, name in enumerate(self._processes)}
        if self._options.json:
            address = None if server is None else f"{server.host}:{server.port}"
            said = json.dumps({"ready": True, "bus": str(path), "nodes": uuids, "socketcand": address})
        else:
            lines = [f"virtual bus ready; attach with -i canductor -c {path}"]
            lines += [f"node {name} has uuid {uuid}" for name, uuid in uuids.items()]
            if server is not None:
                lines.append(f"socketcand at {server.host}:{server.port}, bus {server.name}")
            said = "\n".join(lines)
        show(said)
