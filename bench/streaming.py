"""`canductor run` in a world ten times as fast: what lead the motion worker keeps on one core.

    python bench/streaming.py [--factor N] [--lines N] [CONFIG.cfg] [FILE.gcode]

Host and virtual nodes run with a clock that is FACTOR times as fast (fast_clock.c): the host prints FACTOR
seconds of motion in every second, on a core of its own, the nodes execute every step of it on the others.
All figures but the CPU time are in the seconds of that world: a lead of 500 ms lasts 50 ms of ours, and what
the host computes counts ten times. The worker's lead is how far ahead of now its commands reach when it hands
them over, smallest from a second after the start to the end of the file; M400 is left out, since nobody can
be ahead of a wait. A command's lead is from its arrival at the node until it is due, the start included.
At last, in real time: from the first G1 to the first step.
"""

import argparse
import asyncio
import json
import math
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from coordinator.assembly.load import load_machine
from coordinator.config.model import CanConnection, MachineDescription
from coordinator.gcode.program import Program
from coordinator.runtime.machine import Machine
from coordinator.service.core.job_runner import run_job
from coordinator.streaming.streamer import Streamer
from coordinator.support.progress import Progress
from nodes.virtual.edge_log import EdgeLog
from nodes.virtual.firmware import MAINBOARD, firmware_dictionary
from nodes.virtual.hub import VirtualBus
from nodes.virtual.processes import NodeProcess

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
FAST_CLOCK = ROOT / "build" / "bench" / "fast_clock.so"
HOST_CORE = 0
SETTLED_S = 1.0
"""From the job's first motion until the look-ahead must be full."""
TYPED_AFTER_NS = 1_000_000_000


class Typed:
    """A program that someone types: G28 at once, a G1 a second later, when the machine has long been idle."""

    def __init__(self) -> None:
        self.begun_ns = 0
        self.typed_ns = 0
        self._pieces = [b"G28\n", b"G1 X10 F6000\n"]

    def read(self, _: int, /) -> bytes | None:
        """Return what was typed, None when there is nothing, nothing at all at the end."""
        now = time.monotonic_ns()
        if len(self._pieces) == 2:
            self.begun_ns = now
        elif self._pieces and now < self.begun_ns + TYPED_AFTER_NS:
            return None
        else:
            self.typed_ns = self.typed_ns or now
        return self._pieces.pop(0) if self._pieces else b""

    def close(self) -> None:
        """Nothing to let go of."""


def build_fast_clock() -> None:
    FAST_CLOCK.parent.mkdir(parents=True, exist_ok=True)
    command = ["gcc", "-O2", "-shared", "-fPIC", "bench/fast_clock.c", "-o", FAST_CLOCK, "-ldl"]
    subprocess.run(command, cwd=ROOT, check=True)


@contextmanager
def fast_world(factor: int) -> Iterator[None]:
    """Let every process that is started meanwhile live in the fast world."""
    os.environ |= {"LD_PRELOAD": str(FAST_CLOCK), "FAST_CLOCK": str(factor)}
    try:
        yield
    finally:
        del os.environ["LD_PRELOAD"], os.environ["FAST_CLOCK"]


@contextmanager
def virtual_machine(config: Path, folder: Path, *, edges: bool = False) -> Iterator[Path]:
    """Play the nodes of CONFIG; yield the configuration that leads to them, in FOLDER."""
    text, description = config.read_text(), load_machine(str(config))
    others = sorted(set(os.sched_getaffinity(0)) - {HOST_CORE}) or [HOST_CORE]
    with ExitStack() as stack:
        started: list[NodeProcess] = []
        for index, node in enumerate(description.nodes):
            path = folder / f"{node.name}.link"
            log = folder / f"{node.name}.edges" if edges else None
            if isinstance(node.connection, CanConnection):
                stack.enter_context(VirtualBus(str(path), bitrate=1_000_000))
                text = text.replace(
                    f"canbus_interface: {node.connection.interface}", f"canbus_interface: virtual:{path}"
                )
                options: dict[str, Any] = {"uuid": node.connection.uuid, "can": path}
            else:
                section = "mcu" if index == 0 else f"mcu {node.name}"
                text = re.sub(rf"(?s)(\[{section}\][^\[]*?serial:)[^\n]*", rf"\1 {path}", text)
                options = {"uuid": "000000000000", "uart": path}
            flavour: Any = "mainboard" if index == 0 else "toolhead"
            process = stack.enter_context(NodeProcess(flavour, edge_log=log, name=node.name, **options))
            os.sched_setaffinity(process.pid, others)
            started.append(process)
        for process in started:
            process.wait_ready()
        # No plant stands around these nodes: nothing switches an endstop, and nothing gets warm.
        text = re.sub(r"(?m)^endstop_pin:.*\n", "", text)
        text = re.sub(r"(?m)^\[extruder\]$", "[extruder]\nmin_extrude_temp: 0", text)
        played = folder / "machine.cfg"
        played.write_text(text)
        yield played


LEFT_OUT = ("M400", "M104", "M109", "M140", "M190")


def without_waits(gcode: Path, lines: int | None, folder: Path) -> Path:
    """Write what is to be played: the first LINES, without heat and M400: nobody can be ahead of a wait."""
    part = folder / gcode.name
    with gcode.open() as source:
        part.write_text("".join(line for line in islice(source, lines) if not line.startswith(LEFT_OUT)))
    return part


class LeadWatch:
    """Looks at the worker's lead whenever it hands commands over."""

    def __init__(self) -> None:
        self.machine: Machine | None = None
        self.least_s = math.inf

    def look(self, _: Progress) -> None:
        """Take the lead as it is now."""
        assert self.machine is not None
        streamer = self.machine._job  # noqa: SLF001  (nobody but this bench needs to see into a running job)
        if not isinstance(streamer, Streamer) or streamer.ended_s:
            return
        now = streamer.print_time_now()
        if now > streamer.began_s + SETTLED_S:
            self.least_s = min(self.least_s, streamer.worker.steps.generated_until - now)

    def note(self, machine: Machine) -> None:
        """Learn of the machine once it is ready."""
        self.machine = machine


def host(config: Path, gcode: Path) -> None:
    """Be the host: run GCODE and print what came of it as one JSON line."""
    watch = LeadWatch()
    with Program.open(gcode) as program:
        job = run_job(
            load_machine(str(config)), program, watch.look, on_output=lambda _: None, on_ready=watch.note
        )
        outcome = asyncio.run(job)
    assert outcome.positions == outcome.issued, "the nodes counted other steps than were sent"
    usage = resource.getrusage(resource.RUSAGE_SELF)
    figures = {
        "lead_s": watch.least_s,
        "print_time_s": outcome.print_time_s,
        "moves": outcome.moves,
        "steps": outcome.steps,
        "cpu_s": usage.ru_utime + usage.ru_stime,
        "nodes": {
            n.name: [n.link.min_lead_s, n.link.srtt_s, n.link.bytes_sent, n.link.bytes_repeated]
            for n in outcome.nodes
        },
    }
    print(json.dumps(figures))


def stream(config: Path, gcode: Path, lines: int | None, factor: int) -> None:
    with tempfile.TemporaryDirectory() as name, fast_world(factor):
        folder = Path(name)
        with virtual_machine(config, folder) as played:
            files = [str(played), str(without_waits(gcode, lines, folder))]
            command = ["taskset", "-c", str(HOST_CORE), sys.executable, __file__, "--host", *files]
            begin_s = time.monotonic()
            done = subprocess.run(command, stdout=subprocess.PIPE, check=False)
            took_s = time.monotonic() - begin_s
    if done.returncode:
        sys.exit(f"{gcode}: the job failed")
    run: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    print(
        f"{gcode.stem}, {config.stem}, {factor} times real time: {run['print_time_s']:.1f} s of print, "
        f"{run['moves']:,} moves, {run['steps']:,} steps in {took_s:.1f} s; "
        f"host {run['cpu_s']:.1f} s of CPU on core {HOST_CORE} ({100 * run['cpu_s'] / took_s:.0f} %)"
    )
    print(f"  smallest lead of the worker {run['lead_s'] * 1e3:.0f} ms")
    for node, (lead_s, round_trip_s, sent, repeated) in run["nodes"].items():
        print(
            f"  {node}: smallest lead of a command {lead_s * 1e3:.0f} ms, "
            f"round trip {round_trip_s * 1e6:.0f} us, {sent:,} bytes, {repeated:,} of them again"
        )


def first_step(description: MachineDescription, log: EdgeLog) -> int:
    """Return the node's clock at the first change of the X stepper's step pin."""
    pins = firmware_dictionary(MAINBOARD).enumerations["pin"].values
    pin = pins[next(s for s in description.steppers if s.name == "stepper_x").step_pin.name]
    return next(int(clock[0]) for clock, _, _ in log.edges(pin) if len(clock))


def first_motion(config: Path) -> None:
    """In real time: from reading a G1 at rest to the first step, by the node's own log."""
    typed = Typed()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with virtual_machine(config, folder, edges=True) as played:
            description = load_machine(str(played))
            with Program(typed, "typed") as program:
                job = run_job(description, program, on_output=lambda _: None)
                asyncio.run(job)
        log = EdgeLog(folder / f"{description.nodes[0].name}.edges")
        first_ns = int(log.ticks_to_monotonic_ns(first_step(description, log)))
    print(
        f"{config.stem}: first step {(first_ns - typed.typed_ns) * 1e-6:.0f} ms after the first G1 was read"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--factor", type=int, default=10)
    parser.add_argument("--lines", type=int, help="only so many lines of the file")
    parser.add_argument("--host", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.host:
        host(*chosen.files)
        return
    configs = [f for f in chosen.files if f.suffix == ".cfg"]
    programs = [f for f in chosen.files if f.suffix != ".cfg"]
    config, program = DATA / "config/cartesian_plain.cfg", DATA / "gcode/vase.gcode"
    if not program.exists():
        config, program = ROOT / "config/demo/machine.cfg", ROOT / "config/demo/part.gcode"
    build_fast_clock()
    for machine in configs or [config]:
        for gcode in programs or [program]:
            stream(machine, gcode, chosen.lines, chosen.factor)
        first_motion(machine)


if __name__ == "__main__":
    main()
