"""Which tests execute a mutated line: measured once, kept, and measured again for test files that changed.

Where a source is new, or has moved, all are measured again.
Of a source file that changed since, all tests count that executed anything in it: too many, but none less.
"""

import hashlib
import json
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePath
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
    """Python lines executed when the file is imported: the default of a field, for one. Tests in the folder
    that mirrors the file's count for them, too."""
    every: set[CoveringTest] = field(default_factory=set)
    changed: set[tuple[str, str]] = field(default_factory=set)
    """Test file and source file that changed after the former was measured."""
    failed: list[str] = field(default_factory=list)
    """Tests that do not pass on the unchanged project; they do not count."""

    def tests(self, mutation: Mutation, source: bytes) -> set[CoveringTest]:
        """Return the tests that execute what MUTATION changes in SOURCE, the unchanged file."""
        changed = {test for test in self.by_file[mutation.file] if (test.file, mutation.file) in self.changed}
        return changed | self._tests(mutation, source)

    def _tests(self, mutation: Mutation, source: bytes) -> set[CoveringTest]:
        if mutation.is_c:
            spans = list(enumerate(c_source.statement_spans(source)))
            around = [(end - start, k) for k, (start, end) in spans if start <= mutation.start < end]
            if not around:  # a constant, an initializer
                return self.by_file[mutation.file] or self._in_folder(mutation.file)
            return self.by_statement[mutation.file, min(around)[1]]
        statement = python_source.statement_line(source, mutation.start)
        for line in (mutation.line, statement):
            if (mutation.file, line) in self.imported:
                mirror = PurePath("tests") / PurePath(mutation.file).parent
                return self.by_file[mutation.file] | {
                    test for test in self.every if PurePath(test.file).parent == mirror
                }
            if found := self.by_line[mutation.file, line]:
                return found
        return set()

    def _in_folder(self, header: str) -> set[CoveringTest]:
        """Return the tests that execute anything next to HEADER, which has no statement of its own."""
        folder = PurePath(header).parent
        beside = [tests for file, tests in self.by_file.items() if PurePath(file).parent == folder]
        return set().union(*beside)


def collect(*, everything: bool = False) -> CoverageMap:
    """Return the map, with what is out of date measured again; EVERYTHING takes minutes."""
    copy = ProjectCopy("instrumented")
    sources = {file: (ROOT / file).read_bytes() for file in files() if file.endswith((".c", ".h"))}
    firsts, total = {}, 0
    for file, source in sources.items():
        firsts[file] = total
        total += len(c_source.statement_spans(source))
    digests = {file: _digest(ROOT / file) for file in files()}
    stale = [file for file in _test_files() if everything or not _is_current(file, digests)]
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
            _stamp(file).write_text(
                json.dumps({"test": _digest(ROOT / file), "firsts": firsts, "digests": digests})
            )
    return _read(digests)


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


def _is_current(file: str, sources: Iterable[str]) -> bool:
    """Return whether test FILE was measured as it is, when all SOURCES were there."""
    if not _stamp(file).exists():
        return False
    stamp = json.loads(_stamp(file).read_text())
    return bool(stamp["test"] == _digest(ROOT / file) and stamp["digests"].keys() >= set(sources))


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


def _read(digests: dict[str, str]) -> CoverageMap:
    """Return what is stored; DIGESTS are those of the sources as they are."""
    found = CoverageMap()
    for name in _test_files():
        if not _result(name).exists():
            continue
        stored, stamp = json.loads(_result(name).read_text()), json.loads(_stamp(name).read_text())
        bounds = sorted((first, file) for file, first in stamp["firsts"].items())
        differs = {file for file, digest in digests.items() if stamp["digests"].get(file) != digest}
        found.changed |= {(name, file) for file in differs}
        for file, lines in stored["imported"].items():
            found.imported |= {(file, line) for line in lines if file not in differs}
        for node_id, entry in stored["tests"].items():
            if not entry["passed"]:
                found.failed.append(node_id)
                continue
            test = CoveringTest(node_id, entry["seconds"])
            found.every.add(test)
            for file, number in _in_files(entry["c"], bounds):
                found.by_statement[file, number].add(test)
                found.by_file[file].add(test)
            for file, lines in entry["python"].items():
                found.by_file[file].add(test)
                for line in lines:
                    found.by_line[file, line].add(test)
    return found


def _in_files(numbers: list[int], bounds: list[tuple[int, str]]) -> Iterator[tuple[str, int]]:
    """Yield file and number in it of each of NUMBERS, which rise and go through all files."""
    at = 0
    for number in numbers:
        while at + 1 < len(bounds) and bounds[at + 1][0] <= number:
            at += 1
        yield bounds[at][1], number - bounds[at][0]
