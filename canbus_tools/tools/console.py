"""``canductor console``: sends commands to one node, from a prompt or a script."""

import argparse
import contextlib
import re
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from canbus_tools.bus.computer import Computer
from canbus_tools.bus.open_bus import BusOptions, bus_options, declare_bus
from canbus_tools.bus.talk import BusTalk, NodeTalk, TalkError, open_uart_talk, refuse_if_in_use
from canbus_tools.console.prompt import prompt
from canbus_tools.console.session import Quit, Session
from canbus_tools.discovery.inventory import take_inventory
from nodes.bus.assign import Uuid
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, integer, options_from, parse_int, regular_file
from nodes.support.standard_input import standard_input
from nodes.support.terminal import show
from nodes.support.user_folder import user_folder
from nodes.transport import BAUD_DEFAULT

NODEID_MAX = 255
BAUD_MIN, BAUD_MAX = 1200, 12_000_000
_UUID = re.compile(r"[0-9a-fA-F]{12}\Z")


@dataclass(frozen=True, slots=True, kw_only=True)
class ConsoleOptions:
    """A node, and the commands to send to it."""

    bus: BusOptions | None
    """None: use the UART."""
    node: str = ""
    uart: Path | None = None
    baud: int = BAUD_DEFAULT
    force: bool = False
    commands: tuple[str, ...] = ()
    script: Path | None = None
    as_json: bool = False


def declare(command: argparse.ArgumentParser) -> None:
    """Add the options."""
    declare_bus(command)
    add = command.add_argument
    add(
        "--node",
        type=_node,
        metavar="ID|UUID",
        help="node on the CAN bus: its id, or its uuid of 12 hex digits",
    )
    add("--uart", type=Path, metavar="PATH", help="serial device of the node")
    add(
        "--baud",
        type=integer(BAUD_MIN, BAUD_MAX),
        metavar="BIT/S",
        help=f"baud rate of the serial device (default: {BAUD_DEFAULT})",
    )
    add(
        "--force",
        action="store_true",
        help="use the node even if another host uses it; that host loses the node",
    )
    add(
        "-e",
        "--execute",
        dest="commands",
        metavar="LINE",
        action="append",
        help="run this line; may be repeated",
    )
    add("--script", type=regular_file, metavar="FILE", help="run the lines of this file; stop at an error")


def make_job(given: argparse.Namespace) -> Callable[[Computer], "ConsoleReport"]:
    """Return the job; raises UsageError, CanductorError for a script that is not there."""
    if (given.node is None) == (given.uart is None):
        raise UsageError("console takes either --node, on a CAN bus, or --uart")
    if given.uart is not None and given.channel is not None:
        raise UsageError("--uart does not go with --channel")
    if given.baud is not None and given.uart is None:
        raise UsageError("--baud goes with --uart; a CAN bus takes --bitrate")
    if given.commands and given.script:
        raise UsageError("console takes either --execute or --script")
    options = options_from(
        ConsoleOptions,
        given,
        bus=None if given.uart is not None else bus_options(given),
        node=given.node or "",
        baud=given.baud or BAUD_DEFAULT,
        commands=tuple(given.commands or ()),
        as_json=given.json,
    )
    return lambda computer: run_console(computer, options)


def _node(text: str) -> str:
    if _UUID.match(text):
        return text
    if not text.isdecimal():
        raise UsageError(f"is '{text}', must be an id from 1 to 255, or a uuid of 12 hex digits")
    return str(parse_int(text, 1, NODEID_MAX))


def run_console(computer: Computer, options: ConsoleOptions) -> "ConsoleReport":
    """Run the session to its end; raises CanductorError, with the line of a script that failed."""
    return computer.run(_run(computer, options))


@dataclass(frozen=True, slots=True)
class ConsoleReport:
    """Figures of a session."""

    node: str
    firmware: str
    commands: int
    messages: int
    ok: bool = True

    def to_json(self) -> Mapping[str, object]:
        """Return the figures."""
        return asdict(self)

    def to_text(self) -> str:
        """Return nothing: everything was shown before."""
        return ""


async def _run(computer: Computer, options: ConsoleOptions) -> ConsoleReport:
    async with _open(computer, options) as talk:
        session = Session(talk, _say, as_json=options.as_json)
        try:
            if options.commands or options.script or not standard_input().isatty():
                await _run_lines(session, options)
            else:
                await prompt(session, _history_file())
        finally:
            session.close()
        return ConsoleReport(talk.name, talk.dictionary.version, session.commands, session.messages)


async def _run_lines(session: Session, options: ConsoleOptions) -> None:
    for where, line in _lines(options):
        try:
            await session.run(line)
        except Quit:
            return
        except CanductorError as error:
            raise CanductorError(f"{where}: {error}") from error
    await session.talk.drained()


def _lines(options: ConsoleOptions) -> Iterator[tuple[str, str]]:
    """Yield each line of the script with its place."""
    if options.commands:
        for n, line in enumerate(options.commands, 1):
            yield f"--execute {n}", line
        return
    name = str(options.script) if options.script else "standard input"
    with contextlib.ExitStack() as stack:
        if options.script is None:
            lines: Iterator[str] = iter(standard_input())
        else:
            lines = stack.enter_context(options.script.open(encoding="utf-8"))
        try:
            for n, line in enumerate(lines, 1):
                yield f"{name}:{n}", line
        except UnicodeDecodeError as error:
            raise CanductorError(f"{name} is not UTF-8 text ({error.reason})") from None
        except OSError as error:
            raise CanductorError(f"{name} cannot be read ({error.strerror})") from None


def _say(text: str) -> None:
    show(text)


def _history_file() -> Path:
    """Return the file of earlier lines (XDG_STATE_HOME); raises CanductorError."""
    return user_folder("XDG_STATE_HOME", ".local", "state") / "canductor" / "console_history"


# ------------------------------------------------------------------------------------------------- the node


@contextlib.asynccontextmanager
async def _open(computer: Computer, options: ConsoleOptions) -> AsyncIterator[NodeTalk]:
    if options.bus is None:
        assert options.uart is not None
        async with open_uart_talk(computer, options.uart, options.baud) as talk:
            yield talk
        return
    async with BusTalk.open(computer, options.bus) as bus:
        nodeid = await _nodeid(bus, options.node)
        if not options.force:
            await refuse_if_in_use(bus, nodeid)
        async with bus.node(nodeid) as talk:
            yield talk


async def _nodeid(bus: BusTalk, node: str) -> int:
    """Return the id of a node given by its id or uuid; raises TalkError."""
    if not _UUID.match(node):
        return int(node)
    uuid = Uuid.parse(node.lower())
    found = (await take_inventory(bus)).by_uuid(uuid)
    if len(found) > 1:
        raise TalkError(
            f"{len(found)} boards on bus {bus.name} have the uuid {uuid} (cloned chips?); name one by its id"
        )
    if not found:
        raise TalkError(
            f"no node on bus {bus.name} has the uuid {uuid}; 'canductor can nodes' lists all nodes"
        )
    if found[0].nodeid is None:
        raise TalkError(
            f"node {uuid} on bus {bus.name} waits for an id; assign one first with 'canductor can assign'"
        )
    return found[0].nodeid
