"""A whole service on virtual nodes in real time, in the main thread, whose control loop can be held."""

import asyncio
import contextlib
import os
import pty
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import TypeVar

from coordinator.assembly.load import load_machine
from coordinator.front_ends.stop_path import StopPath
from coordinator.ipc.client.blocking import BlockingClient
from coordinator.ipc.protocol.methods import Registry
from coordinator.ipc.server.server import IpcServer
from coordinator.ipc.server.settings import IpcSettings
from coordinator.ipc.server.state import StateTree
from coordinator.klippy_api.gateway import Gateway
from coordinator.runtime.linux_host import LinuxHost
from coordinator.service.api.methods import add_methods
from coordinator.service.core.machine_service import MachineService, ServiceSettings, ServiceState
from coordinator.service.core.typed import Typed
from coordinator.service.state.log_ring import Entry
from coordinator.support.interrupts import run_to_end
from coordinator.support.loop_watchdog import WatchedLoop
from nodes.virtual.edge_log import EdgeLog
from nodes.virtual.firmware import firmware_dictionary
from nodes.virtual.plant_page import PlantItemKind, PlantPage
from tests.stages.real_nodes import CONFIG, real_nodes

MACHINE = Path("config/corexy_toolhead.cfg")
NODE, FAN_PIN = "toolhead", "PB2"
PATIENCE_S = 60.0
"""Only for what does not come at all."""


class HeldService:
    """SERVICE with its interfaces in FOLDER; what tests do is done in another thread than its loop's."""

    own_process = False
    """Whether nothing else is in this process."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.socket, self.klippy_socket = folder / "api.sock", folder / "klippy.sock"
        self.lines: list[str] = []
        self.service: MachineService
        self.loop: asyncio.AbstractEventLoop
        self.tree = StateTree()
        self.stop_path: StopPath
        self.terminal = -1
        """Where a user types, if it is the service's own."""

    @property
    def fan_turns(self) -> bool:
        """Whether the toolhead's fan is on, by its pin."""
        return fan_turns(self.folder)

    def ready(self) -> None:
        """Wait until the machine is ready, and switch the fan on."""
        self.wait_for(lambda: self.service.state is ServiceState.READY, "it is ready")
        with BlockingClient(str(self.socket)) as client:
            client.call("gcode.run", {"script": "M106 S255"})
        self.wait_for(lambda: self.fan_turns, "the fan turns")

    def wait_for(self, true: Callable[[], bool], what: str) -> None:
        """Wait until TRUE."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not true():
            assert time.monotonic() < deadline_s, f"no end of waiting until {what}: {self.lines[-5:]}"
            time.sleep(0.005)

    def restart(self, *, firmware: bool = True) -> None:
        """Start the machine that was stopped again."""
        self.wait_for(lambda: self.service.state is ServiceState.SHUTDOWN, "it is shut down")
        self.loop.call_soon_threadsafe(lambda: self.service.restart(firmware=firmware))
        self.wait_for(lambda: self.service.state is ServiceState.STARTUP, "it starts")
        self.ready()

    @contextmanager
    def held(self, *, calculating: bool = False) -> Iterator[None]:
        """Hold the loop inside, waiting or CALCULATING, which keeps the interpreter busy, too."""
        begun, over = threading.Event(), threading.Event()

        def wait() -> None:
            begun.set()
            assert over.wait(PATIENCE_S)

        def calculate() -> None:
            begun.set()
            deadline_s = time.monotonic() + PATIENCE_S
            while not over.is_set():
                assert time.monotonic() < deadline_s

        self.loop.call_soon_threadsafe(calculate if calculating else wait)
        assert begun.wait(PATIENCE_S)
        try:
            yield
        finally:
            over.set()

    async def serve(self, test: Callable[[], None]) -> None:
        """Serve until TEST, in a thread, has ended; raises what it raised."""
        self.loop = asyncio.get_running_loop()
        async with self.interfaces():
            testing = asyncio.ensure_future(asyncio.to_thread(test))
            serving = asyncio.ensure_future(self.service.run())
            try:
                await asyncio.wait((testing, serving), return_when=asyncio.FIRST_COMPLETED)
            finally:
                serving.cancel()
                await asyncio.gather(serving, return_exceptions=True)
            await testing

    def hear(self, entry: Entry) -> None:
        """Take note of a line of the service's log."""
        self.lines.append(str(entry["text"]))

    @asynccontextmanager
    async def interfaces(self) -> AsyncIterator[None]:
        """Serve on all ways in."""
        registry = Registry()
        settings = ServiceSettings(name="held", jobs=self.folder, own_process=self.own_process)
        self.service = MachineService(
            lambda: load_machine(str(self.folder / CONFIG)),
            LinuxHost(),
            self.tree,
            settings,
            on_line=self.hear,
        )
        add_methods(self.service, registry)
        path = self.stop_path = StopPath(self.service)
        server = IpcServer(registry, self.tree, IpcSettings(unix_path=self.socket), stop_lane=path.lane)
        gateway = Gateway(
            self.service, self.folder / CONFIG, on_notice=self.lines.append, stop_lane=path.lane
        )
        typed = Typed(self.service, self.lines.append)
        path.lane.look_also(typed.find_stop)
        await server.start()
        await gateway.start(self.klippy_socket)
        path.start()
        try:
            yield
        finally:
            path.close()
            typed.close()
            await server.close()
            await gateway.close()


def fan_turns(folder: Path) -> bool:
    """Return whether the fan of the toolhead in FOLDER is on, by its pin."""
    return PlantPage.at(folder, NODE).item(PlantItemKind.FAN, "fan").value > 0


def stopped_after_ms(folder: Path, sent_ns: Sequence[int]) -> list[float]:
    """Return how long after each of SENT_NS (CLOCK_MONOTONIC) the fan's pin went low; its node has ended."""
    log = EdgeLog(folder / f"{NODE}.edges")
    pin = firmware_dictionary("canductor-node-toolhead").enumerations["pin"].values[FAN_PIN]
    off = [
        int(at_ns)
        for clocks, _, levels in log.edges(pin)
        for at_ns, level in zip(log.ticks_to_monotonic_ns(clocks), levels, strict=True)
        if not level
    ]
    return [(min(at for at in off if at > sent) - sent) / 1e6 for sent in sent_ns]


H = TypeVar("H", bound=HeldService)


def serve_held(
    folder: Path,
    test: Callable[[H], None],
    kind: type[H] = HeldService,  # type: ignore[assignment]
    *,
    terminal: int | None = None,
) -> None:
    """Run TEST with a service in FOLDER, of this KIND; TERMINAL is its end of one, None: it gets one."""
    held = kind(folder)
    stdin = sys.stdin
    with real_nodes(MACHINE, folder), contextlib.ExitStack() as stack:
        if terminal is None:
            held.terminal, terminal = pty.openpty()
            stack.callback(os.close, held.terminal)
        # Homing across nodes needs the host every quarter of a second, which a busy computer may not give it.
        with (folder / CONFIG).open("a", encoding="utf-8") as config:
            config.write("\n[force_move]\nenable_force_move: True\n")
        sys.stdin = stack.enter_context(os.fdopen(terminal))
        try:
            run_to_end(lambda: held.serve(lambda: test(held)), WatchedLoop)
        finally:
            sys.stdin = stdin
