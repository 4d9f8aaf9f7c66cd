"""The command ``canductor``: reads the command line, starts the part that does the work, tells the end.

A command function only turns words into a job. ``main`` runs the job outside of the command line library, so
that every failure ends in one place: one sentence on stderr, with --json also one object on stdout.
"""

import importlib
import os
import select
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, TypeVar, cast

import typer

from coordinator.commands import (
    DemoOptions,
    PlanOptions,
    Report,
    RunOptions,
    SimulateOptions,
    Terminated,
    find_machine,
)
from nodes.errors import CanductorError

Job = Callable[[], Report]
T = TypeVar("T")

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_BUG = 70
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141
EXIT_TERMINATED = 143

SEED_MAX = 2**32
SEEDS_AT_ONCE_MAX = 10_000_000

# rich_markup_mode=None: plain help, and rich is not imported before something is to be drawn.
app = typer.Typer(add_completion=False, rich_markup_mode=None)
# Where the library keeps this class has changed between its versions; that BadParameter is one has not.
_CommandLineError: type[Exception] = next(
    c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException"
)

JsonFlag = Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line.")]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status; never raises but for SystemExit."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    as_json = "--json" in words
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        status = _run(words, as_json)
        sys.stdout.flush()
    except BrokenPipeError:
        if not _stdout_is_gone():
            return _report_bug(as_json)
        _drop_stdout()
        return EXIT_BROKEN_PIPE
    finally:
        signal.signal(signal.SIGTERM, before)
    return status


def _terminate(*_: object) -> None:
    raise Terminated


def _run(words: list[str], as_json: bool) -> int:
    try:
        job = typer.main.get_command(app).main(
            words or ["--help"], prog_name="canductor", standalone_mode=False
        )
        if not callable(job):  # --help and --version have done their work
            return EXIT_OK if words else EXIT_USAGE
        return _show(job(), as_json)
    except CanductorError as error:
        return _fail(str(error), EXIT_FAILED, as_json)
    except _CommandLineError as error:
        return _fail(_usage_sentence(error), EXIT_USAGE, as_json)
    except (KeyboardInterrupt, typer.Abort) as error:
        terminated = isinstance(error, Terminated)
        return _fail(
            "stopped by SIGTERM" if terminated else "stopped by Ctrl-C",
            EXIT_TERMINATED if terminated else EXIT_INTERRUPTED,
            as_json,
        )
    except BrokenPipeError:
        raise
    except Exception:  # noqa: BLE001 (the last line of defence: whatever comes here is a bug, and is told so)
        return _report_bug(as_json)


def _show(report: Report, as_json: bool) -> int:
    if as_json:
        _say_json({"ok": report.ok, **report.to_json()})
    else:
        _say(report.to_text())
    return EXIT_OK if report.ok else EXIT_FAILED


def _fail(sentence: str, status: int, as_json: bool) -> int:
    sys.stderr.write(f"canductor: {sentence}\n")
    if as_json:
        _say_json({"ok": False, "error": sentence})
    return status


def _say_json(values: Mapping[str, object]) -> None:
    import json  # noqa: PLC0415 (start-up time)

    _say(json.dumps(values, allow_nan=False))


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")


def _usage_sentence(error: BaseException) -> str:
    message = str(getattr(error, "message", error))
    format_message = getattr(error, "format_message", None)
    if format_message is not None:
        message = format_message()
    return f"{' '.join(message.split()).rstrip('.')} (see 'canductor --help')"


def _report_bug(as_json: bool) -> int:
    """Keep the traceback in a file: on the terminal it helps nobody."""
    import tempfile  # noqa: PLC0415 (start-up time)
    import traceback  # noqa: PLC0415 (start-up time)

    error = sys.exception() if sys.version_info >= (3, 12) else sys.exc_info()[1]
    with tempfile.NamedTemporaryFile(
        "w", prefix="canductor-", suffix=".log", delete=False, encoding="utf-8"
    ) as log:
        log.write(f"canductor {_version()}, Python {sys.version}\n{' '.join(sys.argv)}\n\n")
        log.write(traceback.format_exc())
    sentence = f"internal error: {type(error).__name__}: {error}; please report it with {log.name}"
    return _fail(" ".join(sentence.split()), EXIT_BUG, as_json)


def _stdout_is_gone() -> bool:
    """Tell a closed reader of our output from a broken pipe elsewhere, which would be a bug."""
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), select.POLLOUT)
        return any(events & (select.POLLERR | select.POLLHUP) for _, events in poll.poll(0))
    except (OSError, ValueError):  # not a file: nobody can close its other end
        return False


def _drop_stdout() -> None:
    """Let what is still buffered go nowhere, or the interpreter complains when it ends."""
    devnull = os.open(os.devnull, os.O_WRONLY)
    os.dup2(devnull, sys.stdout.fileno())
    os.close(devnull)


def _version() -> str:
    from importlib import metadata  # noqa: PLC0415 (start-up time: it draws in the mail parser)

    try:
        return metadata.version("canductor")
    except metadata.PackageNotFoundError:
        return "(not installed)"


def _runner(module: str, function: str) -> Callable[[object], Report]:
    """Import a runner when it is needed: motion and numpy cost more than the rest of a start."""
    return cast("Callable[[object], Report]", getattr(importlib.import_module(module), function))


def _print_version(wanted: bool) -> None:
    if wanted:
        _say(f"canductor {_version()}")
        raise typer.Exit


@app.callback()
def _root(
    *,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """One coordinator conducts many micro-controllers on CAN buses and UARTs as one machine."""


@app.command()
def demo(
    *,
    machine: Annotated[
        str, typer.Option("--machine", help="Configuration file or example; its nodes become virtual ones.")
    ] = "demo",
    gcode: Annotated[Path | None, typer.Option("--gcode", help="G-code file to print.")] = None,
    json_: JsonFlag = False,
    no_web: Annotated[bool, typer.Option("--no-web", help="For scripts: there is no live page yet.")] = False,
    loss: Annotated[str, typer.Option("--loss", help="Share of frames the bus loses: 0.01 or 1%.")] = "0",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Decides which frames are lost.")] = 1,
    rate_ppm: Annotated[
        list[str] | None, typer.Option("--rate-ppm", metavar="NAME=X", help="A node's clock error in ppm.")
    ] = None,
    start_clock: Annotated[
        list[str] | None,
        typer.Option("--start-clock", metavar="NAME=N", help="A node's clock at its start, in ticks."),
    ] = None,
    keep: Annotated[Path | None, typer.Option("--keep", metavar="DIR", help="Keep step logs here.")] = None,
) -> Job:
    """Print on virtual nodes and compare every stepper with the plan."""
    options = DemoOptions(
        machine=find_machine(machine),
        gcode=_existing_file(gcode),
        json=json_,
        web=not no_web,
        loss=_share(loss),
        seed=seed,
        rate_ppm=_assignments("--rate-ppm", rate_ppm, _ppm),
        start_clock=_assignments("--start-clock", start_clock, _ticks),
        keep=keep,
    )
    return lambda: _runner("coordinator.demo", "run_demo")(options)


@app.command()
def run(
    *,
    config: Annotated[Path, typer.Argument(help="Configuration file.")],
    gcode: Annotated[Path | None, typer.Option("--gcode", help="G-code file to print.")] = None,
    json_: JsonFlag = False,
) -> Job:
    """Bring up the machine of a configuration file."""
    _existing_file(config)
    options = RunOptions(config=config, gcode=_existing_file(gcode), json=json_)
    return lambda: _runner("coordinator.run", "run_machine")(options)


@app.command()
def plan(
    *,
    config: Annotated[Path, typer.Argument(help="Configuration file.")],
    gcode: Annotated[Path, typer.Argument(help="G-code file.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Write each node's commands here.")
    ] = None,
    json_: JsonFlag = False,
    dictionary: Annotated[
        list[str] | None,
        typer.Option("--dictionary", metavar="NAME=FILE", help="A node's data dictionary, as JSON."),
    ] = None,
) -> Job:
    """Plan a file without hardware: time, steps, commands, bytes."""
    _existing_file(config)
    _existing_file(gcode)
    dictionaries = _assignments("--dictionary", dictionary, Path)
    for path in dictionaries.values():
        _existing_file(path)
    options = PlanOptions(config=config, gcode=gcode, output=output, json=json_, dictionaries=dictionaries)
    return lambda: _runner("coordinator.plan", "plan_file")(options)


@app.command()
def simulate(
    *,
    scenario: Annotated[
        list[str] | None, typer.Argument(help="Names or files; all if none is named.")
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, max=SEED_MAX, help="The one seed to run; 1 if none is given."),
    ] = None,
    seeds: Annotated[
        str | None, typer.Option("--seeds", metavar="A:B", help="Seeds from A up to but not including B.")
    ] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", min=0, max=256, help="Processes; 0: one for every processor.")
    ] = 0,
    list_: Annotated[bool, typer.Option("--list", help="Only list the scenarios.")] = False,
    json_: JsonFlag = False,
) -> Job:
    """Run whole machines in virtual time, with faults, and check every step."""
    if seed is not None and seeds is not None:
        raise typer.BadParameter("--seed and --seeds exclude each other; give one of them")
    options = SimulateOptions(
        scenarios=tuple(dict.fromkeys(scenario or ())),
        seeds=_one_seed(1 if seed is None else seed) if seeds is None else _seeds(seeds),
        jobs=jobs,
        list=list_,
        json=json_,
    )
    return lambda: _runner("coordinator.simulate", "run_simulation")(options)


def _one_seed(seed: int) -> range:
    return range(seed, seed + 1)


def _seeds(text: str) -> range:
    first, colon, end = text.partition(":")
    if not (colon and all(word.isascii() and word.isdecimal() and len(word) <= 10 for word in (first, end))):
        raise typer.BadParameter(f"--seeds is '{text}', must be A:B, two whole numbers such as 0:100")
    seeds = range(int(first), int(end))
    if not 0 < len(seeds) <= SEEDS_AT_ONCE_MAX:
        raise typer.BadParameter(
            f"--seeds is '{text}', must be A:B with B above A, at most {SEEDS_AT_ONCE_MAX:,} seeds"
        )
    return seeds


def _existing_file(path: Path | None) -> Path | None:
    """Return the path; raises CanductorError early when nothing can be read there."""
    if path is None:
        return None
    if not path.exists():
        raise CanductorError(f"there is no file '{path}'")
    if path.is_dir():
        raise CanductorError(f"'{path}' is a folder, not a file")
    if not os.access(path, os.R_OK):
        raise CanductorError(f"'{path}' may not be read; check its permissions")
    return path


def _assignments(option: str, pairs: list[str] | None, convert: Callable[[str], T]) -> Mapping[str, T]:
    """Return the values of repeated NAME=VALUE options by name."""
    result: dict[str, T] = {}
    for pair in pairs or ():
        name, equals, value = pair.partition("=")
        if not name or not equals or not value:
            raise typer.BadParameter(f"{option} takes NAME=VALUE, not '{pair}'")
        if name in result:
            raise typer.BadParameter(f"{option} is given twice for '{name}'")
        try:
            result[name] = convert(value)
        except ValueError as error:
            raise typer.BadParameter(f"{option} for '{name}' is '{value}', must be {error}") from None
    return result


def _number(text: str, rule: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(rule) from None


def _ppm(text: str) -> float:
    rule = "a number in ppm, from -10000 to 10000"
    value = _number(text, rule)
    if not -10_000 <= value <= 10_000:
        raise ValueError(rule)
    return value


def _ticks(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= 20 and int(text) < 2**64):
        raise ValueError("a whole number of ticks, from 0 to 2^64 - 1")
    return int(text)


def _share(text: str) -> float:
    rule = "a share from 0 to 0.5, or a percentage such as 1%"
    try:
        value = _number(text.removesuffix("%"), rule) / (100 if text.endswith("%") else 1)
    except ValueError as error:
        raise typer.BadParameter(f"--loss is '{text}', must be {error}") from None
    if not 0 <= value <= 0.5:
        raise typer.BadParameter(f"--loss is '{text}', must be {rule}")
    return value


if __name__ == "__main__":
    sys.exit(main())
