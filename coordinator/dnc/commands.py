"""What the commands of ``canductor dnc`` do."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Final, Protocol

from coordinator.dnc.blocks import INPUT, OUTPUT, Header
from coordinator.dnc.driver import Driver, Line
from coordinator.dnc.endpoint import Endpoint, FileSource, Library, Outcome, Sink, Source, Take
from coordinator.dnc.engine import Engine
from coordinator.dnc.feeds import SlowSource
from coordinator.dnc.files import Check, Entry, Folder, check_lines, check_name
from coordinator.dnc.job import DncJob
from coordinator.dnc.machine import MachineSink
from coordinator.dnc.numbers import numbered
from coordinator.dnc.options import DncOptions
from coordinator.dnc.port import Port
from coordinator.dnc.tables import check_table
from coordinator.dnc.verify import Compare, Twice
from coordinator.ipc.client.blocking import BlockingClient
from coordinator.ipc.client.upload import send_program, show_progress
from coordinator.support.report import PlainReport, Report
from nodes.support.errors import CanductorError

NOT_YET_S: Final = 0.02
UNREADABLE: Final = "what comes cannot be read; are baud rate and frame those of the control?"
BETWEEN: Final = 4
"""Silences between two transfers."""


class SerialPort(Line, Protocol):
    """What the commands need of a port."""

    @property
    def is_paced(self) -> bool: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


def _say_to_user(sentence: str) -> None:
    sys.stderr.write(f"{sentence}\n")
    sys.stderr.flush()


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What the commands find around them: ports, a clock, and somebody who reads."""

    open_port: Callable[[str, DncOptions, bool], SerialPort] = Port
    """Gets a name, options, and whether RTS and CTS are used; raises PortError."""
    now_s: Callable[[], float] = time.monotonic
    say: Callable[[str], None] = _say_to_user
    """Gets sentences about what goes on."""
    typed: IO[bytes] | None = None
    """What ``-`` stands for; None: standard input."""


HERE: Final = Surroundings()


@contextlib.contextmanager
def _line(job: DncJob, around: Surroundings) -> Iterator[Driver]:
    """Open the port for an engine; whatever ends the block, the other side is told."""
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
                driver.give_up("this side was stopped")
    finally:
        port.close()


def _play(driver: Driver, endpoint: Endpoint, around: Surroundings) -> Outcome:
    """Go on until a transfer has ended, well or not."""
    try:
        while True:
            until_s = around.now_s() + NOT_YET_S if endpoint.looks else None
            for event in driver.wait(until_s):
                if (outcome := endpoint.handle(event)) is not None:
                    driver.flush()
                    return outcome
            if endpoint.looks:
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
    """Tell of a failure which file it was."""
    name = outcome.name
    named = (
        outcome.sentence.startswith((f"{name} ", f"{name}.", f"{name}:")) or f"{name!a}" in outcome.sentence
    )
    return outcome.sentence if named or not name else f"{outcome.name}: {outcome.sentence}"


def receive(job: DncJob, check: Check = check_table, around: Surroundings = HERE) -> Report:
    """Take one file into a folder, and print it if asked to; raises CanductorError. CHECK is for tables."""
    assert job.folder is not None
    with contextlib.ExitStack() as stack:
        folder = Folder(job.folder, overwrite=job.overwrite, newline=job.newline, check=check)
        stack.enter_context(contextlib.closing(folder))
        driver = stack.enter_context(_line(job, around))
        twice = stack.enter_context(contextlib.closing(Twice(folder, job.options.block_max)))
        take = numbered(twice.take if job.verify else folder_take(folder), even=job.numbered)
        endpoint = Endpoint(driver.engine, take=take)
        if job.peripheral:
            _say(job, around, f"waiting for a control at {job.port} to send a file into {folder.path}")
        outcome = _receive(job, driver, endpoint, around)
        while outcome.ok and (name := twice.waits_for) is not None:
            if job.peripheral:
                _say(job, around, _once(outcome))
            else:
                _say(job, around, f"{name} came; asking for it again, to compare")
                driver.wait(around.now_s() + BETWEEN * job.options.character_s)
            outcome = _receive(job, driver, endpoint, around)
    same = ", the same twice" if job.verify else ""
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
    """Return what takes files into FOLDER."""
    return lambda header: folder.take(header.code, header.name)


def _receive(job: DncJob, driver: Driver, endpoint: Endpoint, around: Surroundings) -> Outcome:
    """Take a file once."""
    if not job.peripheral:
        endpoint.begin(Header(job.code, job.name, INPUT))
    return _play(driver, endpoint, around)


def send(job: DncJob, around: Surroundings = HERE) -> Report:
    """Give one file; raises CanductorError."""
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
            return _report(outcome, f"{job.file}: {outcome.lines} lines; the other side has the same")
    how = "was taken" if outcome.confirmed else "was sent, each block acknowledged"
    return _report(outcome, f"{job.file}: {outcome.lines} lines; the file {how}")


def _fetch_back(job: DncJob, driver: Driver, header: Header, around: Surroundings) -> None:
    """Make sure that the other side has what was sent to it; raises CanductorError."""
    assert job.file is not None
    _say(job, around, f"{job.name} was sent; asking for it, to compare")
    driver.wait(around.now_s() + BETWEEN * job.options.character_s)
    same = Compare(job.name, _open(job.file), job.options.block_max, "delete it at the other side")
    endpoint = Endpoint(driver.engine, take=lambda _: same)
    endpoint.begin(header)
    outcome = _play(driver, endpoint, around)
    if not outcome.ok:
        raise CanductorError(f"{job.name} was sent, but is not confirmed: {outcome.sentence}")


def _open(file: Path) -> IO[bytes]:
    try:
        return file.open("rb")
    except OSError as error:
        raise CanductorError(f"{file} cannot be read: {(error.strerror or str(error)).lower()}") from None


def serve(job: DncJob, check: Check = check_table, around: Surroundings = HERE) -> Report:
    """Be a file server until Ctrl-C; raises CanductorError when the port is gone. CHECK is for tables."""
    assert job.folder is not None
    outcome = Outcome(did="nothing")
    folder = Folder(job.folder, overwrite=job.overwrite, newline=job.newline, check=check)
    with contextlib.closing(folder), _line(job, around) as driver:
        library = Library(folder, driver.engine)
        twice = Twice(folder, job.options.block_max)
        take = numbered(twice.take if job.verify else folder_take(folder), even=job.numbered)
        endpoint = Endpoint(
            driver.engine, give=library.give, take=None if job.read_only else take, folder=folder
        )
        _say(job, around, f"serving {folder.path} at {job.port}; Ctrl-C ends it")
        with contextlib.closing(twice):
            while True:
                outcome = _play(driver, endpoint, around)
                once = outcome.ok and twice.waits_for is not None and twice.waits_for == outcome.name
                _say(job, around, _once(outcome) if once else _told(outcome))
                if job.once and not once:
                    return _report(outcome, "")


def list_files(job: DncJob, around: Surroundings = HERE) -> Report:
    """Ask for the directory; raises CanductorError."""
    with _line(job, around) as driver:
        driver.engine.ask_directory()
        outcome = _play(driver, Endpoint(driver.engine), around)
    if outcome.listing is None:
        raise CanductorError(outcome.sentence)
    lines = [f"{name:<24} {sectors:>7}" for name, sectors in outcome.listing.sectors.items()]
    free = outcome.listing.free_sectors
    return _report(outcome, "\n".join([*lines, *([] if free is None else [f"{free} sectors are free"])]))


def drip(job: DncJob, around: Surroundings = HERE) -> Report:
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


def _open_stream(file: Path, stack: contextlib.ExitStack, around: Surroundings) -> IO[bytes]:
    if str(file) != "-":
        return stack.enter_context(_open(file))
    return sys.stdin.buffer if around.typed is None else around.typed


def _drip_to_machine(job: DncJob, around: Surroundings) -> Report:
    at = job.machine
    sinks: list[MachineSink] = []
    with BlockingClient(at.address, **at.settings("canductor dnc")) as client:

        def print_as_it_comes(header: Header) -> Sink:
            sinks.append(MachineSink(client, check_name(header.name or "NONAME")))
            return sinks[-1]

        with _line(job, around) as driver:
            endpoint = Endpoint(driver.engine, take=numbered(print_as_it_comes, even=job.numbered))
            if job.peripheral:
                waits = f"waiting for a control at {job.port} to send a program; it is printed as it comes"
                _say(job, around, waits)
            else:
                endpoint.begin(Header(job.code, job.name, INPUT))
            outcome = _play(driver, endpoint, around)
        report = _report(outcome, f"{outcome.name}: {outcome.lines} lines were printed as they came")
        _say(job, around, f"{outcome.name}: all {outcome.lines} lines came; waiting for the machine")
        sinks[-1].wait_until_over()
    return report


def _print(job: DncJob, file: Path) -> None:
    on_progress = None if job.json else show_progress
    send_program(job.machine, file, file.name, replace=job.overwrite, start=True, on_progress=on_progress)


def _once(outcome: Outcome) -> str:
    return f"{outcome.name} came once, {outcome.lines} lines; send it once more, to compare"


def _told(outcome: Outcome) -> str:
    if outcome.ok:
        return f"{outcome.did} {outcome.name}, {outcome.lines} lines"
    return f"failed: {_sentence(outcome)}"


def _say(job: DncJob, around: Surroundings, sentence: str) -> None:
    if not job.json:
        around.say(sentence)
