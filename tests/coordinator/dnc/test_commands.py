"""The commands at both ends of a cable, in virtual time; and over TCP, by pyserial's ways."""

import contextlib
import math
import os
import queue
import random
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from serial import rfc2217

from coordinator.cli.main import main
from coordinator.cli.parser import parse_command_line
from coordinator.dnc.commands import Environment
from coordinator.dnc.options import DncOptions
from coordinator.dnc.port import Port, PortError
from tests.coordinator.dnc.virtual_cable import PROGRAM, VirtualCable

FAST = ("--baud", "115200")
PATIENT = ("--answer-timeout", "86400")
"""For what comes from outside of virtual time."""


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    ours.mkdir()
    theirs.mkdir()
    (ours / "part.nc").write_bytes(PROGRAM)
    return ours, theirs


def into(folder: Path) -> tuple[str, ...]:
    return ("--folder", str(folder))


@pytest.mark.parametrize("options", [(), ("--frame", "8N1", "--no-dc1", "--avoid-control")])
def test_send_to_receive(folders: tuple[Path, Path], options: tuple[str, ...]) -> None:
    ours, theirs = folders
    cable = VirtualCable()
    with cable.started("receive", "-p", "1", *FAST, *options, *into(theirs)) as receiver:
        sent = cable.run("send", str(ours / "part.nc"), "-p", "0", *FAST, *options)
        assert (sent.status, sent.sentences) == (0, [])
        assert sent.figures == {
            "did": "sent", "transfers": 1, "name": "part", "code": "D", "lines": 60, "confirmed": False
        }  # fmt: skip
        took = receiver.end()
    assert (took.status, took.text) == (0, f"part.nc: 60 lines are in {theirs}")
    assert (theirs / "part.nc").read_bytes() == PROGRAM
    assert [p.name for p in theirs.iterdir()] == ["part.nc"]


def test_a_file_server(folders: tuple[Path, Path]) -> None:
    ours, theirs = folders
    (ours / "tab.nc").write_bytes(b"A\tB\n")
    cable = VirtualCable()
    with cable.started("serve", str(ours), "-p", "0", *FAST) as server:
        at = ("-p", "1", *FAST)
        assert cable.run("list", *at).figures["files"] == {"part.nc": 2, "tab.nc": 1}
        assert cable.run("receive", "PART", *at, "--crlf", *into(theirs)).status == 0
        assert (theirs / "PART.nc").read_bytes() == PROGRAM.replace(b"\n", b"\r\n")
        for words, sentence in (
            (
                ("receive", "PART", *into(theirs)),
                f"PART.nc exists in {theirs} already; use another name, or give --overwrite",
            ),
            (("receive", "NONE", *into(theirs)), "NONE.nc: the peripheral reports: NO SUCH FILE"),
            (("receive", "tab.nc", *into(theirs)), "tab.nc: the peripheral reports: ERROR IN FILE"),
            (
                ("send", str(theirs / "PART.nc"), "--name", "part.nc"),
                "part.nc: the peripheral reports: FILE EXISTS",
            ),
        ):
            ended = cable.run(*words, *at)
            assert (ended.status, ended.sentences) == (1, [sentence])
        assert cable.run("send", str(theirs / "PART.nc"), "--name", "NEW", *at).status == 0
        cable.time.sleep(1)  # the control has said its last word, and does not wait for the file to be kept
        assert server.stop().status == 143
    assert (ours / "NEW.nc").read_bytes() == PROGRAM
    assert sorted(p.name for p in theirs.iterdir()) == ["PART.nc"]


@pytest.mark.parametrize("seed", range(5))
def test_a_bad_cable(folders: tuple[Path, Path], seed: int) -> None:
    """Flipped bits and lost characters: the same file, or none and a sentence."""
    ours, theirs = folders
    chance = random.Random(seed)
    damaged = 0

    def damage(_: int, data: bytes) -> bytes:
        nonlocal damaged
        if len(data) > 6 and chance.random() < 0.2:
            damaged += 1
            at = chance.randrange(1, len(data))
            data = data[:at] + (b"" if chance.random() < 0.5 else bytes([data[at] ^ 8])) + data[at + 1 :]
        return data

    cable = VirtualCable(damage)
    with cable.started("receive", "-p", "1", *FAST, *into(theirs)) as receiver:
        cable.run("send", str(ours / "part.nc"), "-p", "0", *FAST)
        took = receiver.end()
    assert damaged
    if took.status:
        assert took.sentences[-1].startswith("part.nc: ")
        assert list(theirs.iterdir()) == []
    else:
        assert (theirs / "part.nc").read_bytes() == PROGRAM


def test_a_cut_cable_leaves_nothing(folders: tuple[Path, Path]) -> None:
    ours, theirs = folders
    is_cut = False

    def once_cut(_: int, data: bytes) -> bytes:
        nonlocal is_cut
        is_cut = is_cut or b"N30 " in data
        return b"" if is_cut else data

    cable = VirtualCable(once_cut)
    with cable.started("receive", "-p", "1", *FAST, *into(theirs)) as receiver:
        sent = cable.run("send", str(ours / "part.nc"), "-p", "0", *FAST)
        assert sent.status == 1
        assert "nothing was received after line 31 in time; check the cable" in sent.sentences[-1]
        sentence = receiver.end().sentences[-1]
        assert "nothing was received after line 30, the last one received in time" in sentence
    assert list(theirs.iterdir()) == []


def test_drip_from_a_pipe(folders: tuple[Path, Path]) -> None:
    """The control gets lines as they come; whoever writes them waits for the control."""
    _, theirs = folders
    reader, writer = os.pipe()
    cable = VirtualCable()
    with os.fdopen(reader, "rb") as typed, os.fdopen(writer, "wb") as pipe:
        drip = ("drip", "-", "-p", "0", *FAST, *PATIENT)
        with cable.started(*drip, typed=typed) as feeder:
            pipe.write(PROGRAM)
            pipe.flush()
            words = ("receive", "JOB", "-p", "1", *FAST, *PATIENT, *into(theirs))
            fetching = cable.time.start(lambda: cable.run(*words))
            cable.time.wait(lambda: 0.0 if cable.carried[0] >= len(PROGRAM) else math.inf)
            assert not (theirs / "JOB.nc").exists()
            pipe.write(b"M30")
            pipe.close()
            assert fetching.join().status == 0
            assert feeder.end().text == "61 lines were fed to the control"
    assert (theirs / "JOB.nc").read_bytes() == PROGRAM + b"M30\n"


# ---------------------------------------------------------------------------------------------- over TCP


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # of pyserial
@pytest.mark.parametrize("scheme", ["socket", "rfc2217"])
def test_over_tcp(folders: tuple[Path, Path], scheme: str, capsys: pytest.CaptureFixture[str]) -> None:
    """In real time: it is pyserial that is tested, and sockets."""
    ours, theirs = folders
    with (
        socket.create_server(("127.0.0.1", 0)) as ours_at,
        socket.create_server(("127.0.0.1", 0)) as theirs_at,
    ):
        at = [f"127.0.0.1:{listener.getsockname()[1]}" for listener in (ours_at, theirs_at)]
        joining = threading.Thread(target=_join, args=(ours_at, theirs_at, scheme == "rfc2217"))
        joining.start()
        said: queue.Queue[str] = queue.Queue()
        serving = threading.Thread(target=_serve, args=(f"socket://{at[0]}", ours, said.put))
        serving.start()
        assert said.get().startswith("serving")
        words = ["dnc", "receive", "PART", "-p", f"{scheme}://{at[1]}", *FAST, *into(theirs)]
        assert main(words) == 0, capsys.readouterr()
        joining.join()
        serving.join()
    assert (theirs / "PART.nc").read_bytes() == PROGRAM


def _serve(url: str, folder: Path, say: Callable[[str], None]) -> None:
    words = ["dnc", "serve", str(folder), "-p", url, *FAST]
    serve = parse_command_line(words, environment=Environment(say=say))
    with contextlib.suppress(PortError):  # the other side has gone
        serve()


def _join(ours_at: socket.socket, theirs_at: socket.socket, speaks_rfc2217: bool) -> None:
    """Be a serial server: hand on what comes from one connection to the other, until theirs ends."""
    ours, theirs = ours_at.accept()[0], theirs_at.accept()[0]
    client = _Client(theirs)
    manager: Any = rfc2217.PortManager(_SerialLine(), client) if speaks_rfc2217 else None

    def back() -> None:
        with contextlib.suppress(OSError):
            while data := ours.recv(4096):
                client.write(data if manager is None else b"".join(manager.escape(data)))

    with ours, theirs:
        backward = threading.Thread(target=back)
        backward.start()
        with contextlib.suppress(OSError):
            while data := theirs.recv(4096):
                ours.sendall(data if manager is None else b"".join(manager.filter(data)))
        ours.shutdown(socket.SHUT_WR)
        backward.join()


class _Client:
    """What a port manager answers with."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._lock = threading.Lock()

    def write(self, data: bytes) -> None:
        with self._lock, contextlib.suppress(OSError):
            self._connection.sendall(data)


class _SerialLine:
    """What a port manager sets and looks at; it has no modem lines."""

    baudrate, bytesize, parity, stopbits = 9600, 8, "N", 1
    xonxoff = rtscts = dtr = rts = break_condition = False
    cts = dsr = ri = cd = False

    def reset_input_buffer(self) -> None:
        pass

    def reset_output_buffer(self) -> None:
        pass


# -------------------------------------------------------------------------------------------------- sentences


@pytest.mark.parametrize(
    ("words", "status", "sentence"),
    [
        (("list", "-p", "/dev/none"), 1, "there is no serial port '/dev/none'; check its plug"),
        (("list", "-p", "loop:/x"), 1, "there is no serial port 'loop:/x'"),
        (("list", "-p", "what://x"), 1, "cannot be opened at 9600 baud 7E1"),
        (
            ("list", "-p", "socket://127.0.0.1:1"),
            1,
            "socket://127.0.0.1:1 cannot be reached: connection refused",
        ),
        (("list", "-p", "rfc2217://127.0.0.1:1"), 1, "connection refused; check host, port, and that the"),
        (("list", "-p", "/dev/null"), 1, "/dev/null is not a serial port; use a device such as /dev/ttyUSB0"),
        (("list", "-p", "."), 1, ". is not a serial port; use a device"),
        (("list", "-p", ""), 1, "there is no serial port ''; check its plug"),
        (("list", "-p", "X", "--frame", "9Z1"), 2, "--frame is '9Z1', must be like 7E1"),
        (("list", "-p", "X", "--baud", "fast"), 2, "--baud is 'fast', must be a whole number"),
        (("list", "-p", "X", "--silence", "9"), 2, "the timeout of an answer is 8 s, must be longer"),
        (("send", "none.nc", "-p", "X"), 1, "there is no file 'none.nc'"),
        (
            ("send", "tab.nc", "-p", "X"),
            1,
            "line 2 of tab.nc has the character 09 hex, which no block can carry",
        ),
        (("send", "ok.nc", "-p", "X", "--code", "77"), 2, "--code is '77', must be one letter"),
        (
            ("receive", "A", "-p", "X", "--at", "Y"),
            2,
            "--at selects the machine that prints; give --start as well",
        ),
        (("drip", "-p", "X"), 2, "drip takes either a FILE"),
        (("drip", "ok.nc", "--from", "A", "-p", "X"), 2, "drip takes either a FILE"),
        (("drip", "--from", "A", "--from-control", "-p", "X"), 2, "drip takes either a FILE"),
        (("drip", "ok.nc", "-p", "X", "--at", "Y"), 2, "--at selects the machine that prints; give --from"),
        (("send", "ok.nc", "--as", "peripheral", "--verify", "-p", "X"), 2, "which a peripheral cannot"),
        (("receive", "A", "-p", "X", "--start", "--token-file", "no"), 1, "there is no file 'no'"),
        (("serve", "nowhere", "-p", "X"), 1, "the folder nowhere cannot be opened"),
        (("drip", "--from", "JOB", "-p", "X", "--at", "/none.sock"), 1, "/none.sock"),
        ((), 2, "ACTION"),
    ],
)
def test_sentences(
    *,
    tmp_path: Path,
    words: tuple[str, ...],
    status: int,
    sentence: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "tab.nc").write_bytes(b"ok\nA\tB\n")
    (tmp_path / "ok.nc").write_bytes(b"ok\n")
    monkeypatch.chdir(tmp_path)
    assert main(["dnc", *words]) == status
    said = capsys.readouterr().err
    assert sentence in said
    assert said.count("\n") == 1
    assert said.startswith("canductor: ")


def test_nobody_answers(tmp_path: Path) -> None:
    (tmp_path / "ok.nc").write_bytes(b"ok\n")
    cable = VirtualCable()
    for words, what in (
        (("list",), "the request for the directory"),
        (("receive", "A", *into(tmp_path)), "the header"),
        (("send", str(tmp_path / "ok.nc")), "the header"),
    ):
        ended = cable.run(*words, "-p", "0")
        assert ended.status == 1
        assert f"nothing was received after {what} in time; check the cable" in ended.sentences[-1]


def test_a_port_that_is_in_use(capsys: pytest.CaptureFixture[str]) -> None:
    """A real one: it is the system that says so."""
    ours, theirs = os.openpty()
    name = os.ttyname(theirs)
    try:
        with contextlib.closing(Port(name, DncOptions())) as port:
            assert not port.is_paced
            assert main(["dnc", "list", "-p", name]) == 1
        assert "is in use by another program; close that program first" in capsys.readouterr().err
    finally:
        os.close(ours)
        os.close(theirs)


def test_the_wrong_baud_rate(tmp_path: Path) -> None:
    """Both sides are told what it may be."""

    def garble(_: int, data: bytes) -> bytes:
        return bytes(c * 7 + 3 & 0x7F | 0x40 for c in data)

    cable = VirtualCable(garble)
    with cable.started("serve", str(tmp_path), "-p", "0") as server:
        long = "A" * 30  # a NAK comes back
        asked = cable.run("receive", long, "-p", "1", *into(tmp_path))
        assert asked.sentences == [
            f"{long}.nc: the answer of the other side cannot be read; check baud rate, parity and the cable"
        ]
        told = server.stop().sentences
    assert (
        told[1] == "the received data cannot be read; check that baud rate and frame are those of the control"
    )


def test_a_line_to_oneself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The header comes back where its answer should."""
    (tmp_path / "ok.nc").write_bytes(b"ok\n")
    words = ["dnc", "send", str(tmp_path / "ok.nc"), "-p", "loop://", "--baud", "115200"]
    assert main(words) == 1
    assert capsys.readouterr().err == "canductor: ok: the peripheral reports: DokA\n"
