"""``canductor simulate``: machines in virtual time, with faults."""

import argparse
from typing import Any, Final

from coordinator.simulate.run import SimulateOptions, run_simulation
from coordinator.support.report import Report
from nodes.support.numbers import read_int
from nodes.support.option_values import UsageError, add_command, integer, options_from

SEED_MAX: Final = 2**32
SEEDS_AT_ONCE_MAX: Final = 10_000_000
JOBS_MAX: Final = 256


def add_to(commands: Any) -> None:
    """Add the command."""
    summary = "run machines in virtual time, with faults, and check every step"
    add_command(commands, "simulate", summary, _declare, _run)


def _declare(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("scenarios", nargs="*", metavar="SCENARIO", help="names or files of scenarios (default: all)")
    add("--seed", type=integer(0, SEED_MAX), metavar="N", help="run this seed only (default: 1)")
    add("--seeds", type=_seeds, metavar="A:B", help="run the seeds from A to B, without B")
    add(
        "--jobs",
        type=integer(0, JOBS_MAX),
        default=0,
        metavar="N",
        help="number of processes; 0: one per processor",
    )
    add("--list", action="store_true", help="list the scenarios and exit")


def _run(given: argparse.Namespace) -> Report:
    if given.seed is not None and given.seeds is not None:
        raise UsageError("--seed and --seeds exclude each other; give one of them")
    first = 1 if given.seed is None else given.seed
    options = options_from(
        SimulateOptions,
        given,
        scenarios=tuple(dict.fromkeys(given.scenarios)),
        seeds=given.seeds or range(first, first + 1),
    )
    return run_simulation(options)


def _seeds(text: str) -> range:
    first, colon, end = text.partition(":")
    low, high = read_int(first), read_int(end)
    if not colon or low is None or high is None or low < 0:
        raise UsageError(f"is '{text}', must be A:B, two whole numbers such as 0:100")
    seeds = range(low, high)
    if not 0 < high - low <= SEEDS_AT_ONCE_MAX:
        raise UsageError(f"is '{text}', must be A:B with B above A, at most {SEEDS_AT_ONCE_MAX:,} seeds")
    return seeds
