"""Which tests execute a mutated line: collected once, kept, renewed where tests or sources changed."""

import hashlib
import json
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from tests.mutation import c_source, python_source
from tests.mutation.areas import REAL_PROCESSES, ROOT, TESTS, files
from tests.mutation.mutation import Mutation
from tests.mutation.project_copy import FOLDER, ProjectCopy

COLLECTED: Final = FOLDER / "covered"
COLLECTION_LIMIT_S: Final = 7200.0
C_TEST_LIMIT_S: Final = 300.0


@dataclass(frozen=True, slots=True)
class CoveringTest:
    """A test that passes on the unchanged project."""

    name: str
    """A pytest node id, or the path of a C test program."""
    seconds: float

    @property
    def file(self) -> str:
        """Return the file that it is in."""
        return self.name.split("::", maxsplit=1)[0]

    @property
    def is_c(self) -> bool:
        """Whether it is a C program."""
        return self.name.endswith(".c")


@dataclass(slots=True)
class CoverageMap:
    """Tests by what they execute."""

    by_statement: dict[tuple[str, int], set[CoveringTest]] = field(default_factory=lambda: defaultdict(set))
    """C: by file and number of the statement in it."""
    by_line: dict[tuple[str, int], set[CoveringTest]] = field(default_factory=lambda: defaultdict(set))
    """Python: by file and line."""
    by_file: dict[str, set[CoveringTest]] = field(default_factory=lambda: defaultdict(set))
    imported: set[tuple[str, int]] = field(default_factory=set)
    """Python lines executed when the file is imported."""
    failed: list[str] = field(default_factory=list)
    """Tests that do not pass on the unchanged project; they do not count."""

    def tests(self, mutation: Mutation, source: bytes) -> set[CoveringTest]:
        """Return the tests that execute what MUTATION changes in SOURCE, the unchanged file."""
        if mutation.is_c:
            spans = list(enumerate(c_source.statement_spans(source)))
            around = [(end - start, k) for k, (start, end) in spans if start <= mutation.start < end]
            if not around:  # a constant, an initializer
                return self.by_file[mutation.file]
            return self.by_statement[mutation.file, min(around)[1]]
        statement = python_source.statement_line(source, mutation.start)
        for line in (mutation.line, statement):
            if (mutation.file, line) in self.imported:
                return self.by_file[mutation.file]
            if found := self.by_line[mutation.file, line]:
                return found
        return set()


def collect() -> CoverageMap:
    """Return the map, with what is out of date measured again: minutes when all is."""
    copy = ProjectCopy("instrumented")
    sources = {file: (ROOT / file).read_bytes() for file in files() if file.endswith((".c", ".h"))}
    firsts, total = {}, 0
    for file, source in sources.items():
        firsts[file] = total
        total += len(c_source.statement_spans(source))
    state = _digest(*(ROOT / file for file in files()))
    stale = [file for file in _test_files() if not _is_current(file, state)]
    if stale:
        sys.stdout.write(f"coverage: measuring {len(stale)} test files\n")
        sys.stdout.flush()
        instrumented = {
            file: c_source.with_counters(source, firsts[file]) for file, source in sources.items()
        }
        copy.update(instrumented)
        flags = ("-O1", "-g0", "-w", f"-DMUTATION_HITS={total}")
        copy.prepare(flags, extra_sources=("tests/mutation/hits.c",))
        _run_pytest(copy, [file for file in stale if file.endswith(".py")], total)
        _run_c_tests(copy, [file for file in stale if file.endswith(".c")])
        for file in stale:
            _stamp(file).write_text(_digest(ROOT / file) + state)
    return _read(firsts)


def _digest(*paths: Path) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _test_files() -> Iterator[str]:
    for place in TESTS:
        path = ROOT / place
        for file in sorted(path.rglob("test_*.*")) if path.is_dir() else [path]:
            name = str(file.relative_to(ROOT))
            if (
                file.suffix in {".py", ".c"}
                and not name.startswith(REAL_PROCESSES)
                and "must_trip" not in name
            ):
                yield name


def _result(file: str) -> Path:
    return COLLECTED / (file.replace("/", "-") + ".json")


def _stamp(file: str) -> Path:
    return _result(file).with_suffix(".stamp")


def _is_current(file: str, state: str) -> bool:
    return _stamp(file).exists() and _stamp(file).read_text() == _digest(ROOT / file) + state


def _run_pytest(copy: ProjectCopy, tests: list[str], total: int) -> None:
    if not tests:
        return
    COLLECTED.mkdir(parents=True, exist_ok=True)
    for file in tests:
        _result(file).unlink(missing_ok=True)
    environment = {"MUTATION_COLLECT": str(COLLECTED), "MUTATION_HITS": str(total)}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p"]
    done = copy.run(
        [*command, "tests.mutation.coverage_plugin", *tests],
        timeout_s=COLLECTION_LIMIT_S,
        cpu_s=COLLECTION_LIMIT_S,
        environment=environment,
    )
    if done.status not in {0, 1} or not all(_result(file).exists() for file in tests):
        raise RuntimeError(f"the coverage of tests could not be measured:\n{done.output[-4000:]}")


def _run_c_tests(copy: ProjectCopy, tests: list[str]) -> None:
    COLLECTED.mkdir(parents=True, exist_ok=True)
    for program in copy.c_tests:
        if program.name not in tests:
            continue
        copy.build(program)
        began_s = time.perf_counter()
        hits = COLLECTED / "hits"
        hits.unlink(missing_ok=True)
        done = copy.run(
            [f"./{program.output}"], timeout_s=C_TEST_LIMIT_S, environment={"MUTATION_HITS_FILE": str(hits)}
        )
        seconds = round(time.perf_counter() - began_s, 4)
        executed = [at for at, hit in enumerate(hits.read_bytes()) if hit] if hits.exists() else []
        test = {"passed": done.status == 0, "seconds": seconds, "c": executed, "python": {}}
        _result(program.name).write_text(json.dumps({"imported": {}, "tests": {program.name: test}}))


def _read(firsts: dict[str, int]) -> CoverageMap:
    """Return what is stored, with numbers of statements made relative to their file."""
    bounds = sorted((first, file) for file, first in firsts.items())
    found = CoverageMap()
    for name in _test_files():
        if not _result(name).exists():
            continue
        stored = json.loads(_result(name).read_text())
        for file, lines in stored["imported"].items():
            found.imported |= {(file, line) for line in lines}
        for node_id, entry in stored["tests"].items():
            test = CoveringTest(node_id, entry["seconds"])
            if not entry["passed"]:
                found.failed.append(node_id)
                continue
            at = 0
            for number in entry["c"]:
                while at + 1 < len(bounds) and bounds[at + 1][0] <= number:
                    at += 1
                first, file = bounds[at]
                found.by_statement[file, number - first].add(test)
                found.by_file[file].add(test)
            for file, lines in entry["python"].items():
                found.by_file[file].add(test)
                for line in lines:
                    found.by_line[file, line].add(test)
    return found
