"""``make soak``: a real service on virtual nodes prints again and again while clients connect and disconnect.

    python -m tests.soak.run [--minutes M]

At the end of each print, when no client is there but the one that starts the prints, memory, descriptors and
threads of the service are measured. Exit status 1: a print did not succeed, or one of them grows. Of a print
that did not succeed, what the nodes report and who had to wait for a processor meanwhile is shown.
"""

import argparse
import asyncio
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from coordinator.ipc.client.client import Client
from nodes.support.errors import CanductorError
from tests.soak.footprint import Footprint, growth, of_process, problems
from tests.soak.waiting import command_of, family, waited_s

ROOT: Final = Path(__file__).resolve().parents[2]
CLIENTS: Final = 4
START_S: Final = 60.0
LOOK_S: Final = 0.1
END_S: Final = 30.0
PRINT_S: Final = 120.0
"""A print that takes longer hangs; it takes some four seconds of motion."""
SETTLE_S: Final = 0.5
"""So long after the clients have gone the server has closed what they used."""
OUTPUT_MAX: Final = 4000
"""Characters of the service's output that are shown after a failure, the last ones."""


def job(prints: int) -> str:
    """Return a short job; every print has another path, so that nothing is merely repeated."""
    chance = random.Random(prints)
    lines = ["G28", "G90", "M83", "G1 Z0.3 F600"]
    for _ in range(30):
        x, y = chance.uniform(20, 80), chance.uniform(20, 80)
        lines.append(f"G1 X{x:.3f} Y{y:.3f} E{chance.uniform(0, 0.5):.4f} F{chance.randrange(6000, 12000)}")
    return "\n".join(lines) + "\n"


@contextmanager
def service(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run the demo's virtual machine as a service in FOLDER; its output goes to a file there."""
    command = [sys.executable, "-m", "coordinator.cli.main", "demo", "--serve", "--no-web", "--ipc"]
    with (folder / "output").open("wb") as output:
        process = subprocess.Popen(
            [*command, str(folder / "soak.sock"), "--jobs", str(folder / "jobs")],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        try:
            yield process
        finally:
            process.terminate()
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


async def come_and_go(address: str, seed: int, stop: asyncio.Event) -> int:
    """Connect, watch for a moment, ask something, disconnect, again and again; return how often."""
    chance, visits = random.Random(seed), 0
    while not stop.is_set():
        with suppress(TimeoutError):
            async with Client(address) as client:
                await client.call("machine.state")
                if chance.random() < 0.5:
                    async with asyncio.timeout(chance.uniform(0.0, 1.0)):
                        async for _ in client.watch(["*"], rate_hz=20):
                            if stop.is_set():
                                break
                else:
                    await client.call("state.get", {"fields": ["*"]})
        visits += 1
    return visits


async def one_print(client: Client, address: str, folder: Path, number: int) -> int:
    """Print while clients come and go; return how many visits there were."""
    (folder / "jobs" / "soak.gcode").write_text(job(number))
    stop = asyncio.Event()
    visitors = [
        asyncio.ensure_future(come_and_go(address, number * CLIENTS + k, stop)) for k in range(CLIENTS)
    ]
    try:
        await client.call("job.start", {"file": "soak.gcode"})
        async with asyncio.timeout(PRINT_S):
            async for update in client.watch(["job.state"], rate_hz=10):
                state = update.values.get("job.state")
                if state not in (None, "printing"):
                    break
        if state != "done":
            raise CanductorError(f"print {number}: the job ended as '{state}'")
    finally:
        stop.set()
        visits = await asyncio.gather(*visitors)
    await asyncio.sleep(SETTLE_S)
    return sum(visits)


async def explain(client: Client, began_s: float, before: dict[int, float]) -> str:
    """Return what may say why the print begun at BEGAN_S failed; BEFORE: ``waited_s`` of each process."""
    took_s = time.monotonic() - began_s
    waits = [f"{command_of(pid)} {waited_s(pid) - then_s:.3f} s" for pid, then_s in before.items()]
    lines = [f"waited for a processor in the {took_s:.3f} s of this print: {', '.join(waits)}"]
    try:
        state = await client.call("state.get", {"fields": ["machine.*", "nodes.*"]})
    except CanductorError as error:
        return "\n".join([*lines, f"the service does not answer: {error}"])
    return "\n".join([*lines, *(f"{field}: {value}" for field, value in sorted(state["values"].items()))])


async def soak(pid: int, folder: Path, minutes: float) -> tuple[list[Footprint], int]:
    """Print for MINUTES; return a footprint after each print, and how many visits there were."""
    address = f"unix:{folder / 'soak.sock'}"
    samples: list[Footprint] = []
    visits, until_s = 0, time.monotonic() + minutes * 60
    async with asyncio.timeout(START_S):
        while not (folder / "soak.sock").exists():  # noqa: ASYNC110 - another process makes it
            await asyncio.sleep(LOOK_S)
    async with Client(address) as client:
        async with asyncio.timeout(START_S):
            async for update in client.watch(["machine.state"], rate_hz=10):
                if update.values.get("machine.state") == "ready":
                    break
        while time.monotonic() < until_s:
            began_s, waited = time.monotonic(), {one: waited_s(one) for one in family(pid)}
            try:
                visits += await one_print(client, address, folder, len(samples))
            except (CanductorError, TimeoutError):
                sys.stdout.write(f"{await explain(client, began_s, waited)}\n")
                raise
            samples.append(of_process(pid))
    return samples, visits


def main(arguments: list[str] | None = None) -> int:
    """Run the soak; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=15.0)
    minutes: Any = parser.parse_args(arguments).minutes
    with tempfile.TemporaryDirectory(prefix="canductor-soak-") as name:
        folder = Path(name)
        (folder / "jobs").mkdir()
        with service(folder) as process:
            try:
                samples, visits = asyncio.run(soak(process.pid, folder, minutes))
                found = problems("the service", samples)
            except (CanductorError, TimeoutError, OSError, ValueError) as error:
                sys.stdout.write(f"{(folder / 'output').read_text()[-OUTPUT_MAX:]}\nFAILED: {error}\n")
                return 1
        if process.returncode:
            found.append(f"the service ended with {process.returncode}")
    grown, last = growth(samples), samples[-1]
    sys.stdout.write("".join(f"FAILED: {sentence}\n" for sentence in found))
    sys.stdout.write(
        f"{len(samples)} prints, {visits} visits; at the end {last.rss_kib:,} KiB, "
        f"{last.descriptors} descriptors, {last.threads} threads; "
        f"growth {grown.rss_kib:+,} KiB, {grown.descriptors:+}, {grown.threads:+}\n"
    )
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
