"""``canductor table … --device``: MT without a coordinator, to drives that cannot answer and nodes that can.

The drives are the literal transcription of what MT was first written as, at a pseudo-terminal and on a bus.
"""

import os
import pty
import socket
import termios
import tty
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from nodes.mt.mt import WORD_BYTES, from_bytes
from nodes.support.can_protocol import MT_CAN_ID
from nodes.virtual.firmware import TOOLHEAD
from tests.canbus_tools.command import Command, Said
from tests.nodes.mt import literal
from tests.stages.can_stage import MAIN, MAIN_ID, TOOL, TOOL_ID, CanStage
from tests.stages.simulated_computer import WireUser

COMP = "0 0 0\n50 50.01 49.99\n100 100.02 99.98\n"
FORWARD = [(0, 0), (500_000, -10_000), (1_000_000, -20_000)]
REVERSE = [(0, 0), (500_000, 10_000), (1_000_000, 20_000)]
AROUND = 10
"""Words that begin and end a transmission."""


class Table:
    """``canductor table``, with a table to be sent."""

    def __init__(self, tool: Command, comp: Path) -> None:
        self._tool = tool
        self._comp = comp

    def __call__(self, action: str, *words: object) -> Said:
        file = [self._comp] if action == "send" else []
        return self._tool.run("table", action, *file, *words)


@pytest.fixture
def table(can_tool: Command, tmp_path: Path) -> Table:
    comp = tmp_path / "x.comp"
    comp.write_text(COMP)
    return Table(can_tool, comp)


def drives(words: list[int], axles: tuple[int, ...], *, polled: bool = False) -> list[list[tuple[int, int]]]:
    """Return what drives with AXLES keep after WORDS; POLLED: they see changes of a register only."""
    found = []
    for axle in axles:
        peer = literal.Receiver(axle)
        for word in literal.ChangedOnly().pass_on(iter(words)) if polled else words:
            peer.read(word)
        assert peer.table_status == literal.STATUS_OK
        found.append(peer.table)
    return found


# -------------------------------------------------------------------------------------------- a serial line


@dataclass(frozen=True)
class Cable:
    """A pseudo-terminal: the command opens PATH, the drive reads the other end."""

    fd: int
    path: str

    def words(self) -> list[int]:
        """Return all that came; the line holds it until then."""
        data = b""
        os.set_blocking(self.fd, False)
        while True:
            try:
                data += os.read(self.fd, 4096)
            except BlockingIOError:
                assert len(data) % WORD_BYTES == 0
                return from_bytes(data)


@pytest.fixture
def cable() -> Iterator[Cable]:
    fd, far = pty.openpty()
    tty.setraw(far, termios.TCSANOW)
    yield Cable(fd, os.ttyname(far))
    os.close(far)
    os.close(fd)


def test_a_stream_of_bytes_reaches_drives_on_a_serial_line(table: Table, cable: Cable) -> None:
    said = table("send", "--device", cable.path, "--stepper", "1,3", "--baud", 115200, "--json")
    assert said.status == 0, said
    assert said.json["confirmed"] is None
    assert drives(cable.words(), (1, 2, 5, 6, 7)) == [FORWARD, REVERSE, FORWARD, REVERSE, []]
    for sent, axles in zip(said.json["sent"], ([1, 5], [2, 6]), strict=True):
        assert (sent["axles"], sent["points"]) == (axles, 3)
        assert sent["bound_s"] == pytest.approx(sent["words"] * 40 / 115200, rel=1e-3)
        assert sent["elapsed_s"] >= sent["bound_s"]


def test_a_serial_server_takes_them_over_tcp(table: Table) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        said = table("send", "--device", f"socket://127.0.0.1:{server.getsockname()[1]}", "--stepper", 1)
        assert said.status == 0, said
        far, _ = server.accept()
        with far, far.makefile("rb") as came:
            assert drives(from_bytes(came.read()), (1, 2)) == [FORWARD, REVERSE]


def test_a_register_gets_one_word_at_a_time(table: Table, cable: Cable) -> None:
    said = table("send", "--device", cable.path, "--axles", 4, "--side", "reverse", "--delay", 1, "--json")
    words = cable.words()
    assert drives(words, (4, 3), polled=True) == [REVERSE, []]
    (sent,) = said.json["sent"]
    assert sent["words"] == len(words) == 2 * len(REVERSE) + AROUND + 1, "one value is 0 after a 0: LIT"
    assert sent["bound_s"] == pytest.approx(len(words) * 1e-3)
    assert sent["elapsed_s"] >= sent["bound_s"], "every word stood for T"


def test_who_cannot_answer_is_told_in_a_sentence(table: Table, cable: Cable) -> None:
    said = table("send", "--device", cable.path, "--axles", 1, "--side", "forward", "--delay", 1)
    assert said.status == 0
    assert "2·l·T = 2·3·1 ms = 0.006 s; with 10 words that begin and end it and 1 LIT 0.017 s" in said.out
    assert f"not confirmed: receivers that only listen on {cable.path} cannot answer" in said.out


def test_an_empty_table_takes_the_last_one_away(table: Table, cable: Cable) -> None:
    assert table("remove", "--device", cable.path, "--stepper", 1).status == 0
    assert drives(cable.words(), (1, 2)) == [[], []]


# -------------------------------------------------------------------------------------------------- a bus


DEVICE = "virtual:can0"


def words_on(bus: WireUser) -> list[int]:
    """Return the words of all tables that were sent."""
    return [word for frame in bus.frames if frame.id == MT_CAN_ID for word in from_bytes(frame.data)]


def test_a_broadcast_reaches_drives_on_a_bus(table: Table, stage: CanStage) -> None:
    with stage.user() as bus:
        said = table("send", "--device", DEVICE, "--stepper", 2, "--bitrate", 1_000_000, "--json")
    assert drives(words_on(bus), (3, 4, 1)) == [FORWARD, REVERSE, []]
    for sent in said.json["sent"]:
        assert 9 * 64 < sent["bound_s"] * 0.2 * 1_000_000 <= 9 * 135, (
            "17 words in 9 frames, a fifth of the bus"
        )
        assert sent["bound_s"] <= sent["elapsed_s"] < 1.1 * sent["bound_s"]


def test_drives_that_poll_get_one_word_a_frame(table: Table, stage: CanStage) -> None:
    with stage.user() as bus:
        words = ("--axles", "9,10", "--side", "forward", "--delay", 1, "--json")
        said = table("send", "--device", DEVICE, *words)
    assert drives(words_on(bus), (9, 10, 11), polled=True) == [FORWARD, FORWARD, []]
    (sent,) = said.json["sent"]
    assert sent["bound_s"] == pytest.approx(0.017)
    assert sent["bound_s"] <= sent["elapsed_s"] < 1.1 * sent["bound_s"]


def test_nodes_confirm(table: Table, stage: CanStage) -> None:
    stage.add_node(MAIN, MAIN_ID)
    stage.add_node(TOOL, TOOL_ID, build=TOOLHEAD, legacy=True)
    at = ("--device", DEVICE, "--node", MAIN_ID)
    none = table("status", *at)
    assert (none.status, none.out) == (0, f"no node of {DEVICE} has a table for these axles\n")
    for generation, more in ((1, ()), (2, ("--delay", "1")), (3, ("--bitrate", 1_000_000))):
        said = table("send", *at, "--stepper", 1, *more, "--json")
        assert (said.status, said.json["confirmed"]) == (0, True), said
        assert kept(said) == [(1, "ok", generation, 3), (2, "ok", generation, 3)]
        assert all(sent["elapsed_s"] >= sent["bound_s"] > 0 for sent in said.json["sent"])
    assert kept(table("status", *at, "--json")) == [(1, "ok", 3, 3), (2, "ok", 3, 3)]
    missing = table("send", *at, "--axles", "2,7", "--side", "forward")
    assert missing.status == 1
    assert "axle 7: none of the nodes has a table for it" in missing.out
    assert f"axle 2 on node {MAIN_ID}" in missing.out
    assert kept(table("remove", *at, "--stepper", 1, "--json")) == [(1, "ok", 4, 0), (2, "ok", 5, 0)]
    deaf = table("send", "--device", DEVICE, "--node", TOOL_ID, "--stepper", 1, "--json")
    assert kept(deaf) == [(1, "ok", 1, 3), (2, "ok", 1, 3)], "its link brings what broadcasts do not"
    assert [sent["broadcasts"] for sent in deaf.json["sent"]] == [1, 1]
    with stage.other_host(MAIN_ID, every_s=0.98):
        assert f"node {MAIN_ID} on bus canductor:can0 is in use" in table("status", *at).sentence


@pytest.mark.parametrize("seed", [5, 6])
def test_a_lossy_bus_ends_well_or_the_axle_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, seed: int
) -> None:
    stage = CanStage(loss=0.03, seed=seed)
    stage.add_node(MAIN, MAIN_ID)
    comp = tmp_path / "x.comp"
    comp.write_text(COMP)
    table = Table(Command(stage.computer, capsys), comp)
    at = ("--device", DEVICE, "--node", MAIN_ID)
    said = table("send", *at, "--stepper", 1, "--delay", 1, "--json")
    asked = {axle: (status, points) for axle, status, _, points in kept(table("status", *at, "--json"))}
    assert (said.status == 0) == said.json["confirmed"] == all(a["ok"] for a in said.json["axles"])
    for axle in said.json["axles"]:
        assert (asked[axle["axle"]] == ("ok", 3)) == axle["ok"]
        assert bool(axle["problem"]) != axle["ok"]


def kept(said: Said) -> list[tuple[int, str, int, int]]:
    return [(a["axle"], a["status"], a["generation"], a["points"]) for a in said.json["axles"]]


def test_a_node_on_a_serial_line_confirms(table: Table, stage: CanStage) -> None:
    stage.add_node(MAIN, uart=True)
    at = ("--device", "/dev/tty0", "--link")
    said = table("send", *at, "--stepper", 1)
    assert said.status == 0, said
    assert "the words alone take 68 bytes at 250000 baud: 0.003 s" in said.out
    assert "axle 2 on node on UART" in said.out
    slowly = table("send", *at, "--stepper", 1, "--delay", 60, "--json")
    assert kept(slowly) == [(1, "ok", 2, 3), (2, "ok", 2, 3)], "through the register that it polls"
    assert all(sent["elapsed_s"] >= sent["bound_s"] for sent in slowly.json["sent"])
    assert kept(table("remove", *at, "--axles", "2", "--json")) == [(2, "ok", 3, 0)]
    assert kept(table("status", *at, "--json")) == [(1, "ok", 2, 3), (2, "ok", 3, 0)]


# ----------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("send",), "'send' needs --axis of a running machine, or --device"),
        (("send", "--axis", "x", "--stepper", "1"), "--stepper goes with --device"),
        (("send", "--device", "can0"), "give either --axles or --stepper"),
        (("send", "--device", "can0", "--axles", "1", "--stepper", "1"), "give either --axles or --stepper"),
        (("send", "--device", "can0", "--axles", "29"), "--axles"),
        (("send", "--device", "can0", "--axles", "1"), "differs by the direction of travel"),
        (("send", "--device", "can0", "--stepper", "1", "--side", "forward"), "--side goes with --axles"),
        (("send", "--device", "can0", "--stepper", "1", "--at", "x"), "give one of them"),
        (("send", "--device", "can0", "--stepper", "1", "--link"), "--link is for a serial line"),
        (("send", "--device", "/dev/tty", "--stepper", "1", "--node", "4"), "--node is for a CAN bus"),
        (("send", "--device", "socket://h:1", "--stepper", "1", "--link"), "--link needs a serial device"),
        (("send", "--device", "can 0", "--stepper", "1"), "'can 0' is not a device; give a CAN interface"),
        (("send", "--device", "can0", "--stepper", "1", "--delay", "0"), "--delay"),
        (("send", "--device", "can0", "--stepper", "1", "--share", "0"), "--share is 0"),
        (("send", "--device", "can0", "--stepper", "1", "--can-id", "0x800"), "--can-id is '0x800'"),
        (
            ("send", "--device", "/dev/nothing", "--stepper", "1"),
            "/dev/nothing cannot be opened at 250000 baud",
        ),
        (("status", "--device", "can0"), "only nodes can be queried: give --node ID"),
    ],
)
def test_what_cannot_be_asked_for(table: Table, words: tuple[str, ...], sentence: str) -> None:
    said = table(*words)
    assert (said.status, said.out) in ((1, ""), (2, ""))
    assert sentence in said.err
    assert said.err.count("\n") == 1
