"""The commands of ``canductor dnc``."""

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Final, Protocol

from coordinator.dnc.driver import Driver, Line
from coordinator.dnc.endpoint import Endpoint, FileSource, Library, Outcome, Sink, Source, Take
from coordinator.dnc.feeds import SlowSource
from coordinator.dnc.files import Check, Entry, Folder, check_lines, check_name
from coordinator.dnc.job import DncJob
from coordinator.dnc.machine import MachineSink
from coordinator.dnc.options import DncOptions
from coordinator.dnc.port import Port
from coordinator.dnc.protocol.blocks import INPUT, OUTPUT, Header
from coordinator.dnc.protocol.engine import Engine
from coordinator.dnc.protocol.numbers import numbered
from coordinator.dnc.tables import check_table
from coordinator.dnc.verify import Compare, TwoPassFolder
from coordinator.ipc.client.blocking import BlockingClient
from coordinator.ipc.client.upload import send_program, show_progress
from coordinator.support.report import PlainReport, Report
from nodes.support.errors import CanductorError
from nodes.support.standard_input import standard_input
from nodes.support.terminal import show_error

POLL_PERIOD_S: Final = 0.02
UNREADABLE: Final = (
    "the received data cannot be read; check that baud rate and frame are those of the control"
)
PAUSE_SILENCES: Final = 4
"""Pause between two transfers, in multiples of the silence that ends a block."""


class SerialPort(Line, Protocol):
    """The interface of a port."""

    @property
    def is_paced(self) -> bool: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


def _print_notice(sentence: str) -> None:
    show_error(sentence)


@dataclass(frozen=True, slots=True)
class Environment:
    """Ports, clock and output of the commands; tests replace them."""

    open_port: Callable[[str, DncOptions, bool], SerialPort] = Port
    """Takes a name, options, and whether RTS and CTS are used; raises PortError."""
    now_s: Callable[[], float] = time.monotonic
    say: Callable[[str], None] = _print_notice
    """Takes messages about the progress."""
    typed: IO[bytes] | None = None
    """Read for the file ``-``; None: standard input."""


THIS_COMPUTER: Final = Environment()


@contextlib.contextmanager
def _line(job: DncJob, around: Environment) -> Iterator[Driver]:
    """Open the port for an engine; when the block ends, a running transfer is aborted with EOT."""
    port = around.open_port(job.port, job.options, job.rtscts)
    try:
        paced = port.is_paced if job.paced is None else job.paced
        options = replace(job.options, paced=paced)
        driver = Driver(
            port,
            Engine(options, around.now_s(), peripheral=job.peripheral),
            around.now_s,
            on_unreadable=lambda: _say(job, around, UNREADABLE),
        )
        try:
            yield driver
        finally:
            with contextlib.suppress(CanductorError):
                driver.abort("this side was stopped")
    finally:
        port.close()


def _play(driver: Driver, endpoint: Endpoint, around: Environment) -> Outcome:
    """Run until a transfer has ended, with success or not."""
    try:
        while True:
            until_s = around.now_s() + POLL_PERIOD_S if endpoint.needs_polling else None
            for event in driver.wait(until_s):
                if (outcome := endpoint.handle(event)) is not None:
                    driver.flush()
                    return outcome
            if endpoint.needs_polling:
                endpoint.go_on()
    except CanductorError as error:
        endpoint.close(str(error))
        raise
    except BaseException:
        endpoint.close("canductor dnc was stopped")
        raise


def _report(outcome: Outcome, text: str) -> Report:
    if not outcome.ok:
        raise CanductorError(_sentence(outcome))
    figures: dict[str, object] = {"did": outcome.did, "transfers": 1}
    if outcome.listing is not None:
        figures |= {"files": outcome.listing.sectors, "free_sectors": outcome.listing.free_sectors}
    else:
        figures |= {
            "name": outcome.name,
            "code": outcome.code,
            "lines": outcome.lines,
            "confirmed": outcome.confirmed,
        }
    return PlainReport(figures, text)


def _sentence(outcome: Outcome) -> str:
    """Return the message of a failure, with the name of the file."""
    name = outcome.name
    named = (
        outcome.sentence.startswith((f"{name} ", f"{name}.", f"{name}:")) or f"{name!a}" in outcome.sentence
    )
    return outcome.sentence if named or not name else f"{outcome.name}: {outcome.sentence}"


def receive(job: DncJob, check: Check = check_table, around: Environment = THIS_COMPUTER) -> Report:
    """Receive one file, and print it if requested; raises CanductorError. CHECK validates tables."""
    assert job.folder is not None
    with contextlib.ExitStack() as stack:
        folder = Folder(job.folder, overwrite=job.overwrite, newline=job.newline, check=check)
        stack.enter_context(contextlib.closing(folder))
        driver = stack.enter_context(_line(job, around))
        twice = stack.enter_context(contextlib.closing(TwoPassFolder(folder, job.options.block_max)))
        take = numbered(twice.take if job.verify else folder_take(folder), even=job.numbered)
        endpoint = Endpoint(driver.engine, take=take)
        if job.peripheral:
            _say(job, around, f"waiting for a control at {job.port} to send a file into {folder.path}")
        outcome = _receive(job, driver, endpoint, around)
        while outcome.ok and (name := twice.waits_for) is not None:
            if job.peripheral:
                _say(job, around, _received_once(outcome))
            else:
                _say(job, around, f"{name} was received; requesting it again, to compare")
                driver.wait(around.now_s() + PAUSE_SILENCES * job.options.character_s)
            outcome = _receive(job, driver, endpoint, around)
    same = ", identical twice" if job.verify else ""
    text = f"{outcome.name}: {outcome.lines} lines are in {job.folder}{same}"
    report = _report(outcome, text)
    if not job.start:
        return report
    try:
        _print(job, job.folder / outcome.name)
    except CanductorError as error:
        raise CanductorError(f"{text}, but not printed: {error}") from None
    return _report(outcome, f"{text}, and is being printed")


def folder_take(folder: Folder) -> Take:
    """Return the function that opens files in FOLDER."""
    return lambda header: folder.take(header.code, header.name)


def _receive(job: DncJob, driver: Driver, endpoint: Endpoint, around: Environment) -> Outcome:
    """Receive a file once."""
    if not job.peripheral:
        endpoint.begin(Header(job.code, job.name, INPUT))
    return _play(driver, endpoint, around)


def send(job: DncJob, around: Environment = THIS_COMPUTER) -> Report:
    """Send one file; raises CanductorError."""
    assert job.file is not None
    code = job.code or Entry(job.file.name, 0).code
    with contextlib.ExitStack() as stack:
        content = stack.enter_context(_open(job.file))
        line_max = job.options.block_max - 2
        check_lines(content, job.file.name, line_max, job.options.frame.data_bits)
        driver = stack.enter_context(_line(job, around))
        endpoint = Endpoint(driver.engine, give=lambda _: (job.name, FileSource(content, line_max)))
        if job.peripheral:
            _say(job, around, f"waiting for a control at {job.port} to ask for a file; it gets {job.file}")
        else:
            endpoint.begin(Header(code, job.name, OUTPUT))
        outcome = _play(driver, endpoint, around)
        if outcome.ok and job.verify:
            _fetch_back(job, driver, Header(code, job.name, INPUT), around)
            outcome = replace(outcome, confirmed=True)
            return _report(
                outcome, f"{job.file}: {outcome.lines} lines; the copy at the other side is identical"
            )
    how = "was accepted" if outcome.confirmed else "was sent, each block acknowledged"
    return _report(outcome, f"{job.file}: {outcome.lines} lines; the file {how}")


def _fetch_back(job: DncJob, driver: Driver, header: Header, around: Environment) -> None:
    """Request the file that was sent and compare it; raises CanductorError."""
    assert job.file is not None
    _say(job, around, f"{job.name} was sent; requesting it, to compare")
    driver.wait(around.now_s() + PAUSE_SILENCES * job.options.character_s)
    same = Compare(job.name, _open(job.file), job.options.block_max, "delete it at the other side")
    endpoint = Endpoint(driver.engine, take=lambda _: same)
    endpoint.begin(header)
    outcome = _play(driver, endpoint, around)
    if not outcome.ok:
        raise CanductorError(f"{job.name} was sent, but not confirmed: {outcome.sentence}")


def _open(file: Path) -> IO[bytes]:
    try:
        return file.open("rb")
    except OSError as error:
        raise CanductorError(f"{file} cannot be read: {(error.strerror or str(error)).lower()}") from None


def serve(job: DncJob, check: Check = check_table, around: Environment = THIS_COMPUTER) -> Report:
    """Serve files until Ctrl-C; raises CanductorError when the port is lost. CHECK validates tables."""
    assert job.folder is not None
    outcome = Outcome(did="nothing")
    folder = Folder(job.folder, overwrite=job.overwrite, newline=job.newline, check=check)
    with contextlib.closing(folder), _line(job, around) as driver:
        library = Library(folder, driver.engine)
        twice = TwoPassFolder(folder, job.options.block_max)
        take = numbered(twice.take if job.verify else folder_take(folder), even=job.numbered)
        endpoint = Endpoint(
            driver.engine, give=library.give, take=None if job.read_only else take, folder=folder
        )
        _say(job, around, f"serving {folder.path} at {job.port}; stop with Ctrl-C")
        with contextlib.closing(twice):
            while True:
                outcome = _play(driver, endpoint, around)
                once = outcome.ok and twice.waits_for is not None and twice.waits_for == outcome.name
                _say(job, around, _received_once(outcome) if once else _summary(outcome))
                if job.once and not once:
                    return _report(outcome, "")


def list_files(job: DncJob, around: Environment = THIS_COMPUTER) -> Report:
    """Request and print the directory; raises CanductorError."""
    with _line(job, around) as driver:
        driver.engine.ask_directory()
        outcome = _play(driver, Endpoint(driver.engine), around)
    if outcome.listing is None:
        raise CanductorError(outcome.sentence)
    lines = [f"{name:<24} {sectors:>7}" for name, sectors in outcome.listing.sectors.items()]
    free = outcome.listing.free_sectors
    return _report(outcome, "\n".join([*lines, *([] if free is None else [f"{free} sectors are free"])]))


def drip(job: DncJob, around: Environment = THIS_COMPUTER) -> Report:
    """Feed a control line by line, or print what the other side sends; raises CanductorError."""
    if job.file is None:
        return _drip_to_machine(job, around)
    with contextlib.ExitStack() as stack:
        content = _open_stream(job.file, stack, around)
        with _line(job, around) as driver:
            source: Source = SlowSource(content, job.options.block_max - 2)
            endpoint = Endpoint(driver.engine, give=lambda header: (header.name, source))
            _say(job, around, f"waiting for a control at {job.port} to ask for a program; it gets {job.file}")
            outcome = _play(driver, endpoint, around)
    return _report(outcome, f"{outcome.lines} lines were fed to the control")


def _open_stream(file: Path, stack: contextlib.ExitStack, around: Environment) -> IO[bytes]:
    if str(file) != "-":
        return stack.enter_context(_open(file))
    return standard_input().buffer if around.typed is None else around.typed


def _drip_to_machine(job: DncJob, around: Environment) -> Report:
    at = job.machine
    sinks: list[MachineSink] = []
    with BlockingClient(at.address, **at.settings("canductor dnc")) as client:

        def print_as_it_comes(header: Header) -> Sink:
            sinks.append(MachineSink(client, check_name(header.name or "NONAME")))
            return sinks[-1]

        with _line(job, around) as driver:
            endpoint = Endpoint(driver.engine, take=numbered(print_as_it_comes, even=job.numbered))
            if job.peripheral:
                waits = f"waiting for a control at {job.port} to send a program; it is printed as it arrives"
                _say(job, around, waits)
            else:
                endpoint.begin(Header(job.code, job.name, INPUT))
            outcome = _play(driver, endpoint, around)
        report = _report(outcome, f"{outcome.name}: {outcome.lines} lines were printed as they arrived")
        _say(job, around, f"{outcome.name}: all {outcome.lines} lines were received; waiting for the machine")
        sinks[-1].wait_until_over()
    return report


def _print(job: DncJob, file: Path) -> None:
    on_progress = None if job.json else show_progress
    send_program(job.machine, file, file.name, replace=job.overwrite, start=True, on_progress=on_progress)


def _received_once(outcome: Outcome) -> str:
    return f"{outcome.name} was received once, {outcome.lines} lines; send it again, to compare"


def _summary(outcome: Outcome) -> str:
    if outcome.ok:
        return f"{outcome.did} {outcome.name}, {outcome.lines} lines"
    return f"failed: {_sentence(outcome)}"


def _say(job: DncJob, around: Environment, sentence: str) -> None:
    if not job.json:
        around.say(sentence)
