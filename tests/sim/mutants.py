"""``make mutants``: plants bugs one by one and checks that the simulation and the tests find them.

A check that finds nothing proves nothing. Every entry of mutants.toml is one bug a programmer might make: a
text in one file that is replaced by another. For each, the project is copied, changed, what it touches is
compiled again, and the scenarios and tests that the entry names are run. Both have to see the bug when both
are named, and the simulation has to see at least half of all bugs; the exit status says so.

``python tests/sim/mutants.py [NAME…]``; the unchanged project has to pass the same seeds and tests first.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]
LIST: Final = Path(__file__).with_name("mutants.toml")
TIMEOUT_S: Final = 3600.0
"""After it something hangs; a busy computer needs minutes for what the project itself has to pass."""
SIMULATION_SHARE: Final = 0.5
"""At least this part of all planted bugs the simulation has to see."""
COPIED: Final = (
    *("coordinator", "nodes", "firmware", "config", "build", "canbus_tools", "tests", "docs"),
    *("pyproject.toml", "setup.py"),
)
LEFT_OUT: Final = shutil.ignore_patterns(
    "__pycache__", "*.o", "*.d", "mutation", "emulated", "frontends", "octoprint"
)


@dataclass(frozen=True, slots=True)
class Mutant:
    """One bug: in FILE the text FIND, which occurs once, becomes REPLACE."""

    name: str
    why: str
    """What a programmer might have thought."""
    file: str
    find: str
    replace: str
    scenarios: tuple[str, ...] = ()
    """Where it has to show in the simulation."""
    seeds: int = 40
    modules: tuple[str, ...] = ()
    """Build scripts of the compiled modules that contain FILE; none for Python."""
    tests: tuple[str, ...] = ()
    """Which tests have to fail, at least one: pytest node ids or C test programs."""


@dataclass(frozen=True, slots=True)
class Sight:
    """What one kind of check saw of a mutant."""

    saw: bool
    evidence: str
    """Its last line about it."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What was seen of a mutant; None where the entry names nothing of this kind."""

    simulation: Sight | None
    tests: Sight | None
    seconds: float

    @property
    def caught(self) -> bool:
        """Whether everything that the entry names saw the bug."""
        return all(sight.saw for sight in (self.simulation, self.tests) if sight)

    def line(self, name: str) -> str:
        """Return one line of the report about the mutant NAME."""
        word = "caught  " if self.caught else "SURVIVED"
        seen = [
            f"{kind} {'saw it' if sight.saw else 'MISSED it'}: {sight.evidence[:100]}"
            for kind, sight in (("simulation", self.simulation), ("tests", self.tests))
            if sight
        ]
        return f"{word} {name:<28} {self.seconds:5.1f} s  " + "; ".join(seen)


def read_list(path: Path = LIST) -> list[Mutant]:
    """Return all mutants; raises ValueError when one does not apply to the sources as they are."""
    mutants = []
    for name, entry in tomllib.loads(path.read_text(encoding="utf-8")).items():
        for key in ("scenarios", "modules", "tests"):
            entry[key] = tuple(entry.get(key, ()))
        mutant = Mutant(name, **entry)
        found = (ROOT / mutant.file).read_text(encoding="utf-8").count(mutant.find)
        if found != 1:
            raise ValueError(f"mutant {name}: its text occurs {found} times in {mutant.file}, not once")
        if not mutant.scenarios and not mutant.tests:
            raise ValueError(f"mutant {name}: names neither scenarios nor tests")
        mutants.append(mutant)
    return mutants


def run(folder: Path, command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run COMMAND with the project in FOLDER."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )


def simulate(folder: Path, scenarios: Sequence[str], seeds: int) -> subprocess.CompletedProcess[str]:
    """Run the simulation of the project in FOLDER."""
    command = [sys.executable, "-m", "coordinator.cli.main", "simulate", "--seeds", f"0:{seeds}", *scenarios]
    return run(folder, command)


def run_tests(folder: Path, tests: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run TESTS of the project in FOLDER; of the two kinds, pytest's are not run when a C program failed."""
    programs = [test for test in tests if test.endswith(".c")]
    node_ids = [test for test in tests if not test.endswith(".c")]
    done = subprocess.CompletedProcess[str]([], 0, "", "")
    if programs:
        names = " ".join(test.removeprefix("tests/").removesuffix(".c") for test in programs)
        done = run(folder, ["make", "-C", "tests", f"TESTS={names}", f"PYTHON={sys.executable}"])
    if node_ids and not done.returncode:
        done = run(folder, [sys.executable, "-m", "pytest", "-x", "-p", "no:cacheprovider", *node_ids])
    return done


def build(folder: Path, mutant: Mutant) -> None:
    """Compile what contains the changed file."""
    for script in mutant.modules:
        module = script.removesuffix(".py").replace("/", ".")
        code = f"from {module} import ffibuilder; ffibuilder.compile(tmpdir='.')"
        done = run(folder, [sys.executable, "-c", code])
        if done.returncode:
            raise RuntimeError(
                f"mutant {mutant.name} does not compile:\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
            )


def seen_by_simulation(folder: Path, mutant: Mutant) -> Sight | None:
    """Run the scenarios of MUTANT, planted in FOLDER."""
    if not mutant.scenarios:
        return None
    try:
        done = simulate(folder, mutant.scenarios, mutant.seeds)
    except subprocess.TimeoutExpired:
        return Sight(True, "the simulation hung")
    lines = _lines(done)
    failures = [line for line in lines if line.startswith("FAILED")]
    # A bug counts as found when the simulation says what is wrong, not when it merely ends.
    evidence = failures[0] if failures else lines[-1] if lines else "no output"
    return Sight(bool(failures) and done.returncode != 0, evidence)


def seen_by_tests(folder: Path, mutant: Mutant) -> Sight | None:
    """Run the tests of MUTANT, planted in FOLDER."""
    if not mutant.tests:
        return None
    try:
        done = run_tests(folder, mutant.tests)
    except subprocess.TimeoutExpired:
        return Sight(True, "the tests hung")
    lines = _lines(done)
    failures = [line for line in lines if line.startswith("FAILED")]
    evidence = failures[0] if failures else lines[-1] if lines else "no output"
    # As above: tests that cannot run at all are no verdict.
    return Sight(bool(failures) and done.returncode != 0, evidence)


def _lines(done: subprocess.CompletedProcess[str]) -> list[str]:
    return [line.strip() for line in (done.stdout + done.stderr).splitlines() if line.strip()]


def judge(mutant: Mutant) -> Verdict:
    """Plant MUTANT in a copy of the project and see what finds it."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="canductor-mutant-") as name:
        folder = Path(name)
        for part in COPIED:
            if (ROOT / part).is_dir():
                shutil.copytree(ROOT / part, folder / part, ignore=LEFT_OUT, symlinks=True)
            elif (ROOT / part).exists():
                shutil.copy2(ROOT / part, folder / part)
        target = folder / mutant.file
        target.write_text(target.read_text().replace(mutant.find, mutant.replace))
        build(folder, mutant)
        simulation, tests = seen_by_simulation(folder, mutant), seen_by_tests(folder, mutant)
    return Verdict(simulation, tests, time.monotonic() - began)


def passes_unchanged(mutants: Sequence[Mutant]) -> bool:
    """Whether the project itself passes all that MUTANTS name; prints what fails."""
    seeds_of: dict[str, int] = {}
    for mutant in mutants:
        for scenario in mutant.scenarios:
            seeds_of[scenario] = max(mutant.seeds, seeds_of.get(scenario, 0))
    tests = tuple(dict.fromkeys(t for mutant in mutants for t in mutant.tests))
    for seeds in sorted(set(seeds_of.values())):
        scenarios = tuple(scenario for scenario, most in seeds_of.items() if most == seeds)
        done = simulate(ROOT, scenarios, seeds)
        if done.returncode or " 0 failed" not in done.stdout:
            print(f"the project itself fails: {done.stdout[-1500:]}{done.stderr[-1500:]}")
            return False
        print(f"unchanged: passes {seeds} seeds of {', '.join(scenarios)}", flush=True)
    if tests:
        done = run_tests(ROOT, tests)
        if done.returncode:
            print(f"the project itself fails: {done.stdout[-1500:]}{done.stderr[-1500:]}")
            return False
        print(f"unchanged: passes {', '.join(tests)}", flush=True)
    return True


def main() -> int:
    """Run the check; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="only these mutants")
    names = parser.parse_args().names
    mutants = [mutant for mutant in read_list() if not names or mutant.name in names]
    if not passes_unchanged(mutants):
        return 1
    verdicts = []
    for mutant in mutants:
        verdicts.append(judge(mutant))
        print(verdicts[-1].line(mutant.name), flush=True)
    caught = sum(verdict.caught for verdict in verdicts)
    seen = sum(bool(verdict.simulation and verdict.simulation.saw) for verdict in verdicts)
    print(f"{caught} of {len(mutants)} planted bugs were caught, {seen} of them by the simulation")
    blind = not names and seen < SIMULATION_SHARE * len(mutants)
    if blind:
        print(f"the simulation has to see at least {SIMULATION_SHARE:.0%} of them")
    return 1 if blind or caught < len(mutants) else 0


if __name__ == "__main__":
    sys.exit(main())
