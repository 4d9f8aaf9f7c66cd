"""``make mutation``: changes one place of the code at a time and sees whether a test fails.

    python -m tests.mutation.run [--seed N] [--sample N] [--area NAME | --file PATH] [--workers N]

Of all mutations of an area (all areas by default) a sample is drawn. For each the tests that execute the
changed statement are run, those next to the file first, then the fastest, until one fails. The report names
the survivors. Exit status 1: more than 5 % of the sample survive without an explanation in equivalent.toml,
or one in a file that makes heat or stops motion.
"""

import argparse
import json
import random
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import PurePath
from queue import SimpleQueue
from typing import Final

from tests.mutation import areas, c_source, coverage_map, explained, python_source
from tests.mutation.coverage_map import CoverageMap, CoveringTest
from tests.mutation.mutation import Mutation
from tests.mutation.project_copy import FOLDER, BuildError, ProjectCopy

SURVIVORS_MAX: Final = 0.05
BUDGET_S: Final = 40.0
"""So long, measured on the unchanged project, the tests of one mutant may take together."""
FACTOR: Final = 3.0
START_S: Final = 5.0
"""A mutant hangs when its tests compute FACTOR times as long as on the unchanged project, and START_S."""
WALL_FACTOR: Final = 10.0
"""… or take so much longer than that: they wait for what does not come, or the computer is very busy."""
FIRST_BATCH_S: Final = 1.5
BATCH_GROWTH: Final = 4.0
"""Tests run in batches: most mutants die in the first one, and to collect all tests takes seconds."""
PYTEST: Final = (
    *(sys.executable, "-m", "pytest", "-q", "-x", "--no-header", "--tb=no"),
    *("-p", "no:cacheprovider", "-p", "no:xdist"),
)
FILE_COST_S: Final = 0.3
"""What it takes to collect a test file."""

KILLED: Final = "killed"
SURVIVED: Final = "survived"
NOT_COVERED: Final = "not covered"
EXPLAINED: Final = "explained"
SAME_CODE: Final = "same code"
NO_CODE: Final = "does not compile"


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of a mutation."""

    mutation: Mutation
    outcome: str
    seconds: float = 0.0
    evidence: str = ""


def say(*lines: str) -> None:
    """Print LINES at once."""
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stdout.flush()


def find_mutations(file: str) -> list[Mutation]:
    """Return all mutations of FILE."""
    source = (areas.ROOT / file).read_bytes()
    find = c_source.find_mutations if file.endswith((".c", ".h")) else python_source.find_mutations
    return find(file, source)


def draw(mutations: Sequence[Mutation], seed: int, sample: int) -> list[Mutation]:
    """Return SAMPLE of MUTATIONS, or all when there are fewer, drawn by SEED."""
    return random.Random(seed).sample(list(mutations), min(sample, len(mutations)))


def in_order(
    tests: set[CoveringTest], file: str, history: Counter[str], budget_s: float = BUDGET_S
) -> list[CoveringTest]:
    """Return which of TESTS are run for a mutant of FILE, and in what order; test files stay together.

    First the C programs of FILE's own folder, then what has killed mutants of FILE, then what is in the
    folder that mirrors it, then the quick.
    """
    by_file: dict[str, list[CoveringTest]] = {}
    for test in sorted(tests, key=lambda t: (t.seconds, t.name)):
        by_file.setdefault(test.file, []).append(test)
    room = file.split("/", maxsplit=1)[0]

    folder = f"tests/{PurePath(file).parent}/"

    def rank(name: str) -> tuple[bool, int, bool, float]:
        is_near = name.startswith(folder) and name.endswith(".c")
        mirrors = name.startswith(f"tests/{room}/")
        return not is_near, -history[name], not mirrors, sum(test.seconds for test in by_file[name])

    chosen: list[CoveringTest] = []
    spent_s = 0.0
    for name in sorted(by_file, key=rank):
        spent_s += FILE_COST_S
        for test in by_file[name]:
            if spent_s + test.seconds > budget_s and chosen:
                break
            spent_s += test.seconds
            chosen.append(test)
    return chosen


class Runner:
    """Judges mutations, several at a time, each in a copy of the project of its own."""

    def __init__(self, covered: CoverageMap, workers: int, budget_s: float = BUDGET_S) -> None:
        self._covered = covered
        self._budget_s = budget_s
        self._explained = explained.read_list()
        self._history_file = FOLDER / "history.json"
        self._history: dict[str, Counter[str]] = {}
        if self._history_file.exists():
            stored = json.loads(self._history_file.read_text())
            self._history = {file: Counter(kills) for file, kills in stored.items()}
        self._lock = threading.Lock()
        self._workers = workers
        self._copies: SimpleQueue[ProjectCopy] = SimpleQueue()
        for number in range(workers):
            copy = ProjectCopy(f"worker{number}")
            copy.update()
            copy.prepare()
            self._copies.put(copy)

    def judge_all(self, mutations: Sequence[Mutation]) -> Iterator[Verdict]:
        """Yield what becomes of each of MUTATIONS, in their order."""
        with ThreadPoolExecutor(self._workers) as pool:
            yield from pool.map(self._judge, mutations)
        self._history_file.write_text(json.dumps(self._history))

    def _judge(self, mutation: Mutation) -> Verdict:
        copy = self._copies.get()
        began_s = time.monotonic()
        try:
            outcome, evidence = self._outcome(copy, mutation)
        finally:
            self._copies.put(copy)
        if outcome in {SURVIVED, NOT_COVERED} and (reason := explained.reason(mutation, self._explained)):
            outcome, evidence = EXPLAINED, reason
        return Verdict(mutation, outcome, time.monotonic() - began_s, evidence)

    def _outcome(self, copy: ProjectCopy, mutation: Mutation) -> tuple[str, str]:
        tests = self._covered.tests(mutation, copy.read(mutation.file))
        with self._lock:
            chosen = in_order(
                tests, mutation.file, self._history.setdefault(mutation.file, Counter()), self._budget_s
            )
        names = {test.file for test in chosen if test.is_c}
        programs = [program for program in copy.c_tests if program.name in names]
        try:
            for program in programs:
                copy.build(program)
            with copy.planted(mutation, programs) as same:
                if same:
                    return SAME_CODE, ""
                if not chosen:
                    return NOT_COVERED, ""
                return self._run(copy, mutation, chosen)
        except BuildError:
            return NO_CODE, ""

    def _run(self, copy: ProjectCopy, mutation: Mutation, chosen: list[CoveringTest]) -> tuple[str, str]:
        for batch in batches(chosen):
            cpu_s = START_S + FACTOR * sum(test.seconds for test in batch)
            if batch[0].is_c:
                program = next(p for p in copy.c_tests if p.name == batch[0].name)
                copy.build(program)
                done = copy.run([f"./{program.output}"], timeout_s=WALL_FACTOR * cpu_s, cpu_s=cpu_s)
                failed = [f"FAILED {batch[0].name}"] if done.status != 0 else []
            else:
                names = [test.name for test in batch]
                done = copy.run([*PYTEST, *names], timeout_s=WALL_FACTOR * cpu_s, cpu_s=cpu_s)
                lines = done.output.splitlines()
                failed = [line for line in lines if line.startswith(("FAILED ", "ERROR "))]
            if done.status == 0:
                continue
            with self._lock:
                at_fault = failed[0].split()[1] if failed else batch[0].name
                self._history[mutation.file][at_fault.split("::", maxsplit=1)[0]] += 1
            if done.status is None:
                return KILLED, f"hangs: more than {cpu_s:.0f} s"
            return KILLED, failed[0][:150] if failed else f"status {done.status}"
        return SURVIVED, f"{len(chosen)} tests, {sum(test.seconds for test in chosen):.0f} s"


def batches(tests: list[CoveringTest]) -> Iterator[list[CoveringTest]]:
    """Split TESTS: C programs alone, others so that the first batches are short."""
    batch: list[CoveringTest] = []
    spent_s, room_s = 0.0, FIRST_BATCH_S
    for test in tests:
        is_full = batch and batch[-1].file != test.file and spent_s >= room_s
        if batch and (test.is_c or batch[0].is_c or is_full):
            yield batch
            room_s *= 1 if batch[0].is_c else BATCH_GROWTH
            batch, spent_s = [], 0.0
        batch.append(test)
        spent_s += test.seconds
    if batch:
        yield batch


def report(verdicts: Sequence[Verdict]) -> tuple[list[str], bool]:
    """Return the lines of the report, and whether the tests are good enough."""
    counts = Counter(verdict.outcome for verdict in verdicts)
    alive = [v for v in verdicts if v.outcome in {SURVIVED, NOT_COVERED}]
    judged = counts[KILLED] + counts[EXPLAINED] + len(alive)
    dangerous = [v for v in alive if v.mutation.file in areas.SAFETY]
    lines = [f"{v.outcome}: {v.mutation}" for v in sorted(alive, key=lambda v: v.mutation)]
    lines += [f"explained: {v.mutation} ({v.evidence})" for v in verdicts if v.outcome == EXPLAINED]
    figures = ", ".join(f"{counts[name]} {name}" for name in (KILLED, SURVIVED, NOT_COVERED, EXPLAINED))
    lines.append(f"{judged} mutants: {figures}; beside them {counts[SAME_CODE]} compile to the same code")
    share = len(alive) / judged if judged else 0.0
    lines.append(
        f"{share:.1%} survive unexplained, {len(dangerous)} of them where heat is made or motion stops"
    )
    return lines, share <= SURVIVORS_MAX and not dangerous


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the check; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sample", type=int, default=300)
    parser.add_argument("--area", default="", choices=["", *areas.AREAS])
    parser.add_argument("--file", default="", help="only this file")
    parser.add_argument("--lines", default="", help="only these lines of it, A:B")
    parser.add_argument("--budget", type=float, default=BUDGET_S, help="seconds of tests for one mutant")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--measure", action="store_true", help="measure the coverage of all tests again")
    parser.add_argument("--list", action="store_true", help="only print the sample")
    options = parser.parse_args(arguments)
    chosen = [options.file] if options.file else areas.files(options.area)
    mutations = [mutation for file in chosen for mutation in find_mutations(file)]
    if options.lines:
        first, last = map(int, options.lines.split(":"))
        mutations = [mutation for mutation in mutations if first <= mutation.line <= last]
    sample = draw(mutations, options.seed, options.sample)
    say(f"{len(sample)} of {len(mutations)} mutations in {len(chosen)} files, seed {options.seed}")
    if options.list:
        say(*map(str, sample))
        return 0
    covered = coverage_map.collect(everything=options.measure)
    if covered.failed:
        say(f"not counted, since they do not pass: {len(covered.failed)} tests", *covered.failed)
    verdicts = []
    for verdict in Runner(covered, options.workers, options.budget).judge_all(sample):
        verdicts.append(verdict)
        say(f"{verdict.outcome:<12} {verdict.seconds:5.1f} s  {verdict.mutation}  [{verdict.evidence}]")
    lines, good = report(verdicts)
    say(*lines)
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
