"""Builds the project for ARM, runs it emulated, and compares all results with this computer's.

    python -m tests.arm.prove [--seeds N] [aarch64] [arm]

For each processor: the C tests under UBSan (AddressSanitizer does not run emulated), then command streams of
every example machine, and of sliced programs where they lie beside the project, byte by byte, and the traces
of simulated runs. Exit status 1 when anything differs; the last words say what. Debian packages that are
needed and not there are named.
"""

import argparse
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Final

from tests.arm.modules import ROOT, build_tree
from tests.arm.target import ArmError, Target, missing_packages, run, targets

FOLDER: Final = ROOT / "build" / "emulated"
SHARED: Final = ROOT.parent / "shared" / "data"
SCENARIOS: Final = ("long_print", "loss_1_percent", "uart_loss", "rollover", "bad_day")
LINES: Final = 1500
"""Of a sliced program: its first layers."""
PROGRAM: Final = """\
G28
G1 Z5 F600
G1 X12.5 Y7.3 F9000
G1 X20.013 Y15.7
G3 X10 Y18.1 I-5 J1.2 F6000
G1 X9.4 Y8 Z5.21
G1 X5 Y14.4 F3000
G1 X8 Y9 F12000
"""


def main() -> int:
    """Prove; print what was compared."""
    known = {target.name: target for target in targets(FOLDER)}
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("processors", nargs="*", metavar="PROCESSOR", help=f"of {', '.join(known)}")
    parser.add_argument("--seeds", type=int, default=2, help="of each scenario")
    options = parser.parse_args()
    if unknown := set(options.processors) - set(known):
        parser.error(f"no processor {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    wanted = [known[name] for name in options.processors or known]
    if missing := missing_packages(wanted):
        print(f"arm: needs: apt-get install --no-install-recommends {' '.join(missing)}", file=sys.stderr)
        return 1
    try:
        asked = _asked(options.seeds)
        here = FOLDER / "here"
        _results([sys.executable], here, asked)
        for target in wanted:
            target.make_root()
            print(f"{target.name}: {_c_tests(target)}", flush=True)
            there = target.folder / "results"
            _results(target.python(build_tree(target)), there, asked)
            print(f"{target.name}: {_compare(here, there)}", flush=True)
    except ArmError as error:
        print(f"arm: {error}", file=sys.stderr)
        return 1
    return 0


def _asked(seeds: int) -> Path:
    """Return the file that says what to plan and to simulate."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    program = FOLDER / "moves.gcode"
    program.write_text(PROGRAM, encoding="ascii")
    machines = sorted(path for path in (ROOT / "config").glob("*.cfg") if path.stem != "none")
    plans = {path.stem: [str(path), str(program)] for path in machines}
    for gcode in sorted((SHARED / "gcode").glob("*.gcode")):
        first = FOLDER / gcode.name
        first.write_text("".join(gcode.read_text(encoding="utf-8").splitlines(keepends=True)[:LINES]))
        for config in sorted((SHARED / "config").glob("*.cfg")):
            plans[f"{gcode.stem}-{config.stem}"] = [str(config), str(first)]
    runs = [(scenario, seed) for scenario in SCENARIOS for seed in range(seeds)]
    path = FOLDER / "asked.json"
    path.write_text(json.dumps({"plans": plans, "runs": runs}), encoding="utf-8")
    return path


def _results(python: list[str], folder: Path, asked: Path) -> None:
    """Have PYTHON put its results into FOLDER."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    run([*python, str(Path(__file__).with_name("results.py")), str(folder), str(asked)], FOLDER)


def _c_tests(target: Target) -> str:
    """Run the C tests; return in words how many passed."""
    settings = {
        "CC": target.compiler,
        "SANITIZE": "-fsanitize=undefined -fno-sanitize-recover=all -static-libubsan",
        "OUT": str(target.folder / "ctest"),
        "RUN": " ".join(target.emulator),
    }
    words = [f"{name}={value}" for name, value in settings.items()]
    shown = run(["make", "-s", f"-j{os.cpu_count()}", "-C", str(ROOT / "tests"), *words])
    return f"C tests: {shown.splitlines()[-1]}"


def _compare(here: Path, there: Path) -> str:
    """Return in words what is the same; raises ArmError for the first thing that is not."""
    streams = sorted(path.relative_to(here) for path in here.rglob("*.batch"))
    if streams != sorted(path.relative_to(there) for path in there.rglob("*.batch")) or not streams:
        raise ArmError(f"{there} has other streams than {here}")
    size = 0
    for name in streams:
        ours, theirs = (here / name).read_bytes(), (there / name).read_bytes()
        if ours != theirs:
            at = next((i for i, (a, b) in enumerate(zip(ours, theirs, strict=False)) if a != b), -1)
            raise ArmError(f"{there / name} differs from {here / name}, first at byte {at}")
        size += len(ours)
    traces, others = (json.loads((folder / "traces.json").read_text()) for folder in (here, there))
    for name, trace in traces.items():
        if others[name] != trace or not trace["ok"]:
            raise ArmError(f"simulated run {name} is {others[name]} there, {trace} here")
    steps = sum(trace["steps"] for trace in traces.values())
    return (
        f"{len(streams)} command streams, {size:,} bytes, and {len(traces)} simulated runs of"
        f" {steps:,} steps are those of this computer"
    )


if __name__ == "__main__":
    sys.exit(main())
