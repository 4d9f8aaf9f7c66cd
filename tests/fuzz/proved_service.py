"""A machine that is served and prints on virtual nodes, and proves every step of it at its end.

A process of its own, for fuzzers to do their worst to: `python -m tests.fuzz.proved_service FOLDER GCODE`. It
serves at FOLDER/open.sock (whoever comes may watch) and over TCP on loopback (tokens below). It prints its
port once the machine is ready, and when its standard input ends, one JSON line: the demo's proof, and for
each job the smallest lead of motion.
"""

import asyncio
import json
import os
import re
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from coordinator.assembly.load import load_machine
from coordinator.demo.report import report_of
from coordinator.demo.run import DemoOptions
from coordinator.ipc.protocol.limits import Limits
from coordinator.ipc.protocol.methods import Registry, Scope
from coordinator.ipc.server.server import IpcServer
from coordinator.ipc.server.settings import IpcSettings, TcpSettings
from coordinator.ipc.server.state import StateTree
from coordinator.ipc.server.uploads import upload_method
from coordinator.motion.moves import MOVE_BYTES
from coordinator.runtime.linux_host import LinuxHost
from coordinator.service.api.methods import add_methods
from coordinator.service.core.machine_service import MachineService, ServiceSettings
from coordinator.service.core.motion_lead import MotionLead
from coordinator.service.jobs.outcome import Outcome, outcome_of
from coordinator.service.state.log_ring import Entry
from coordinator.streaming.pipeline import PlanRecord
from coordinator.support.examples import DEMO_MACHINE
from coordinator.verification.prover import Prover
from coordinator.virtual_machine.virtual_machine import VirtualMachine

WATCH_TOKEN, ADMIN_TOKEN = "watch" * 8, "admin" * 8
LOOK_S = 0.02
NODES_PRIORITY, SERVICE_PRIORITY = 10, 5


class FiledRecord(PlanRecord):
    """Keeps trapezoids in a file: the memory that is watched is to be the service's own."""

    __slots__ = ("_file",)

    def __init__(self, path: Path) -> None:
        super().__init__((0.0, 0.0, 0.0, 0.0))
        self._file = path.open("ab")

    def restart(self) -> None:
        super().restart()
        self._file.truncate(0)

    def add(self, moves: bytes) -> None:
        self._file.write(moves)
        self.count += len(moves) // MOVE_BYTES

    def every(self) -> bytes:
        self._file.flush()
        return Path(self._file.name).read_bytes()


class Proved:
    """The service, its server, and what was noted of them."""

    def __init__(self, stage: VirtualMachine, folder: Path, jobs: Path) -> None:
        self.record = FiledRecord(folder / "trapezoids")
        self.leads: list[float | None] = []
        self.both_edges: dict[str, bool] = {}
        self.claimed: dict[str, list[str]] = {}
        tokens = folder / "tokens"
        tokens.touch(0o600)
        tokens.write_text(f"watch fuzzer {WATCH_TOKEN}\nadmin operator {ADMIN_TOKEN}\n")
        tree, registry = StateTree(), Registry()
        self.service = MachineService(
            lambda: stage.description,
            LinuxHost(),
            tree,
            ServiceSettings(name="proved", jobs=jobs, node_commands=True, own_process=True),
            record=self.record,
            on_line=self._tell,
        )
        add_methods(self.service, registry)
        registry.add(upload_method(jobs))
        settings = IpcSettings(
            unix_path=folder / "open.sock",
            unix_scope=Scope.WATCH,
            tcp=TcpSettings(host="127.0.0.1", port=0, tokens=tokens, plain_on_loopback=True),
            limits=Limits(message_timeout_s=1.0),
        )
        self.server = IpcServer(registry, tree, settings)

    def _tell(self, entry: Entry) -> None:
        self.server.notify("log", dict(entry))

    async def serve(self, ended: asyncio.Event) -> Outcome:
        """Serve until ENDED, and return what the machine did."""
        await self.server.start()
        life = asyncio.ensure_future(self.service.run())
        try:
            await self._ready(life)
            _say(str(self.server.tcp_port))
            noting = asyncio.ensure_future(self._note_leads())
            await asyncio.wait(
                (noting, life, asyncio.ensure_future(ended.wait())), return_when="FIRST_COMPLETED"
            )
            assert not life.done(), life
            noting.cancel()
            motion = self.service.motion
            assert motion is not None, self.service.cause
            motion.finish()
            while not motion.streamer.ended_s or not motion.standing:
                assert self.service.state != "shutdown", self.service.cause
                await asyncio.sleep(LOOK_S)
            self._note_lead(motion.lead)
            assert self.service.machine is not None
            return await outcome_of(self.service.machine, motion.streamer)
        finally:
            life.cancel()
            with suppress(asyncio.CancelledError):
                await life
            await self.server.close()

    async def _ready(self, life: asyncio.Future[None]) -> None:
        while self.service.motion is None:
            assert not life.done(), life
            assert self.service.state != "error", self.service.cause
            await asyncio.sleep(LOOK_S)
        assert self.service.machine is not None
        steppers = self.service.machine.devices.steppers
        pins = self.service.machine.modules.pins
        self.claimed |= {name: pins.claimed(name) for name in self.service.machine.nodes}
        self.both_edges |= {name: stepper.steps_on_both_edges for name, stepper in steppers.items()}

    async def _note_leads(self) -> None:
        """Note the smallest lead of each job when the next one begins."""
        job = None
        while True:
            motion = self.service.motion
            if self.service.job is not job and motion is not None:
                if job is not None:
                    self._note_lead(motion.lead)
                job = self.service.job
                motion.lead = MotionLead()
            await asyncio.sleep(LOOK_S)

    def _note_lead(self, lead: MotionLead) -> None:
        self.leads.append(None if lead.least_s is None else round(lead.least_s * 1e3, 1))


async def _serve(proved: Proved) -> Outcome:
    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(sys.stdin, ended.set)
    try:
        return await proved.serve(ended)
    finally:
        loop.remove_reader(sys.stdin)


def _prefer(pid: int, priority: int) -> None:
    """Let a process run before others, as far as the user may ask for that; 0 is this one."""
    with suppress(PermissionError):
        os.sched_setscheduler(pid, os.SCHED_RR, os.sched_param(priority))


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    """Serve, and prove."""
    folder, jobs = map(Path, sys.argv[1:])
    # Without endstops G28 moves nothing, so that every print begins where the one before it ended.
    machine = folder / "machine.cfg"
    machine.write_text(re.sub(r"endstop_pin: .*\n", "", DEMO_MACHINE.read_text()))
    options = DemoOptions(machine=machine)
    description = load_machine(str(options.machine))
    with VirtualMachine(description, options, folder) as stage:
        # What is proved is that clients do no harm through the sockets. Other processes may: a busy computer
        # was seen to leave the service without a processor for a second, and boards, which have their own.
        for node in stage.processes.values():
            _prefer(node.pid, NODES_PRIORITY)
        _prefer(0, SERVICE_PRIORITY)
        proved = Proved(stage, folder, jobs)
        outcome = asyncio.run(_serve(proved))
        figures = stage.stop_nodes()
        prover = Prover(
            description,
            stage.edge_log,
            outcome,
            proved.record,
            both_edges=proved.both_edges,
            claimed=proved.claimed,
        )
        report = report_of(prover, stage, figures, outcome, [])
        told: dict[str, Any] = {"leads_ms": proved.leads, **report.to_json(), "ok": report.ok}
        _say(json.dumps(told | {"server": proved.server.figures()}))


if __name__ == "__main__":
    main()
