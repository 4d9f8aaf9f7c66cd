"""What ``make thorough`` runs, and which line of each step's output is its figure."""

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Step:
    """One command; FIGURE finds in its output what the table shows, the last match counts."""

    name: str
    about: str
    command: tuple[str, ...]
    figure: str

    def figure_of(self, output: str) -> str:
        """Return the figure in OUTPUT; the last line when there is none."""
        found = list(re.finditer(self.figure, output, re.MULTILINE))
        lines = [line.strip() for line in output.splitlines() if line.strip()]
        return found[-1][0] if found else lines[-1] if lines else "no output"


@dataclass(frozen=True, slots=True)
class Amount:
    """How much each step does."""

    seeds: int = 2000
    sample: int = 300
    seed: int = 1
    fuzz_s: int = 600
    soak_minutes: float = 120.0


_PYTEST_FIGURE: Final = r"\d+ (passed|failed)\b[^\n]*?(?= in [\d.]+)"
_FUZZ_FIGURE: Final = r"^.*(DONE|Done|done|runs|exec)\b.*$"


def steps(amount: Amount) -> Iterator[Step]:
    """Yield all steps in the order in which they run."""
    python = sys.executable
    pytest = (python, "-m", "pytest", "-n", "2", "--dist", "loadfile")
    fuzz = ("make", "-C", "tests/fuzz", f"SECONDS={amount.fuzz_s}", f"PYTHON={python}")
    yield Step(
        "full",
        "all tests, with many more examples of each property",
        (*pytest, "--hypothesis-profile", "full", "--timeout", "1800"),
        _PYTEST_FIGURE,
    )
    ties = "tests/coordinator/motion/test_half_step_ties.py"
    yield Step(
        "ties",
        "10,000 programs that rest and turn at half steps",
        (python, "-m", "pytest", "-q", "--hypothesis-profile", "full", "--timeout", "1800", ties),
        _PYTEST_FIGURE,
    )
    yield Step(
        "memory",
        "all tests, with memory that is filled when taken and freed, and garbage collected late",
        ("env", "MALLOC_PERTURB_=165", "PYTHONMALLOC=debug", *pytest, "-p", "tests.late_collection"),
        _PYTEST_FIGURE,
    )
    yield Step(
        "sim",
        "machines in virtual time, each seed with other faults",
        (python, "-m", "coordinator.cli.main", "simulate", "--seeds", f"0:{amount.seeds}"),
        r"^.*\d+ failed.*$",
    )
    for share, prints in ((5, 300), (10, 100)):
        yield Step(
            f"loss-{share}",
            f"{prints} prints on a bus that loses {share} % of the frames",
            (
                *(python, "-m", "coordinator.cli.main", "simulate", f"loss_{share}_percent"),
                *("--seeds", f"0:{prints}"),
            ),
            r"^.*\d+ failed.*$",
        )
    yield Step("mutants", "planted bugs", (python, "tests/sim/mutants.py"), r"^\d+ of \d+ planted bugs.*$")
    yield Step(
        "mutation",
        "a sample of all mutations",
        (python, "-m", "tests.mutation.run", "--seed", str(amount.seed), "--sample", str(amount.sample)),
        r"^[\d.]+% survive unexplained.*$",
    )
    yield Step(
        "arm",
        "64 and 32 bits of ARM, emulated, beside this processor",
        (python, "-m", "tests.arm.prove"),
        r"^arm(?=:.*command streams).*$",
    )
    yield Step("fuzz", "the motion engine under the sanitizers", (*fuzz, "run"), _FUZZ_FIGURE)
    yield Step("fuzz-mt", "the table receiver under the sanitizers", (*fuzz, "mt"), _FUZZ_FIGURE)
    yield Step("fuzz-live", "the sockets of a machine that prints", (*fuzz, "live"), r"^lead lost.*$")
    yield Step(
        "fuzz-stops",
        "emergency stops while fuzzers are at all ways in",
        (*fuzz, "stops"),
        r"^loop held: .*$",
    )
    yield Step(
        "octoprint",
        "OctoPrint prints over a pseudo-terminal",
        ("make", "octoprint"),
        r"(?<=^ok: )printed .*$",
    )
    yield Step(
        "soak",
        "a service that prints while clients come and go",
        (python, "-m", "tests.soak.run", "--minutes", str(amount.soak_minutes)),
        r"^\d+ prints, .*$",
    )
