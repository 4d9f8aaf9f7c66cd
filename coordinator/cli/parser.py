"""The words of the command line: which commands there are, what they take, and the job each of them is.

argparse, because the start counts: a library that is nicer to write with cost more than half of a short plan.
"""

import argparse
import gc
import importlib
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, cast

from canbus_tools.bus.computer import Computer
from coordinator.cli.arguments.serving import declare_serving, is_asked_to_serve, read_serving
from coordinator.support.command_options import (
    DemoOptions,
    PlanOptions,
    Report,
    RunOptions,
    SimulateOptions,
    find_machine,
)
from nodes.support.option_values import UsageError, assignments, existing_file, share, whole

Job = Callable[[], Report]

SEED_MAX = 2**32
SEEDS_AT_ONCE_MAX = 10_000_000
JOBS_MAX = 256
_COLUMNS = 80
TOOL_COMMANDS = {
    "can": "Find, watch and debug nodes on a CAN bus.",
    "console": "Talk to one node in its own words.",
}
"""Commands whose words are read by ``canbus_tools.tools.parser``."""
FRONT_END_COMMANDS = {
    "call": "Call a method of a machine that runs.",
    "watch": "Show the fields of a machine that runs, and their changes.",
    "status": "Tell how a machine that runs is doing.",
    "send": "Send a file to a machine that runs, and print it.",
    "page": "Print a link that lets a browser into the live page of a machine that runs, once.",
    "estop": "Stop a machine that runs, at once.",
    "discover": "List the machines that run here or are announced on the network.",
    "table": "Check compensation tables of axes, and give them to a machine that runs.",
    "completion": "Write what makes a shell complete the words of canductor.",
}
"""Commands whose words are read by ``coordinator.cli.arguments.front_ends``."""
OTHER_COMMANDS = {
    "config": "Check a configuration, or print what one may contain.",
    "dnc": "Exchange programs and tables with machine-shop peripherals over a serial line.",
}
"""Commands whose words are read by a module of their own."""
_WORDS_OF = {"config": "coordinator.cli.arguments.config", "dnc": "coordinator.cli.commands.dnc"}


class Answered(Exception):  # noqa: N818 (no failure: the words asked for help or the version, and got it)
    """There is nothing left to do."""


class _Help(argparse.HelpFormatter):
    """Looks up the terminal's width itself: argparse does for every option declared, by a slow import."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=_columns() - 2)


def _columns() -> int:
    """Return what ``shutil.get_terminal_size`` would."""
    given = os.environ.get("COLUMNS", "")
    if given.isdecimal() and int(given):
        return int(given)
    try:
        return os.get_terminal_size(sys.stdout.fileno()).columns or _COLUMNS
    except (AttributeError, ValueError, OSError):  # there is none, it is closed, or no terminal
        return _COLUMNS


class _Parser(argparse.ArgumentParser):
    """Raises where argparse would print and exit."""

    def __init__(self, **words: Any) -> None:
        super().__init__(formatter_class=_Help, **words)

    def error(self, message: str) -> NoReturn:
        """Tell what is wrong."""
        raise UsageError(message)

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """End after --help."""
        del status, message
        raise Answered


def read_words(words: Sequence[str], computer: "Computer | None" = None) -> Job:
    """Return the job that WORDS ask for; a CAN tool will run on COMPUTER, this one if None.

    Raises UsageError, Answered after --help or --version, CanductorError for a file that is not there.
    """
    if words[0] in TOOL_COMMANDS:
        return _tool(words, computer)
    if words[0] in FRONT_END_COMMANDS:
        return _front_end(words, computer)
    if words[0] in OTHER_COMMANDS:
        return _other(words)
    arguments = _parser(only=words[0]).parse_args(list(words))
    if arguments.version:
        sys.stdout.write(f"canductor {version()}\n")
        raise Answered
    if arguments.make_job is None:
        raise UsageError("the command is missing")
    return cast("Job", arguments.make_job(arguments))


def print_help() -> None:
    """Write what --help writes."""
    _parser().print_help()


def help_of(words: Sequence[str]) -> str:
    """Return the command that explains the words: of the CAN tools each has its own help."""
    from canbus_tools.tools.parser import TOOLS  # noqa: PLC0415 (start-up time)

    named = words[:1] if words[0] == "console" else words[:2] if words[0] == "can" else []
    if named[1:] and named[1] not in TOOLS:
        named = named[:1]
    return " ".join(["canductor", *named, "--help"])


def version() -> str:
    """Return the version of the installed project."""
    from importlib import metadata  # noqa: PLC0415 (start-up time: it draws in the mail parser)

    try:
        return metadata.version("canductor")
    except metadata.PackageNotFoundError:
        return "(not installed)"


def whole_parser() -> argparse.ArgumentParser:
    """Return the parser of all words, for what lists them: a start does not pay for those it does not use."""
    from canbus_tools.tools.parser import add_tools, declare_tool  # noqa: PLC0415 (start-up time)

    parser = _parser(whole=True)
    (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))  # noqa: SLF001
    for name, summary in FRONT_END_COMMANDS.items():
        _declare_front_end(commands, name, summary)
    for name in OTHER_COMMANDS:
        _declare_other(commands, name)
    can = commands.add_parser("can", allow_abbrev=False, help=_in_list(TOOL_COMMANDS["can"]))
    add_tools(can)
    declare_tool(commands, "console")
    return parser


def _in_list(summary: str) -> str:
    return f"{summary[0].lower()}{summary[1:].rstrip('.')}"


def _front_end(words: Sequence[str], computer: "Computer | None") -> Job:
    """Read the words of a command that talks to a machine that runs."""
    parser = _Parser(prog="canductor", allow_abbrev=False)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    _declare_front_end(commands, words[0], FRONT_END_COMMANDS[words[0]])
    arguments = parser.parse_args(list(words))
    arguments.on_device = partial(_on_device, computer)
    return cast("Job", arguments.make_job(arguments))


def _on_device(computer: "Computer | None", job: Any) -> Report:
    """Send tables to drives and nodes without a coordinator: a tool's work."""
    from canbus_tools.bus.computer import ThisComputer  # noqa: PLC0415 (start-up time)
    from canbus_tools.tables.table_device import carry_out  # noqa: PLC0415 (start-up time)

    return carry_out(computer or ThisComputer(), job)


def _declare_front_end(commands: Any, name: str, summary: str) -> None:
    from coordinator.cli.arguments.front_ends import declare  # noqa: PLC0415 (start-up time)

    declare(commands.add_parser(name, help=_in_list(summary), description=summary, allow_abbrev=False), name)


def _other(words: Sequence[str]) -> Job:
    """Read the words of a command that has a module of its own."""
    parser = _Parser(prog="canductor", allow_abbrev=False)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    _declare_other(commands, words[0])
    arguments = parser.parse_args(list(words))
    if "make_job" not in arguments:
        raise UsageError(f"what '{words[0]}' shall do is missing")
    return cast("Job", arguments.make_job(arguments))


def _declare_other(commands: Any, name: str) -> None:
    summary = OTHER_COMMANDS[name]
    command = commands.add_parser(name, help=_in_list(summary), description=summary, allow_abbrev=False)
    importlib.import_module(_WORDS_OF[name]).declare(command)


def _parser(*, whole: bool = False, only: str = "") -> argparse.ArgumentParser:
    """Return the parser; WHOLE: without the commands that others declare; ONLY: of this command of ours."""
    parser = _Parser(
        prog="canductor",
        description="One coordinator conducts many micro-controllers on CAN buses and UARTs as one machine.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="store_true", help="print the version")
    parser.set_defaults(make_job=None)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    own = (
        ("demo", "print on virtual nodes and compare every stepper with the plan", _declare_demo, _demo),
        ("run", "bring up the machine of a configuration file", _declare_run, _run),
        ("plan", "plan a file without hardware: time, steps, bus load, warnings", _declare_plan, _plan),
        (
            "simulate",
            "run machines in virtual time, with faults, and check steps",
            _declare_simulate,
            _simulate,
        ),
    )
    known = only in [name for name, *_ in own]
    others = {} if whole or known else TOOL_COMMANDS | FRONT_END_COMMANDS | OTHER_COMMANDS
    for name, summary in others.items():
        commands.add_parser(name, help=_in_list(summary))
    for name, summary, declare, make_job in own:
        if known and name != only:
            continue
        command = commands.add_parser(name, help=summary, description=f"{summary}.", allow_abbrev=False)
        declare(command)
        command.add_argument("--json", action="store_true", help="print one JSON object as the last line")
        command.set_defaults(make_job=make_job)
    return parser


def _tool(words: Sequence[str], computer: "Computer | None") -> Job:
    """Read the words of a bus tool; those that only plan do not pay for the tools' start."""
    from canbus_tools.tools.parser import add_tools, declare_tool  # noqa: PLC0415 (start-up time)

    parser = _Parser(prog="canductor", allow_abbrev=False)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    if words[0] == "console":
        declare_tool(commands, "console", computer)
    else:
        can = commands.add_parser("can", allow_abbrev=False, description=TOOL_COMMANDS["can"])
        add_tools(can, computer)
    arguments = parser.parse_args(list(words))
    if "make_job" not in arguments:
        raise UsageError("the CAN tool is missing")
    return cast("Job", arguments.make_job(arguments))


def _runner(module: str, function: str) -> Callable[[object], Report]:
    """Import a runner when it is needed: motion costs more than the rest of a start."""
    gc.disable()  # what is imported stays
    try:
        found = importlib.import_module(module)
    finally:
        gc.freeze()
        gc.enable()
    return cast("Callable[[object], Report]", getattr(found, function))


# ------------------------------------------------------------------------------------------------ commands


def _declare_demo(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("--machine", default="demo", help="configuration file or example; its nodes become virtual ones")
    add("--gcode", type=Path, metavar="FILE", help="g-code file to print")
    add(
        "--no-web",
        action="store_true",
        help="for scripts: no live page, which is there only with --serve --web",
    )
    add("--loss", default="0", metavar="SHARE", help="share of frames the bus loses: 0.01 or 1%%")
    add("--seed", default="1", metavar="N", help="decides which frames are lost")
    add("--rate-ppm", action="append", metavar="NAME=X", help="a node's clock error in ppm")
    add("--start-clock", action="append", metavar="NAME=N", help="a node's clock at its start, in ticks")
    add("--keep", type=Path, metavar="DIR", help="keep step logs here")
    add("--cold", action="store_true", help="let the heaters begin cold; they take their time, as real ones")
    add("--serve", action="store_true", help="keep the virtual machine up for front ends instead of printing")
    add(
        "--socketcan",
        action="append",
        metavar="[BUS=]INTERFACE",
        help="put the machine's CAN buses, or the one called BUS, on this interface (such as vcan0)",
    )
    declare_serving(command)


def _demo(given: argparse.Namespace) -> Job:
    machine = find_machine(given.machine)
    if given.serve and given.gcode is not None:
        raise UsageError("--serve prints nothing by itself; leave --gcode out, or --serve")
    if given.web is not None and (given.no_web or not given.serve):
        raise UsageError("--web shows the machine that --serve keeps up; give --serve, and no --no-web")
    options = DemoOptions(
        machine=machine,
        gcode=existing_file(given.gcode),
        json=given.json,
        web=not given.no_web,
        loss=share("--loss", given.loss),
        seed=whole("--seed", given.seed),
        rate_ppm=assignments("--rate-ppm", given.rate_ppm, _ppm),
        start_clock=assignments("--start-clock", given.start_clock, _ticks),
        keep=given.keep,
        cold=given.cold,
        serve=read_serving(given, machine, announce=False) if given.serve else None,
        socketcan=_interfaces(given.socketcan),
    )
    if options.socketcan and options.loss:
        raise UsageError(
            "--loss is of virtual buses; an interface loses frames by 'tc qdisc add dev INTERFACE root netem"
            " loss 1%' (docs/can/vcan.md)"
        )
    if options.serve is not None:
        return lambda: _runner("coordinator.demo.serve", "serve_demo")(options)
    return lambda: _runner("coordinator.demo", "run_demo")(options)


def _interfaces(words: list[str] | None) -> Mapping[str, str]:
    """Read --socketcan: the interface by the bus it carries, that of all other buses under no name."""
    every = [word for word in words or () if "=" not in word]
    if len(every) > 1:
        raise UsageError(f"--socketcan names two interfaces for every bus, {every[0]} and {every[1]}")
    named = assignments("--socketcan", [word for word in words or () if "=" in word], str)
    return {"": every[0], **named} if every else named


def _declare_run(command: argparse.ArgumentParser) -> None:
    command.add_argument("config", type=Path, help="configuration file")
    command.add_argument("--gcode", type=Path, metavar="FILE", help="g-code file to print")
    declare_serving(command)


def _run(given: argparse.Namespace) -> Job:
    existing_file(given.config)
    asked = is_asked_to_serve(given)
    if asked and given.gcode is not None:
        raise UsageError("--gcode prints a file and ends; leave it out to serve front ends")
    serves = asked or (given.gcode is None and sys.stdin is not None and sys.stdin.isatty())
    options = RunOptions(
        config=given.config,
        gcode=existing_file(given.gcode),
        json=given.json,
        serve=read_serving(given, given.config) if serves else None,
    )
    if options.serve is not None:
        return lambda: _runner("coordinator.front_ends.serve", "serve_machine")(options)
    return lambda: _runner("coordinator.cli.commands.run", "run_machine")(options)


def _declare_plan(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("config", type=Path, help="configuration file")
    add("gcode", type=Path, help="g-code file; - reads standard input")
    add("-o", "--output", type=Path, metavar="DIR", help="write command streams, report and plot here")
    add("--plot", type=Path, metavar="FILE.svg", help="draw velocity, flow and bus load over print time")
    add("--dictionary", action="append", metavar="NAME=FILE", help="a node's data dictionary, as JSON")
    add("--bitrate", default="1000000", metavar="BIT/S", help="of the CAN buses; 1000000 if not given")
    add(
        "--table", action="append", metavar="AXIS=FILE", help="correct an axis by a table, as a machine would"
    )


def _plan(given: argparse.Namespace) -> Job:
    existing_file(given.config)
    if str(given.gcode) != "-":
        existing_file(given.gcode)
    if given.plot is not None and given.plot.suffix.lower() != ".svg":
        raise UsageError(f"--plot is '{given.plot}', must be a file that ends in .svg")
    dictionaries = assignments("--dictionary", given.dictionary, Path)
    by_axis = [pair.partition("=") for pair in given.table or ()]
    tables = assignments("--table", [f"{axis.lower()}{equals}{file}" for axis, equals, file in by_axis], Path)
    for path in (*dictionaries.values(), *tables.values()):
        existing_file(path)
    options = PlanOptions(
        config=given.config,
        gcode=given.gcode,
        output=given.output,
        plot=given.plot,
        json=given.json,
        dictionaries=dictionaries,
        tables=tables,
        can_bitrate=whole("--bitrate", given.bitrate, 10_000, 8_000_000),
    )
    return lambda: _runner("coordinator.planning.plan", "plan_file")(options)


def _declare_simulate(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("scenario", nargs="*", help="names or files; all if none is named")
    add("--seed", metavar="N", help="the one seed to run; 1 if none is given")
    add("--seeds", metavar="A:B", help="seeds from A up to but not including B")
    add("--jobs", default="0", metavar="N", help="processes; 0: one for every processor")
    add("--list", action="store_true", help="only list the scenarios")


def _simulate(given: argparse.Namespace) -> Job:
    if given.seed is not None and given.seeds is not None:
        raise UsageError("--seed and --seeds exclude each other; give one of them")
    seed = 1 if given.seed is None else whole("--seed", given.seed, 0, SEED_MAX)
    options = SimulateOptions(
        scenarios=tuple(dict.fromkeys(given.scenario)),
        seeds=_one_seed(seed) if given.seeds is None else _seeds(given.seeds),
        jobs=whole("--jobs", given.jobs, 0, JOBS_MAX),
        list=given.list,
        json=given.json,
    )
    return lambda: _runner("coordinator.simulate", "run_simulation")(options)


# -------------------------------------------------------------------------------------------------- values


def _one_seed(seed: int) -> range:
    return range(seed, seed + 1)


def _seeds(text: str) -> range:
    first, colon, end = text.partition(":")
    if not (colon and all(word.isascii() and word.isdecimal() and len(word) <= 10 for word in (first, end))):
        raise UsageError(f"--seeds is '{text}', must be A:B, two whole numbers such as 0:100")
    seeds = range(int(first), int(end))
    if not 0 < len(seeds) <= SEEDS_AT_ONCE_MAX:
        raise UsageError(
            f"--seeds is '{text}', must be A:B with B above A, at most {SEEDS_AT_ONCE_MAX:,} seeds"
        )
    return seeds


def _ppm(text: str) -> float:
    rule = "a number in ppm, from -10000 to 10000"
    try:
        value = float(text)
    except ValueError:
        raise ValueError(rule) from None
    if not -10_000 <= value <= 10_000:
        raise ValueError(rule)
    return value


def _ticks(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= 20 and int(text) < 2**64):
        raise ValueError("a whole number of ticks, from 0 to 2^64 - 1")
    return int(text)
