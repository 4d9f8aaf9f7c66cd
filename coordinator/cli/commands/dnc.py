"""``canductor dnc``: receive, send, serve, list and drip over a serial line."""

import argparse
from pathlib import Path
from typing import Any, Final

from coordinator.cli.arguments.target import declare_target, target_of
from coordinator.dnc import commands as work
from coordinator.dnc.job import DncJob
from coordinator.dnc.options import BLOCK_MAX, TRANSMISSIONS_MAX, DncOptions, read_frame
from coordinator.ipc.client.target import Target
from coordinator.support.report import Report
from nodes.support.errors import CanductorError
from nodes.support.option_values import (
    UsageError,
    add_command,
    add_group,
    decimal,
    existing_file,
    integer,
    options_from,
    regular_file,
)

CONTROL: Final = "control"
PERIPHERAL: Final = "peripheral"
PACED: Final = {"auto": None, "yes": True, "no": False}
ANSWER_S: Final = 8.0
DRIP_ANSWER_S: Final = 600.0


def add_to(commands: Any) -> None:
    """Add the commands."""
    summary = "exchange programs and tables with machine-shop peripherals over a serial line"
    actions = add_group(commands, "dnc", summary, "ACTION")
    for name, text, declare, run in (
        (
            "receive",
            "receive a file from a control, or request one from a peripheral",
            _declare_receive,
            _receive,
        ),
        ("send", "send a file to a peripheral, or to a control that requests one", _declare_send, _send),
        ("serve", "serve the files of a folder to a control, and accept new ones", _declare_serve, _serve),
        ("list", "print the directory of a peripheral", _declare_line, _list),
        ("drip", "feed a job of any length, line by line", _declare_drip, _drip),
    ):
        add_command(actions, name, text, declare, run)


def _declare_line(command: argparse.ArgumentParser) -> None:
    add = command.add_argument_group("serial line").add_argument
    seconds = decimal(0.01, 86_400, "s")
    add(
        "-p",
        "--port",
        required=True,
        metavar="PORT",
        help="serial device, socket://HOST:PORT or rfc2217://HOST:PORT",
    )
    add("--baud", type=integer(50, 4_000_000), default=9600, metavar="N", help="baud rate")
    add(
        "--frame",
        type=read_frame,
        default=DncOptions().frame,
        metavar="7E1",
        help="data bits, parity and stop bits, such as 8N1 (default: %(default)s)",
    )
    add("--rtscts", action="store_true", help="use hardware flow control (RTS/CTS)")
    add("--no-dc1", dest="dc1", action="store_false", help="do not send DC1 after check characters")
    add("--avoid-control", action="store_true", help="do not send check characters below 20 hex")
    add(
        "--transmissions",
        type=integer(1, 100),
        default=TRANSMISSIONS_MAX,
        metavar="N",
        help="maximum transmissions of one block; old controls: 3",
    )
    add(
        "--block-max",
        type=integer(16, 65_536),
        default=BLOCK_MAX,
        metavar="N",
        help="maximum characters of a block",
    )
    add(
        "--answer-timeout",
        dest="answer_s",
        type=seconds,
        metavar="S",
        help=f"how long to wait for a block or its answer (default: {ANSWER_S:g}; drip: {DRIP_ANSWER_S:g})",
    )
    add(
        "--header-timeout",
        dest="decide_s",
        type=seconds,
        default=30.0,
        metavar="S",
        help="how long to wait for the answer to a header",
    )
    add(
        "--silence",
        dest="character_s",
        type=decimal(0.001, 60, "s"),
        default=0.25,
        metavar="S",
        help="silence that ends a damaged block",
    )
    add("--paced", choices=tuple(PACED), default="auto", help="whether the port keeps to the baud rate")


def _declare_code(command: argparse.ArgumentParser, default: str | None, note: str) -> None:
    command.add_argument("--code", type=_code, default=default, metavar="K", help=f"file code{note}")


def _declare_newline(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--crlf",
        dest="newline",
        action="store_const",
        const=b"\r\n",
        default=b"\n",
        help="end lines with CR LF (default: LF)",
    )


def _declare_numbered(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--numbered", action="store_true", help="refuse a file whose N words do not rise by the same step"
    )


def _declare_verify(command: argparse.ArgumentParser, how: str) -> None:
    command.add_argument("--verify", action="store_true", help=f"{how}; fail unless both are the same")


def _declare_receive(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("name", nargs="?", help="file to request from a peripheral (default: take what a control sends)")
    _declare_code(command, "D", ": D program, H dialog program, S table ... (default: D)")
    add("--folder", type=Path, default=Path(), metavar="DIR", help="folder for the files (default: this one)")
    add("--overwrite", action="store_true", help="overwrite an existing file of that name")
    _declare_newline(command)
    _declare_verify(command, "receive the file twice")
    _declare_numbered(command)
    add("--start", action="store_true", help="send the program to a running machine and print it")
    declare_target(command)
    _declare_line(command)


def _declare_send(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("file", type=regular_file, help="file to send")
    add("--name", help="name at the other side (default: that of the file, without its suffix)")
    _declare_code(command, None, " (default: by the file's suffix)")
    add(
        "--as",
        dest="role",
        choices=(CONTROL, PERIPHERAL),
        default=CONTROL,
        help="role of this side; a peripheral waits for a request",
    )
    _declare_verify(command, "request the file again afterwards")
    _declare_line(command)


def _declare_serve(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("folder", type=Path, help="folder that the control may list, fetch from and add to")
    add("--overwrite", action="store_true", help="let the control overwrite existing files")
    add("--read-only", action="store_true", help="accept no files")
    _declare_verify(command, "receive each file twice")
    _declare_numbered(command)
    _declare_newline(command)
    add("--once", action="store_true", help="exit after one transfer")
    _declare_line(command)


def _declare_drip(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("file", nargs="?", help="file, pipe or - to feed to a control that requests a program")
    add(
        "--from",
        dest="source",
        metavar="NAME",
        help="request NAME from a peripheral and print it as it arrives",
    )
    add("--from-control", action="store_true", help="print what a control sends as it arrives")
    _declare_code(command, "D", " of --from (default: D)")
    _declare_numbered(command)
    declare_target(command)
    _declare_line(command)


def _code(text: str) -> str:
    if len(text) != 1 or not text.isascii() or not (text.isalpha() or text == "%"):
        raise UsageError(f"is '{text}', must be one letter such as D, H or S")
    return text.upper()


def _job(given: argparse.Namespace, *, answer_s: float = ANSWER_S, **computed: Any) -> DncJob:
    """Return the job; raises UsageError."""
    try:
        options = options_from(
            DncOptions,
            given,
            paced=False,
            answer_s=given.answer_s or answer_s,
            nak_quiet_s=1.2 * given.character_s,
        )
    except CanductorError as error:
        raise UsageError(str(error)) from None
    return options_from(DncJob, given, options=options, paced=PACED[given.paced], **computed)


def _machine(given: argparse.Namespace, *, prints: bool, hint: str) -> Target:
    """Return the machine that prints; raises UsageError if one is named and nothing is printed."""
    if prints:
        return target_of(given)
    for option, value in (
        ("at", given.address),
        ("token-file", given.token),
        ("certificate", given.certificate),
    ):
        if value:
            raise UsageError(f"--{option} selects the machine that prints; {hint}")
    return Target()


def _receive(given: argparse.Namespace) -> Report:
    machine = _machine(given, prints=given.start, hint="give --start as well")
    job = _job(given, peripheral=given.name is None, name=given.name or "", machine=machine)
    return work.receive(job, around=getattr(given, "environment", work.THIS_COMPUTER))


def _send(given: argparse.Namespace) -> Report:
    peripheral = given.role == PERIPHERAL
    if given.verify and peripheral:
        raise UsageError("--verify requests the file again, which a peripheral cannot; leave it out")
    name = given.name or given.file.stem
    job = _job(given, peripheral=peripheral, name=name, code=given.code or "")
    return work.send(job, around=getattr(given, "environment", work.THIS_COMPUTER))


def _serve(given: argparse.Namespace) -> Report:
    return work.serve(_job(given, peripheral=True), around=getattr(given, "environment", work.THIS_COMPUTER))


def _list(given: argparse.Namespace) -> Report:
    return work.list_files(_job(given), around=getattr(given, "environment", work.THIS_COMPUTER))


def _drip(given: argparse.Namespace) -> Report:
    if (given.file is not None) + (given.source is not None) + given.from_control != 1:
        raise UsageError(
            "drip takes either a FILE to feed to a control, --from NAME to print from a peripheral,"
            " or --from-control to print what a control sends"
        )
    prints = given.file is None
    machine = _machine(given, prints=prints, hint="give --from or --from-control as well")
    file = None if prints else Path(given.file)
    if file is not None and str(file) != "-":
        existing_file(file)
    job = _job(
        given,
        answer_s=DRIP_ANSWER_S,
        peripheral=given.source is None,
        name=given.source or "",
        file=file,
        start=prints,
        machine=machine,
    )
    return work.drip(job, around=getattr(given, "environment", work.THIS_COMPUTER))
