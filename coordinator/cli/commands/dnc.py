"""The words of ``canductor dnc``: receive, send, serve, list and drip."""

import argparse
import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, cast

from coordinator.cli.arguments.front_ends import Target, add_target, read_target
from coordinator.dnc.options import BLOCK_MAX, TRANSMISSIONS_MAX, DncOptions, read_frame
from coordinator.support.command_options import Report
from nodes.support.errors import CanductorError
from nodes.support.option_values import UsageError, existing_file, number, whole

CONTROL: Final = "control"
PERIPHERAL: Final = "peripheral"
HERE: Final = Target(address=None, token=None, certificate=None, timeout_s=5.0)
"""The only machine of this user that runs here."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DncJob:
    """What one of the commands is to do."""

    port: str
    options: DncOptions
    paced: bool | None
    """None: as the port is."""
    rtscts: bool
    peripheral: bool
    code: str = "D"
    name: str = ""
    file: Path | None = None
    """What is sent; ``-``: standard input."""
    folder: Path | None = None
    overwrite: bool = False
    newline: bytes = b"\n"
    read_only: bool = False
    once: bool = False
    start: bool = False
    """Print what came, or as it comes."""
    numbered: bool = False
    """N words rise by the same each time."""
    verify: bool = False
    """Have it come, or go back, once more, and compare."""
    machine: Target = HERE
    """Where it is printed."""
    json: bool = False


def declare(command: argparse.ArgumentParser) -> None:
    """Add the words."""
    commands = command.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, (summary, add_options, make_job) in _COMMANDS.items():
        one = commands.add_parser(name, help=summary, description=f"{summary}.", allow_abbrev=False)
        add_options(one)
        _declare_line(one)
        one.add_argument("--json", action="store_true", help="print one JSON object as the last line")
        one.set_defaults(make_job=make_job)


def _declare_line(command: argparse.ArgumentParser) -> None:
    add = command.add_argument_group("line").add_argument
    add(
        "-p",
        "--port",
        required=True,
        metavar="PORT",
        help="device, socket://HOST:PORT or rfc2217://HOST:PORT",
    )
    add("--baud", default="9600", metavar="N", help="9600 if not given")
    add(
        "--frame",
        default="7E1",
        metavar="7E1",
        help="bits, parity and stop bits: 7E1 (if not given), 8N1 ...",
    )
    add("--rtscts", action="store_true", help="the adapter pauses by RTS and CTS")
    add("--no-dc1", action="store_true", help="send no DC1 after check characters")
    add("--avoid-control", action="store_true", help="send no check characters below 20 hex")
    add("--transmissions", default=str(TRANSMISSIONS_MAX), metavar="N", help="of one block; old controls: 3")
    add("--block-max", default=str(BLOCK_MAX), metavar="N", help=f"characters of a block; {BLOCK_MAX}")
    add("--answer-timeout", metavar="S", help="for a block or its answer; 8, for drip 600")
    add("--header-timeout", default="30", metavar="S", help="for a header's answer; 30")
    add("--silence", default="0.25", metavar="S", help="that ends a damaged block; 0.25")
    add(
        "--paced",
        choices=("auto", "yes", "no"),
        default="auto",
        help="whether the port keeps to the baud rate",
    )


def _declare_receive(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("name", nargs="?", help="file to ask a peripheral for; without it, take what a control sends")
    add("--code", default="D", metavar="K", help="file code: D program, H dialog program, S table ...; D")
    add("--folder", type=Path, default=Path(), metavar="DIR", help="where files go; this folder")
    add("--overwrite", action="store_true", help="a file of that name may be there")
    add("--crlf", action="store_true", help="end lines with CR LF; else LF")
    _declare_verify(command, "have the file come twice")
    _declare_numbered(command)
    add("--start", action="store_true", help="send the program to a machine that runs, and print it")
    add_target(command)


def _declare_numbered(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--numbered", action="store_true", help="N words rise by the same each time; refuse a gap"
    )


def _declare_verify(command: argparse.ArgumentParser, how: str) -> None:
    command.add_argument("--verify", action="store_true", help=f"{how}; nothing counts unless both are alike")


def _declare_send(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("file", type=Path, help="what to send")
    add("--name", help="what it is called there; its own name without suffix")
    add("--code", metavar="K", help="file code; by the file's suffix if not given")
    add(
        "--as",
        dest="role",
        choices=(CONTROL, PERIPHERAL),
        default=CONTROL,
        help="peripheral: wait to be asked",
    )
    _declare_verify(command, "ask for the file again")


def _declare_serve(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("folder", type=Path, help="what the control may see, fetch and add to")
    add("--overwrite", action="store_true", help="files may be replaced")
    add("--read-only", action="store_true", help="take no files")
    _declare_verify(command, "have each file come twice")
    _declare_numbered(command)
    add("--crlf", action="store_true", help="end lines with CR LF; else LF")
    add("--once", action="store_true", help="end after one transfer")


def _declare_drip(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("file", nargs="?", help="file, pipe or - to feed a control that asks for a program")
    add("--from", dest="source", metavar="NAME", help="ask a peripheral for NAME, and print it as it comes")
    add("--from-control", action="store_true", help="print what a control sends, as it comes")
    add("--code", default="D", metavar="K", help="file code, with --from; D")
    _declare_numbered(command)
    add_target(command)


def _options(given: argparse.Namespace, answer_s: str) -> DncOptions:
    try:
        return DncOptions(
            frame=read_frame(given.frame),
            baud=whole("--baud", given.baud, 50, 4_000_000),
            dc1=not given.no_dc1,
            avoid_control=given.avoid_control,
            transmissions=whole("--transmissions", given.transmissions, 1, 100),
            block_max=whole("--block-max", given.block_max, 16, 65_536),
            answer_s=number("--answer-timeout", given.answer_timeout or answer_s, 0.01, 86_400, "s"),
            decide_s=number("--header-timeout", given.header_timeout, 0.01, 86_400, "s"),
            character_s=number("--silence", given.silence, 0.001, 60, "s"),
            nak_quiet_s=1.2 * number("--silence", given.silence, 0.001, 60, "s"),
        )
    except CanductorError as error:
        raise UsageError(str(error)) from None


def _line(given: argparse.Namespace, answer_s: str = "8") -> Mapping[str, object]:
    return {
        "port": given.port,
        "options": _options(given, answer_s),
        "paced": {"auto": None, "yes": True, "no": False}[given.paced],
        "rtscts": given.rtscts,
        "json": given.json,
    }


def _machine(given: argparse.Namespace, printing: str | None, hint: str) -> Target:
    """Return where to print; raises UsageError when nothing is."""
    named = [f"--{o}" for o in ("at", "token-file", "certificate") if getattr(given, o.replace("-", "_"))]
    if printing is None and named:
        raise UsageError(f"{named[0]} says where to print; {hint}")
    return HERE if printing is None else read_target(given)


def _code(text: str) -> str:
    if len(text) != 1 or not text.isascii() or not (text.isalpha() or text == "%"):
        raise UsageError(f"--code is '{text}', must be one letter such as D, H or S")
    return text.upper()


def _receive(given: argparse.Namespace) -> Callable[[], Report]:
    machine = _machine(given, "--start" if given.start else None, "give --start, too")
    job = DncJob(
        **_line(given),  # type: ignore[arg-type]
        peripheral=given.name is None,
        code=_code(given.code),
        name=given.name or "",
        folder=given.folder,
        overwrite=given.overwrite,
        newline=b"\r\n" if given.crlf else b"\n",
        numbered=given.numbered,
        verify=given.verify,
        start=given.start,
        machine=machine,
    )
    return DncCommand("receive", job)


def _send(given: argparse.Namespace) -> Callable[[], Report]:
    existing_file(given.file)
    if given.verify and given.role == PERIPHERAL:
        raise UsageError("--verify asks for the file again, which a peripheral cannot; leave it out")
    job = DncJob(
        **_line(given),  # type: ignore[arg-type]
        peripheral=given.role == PERIPHERAL,
        code="" if given.code is None else _code(given.code),
        name=given.name or given.file.stem,
        file=given.file,
        verify=given.verify,
    )
    return DncCommand("send", job)


def _serve(given: argparse.Namespace) -> Callable[[], Report]:
    job = DncJob(
        **_line(given),  # type: ignore[arg-type]
        peripheral=True,
        folder=given.folder,
        overwrite=given.overwrite,
        newline=b"\r\n" if given.crlf else b"\n",
        read_only=given.read_only,
        numbered=given.numbered,
        verify=given.verify,
        once=given.once,
    )
    return DncCommand("serve", job)


def _list(given: argparse.Namespace) -> Callable[[], Report]:
    job = DncJob(**_line(given), peripheral=False)  # type: ignore[arg-type]
    return DncCommand("list_files", job)


def _drip(given: argparse.Namespace) -> Callable[[], Report]:
    if (given.file is not None) + (given.source is not None) + given.from_control != 1:
        raise UsageError(
            "drip takes either a FILE to feed a control with, --from NAME to print from a peripheral,"
            " or --from-control to print what a control sends"
        )
    machine = _machine(given, None if given.file else "--from", "it goes with --from or --from-control")
    if given.file not in (None, "-") and not Path(given.file).is_fifo():
        existing_file(Path(given.file))
    job = DncJob(
        **_line(given, "600"),  # type: ignore[arg-type]
        peripheral=given.source is None,
        code=_code(given.code),
        name=given.source or "",
        file=None if given.file is None else Path(given.file),
        numbered=given.numbered,
        start=given.file is None,
        machine=machine,
    )
    return DncCommand("drip", job)


@dataclass(frozen=True, slots=True)
class DncCommand:
    """What the words ask for: the function NAME of ``coordinator.dnc.commands`` with JOB."""

    name: str
    job: DncJob

    def __call__(self) -> Report:
        """Import what does the work, and do it."""
        work = getattr(importlib.import_module("coordinator.dnc.commands"), self.name)
        return cast("Report", work(self.job))


_Declare = Callable[[argparse.ArgumentParser], None]
_COMMANDS: Final[Mapping[str, tuple[str, _Declare, Callable[[argparse.Namespace], Callable[[], Report]]]]] = {
    "receive": ("take a file from a control, or ask a peripheral for one", _declare_receive, _receive),
    "send": ("give a file to a peripheral, or to a control that asks", _declare_send, _send),
    "serve": ("be a file server for a control: directory, files, new files", _declare_serve, _serve),
    "list": ("ask a peripheral for its directory", lambda _: None, _list),
    "drip": ("feed a running job of any length, line by line", _declare_drip, _drip),
}
