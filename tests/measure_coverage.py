"""Measures which lines of C and Python the tests run, and prints one table. Exit status 1 below the bounds.

Usage: python -m tests.measure_coverage [--verbose] [--add] [PATH...]

In a copy of the tree (build/coverage/tree) all C is compiled for gcov; there the C tests run, then pytest on
the PATHs (default: every folder of tests/ in turn) under coverage.py, which follows processes that tests
start. With --add what was measured before stays: folders can be measured one at a time. A line counts as run
when any process ran it and ended in order. --report measures nothing and prints what is there.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[1]
BASE: Final = ROOT / "build" / "coverage"
TREE: Final = BASE / "tree"
DATA: Final = BASE / "data"
COPIED: Final = (
    "bench",
    "canbus_tools",
    "config",
    "coordinator",
    "docs",
    "firmware",
    "nodes",
    "tests",
    ".ci",
)
LEFT_OUT: Final = ("*.so", "*.o", "*.d", "*.gc??", "__pycache__", "_*.c", "build", "bin", "*.egg-info")
C_BOUND: Final = 97.0
C_FOLDERS: Final = (
    *(f"firmware/{folder}" for folder in ("wire", "core", "objects", "net")),
    *("nodes/link", "coordinator/motion", "coordinator/kinematics"),
)
"""The bound is for all lines in them, folders below included; other C is listed."""
PYTHON_BOUND: Final = 92.0
PACKAGES: Final = ("coordinator", "nodes", "canbus_tools")
LEAST: Final = 15
"""Files named in the table."""
COUNTED: Final = "-O1 --coverage -fprofile-update=prefer-atomic -frandom-seed=coverage"
COMPILER: Final = f'#!/bin/sh\nexec {{compiler}} "$@" {COUNTED}\n'
"""Stands for gcc on the PATH of what is measured; the last -O counts. Several modules have the same source:
with one seed for all, their objects count into the same file."""
SITE: Final = "import coverage\ncoverage.process_startup()\n"
"""Runs in each Python process that has this folder on its path."""
SETTINGS: Final = f"""\
[run]
source = {", ".join(PACKAGES)}
omit = */build_*.py, */nodes/support/native_build.py, */nodes/support/link_sources.py
data_file = {DATA}/python
parallel = true
relative_files = true
concurrency = thread, multiprocessing
disable_warnings = no-data-collected, module-not-measured, module-not-imported, already-imported
[report]
exclude_also =
    if TYPE_CHECKING:
    ^\\s*\\.\\.\\.$
    class .*\\(Protocol.*\\):
    @overload
"""
# gcov's files are many; a command line takes this many of them.
BATCH: Final = 200


@dataclass
class Source:
    """What is known of one file."""

    run: set[int] = field(default_factory=set)
    missed: set[int] = field(default_factory=set)

    @property
    def lines(self) -> int:
        """Return how many lines have code."""
        return len(self.run) + len(self.missed)


Sources = Mapping[str, Source]
"""By path from the project's root."""


def copy_tree() -> None:
    """Bring the copy up to date: files that did not change keep their time, so that little is compiled."""
    left_out = shutil.ignore_patterns(*LEFT_OUT)
    for name in COPIED:
        shutil.copytree(ROOT / name, TREE / name, ignore=left_out, copy_function=_copy, dirs_exist_ok=True)
        for path in [
            path for path in (TREE / name).rglob("*") if not (ROOT / path.relative_to(TREE)).exists()
        ]:
            if path.is_file() and not left_out(str(path.parent), [path.name]) and not _built(path):
                path.unlink()
    for path in ROOT.iterdir():
        if path.is_file():
            _copy(str(path), str(TREE / path.name))
    shared = ROOT.parent / "shared"
    if shared.is_dir() and not (BASE / "shared").exists():
        (BASE / "shared").symlink_to(shared)


def _built(path: Path) -> bool:
    return bool({"build", "bin", "__pycache__"} & set(path.relative_to(TREE).parts))


def _copy(source: str, target: str) -> str:
    old, new = Path(target), Path(source).stat()
    if not old.exists() or (old.stat().st_mtime_ns, old.stat().st_size) != (new.st_mtime_ns, new.st_size):
        shutil.copy2(source, target)
    return target


def environment() -> dict[str, str]:
    """Return the variables that have compilers count lines and every Python process measure itself."""
    tools, site, settings = BASE / "tools", BASE / "site", BASE / "settings.ini"
    for folder in (tools, site, DATA, TREE):
        folder.mkdir(parents=True, exist_ok=True)
    compiler = shutil.which("gcc")
    if compiler is None:
        raise SystemExit("coverage: gcc is missing; install it with: apt-get install gcc")
    for name in ("gcc", "cc"):
        (tools / name).write_text(COMPILER.format(compiler=compiler))
        (tools / name).chmod(0o755)
    (site / "sitecustomize.py").write_text(SITE)
    settings.write_text(SETTINGS)
    return {
        **os.environ,
        "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join([str(site), str(TREE)]),
        "COVERAGE_PROCESS_START": str(settings),
    }


def measure(groups: Iterable[list[str]]) -> list[str]:
    """Compile; run pytest on each of GROUPS, which are paths, or the C tests for C; return what failed."""
    variables = environment()
    copy_tree()
    build = {name: value for name, value in variables.items() if name != "COVERAGE_PROCESS_START"}
    build_words = [sys.executable, "setup.py", "-q", "build_ext", "--inplace"]
    _start(build_words, build, check=True, quiet=True)
    failed = []
    for group in groups:
        if group == ["C"]:
            words, with_variables = ["make", "-s", "-k", "-C", "tests", f"PYTHON={sys.executable}"], build
        else:
            pytest = [sys.executable, "-m", "pytest", "-q", "--timeout=900", "-p", "no:cacheprovider"]
            words, with_variables = (
                [*pytest, *group],
                variables,
            )
        if _start(words, with_variables):
            failed.append(" ".join(group))
    return failed


def _start(words: list[str], variables: dict[str, str], *, check: bool = False, quiet: bool = False) -> int:
    print("coverage:", " ".join(words), flush=True)
    output = subprocess.DEVNULL if quiet else None
    return subprocess.run(words, cwd=TREE, env=variables, check=check, stdout=output).returncode


def c_sources() -> dict[str, Source]:
    """Return the C files of the product that have code, as gcov knows them; not what cffi writes."""
    counts: dict[str, dict[int, int]] = defaultdict(lambda: defaultdict(int))
    notes = sorted(str(path) for path in TREE.rglob("*.gcno"))
    for start in range(0, len(notes), BATCH):
        for unit in _gcov(notes[start : start + BATCH]):
            folder = Path(unit["current_working_directory"])
            for file in unit["files"]:
                path = (folder / file["file"]).resolve()
                if path.is_relative_to(TREE) and (ROOT / (name := str(path.relative_to(TREE)))).exists():
                    for line in file["lines"]:
                        counts[name][line["line_number"]] += line["count"]
    return {
        name: Source({n for n in lines if lines[n]}, {n for n in lines if not lines[n]})
        for name, lines in counts.items()
        if not name.startswith(("tests/", "build/", "bench/")) and not Path(name).name.startswith("_")
    }


def _gcov(notes: list[str]) -> Iterator[dict[str, Any]]:
    words = ["gcov", "--json-format", "--stdout", *notes]
    printed = subprocess.run(words, cwd=TREE, check=True, capture_output=True, text=True).stdout
    yield from (json.loads(line) for line in printed.splitlines() if line.startswith("{"))


def python_sources() -> dict[str, Source]:
    """Return the Python files of the packages, as coverage.py knows them."""
    settings, report = f"--rcfile={BASE / 'settings.ini'}", BASE / "python.json"
    words = [sys.executable, "-m", "coverage"]
    together = f"--data-file={DATA / 'together'}"
    parts = [str(path) for path in DATA.glob("python.*")]
    if parts:
        again = ["--append"] if (DATA / "together").exists() else []
        subprocess.run([*words, "combine", settings, together, "-q", *again, *parts], cwd=TREE, check=True)
    if not (DATA / "together").exists():
        return {}
    printed = [settings, together, "-q", "-o", str(report)]
    subprocess.run([*words, "json", *printed], cwd=TREE, check=True)
    files = json.loads(report.read_text())["files"]
    return {
        name: Source(set(known["executed_lines"]), set(known["missing_lines"]))
        for name, known in files.items()
    }


def percent(sources: Iterable[Source]) -> float:
    """Return the share of lines with code that were run, 0 to 100; 100 where there are none."""
    known = list(sources)
    lines = sum(source.lines for source in known)
    return 100.0 * sum(len(source.run) for source in known) / lines if lines else 100.0


def ranges(numbers: Iterable[int]) -> str:
    """Return sorted line NUMBERS as text, neighbours joined: ``3, 7-9``."""
    spans: list[list[int]] = []
    for number in sorted(numbers):
        if spans and number == spans[-1][1] + 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    return ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in spans)


def rows(sources: Sources, folders: Iterable[str], *, deep: bool = False) -> Iterator[str]:
    """Yield a row of the table for each of FOLDERS; when DEEP with what is in folders inside."""
    for folder in folders:
        inside = [
            source
            for name, source in sources.items()
            if str(Path(name).parent) == folder or (deep and name.startswith(f"{folder}/"))
        ]
        yield row(folder, inside)


def row(name: str, sources: Iterable[Source], bound: float | None = None) -> str:
    """Return a row of the table."""
    known = list(sources)
    lines, run = sum(source.lines for source in known), sum(len(source.run) for source in known)
    demanded = f"  at least {bound:g} %" if bound is not None else ""
    return f"{name:<34}{lines:>8}{run:>8}{percent(known):>8.1f} %{demanded}"


def least(sources: Sources, *, verbose: bool) -> Iterator[str]:
    """Yield the files with the most lines that were not run, by share; with VERBOSE all, with the lines."""
    order = sorted(sources.items(), key=lambda item: (percent([item[1]]), -len(item[1].missed)))
    incomplete = [(name, source) for name, source in order if source.missed]
    for name, source in incomplete if verbose else incomplete[:LEAST]:
        yield f"  {percent([source]):5.1f} %  {len(source.missed):>4} of {source.lines:<5} {name}"
        if verbose:
            yield f"             not run: {ranges(source.missed)}"


def folders_of(sources: Sources) -> list[str]:
    """Return the folders that have files in SOURCES."""
    return sorted({str(Path(name).parent) for name in sources})


def table(c: Sources, python: Sources, *, verbose: bool) -> bool:
    """Print the table; return whether the bounds are kept."""
    chosen = [
        folder for folder in folders_of(c) if any(Path(folder).is_relative_to(top) for top in C_FOLDERS)
    ]
    bounded = {name: source for name, source in c.items() if str(Path(name).parent) in chosen}
    print(f"{'':<34}{'lines':>8}{'run':>8}{'':>8}")
    print(*rows(c, chosen), sep="\n")
    print(row("C of these", bounded.values(), C_BOUND))
    print(*rows(c, sorted(set(folders_of(c)) - set(chosen))), sep="\n")
    folders = (folder for folder in folders_of(python) if verbose and folder not in PACKAGES)
    print(*rows(python, folders), *rows(python, PACKAGES, deep=True), sep="\n")
    print(row("Python", python.values(), PYTHON_BOUND))
    print("C with the most lines not run:", *least(c, verbose=verbose), sep="\n")
    print("Python with the most lines not run:", *least(python, verbose=verbose), sep="\n")
    return percent(bounded.values()) >= C_BOUND and percent(python.values()) >= PYTHON_BOUND


def everything() -> list[list[str]]:
    """Return what is measured by default: the C tests, every folder of tests/ by itself, then its modules."""
    named = [path for path in sorted((ROOT / "tests").iterdir()) if path.name not in {"package", "vcan"}]
    folders = [path for path in named if path.is_dir() and any(path.rglob("test_*.py"))]
    modules = [path for path in named if path.match("test_*.py")]
    grouped = [*([folder] for folder in folders), modules]
    return [["C"], *([str(path.relative_to(ROOT)) for path in group] for group in grouped)]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "paths", metavar="PATH", nargs="*", help="a folder or file of tests, or C: its tests in C"
    )
    parser.add_argument("--verbose", action="store_true", help="name every line that is not run")
    parser.add_argument("--add", action="store_true", help="keep what was measured before")
    parser.add_argument("--report", action="store_true", help="measure nothing, print what is known")
    options = parser.parse_args()
    failed: list[str] = []
    if not options.report:
        if not options.add:
            shutil.rmtree(DATA, ignore_errors=True)
            for path in TREE.rglob("*.gcda"):
                path.unlink()
        named = [["C"]] if "C" in options.paths else []
        tests = [path for path in options.paths if path != "C"]
        failed = measure([*named, *([tests] if tests else [])] or everything())
    kept = table(c_sources(), python_sources(), verbose=options.verbose)
    for group in failed:
        print(f"coverage: tests failed in {group}", file=sys.stderr)
    if not kept:
        print("coverage: below the bounds", file=sys.stderr)
    return 0 if kept and not failed else 1


if __name__ == "__main__":
    sys.exit(main())
