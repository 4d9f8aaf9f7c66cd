"""``canductor simulate``: which seed runs which scenario, one after the other or in a pool of processes."""

import math
import multiprocessing
import os
import signal
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final

from coordinator.simulate import scenario as scenarios
from coordinator.simulate.checker import Violation
from coordinator.simulate.play import play
from coordinator.simulate.result import Result, SimulationReport
from coordinator.simulate.scenario import Scenario
from coordinator.support.progress import Progress, ProgressDisplay
from coordinator.support.report import PlainReport, Report
from coordinator.support.toml_values import ScenarioError
from nodes.support.errors import CanductorError

SEED_LIMIT_S: Final = 120.0
"""Real time after which a seed that has not ended hangs."""
WAITING_PER_JOB: Final = 4
"""Seeds handed to the pool ahead of need."""

Task = tuple[Scenario, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulateOptions:
    """``canductor simulate``."""

    scenarios: tuple[str, ...] = ()
    """Names or files, each run with every seed; none: all, and several seeds are spread over them."""
    seeds: range = range(1, 2)
    jobs: int = 0
    """Processes; 0: one per processor."""
    list: bool = False
    """Only list the scenarios."""
    json: bool = False
    """Show no progress."""


class _Hangs(BaseException):
    """A seed takes too long; not an Exception, so that nothing in the code under test catches it."""


def run_simulation(options: SimulateOptions) -> Report:
    """Do what OPTIONS ask for; raises CanductorError for a scenario that cannot be read."""
    chosen = [scenarios.find(name) for name in options.scenarios or scenarios.names()]
    if options.list:
        listed = {s.name: {"expect": s.expect, "about": s.about} for s in chosen}
        text = "\n".join(f"{s.name:22}  {s.expect:9}  {s.about}" for s in chosen)
        return PlainReport({"scenarios": listed}, text)
    tasks = list(plan(chosen, options))
    began_s = time.monotonic()
    results: list[Result] = []
    faults = 0
    with ProgressDisplay("simulating", quiet=options.json) as display:
        for result in run_all(tasks, options.jobs or os.cpu_count() or 1):
            results.append(result)
            faults += result.faults
            display.update(
                Progress(
                    done=len(results),
                    total=len(tasks),
                    unit="seeds",
                    print_time_s=sum(r.virtual_s for r in results),
                    wall_time_s=time.monotonic() - began_s,
                )
            )
    results.sort(key=lambda r: (r.scenario, r.seed))
    return SimulationReport(results, time.monotonic() - began_s)


def plan(chosen: Sequence[Scenario], options: SimulateOptions) -> Iterator[Task]:
    """Yield what is to be run: named scenarios with every seed, else each seed with the one it falls to."""
    if options.scenarios or len(options.seeds) == 1:
        heavy = bool(options.scenarios)
        yield from ((s, seed) for s in chosen if heavy or s.weight > 0 for seed in options.seeds)
        return
    turn = _in_turn(chosen)
    yield from ((turn[seed % len(turn)], seed) for seed in options.seeds)


def _in_turn(chosen: Iterable[Scenario]) -> list[Scenario]:
    """Return the scenarios in the order in which seeds fall to them: as often as they weigh, well mixed."""
    by_name = {s.name: s for s in chosen if s.weight > 0}
    total = sum(s.weight for s in by_name.values())
    if not by_name:
        raise CanductorError("no scenario has a weight above 0; name the one to run")
    credit = dict.fromkeys(by_name, 0.0)
    turn = []
    for _ in range(math.ceil(total)):
        for name in credit:
            credit[name] += by_name[name].weight
        first = max(credit, key=lambda name: credit[name])
        credit[first] -= total
        turn.append(by_name[first])
    return turn


def run_all(tasks: Sequence[Task], jobs: int) -> Iterator[Result]:
    """Yield a result for every one of TASKS, as they come."""
    if jobs == 1 or len(tasks) == 1:
        yield from (run_one(*task) for task in tasks)
        return
    left = iter(tasks)
    context = multiprocessing.get_context("forkserver")
    with ProcessPoolExecutor(min(jobs, len(tasks)), mp_context=context, initializer=_begin_worker) as pool:
        running: dict[Future[Result], Task] = {
            pool.submit(run_one, *task): task for task in islice(left, jobs * WAITING_PER_JOB)
        }
        try:
            while running:
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    yield future.result()
                    del running[future]
                    for task in islice(left, 1):
                        running[pool.submit(run_one, *task)] = task
        except BrokenProcessPool:
            # One of these took its process down: alone, it says so itself.
            suspects = "; ".join(
                f"canductor simulate {s.given} --seed {seed}" for s, seed in running.values()
            )
            raise CanductorError(f"a simulation crashed its process, one of: {suspects}") from None
        finally:
            pool.shutdown(cancel_futures=True)


def _begin_worker() -> None:
    for number in (signal.SIGINT, signal.SIGHUP):  # the command itself handles them and ends the pool
        signal.signal(number, signal.SIG_IGN)


def run_one(scenario: Scenario, seed: int, limit_s: float = SEED_LIMIT_S) -> Result:
    """Run one seed; a bug that shows as an exception is a violation like any other."""
    began_s = time.process_time()
    try:
        with _limit(limit_s):
            return play(scenario, seed)
    except ScenarioError:
        raise
    except (Exception, _Hangs) as error:  # noqa: BLE001 (the seed is what is tested)
        text = f"not over after {limit_s:g} s" if isinstance(error, _Hangs) else _where(error)
        return Result(
            scenario=scenario.given,
            seed=seed,
            violations=(Violation("exception", text),),
            cpu_s=time.process_time() - began_s,
        )


def _where(error: BaseException) -> str:
    """Return what was raised and the innermost places, on one line."""
    places = []
    trace: Any = error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        places.append(f"{os.path.relpath(code.co_filename)}:{trace.tb_lineno} {code.co_name}")
        trace = trace.tb_next
    return f"{type(error).__name__}: {error} ({' < '.join(reversed(places[-6:]))})"


@contextmanager
def _limit(seconds: float) -> Iterator[None]:
    """Raise _Hangs in the block when it takes longer than SECONDS of real time."""

    def hangs(*_: object) -> None:
        raise _Hangs

    before = signal.signal(signal.SIGALRM, hangs)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
