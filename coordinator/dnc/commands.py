"""What ``canductor dnc`` does, once its words are read."""

import contextlib
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import IO, Final

from coordinator.dnc.blocks import INPUT, OUTPUT, Header
from coordinator.dnc.command_line import DncJob
from coordinator.dnc.desk import Desk, FileSource, Library, Outcome, Sink, Source
from coordinator.dnc.driver import Driver
from coordinator.dnc.engine import Engine
from coordinator.dnc.feeds import MachineSink, SlowSource
from coordinator.dnc.files import Check, Entry, Folder, check_lines
from coordinator.dnc.port import Port
from coordinator.dnc.tables import check_table
from nodes.errors import CanductorError
from nodes.records import record

NOT_YET_S: Final = 0.02


@record
class DncReport:
    """What became of a command's transfers."""

    outcomes: tuple[Outcome, ...]
    text: str

    @property
    def ok(self) -> bool:
        """Whether none failed."""
        return all(outcome.ok for outcome in self.outcomes)

    def to_json(self) -> Mapping[str, object]:
        """Return the last transfer's figures."""
        last = self.outcomes[-1]
        figures: dict[str, object] = {"did": last.did, "transfers": len(self.outcomes)}
        if last.listing is not None:
            figures |= {"files": last.listing.sectors, "free_sectors": last.listing.free_sectors}
        else:
            figures |= {
                "name": last.name,
                "code": last.code,
                "lines": last.lines,
                "confirmed": last.confirmed,
            }
        return figures

    def to_text(self) -> str:
        """Return it for a reader."""
        return self.text


@contextlib.contextmanager
def _line(job: DncJob) -> Iterator[Driver]:
    """Open the port for an engine; whatever ends the block, the other side is told."""
    port = Port(job.port, job.options, rtscts=job.rtscts)
    try:
        paced = port.is_paced if job.paced is None else job.paced
        options = replace(job.options, paced=paced)
        driver = Driver(port, Engine(options, time.monotonic(), peripheral=job.peripheral))
        try:
            yield driver
        finally:
            with contextlib.suppress(CanductorError):
                driver.give_up("this side was stopped")
    finally:
        port.close()


def _play(driver: Driver, desk: Desk) -> Outcome:
    """Go on until a transfer has ended, well or not."""
    try:
        while True:
            until_s = time.monotonic() + NOT_YET_S if desk.waits_for_line else None
            for event in driver.wait(until_s):
                if (outcome := desk.handle(event)) is not None:
                    driver.flush()
                    return outcome
            if desk.waits_for_line:
                desk.go_on()
    except BaseException:
        desk.close()
        raise


def _report(outcome: Outcome, text: str) -> DncReport:
    if not outcome.ok:
        raise CanductorError(_sentence(outcome))
    return DncReport((outcome,), text)


def _sentence(outcome: Outcome) -> str:
    """Tell of a failure which file it was."""
    return f"{outcome.name}: {outcome.sentence}" if outcome.name else outcome.sentence


def receive(job: DncJob, check: Check = check_table) -> DncReport:
    """Take one file into a folder, and print it if asked to; raises CanductorError. CHECK is for tables."""
    assert job.folder is not None
    folder = Folder(job.folder, overwrite=job.overwrite, newline=job.newline, check=check)
    with contextlib.closing(folder), _line(job) as driver:
        desk = Desk(driver.engine, take=lambda header: folder.take(header.code, header.name))
        if job.peripheral:
            _say(job, f"waiting for a control at {job.port} to send a file into {folder.path}")
        else:
            desk.begin(Header(job.code, job.name, INPUT))
        outcome = _play(driver, desk)
    text = f"{outcome.name}: {outcome.lines} lines are in {job.folder}"
    report = _report(outcome, text)
    if job.start:
        _print(job, job.folder / outcome.name)
        return DncReport(report.outcomes, f"{text}, and being printed")
    return report


def send(job: DncJob) -> DncReport:
    """Give one file; raises CanductorError."""
    assert job.file is not None
    code = job.code or Entry(job.file.name, 0).code
    try:
        content = job.file.open("rb")
    except OSError as error:
        raise CanductorError(f"{job.file} cannot be read: {error.strerror}") from None
    with content:
        line_max = job.options.block_max - 2
        check_lines(content, job.file.name, line_max, job.options.frame.data_bits)
        source = FileSource(content, line_max)
        with _line(job) as driver:
            desk = Desk(driver.engine, give=lambda _: (job.name, source))
            if job.peripheral:
                _say(job, f"waiting for a control at {job.port} to ask for a file; it gets {job.file}")
            else:
                desk.begin(Header(code, job.name, OUTPUT))
            outcome = _play(driver, desk)
    how = "was taken" if outcome.confirmed else "was sent, each block acknowledged"
    return _report(outcome, f"{job.file}: {outcome.lines} lines; the file {how}")


def serve(job: DncJob, check: Check = check_table) -> DncReport:
    """Be a file server until Ctrl-C; raises CanductorError when the port is gone. CHECK is for tables."""
    assert job.folder is not None
    outcome = Outcome(did="nothing")
    folder = Folder(job.folder, overwrite=job.overwrite, newline=job.newline, check=check)
    with contextlib.closing(folder), _line(job) as driver:
        library = Library(folder, driver.engine)
        desk = Desk(
            driver.engine,
            give=library.give,
            take=None if job.read_only else library.take,
            folder=folder,
        )
        _say(job, f"serving {folder.path} at {job.port}; Ctrl-C ends it")
        while True:
            outcome = _play(driver, desk)
            _say(job, _told(outcome))
            if job.once:
                return _report(outcome, "")


def list_files(job: DncJob) -> DncReport:
    """Ask for the directory; raises CanductorError."""
    with _line(job) as driver:
        driver.engine.ask_directory()
        outcome = _play(driver, Desk(driver.engine))
    if outcome.listing is None:
        raise CanductorError(outcome.sentence)
    lines = [f"{name:<24} {sectors:>7}" for name, sectors in outcome.listing.sectors.items()]
    free = outcome.listing.free_sectors
    return _report(outcome, "\n".join([*lines, *([] if free is None else [f"{free} sectors are free"])]))


def drip(job: DncJob) -> DncReport:
    """Feed a control line by line, or print what a peripheral feeds; raises CanductorError."""
    if job.file is None:
        return _drip_to_machine(job)
    with contextlib.ExitStack() as stack:
        content = _open_stream(job.file, stack)
        with _line(job) as driver:
            source: Source = SlowSource(content, job.options.block_max - 2)
            desk = Desk(driver.engine, give=lambda header: (header.name, source))
            _say(job, f"waiting for a control at {job.port} to ask for a program; it gets {job.file}")
            outcome = _play(driver, desk)
    return _report(outcome, f"{outcome.lines} lines were fed to the control")


def _open_stream(file: Path, stack: contextlib.ExitStack) -> IO[bytes]:
    if str(file) == "-":
        return sys.stdin.buffer
    try:
        return stack.enter_context(file.open("rb"))
    except OSError as error:
        raise CanductorError(f"{file} cannot be read: {error.strerror}") from None


def _drip_to_machine(job: DncJob) -> DncReport:
    from coordinator.ipc.blocking import BlockingClient  # noqa: PLC0415 (others do without)

    with BlockingClient(job.at, name="canductor dnc") as client, _line(job) as driver:
        sink: Sink = MachineSink(client.call, job.name)
        desk = Desk(driver.engine, take=lambda _: sink)
        desk.begin(Header(job.code, job.name, INPUT))
        outcome = _play(driver, desk)
    return _report(outcome, f"{outcome.name}: {outcome.lines} lines were printed as they came")


def _print(job: DncJob, file: Path) -> None:
    from coordinator.front_end_words import Target  # noqa: PLC0415 (others do without)
    from coordinator.front_ends import send as send_to_machine  # noqa: PLC0415 (likewise)

    target = Target(address=job.at, token=None, certificate=None, timeout_s=5.0)
    send_to_machine(target, file, file.name, replace=job.overwrite, start=True, quiet=job.json)


def _told(outcome: Outcome) -> str:
    if outcome.ok:
        return f"{outcome.did} {outcome.name}, {outcome.lines} lines"
    return f"failed: {_sentence(outcome)}"


def _say(job: DncJob, sentence: str) -> None:
    if not job.json:
        sys.stderr.write(f"{sentence}\n")
        sys.stderr.flush()
