"""`canductor run` in a world ten times as fast: what lead the motion worker keeps on one core.

    python bench/streaming.py [--factor N] [--lines N] [CONFIG.cfg] [FILE.gcode]

Host and virtual nodes run with a clock that is FACTOR times as fast (fast_clock.c): the host prints FACTOR
seconds of motion in every second, on a core of its own, the nodes execute every step of it on the others.
All figures but the CPU time are in the seconds of that world: a lead of 500 ms lasts 50 ms of ours, and what
the host computes counts ten times. At last, in real time: from the first G1 to the first step.
"""

import argparse
import asyncio
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from coordinator.app import Machine
from coordinator.gcode.program import Program
from coordinator.machine.description import CanConnection, MachineDescription, load_machine
from coordinator.session import run_job
from nodes.virtual.edge_log import EdgeLog
from nodes.virtual.firmware import MAINBOARD, firmware_dictionary
from nodes.virtual.hub import VirtualBus
from nodes.virtual.processes import NodeProcess

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / "shared" / "data"
FAST_CLOCK = ROOT / "build" / "bench" / "fast_clock.so"
HOST_CORE = 0
FIRST_MOVES = "G28\nG1 X10 F6000\nG1 X0\n"


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
        played = folder / "machine.cfg"
        played.write_text(text)
        yield played


def shortened(gcode: Path, lines: int | None, folder: Path) -> Path:
    if lines is None:
        return gcode
    part = folder / gcode.name
    with gcode.open() as source:
        part.write_text("".join(line for line, _ in zip(source, range(lines), strict=False)))
    return part


def stream(config: Path, gcode: Path, lines: int | None, factor: int) -> None:
    with tempfile.TemporaryDirectory() as name, fast_world(factor):
        folder = Path(name)
        with virtual_machine(config, folder) as played:
            command = [str(Path(sys.executable).parent / "canductor"), "run", str(played)]
            command += ["--gcode", str(shortened(gcode, lines, folder)), "--json"]
            begin_s = time.monotonic()
            with (folder / "out").open("w+b") as out:
                process = subprocess.Popen(
                    ["taskset", "-c", str(HOST_CORE), *command], stdout=out, stderr=out
                )
                _, status, usage = os.wait4(process.pid, 0)
                process.returncode = os.waitstatus_to_exitcode(status)
                out.seek(0)
                text = out.read().decode()
            took_s = time.monotonic() - begin_s
    if process.returncode:
        sys.exit(text)
    report = json.loads(text.splitlines()[-1])
    cpu_s = usage.ru_utime + usage.ru_stime
    print(
        f"{gcode.stem}, {config.stem}, {factor} times real time: {report['print_time_s']:.1f} s of print, "
        f"{report['moves']:,} moves, {report['steps']:,} steps in {took_s:.1f} s; "
        f"host {cpu_s:.1f} s of CPU on core {HOST_CORE} ({100 * cpu_s / took_s:.0f} %)"
    )
    for node, figures in report["nodes"].items():
        lead = figures["min_lead_ms"]
        print(
            f"  {node}: smallest lead {lead} ms, round trip {figures['round_trip_us']:.0f} us, "
            f"{figures['bytes_sent']:,} bytes, {figures['retransmitted_bytes']} of them again"
        )


def first_step(description: MachineDescription, log: EdgeLog) -> int:
    """Return the node's clock at the first change of the X stepper's step pin."""
    pins = firmware_dictionary(MAINBOARD).enumerations["pin"].values
    pin = pins[next(s for s in description.steppers if s.name == "stepper_x").step_pin.name]
    return next(int(clock[0]) for clock, _, _ in log.edges(pin) if len(clock))


def first_motion(config: Path) -> None:
    """In real time: how long after the job begins the first step is done, by the node's own log."""
    ready_ns = 0

    def note(machine: Machine) -> None:
        nonlocal ready_ns
        ready_ns = machine.host.now()

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with virtual_machine(config, folder, edges=True) as played:
            gcode = folder / "first.gcode"
            gcode.write_text(FIRST_MOVES)
            description = load_machine(str(played))
            with Program.open(gcode) as program:
                asyncio.run(
                    run_job(description, program, lambda _: None, on_told=lambda _: None, on_ready=note)
                )
        log = EdgeLog(folder / f"{description.nodes[0].name}.edges")
        first_ns = int(log.ticks_to_monotonic_ns(first_step(description, log)))
    print(f"{config.stem}: first step {(first_ns - ready_ns) * 1e-6:.0f} ms after the job began with a G1")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--factor", type=int, default=10)
    parser.add_argument("--lines", type=int, help="only so many lines of the file")
    chosen = parser.parse_args()
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
