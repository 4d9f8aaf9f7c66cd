"""``make mutants``: plants bugs one by one and checks that the simulation finds each.

A simulation that finds nothing proves nothing. Every entry of mutants.toml is one bug a programmer might
make: a text in one file that is replaced by another. For each, the project is copied, changed, what it
touches is compiled anew, and scenarios are run over seeds until one fails. A bug that survives them all is
a hole in the simulation, and the exit status says so.

``python tests/sim/mutants.py [NAME…]``; the unchanged project has to pass the same seeds first.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_name("mutants.toml")
TIMEOUT_S = 240.0
COPIED = ("coordinator", "nodes", "firmware", "config", "build", "canbus_tools")
LEFT_OUT = shutil.ignore_patterns("__pycache__", "*.o", "*.d", "bin")


@dataclass(frozen=True, slots=True)
class Mutant:
    """One bug: in FILE the text FIND, which occurs once, becomes REPLACE."""

    name: str
    why: str
    """What a programmer might have thought."""
    file: str
    find: str
    replace: str
    scenarios: tuple[str, ...]
    """Where it has to show."""
    seeds: int = 40
    modules: tuple[str, ...] = ()
    """Build scripts of the compiled modules that contain FILE; none for Python."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of a mutant."""

    caught: bool
    seconds: float
    evidence: str
    """The simulation's last line about it."""


def read_list() -> list[Mutant]:
    """Return all mutants; raises ValueError when one does not apply to the sources as they are."""
    mutants = []
    for name, entry in tomllib.loads(LIST.read_text()).items():
        entry["scenarios"] = tuple(entry["scenarios"])
        entry["modules"] = tuple(entry.get("modules", ()))
        mutant = Mutant(name, **entry)
        found = (ROOT / mutant.file).read_text().count(mutant.find)
        if found != 1:
            raise ValueError(f"mutant {name}: its text occurs {found} times in {mutant.file}, not once")
        mutants.append(mutant)
    return mutants


def simulate(folder: Path, scenarios: tuple[str, ...], seeds: int) -> subprocess.CompletedProcess[str]:
    """Run the simulation of the project in FOLDER."""
    command = [sys.executable, "-m", "coordinator.cli", "simulate", "--seeds", f"0:{seeds}", *scenarios]
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"}
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )


def build(folder: Path, mutant: Mutant) -> None:
    """Compile what contains the changed file."""
    for script in mutant.modules:
        module = script.removesuffix(".py").replace("/", ".")
        code = f"from {module} import ffibuilder; ffibuilder.compile(tmpdir='.')"
        environment = {**os.environ, "PYTHONPATH": str(folder)}
        done = subprocess.run(
            [sys.executable, "-c", code],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(
                f"mutant {mutant.name} does not compile:\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
            )


def judge(mutant: Mutant) -> Verdict:
    """Plant MUTANT in a copy and see whether the simulation finds it."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="canductor-mutant-") as name:
        folder = Path(name)
        for part in COPIED:
            if (ROOT / part).exists():
                shutil.copytree(ROOT / part, folder / part, ignore=LEFT_OUT, symlinks=True)
        target = folder / mutant.file
        target.write_text(target.read_text().replace(mutant.find, mutant.replace))
        build(folder, mutant)
        try:
            done = simulate(folder, mutant.scenarios, mutant.seeds)
        except subprocess.TimeoutExpired:
            return Verdict(True, time.monotonic() - began, "the simulation hung")
    lines = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    failures = [line for line in lines if line.strip().startswith("FAILED")]
    # A bug counts as found when the simulation says what is wrong, not when it merely ends.
    evidence = failures[0] if failures else lines[-1] if lines else "no output"
    return Verdict(bool(failures) and done.returncode != 0, time.monotonic() - began, evidence.strip())


def main() -> int:
    """Run the check; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="only these mutants")
    names = parser.parse_args().names
    mutants = [mutant for mutant in read_list() if not names or mutant.name in names]
    scenarios = tuple(dict.fromkeys(s for mutant in mutants for s in mutant.scenarios))
    seeds = max(mutant.seeds for mutant in mutants)
    sound = simulate(ROOT, scenarios, seeds)
    if sound.returncode or " 0 failed" not in sound.stdout:
        print(f"the project itself fails: {sound.stdout[-1500:]}{sound.stderr[-1500:]}")
        return 1
    print(f"unchanged: passes {seeds} seeds of {', '.join(scenarios)}", flush=True)
    survived = []
    for mutant in mutants:
        verdict = judge(mutant)
        word = "caught  " if verdict.caught else "SURVIVED"
        print(f"{word} {mutant.name:<28} {verdict.seconds:5.1f} s  {verdict.evidence[:110]}", flush=True)
        if not verdict.caught:
            survived.append(mutant.name)
    print(f"{len(mutants) - len(survived)} of {len(mutants)} planted bugs were caught")
    return 1 if survived else 0


if __name__ == "__main__":
    sys.exit(main())
