"""Fuzzes the sockets of a machine while it prints, and proves that the print is none the worse.

Usage, from the project's root: python -m tests.fuzz.live [--minutes M] [--gcode FILE] [--seed N] [--riot]

One service prints the same file again and again: now quietly, now under clients that do their worst. Every
stepper must have moved by the same number of steps, and at the end the demo's proof looks at the position
and the time of every step of all prints. Leads and memory are those of the service's process.
"""

import argparse
import asyncio
import json
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from coordinator.ipc.client.client import Client
from coordinator.support.examples import DEMO_GCODE
from nodes.support.errors import CanductorError
from tests.fuzz.proved_service import ADMIN_TOKEN, WATCH_TOKEN

ROOT: Final = Path(__file__).resolve().parents[2]
QUIET_EVERY: Final = 10
"""Of so many prints one is quiet, and the last one is."""
PATIENCE_S: Final = 120.0
LONG_S: Final = 10.0
LOOK_S: Final = 1.0
"""Between looks at whether the service is still there."""
SETTLED_PRINTS: Final = 3
"""From then on the service's memory may not grow: its buffers are full."""
GROWTH_KIB_MAX: Final = 8_192
"""More than the toolpath that the page is shown and what the allocator keeps; a leak passes it in minutes."""


@dataclass
class Printed:
    """One print: under fuzzers or not."""

    fuzzed: bool
    took_s: float
    steps: dict[str, int]
    """By stepper: what its node counted, from the begin of the print to its end."""
    memory_kib: int
    """Of the service, at the end."""
    lead_ms: float = float("nan")


@dataclass
class Findings:
    """What was found."""

    prints: list[Printed] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)
    proof: dict[str, Any] = field(default_factory=dict)

    def of(self, *, fuzzed: bool) -> list[Printed]:
        """Return the prints that were fuzzed, or not."""
        return [p for p in self.prints if p.fuzzed == fuzzed]

    @property
    def growth_kib(self) -> int:
        """By how much the service's memory grew after the first prints; 0 when there were too few."""
        memory = [p.memory_kib for p in self.prints]
        return max(memory[SETTLED_PRINTS:], default=0) - memory[SETTLED_PRINTS - 1] if self.settled else 0

    @property
    def settled(self) -> bool:
        """Whether there were enough prints to look at memory."""
        return len(self.prints) > SETTLED_PRINTS

    def verdict(self) -> list[str]:
        """Return what does not hold, in sentences; none of them is about rates or latencies."""
        wrong = [f"PROBLEM: {sentence}" for sentence in self.problems]
        if not self.proof.get("ok"):
            wrong.append("the demo's proof of every step does not hold")
        if len({tuple(p.steps.items()) for p in self.prints}) != 1:
            wrong.append("prints of one file made different numbers of steps")
        if [p.fuzzed for p in self.prints][-2:] != [True, False]:
            wrong.append("there was no print under fuzzers with a quiet one behind it")
        if not self.counts["visits"]:
            wrong.append("no fuzzer came in")
        if self.growth_kib > GROWTH_KIB_MAX:
            wrong.append(f"the service's memory grew by {self.growth_kib:,} KiB")
        return wrong

    @property
    def lead_lost(self) -> float:
        """The part of the lead that fuzzing cost: of the quiet prints' median."""
        quiet = statistics.median(p.lead_ms for p in self.of(fuzzed=False))
        return 1 - statistics.median(p.lead_ms for p in self.of(fuzzed=True)) / quiet

    @property
    def lead_lost_at_worst(self) -> float:
        """The same for the worst of the fuzzed prints."""
        quiet = statistics.median(p.lead_ms for p in self.of(fuzzed=False))
        return 1 - min(p.lead_ms for p in self.of(fuzzed=True)) / quiet


class Bench:
    """The service in a process of its own, and its operator."""

    def __init__(self, process: subprocess.Popen[str], folder: Path, port: int, client: Client) -> None:
        self.process = process
        self.path = folder / "open.sock"
        self.port = port
        self.client = client
        self.findings = Findings()

    async def print(self, file: str, *, seed: int | None) -> None:
        """Print FILE, under fuzzers from SEED unless that is None."""
        before = await self._positions()
        begun_s = time.monotonic()
        await self.client.call("job.start", {"file": file})
        fuzzer = None if seed is None else self._fuzzer(seed)
        await self._until_done()
        took_s = time.monotonic() - begun_s
        if fuzzer is not None:
            told = json.loads((await asyncio.to_thread(fuzzer.communicate))[0])
            self.findings.counts.update(told["counts"])
            self.findings.problems += told["problems"]
        after = await self._positions()
        steps = {name: count - before[name] for name, count in after.items()}
        self.findings.prints.append(Printed(fuzzer is not None, took_s, steps, memory_kib(self.process.pid)))

    async def _until_done(self) -> None:
        ending = asyncio.ensure_future(self._job_end())
        while not (await asyncio.wait((ending,), timeout=LOOK_S))[0]:
            if self.process.poll() is not None:  # the client would wait for another one
                ending.cancel()
                raise CanductorError(
                    f"the service ended with {self.process.returncode} in the middle of a print"
                )
        state = await ending
        if state != "done":
            why = await self.client.call("machine.state")
            leads = await self.client.call("state.get", {"fields": ["*lead*"]})
            raise CanductorError(f"the print {state}: {why['cause']}; {leads['values']}")

    async def _job_end(self) -> Any:
        async for update in self.client.watch(["job.state"], rate_hz=5):
            state = update.values.get("job.state")
            if state not in (None, "printing"):
                return state
        raise CanductorError("the service closed the connection")

    async def _positions(self) -> dict[str, int]:
        told = await self.client.call("position.get", {"ask_nodes": True})
        assert told["nodes_steps"] == {n: s["steps_sent"] for n, s in told["steppers"].items()}
        return dict(told["nodes_steps"])

    def _fuzzer(self, seed: int, token: str = WATCH_TOKEN) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tests.fuzz.live_visits", str(self.path), str(self.port)]
        return subprocess.Popen(
            [*command, token, str(seed)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    async def riot(self, seconds: float, seed: int) -> None:
        """Let fuzzers in that may do everything; whatever they did, the machine can print afterwards."""
        fuzzer = self._fuzzer(seed, ADMIN_TOKEN)
        await asyncio.sleep(seconds)
        told = json.loads((await asyncio.to_thread(fuzzer.communicate))[0])
        self.findings.counts.update(told["counts"])
        self.findings.problems += told["problems"]
        await self._until("machine.state", "ready", "shutdown", "error")
        await self.client.call("machine.emergency_stop")
        await self.client.call("machine.restart")
        await self._until("machine.state", "ready")

    async def _until(self, path: str, *values: str) -> None:
        async for update in self.client.watch([path], rate_hz=5):
            if update.values.get(path) in values:
                return


def memory_kib(pid: int) -> int:
    """Return what process PID has in memory."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1])


@contextmanager
def _service(folder: Path, jobs: Path) -> Iterator[subprocess.Popen[str]]:
    with (folder / "errors").open("w") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.proved_service", str(folder), str(jobs)],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
        try:
            yield process
        finally:
            process.kill()
            process.wait()


@asynccontextmanager
async def _bench(process: subprocess.Popen[str], folder: Path) -> AsyncIterator[Bench]:
    assert process.stdout is not None
    port = int(await asyncio.to_thread(process.stdout.readline) or "0")
    assert port, (folder / "errors").read_text()
    async with Client(f"tcp://127.0.0.1:{port}", token=ADMIN_TOKEN) as client:
        yield Bench(process, folder, port, client)


async def _prints(
    process: subprocess.Popen[str], folder: Path, file: str, fuzz_s: float, seed: int
) -> Findings:
    async with _bench(process, folder) as bench:
        fuzzed_s, turn, over = 0.0, 0, False
        while not over:  # the last print is quiet; in a long run the first one, too
            over = fuzzed_s >= fuzz_s
            quiet = over or (turn % QUIET_EVERY == 0 and fuzz_s > LONG_S)
            await bench.print(file, seed=None if quiet else seed + turn * 1_000_000)
            fuzzed_s += 0.0 if quiet else bench.findings.prints[-1].took_s
            turn += 1
            _show(bench.findings.prints[-1])
    proof, _ = await asyncio.to_thread(process.communicate, None, PATIENCE_S)
    findings = bench.findings
    if not _ended_well(process, folder, findings):
        return findings
    findings.proof = json.loads(proof.splitlines()[-1])
    for printed, lead_ms in zip(findings.prints, findings.proof["leads_ms"], strict=True):
        printed.lead_ms = float("nan") if lead_ms is None else lead_ms
    return findings


async def _riot(
    process: subprocess.Popen[str], folder: Path, file: str, fuzz_s: float, seed: int
) -> Findings:
    async with _bench(process, folder) as bench:
        await bench.riot(fuzz_s, seed)
        await bench.print(file, seed=None)
    process.terminate()
    await asyncio.to_thread(process.communicate, None, PATIENCE_S)
    _ended_well(process, folder, bench.findings)
    return bench.findings


def _ended_well(process: subprocess.Popen[str], folder: Path, findings: Findings) -> bool:
    errors = (folder / "errors").read_text()
    well = not errors and process.returncode in (0, -signal.SIGTERM)
    if not well:
        findings.problems.append(f"the service ended with {process.returncode} and said: {errors[-2000:]}")
    return well


def fuzz_a_print(gcode: Path, fuzz_s: float, seed: int) -> Findings:
    """Print GCODE until fuzzers that may watch were at work for FUZZ_S."""
    return _on_a_service(_prints, gcode, fuzz_s, seed)


def fuzz_the_machine(gcode: Path, fuzz_s: float, seed: int) -> Findings:
    """Let fuzzers that may do everything be at work for FUZZ_S, then print GCODE."""
    return _on_a_service(_riot, gcode, fuzz_s, seed)


def _on_a_service(
    drive: Callable[..., Coroutine[Any, Any, Findings]], gcode: Path, fuzz_s: float, seed: int
) -> Findings:
    with tempfile.TemporaryDirectory(prefix="canductor-fuzz-") as name:
        folder = Path(name)
        jobs = folder / "jobs"
        jobs.mkdir()
        shutil.copy(gcode, jobs)
        with _service(folder, jobs) as process:
            return asyncio.run(drive(process, folder, gcode.name, fuzz_s, seed))


def _show(printed: Printed) -> None:
    word = "fuzzed" if printed.fuzzed else "quiet"
    sys.stderr.write(f"{word}: {printed.took_s:.1f} s, memory {printed.memory_kib:,} KiB\n")


def main() -> None:
    """Fuzz, print the findings; the exit status tells whether it held."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--gcode", type=Path, default=DEMO_GCODE)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--riot", action="store_true", help="fuzzers may do everything; then one print")
    given = parser.parse_args()
    if given.riot:
        found = fuzz_the_machine(given.gcode, given.minutes * 60, given.seed)
        sys.stdout.write(f"seed {given.seed}: {json.dumps(found.counts, indent=1)}\n")
        sys.exit("".join(f"PROBLEM: {sentence}\n" for sentence in found.problems) or 0)
    found = fuzz_a_print(given.gcode, given.minutes * 60, given.seed)
    tell = sys.stdout.write
    for printed in found.prints:
        word = "fuzzed" if printed.fuzzed else "quiet "
        tell(
            f"{word} {printed.took_s:6.1f} s, lead {printed.lead_ms:6.1f} ms, "
            f"memory {printed.memory_kib:,} KiB, steps {printed.steps}\n"
        )
    tell(f"seed {given.seed}: {json.dumps(found.counts, indent=1)}\n{json.dumps(found.proof, indent=1)}\n")
    tell(f"lead lost: median {found.lead_lost:+.1%}, worst {found.lead_lost_at_worst:+.1%}\n")
    grown = f"{found.growth_kib:,} KiB" if found.settled else "not looked at, there were too few prints"
    tell(f"memory grown after print {SETTLED_PRINTS}: {grown}\n")
    wrong = found.verdict()
    tell("".join(f"{sentence}\n" for sentence in wrong) or "all steps proved, no growth\n")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
