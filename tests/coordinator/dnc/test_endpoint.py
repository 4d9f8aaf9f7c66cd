"""What a file server does for a control: one file after the other, tables, directory; over a virtual line."""

import random
from pathlib import Path

import pytest

from coordinator.dnc.commands import _sentence
from coordinator.dnc.endpoint import Endpoint, Library, Outcome
from coordinator.dnc.files import Folder
from coordinator.dnc.options import DncOptions
from coordinator.dnc.protocol import events
from coordinator.dnc.protocol.blocks import ACK, DIRECTORY_REQUEST, EOT, SOH, write_block
from coordinator.dnc.protocol.engine import Engine, State
from coordinator.dnc.protocol.listing import read_listing
from coordinator.dnc.tables import check_table
from tests.coordinator.dnc.line import Faults, Line, Owner, Wire

OPTIONS = DncOptions(paced=True)


class Server:
    """A peripheral with a folder at the end of a line."""

    def __init__(self, path: Path) -> None:
        self.engine = Engine(OPTIONS, 0.0, peripheral=True)
        folder = Folder(path, check=check_table)
        library = Library(folder, self.engine)
        self.endpoint = Endpoint(
            self.engine, give=library.give, take=lambda h: folder.take(h.code, h.name), folder=folder
        )
        self.outcomes: list[Outcome] = []
        self.receive = self.engine.receive
        self.handle_timer = self.engine.handle_timer
        self.next_deadline = self.engine.next_deadline
        self.take_output = self.engine.take_output

    @property
    def is_over(self) -> bool:
        return self.engine.state is State.IDLE

    def look(self, now_s: float) -> None:
        while happened := self.engine.take_events():
            for event in happened:
                if (outcome := self.endpoint.handle(event)) is not None:
                    self.outcomes.append(outcome)


class Control:
    """Asks SERVER for one thing after the other."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self.engine = Engine(OPTIONS, 0.0, peripheral=False)
        self._now_s = 0.0

    def _run(self, owner: Owner) -> Owner:
        wires = (Wire(Faults(), OPTIONS, random.Random(1)), Wire(Faults(), OPTIONS, random.Random(2)))
        line = Line((owner, self._server), wires, random.Random(3), now_s=self._now_s)
        for wire in wires:
            wire.busy_until_s = self._now_s
        line.run()
        self._now_s = line.now_s + 1.0
        return owner

    def fetch(self, code: str, name: str) -> Owner:
        self.engine.handle_timer(self._now_s)
        owner = Owner(self.engine, None)
        self.engine.fetch(code, name)
        return self._run(owner)

    def send(self, code: str, name: str, lines: list[bytes]) -> Owner:
        self.engine.handle_timer(self._now_s)
        owner = Owner(self.engine, lines)
        self.engine.send(code, name)
        return self._run(owner)

    def idle(self, seconds: float) -> None:
        self._now_s += seconds

    def list(self) -> dict[str, int]:
        self.engine.handle_timer(self._now_s)
        owner = Owner(self.engine, None)
        self.engine.ask_directory()
        self._run(owner)
        assert isinstance(owner.outcome, events.Directory)
        return read_listing(owner.outcome.text).sectors


@pytest.fixture
def control(tmp_path: Path) -> Control:
    return Control(Server(tmp_path))


def test_one_file_after_the_other(tmp_path: Path, control: Control) -> None:
    """A header without a name asks for the next file of its code; after the last there is an empty one."""
    for name in ("b.nc", "a.nc", "15.h", "c.txt"):
        (tmp_path / name).write_bytes(name.encode() + b"\n")
    assert [control.fetch("D", "").kept for _ in range(5)] == [
        [b"a.nc"],
        [b"b.nc"],
        [b"c.txt"],
        [],
        [b"a.nc"],
    ]
    assert control.list() == {"15.h": 1, "a.nc": 1, "b.nc": 1, "c.txt": 1}
    assert control.fetch("H", "15").kept == [b"15.h"]
    missing = control.fetch("H", "16")
    assert missing.outcome == events.Failed("the peripheral reports: NO SUCH FILE")


def test_programs_and_tables_come(tmp_path: Path, control: Control) -> None:
    """A table that is none is refused, and there is no file."""
    control.send("D", "PART", [b"G28", b"M30"])
    assert (tmp_path / "PART.nc").read_bytes() == b"G28\nM30\n"
    control.send("S", "X", [b"0 0 0", b"100 100.01 100.02"])
    assert (tmp_path / "X.comp").read_bytes() == b"0 0 0\n100 100.01 100.02\n"
    control.send("S", "Y", [b"0 0 0", b"100 100.01 100.02", b"50 50 50"])
    assert not (tmp_path / "Y.comp").exists()
    outcomes = control._server.outcomes
    assert [outcome.ok for outcome in outcomes] == [True, True, False]
    assert outcomes[-1].sentence.startswith("Y.comp")
    assert sorted(control.list()) == ["PART.nc", "X.comp"]
    again = control.send("D", "PART", [b"M30"])
    assert again.outcome == events.Failed("the peripheral reports: FILE EXISTS")
    for name in ("../PART", "/etc/passwd", ".bashrc", "CON"):
        bad = control.send("D", name, [b"M30"])
        assert bad.outcome == events.Failed("the peripheral reports: BAD FILE NAME")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["PART.nc", "X.comp"]


def test_a_listing_is_no_failure_however_long_nothing_was_asked(tmp_path: Path, control: Control) -> None:
    (tmp_path / "a.nc").write_bytes(b"M30\n")
    for idle_s in (10.0, 0.0, 10_000.0):
        control.idle(idle_s)
        assert control.list() == {"a.nc": 1}
    control.fetch("D", "a")
    control.idle(10.0)
    control.list()
    assert [outcome.did for outcome in control._server.outcomes] == ["sent"]


def test_a_failure_tells_which_file_was_asked_for(tmp_path: Path, control: Control) -> None:
    """Not the one before."""
    (tmp_path / "good.nc").write_bytes(b"M30\n")
    (tmp_path / "long.nc").write_bytes(b"X" * 5000 + b"\n")
    failures = []
    for mode, code, name in (
        ("give", "D", "nosuch"),
        ("take", "D", "../evil"),
        ("take", "D", "good"),
        ("give", "D", "long"),
    ):
        assert control.fetch("D", "good").kept == [b"M30"]
        control.fetch(code, name) if mode == "give" else control.send(code, name, [b"M30"])
        failures.append(control._server.outcomes[-1])
    assert [(failure.did, failure.name) for failure in failures] == [
        ("failed", "nosuch"),
        ("failed", "../evil"),
        ("failed", "good"),
        ("failed", "long"),
    ]
    sentences = [_sentence(failure).replace(f"{tmp_path}", "F") for failure in failures]
    assert [sentence.partition(": 1 to")[0] for sentence in sentences] == [
        "there is no file 'nosuch' in F",
        "'../evil' is not a valid file name",
        "good.nc exists in F already; use another name, or give --overwrite",
        "long: line 1 is longer than 1022 characters, the limit of a block",
    ]


def test_what_cannot_be_told_of_a_file_is_told_without_one(tmp_path: Path) -> None:
    """A directory that ends late, a header that cannot be read: neither is about the file before."""
    (tmp_path / "good.nc").write_bytes(b"M30\n")
    server = Server(tmp_path)
    control = Control(server)
    control.fetch("D", "good")
    for asked, answer in (
        (DIRECTORY_REQUEST, bytes((EOT,))),
        (write_block(SOH, b"DPARTX", dc1=True), bytes((ACK, EOT))),
    ):
        control.idle(20.0)
        now_s = control._now_s
        server.receive(asked, now_s)
        server.handle_timer(now_s + 1.0)
        server.look(now_s + 1.0)
        assert server.take_output()
        server.receive(answer, now_s + 7.0)
        server.handle_timer(now_s + 8.0)
        server.look(now_s + 8.0)
    assert [_sentence(outcome) for outcome in server.outcomes[1:]] == [
        "the control ended the transfer late; it is unknown whether it has the directory",
        "an error was reported to the control",
    ]


def test_the_name_of_a_file_is_not_taken_for_a_word_of_the_sentence() -> None:
    failed = Outcome(did="failed", name="t", sentence="the other side ended the transfer after line 3")
    assert _sentence(failed) == "t: the other side ended the transfer after line 3"
