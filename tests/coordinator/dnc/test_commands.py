"""The commands in processes of their own, over pseudo-terminals, and over TCP."""

import contextlib
import json
import os
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
from serial import rfc2217

from coordinator.cli import main
from tests.coordinator.dnc.cable import Cable

CANDUCTOR = Path(sys.executable).parent / "canductor"
PROGRAM = b"".join(b"N%d G1 X%d.5 Y7\n" % (i, i * 7) for i in range(60))
PATIENCE_S = 60
FAST = ("--baud", "115200")


@contextlib.contextmanager
def started(*words: str, folder: Path, stdin: int | None = None) -> Iterator[subprocess.Popen[str]]:
    """Start a command and wait until it says that it waits for the other side."""
    process = subprocess.Popen(
        [CANDUCTOR, "dnc", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=stdin,
        text=True,
        cwd=folder,
    )
    try:
        assert process.stderr is not None
        said = process.stderr.readline()
        assert said.startswith(("waiting for a control", "serving")), said + process.stderr.read()
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


def run(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [CANDUCTOR, "dnc", *words],
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=PATIENCE_S,
        check=False,
    )


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    ours.mkdir()
    theirs.mkdir()
    (ours / "part.nc").write_bytes(PROGRAM)
    return ours, theirs


@pytest.mark.parametrize("options", [(), ("--frame", "8N1", "--no-dc1", "--avoid-control")])
def test_send_to_receive(folders: tuple[Path, Path], options: tuple[str, ...]) -> None:
    ours, theirs = folders
    with (
        Cable() as cable,
        started("receive", "-p", cable.names[1], *FAST, *options, folder=theirs) as receiver,
    ):
        sent = run("send", "part.nc", "-p", cable.names[0], *FAST, *options, "--json", folder=ours)
        assert (sent.returncode, sent.stderr) == (0, "")
        assert json.loads(sent.stdout) == {
            "ok": True, "did": "sent", "transfers": 1, "name": "part", "code": "D", "lines": 60,
            "confirmed": False,
        }  # fmt: skip
        out, _ = receiver.communicate(timeout=PATIENCE_S)
        assert (receiver.returncode, out) == (0, "part.nc: 60 lines are in .\n")
    assert (theirs / "part.nc").read_bytes() == PROGRAM
    assert [p.name for p in theirs.iterdir()] == ["part.nc"]


def test_a_file_server(folders: tuple[Path, Path]) -> None:
    ours, theirs = folders
    (ours / "tab.nc").write_bytes(b"A\tB\n")
    with Cable() as cable, started("serve", ".", "-p", cable.names[0], *FAST, folder=ours) as server:
        at = ("-p", cable.names[1], *FAST)
        listed = run("list", *at, "--json", folder=theirs)
        assert json.loads(listed.stdout)["files"] == {"part.nc": 2, "tab.nc": 1}
        assert run("receive", "PART", *at, "--crlf", folder=theirs).returncode == 0
        assert (theirs / "part.nc").exists() is False
        assert (theirs / "PART.nc").read_bytes() == PROGRAM.replace(b"\n", b"\r\n")
        again = run("receive", "PART", *at, folder=theirs)
        assert (again.returncode, again.stderr) == (
            1, "canductor: PART.nc is in . already; choose another name, or allow --overwrite\n"
        )  # fmt: skip
        missing = run("receive", "NONE", *at, folder=theirs)
        assert missing.stderr == "canductor: NONE.nc: the peripheral says: NO SUCH FILE\n"
        refused = run("receive", "tab.nc", *at, folder=theirs)
        assert refused.stderr == "canductor: tab.nc: the peripheral says: ERROR IN FILE\n"
        taken = run("send", "PART.nc", "--name", "NEW", *at, folder=theirs)
        assert taken.returncode == 0
        exists = run("send", "PART.nc", "--name", "part.nc", *at, folder=theirs)
        assert exists.stderr == "canductor: part: the peripheral says: FILE EXISTS\n".replace(
            "part:", "part.nc:"
        )
        server.terminate()
        assert server.wait(PATIENCE_S) == 143
    assert (ours / "NEW.nc").read_bytes() == PROGRAM
    assert sorted(p.name for p in theirs.iterdir()) == ["PART.nc"]


def test_a_bad_cable(folders: tuple[Path, Path]) -> None:
    """Flipped bits and lost characters: the same file, or none and a sentence."""
    ours, theirs = folders
    chance = random.Random(5)

    def damage(_: int, data: bytes) -> bytes:
        if len(data) > 6 and chance.random() < 0.2:
            at = chance.randrange(1, len(data))
            data = data[:at] + (b"" if chance.random() < 0.5 else bytes([data[at] ^ 8])) + data[at + 1 :]
        return data

    with (
        Cable(change=damage) as cable,
        started("receive", "-p", cable.names[1], *FAST, "--silence", "0.02", folder=theirs) as receiver,
    ):
        run("send", "part.nc", "-p", cable.names[0], *FAST, "--silence", "0.02", folder=ours)
        _, err = receiver.communicate(timeout=PATIENCE_S)
        assert receiver.returncode in (0, 1)
    if receiver.returncode:
        assert err.startswith("canductor: part.nc: ")
        assert list(theirs.iterdir()) == []
    else:
        assert (theirs / "part.nc").read_bytes() == PROGRAM


def test_a_cut_cable_leaves_nothing(folders: tuple[Path, Path]) -> None:
    ours, theirs = folders
    cut = threading.Event()

    def once_cut(who: int, data: bytes) -> bytes:
        if b"N30 " in data:
            cut.set()
        return b"" if cut.is_set() else data

    short = ("--answer-timeout", "4")
    with (
        Cable(change=once_cut) as cable,
        started("receive", "-p", cable.names[1], *FAST, *short, folder=theirs) as receiver,
    ):
        sent = run("send", "part.nc", "-p", cable.names[0], *FAST, *short, folder=ours)
        assert sent.returncode == 1
        assert "nothing came after line 31 in time; check the cable" in sent.stderr
        _, err = receiver.communicate(timeout=PATIENCE_S)
        assert "nothing came after line 30, the last one that came in time" in err
    assert list(theirs.iterdir()) == []


def test_drip_from_a_pipe(folders: tuple[Path, Path]) -> None:
    """The control gets lines as they come; whoever writes them waits for the control."""
    _, theirs = folders
    reader, writer = os.pipe()
    with Cable() as cable:
        words = ("drip", "-", "-p", cable.names[0], *FAST)
        with started(*words, folder=theirs, stdin=reader) as feeder, os.fdopen(writer, "wb") as pipe:
            os.close(reader)
            pipe.write(PROGRAM)
            pipe.flush()
            fetching = threading.Thread(target=run, args=("receive", "JOB", "-p", cable.names[1], *FAST),
                                        kwargs={"folder": theirs})  # fmt: skip
            fetching.start()
            until_s = time.monotonic() + PATIENCE_S
            while cable.carried[0] < len(PROGRAM) and time.monotonic() < until_s:
                fetching.join(0.01)
            assert not (theirs / "JOB.nc").exists()
            pipe.write(b"M30")
            pipe.close()
            fetching.join(PATIENCE_S)
            out, _ = feeder.communicate(timeout=PATIENCE_S)
            assert (feeder.returncode, out) == (0, "61 lines were fed to the control\n")
    assert (theirs / "JOB.nc").read_bytes() == PROGRAM + b"M30\n"


@pytest.mark.parametrize("scheme", ["socket", "rfc2217"])
def test_over_tcp(folders: tuple[Path, Path], scheme: str) -> None:
    ours, theirs = folders
    bridge_of = {"socket": _bridge, "rfc2217": _rfc2217_server}
    with socket.create_server(("127.0.0.1", 0)) as listener, Cable() as cable:
        port = listener.getsockname()[1]
        bridge = threading.Thread(target=bridge_of[scheme], args=(listener, cable.names[1]))
        bridge.start()
        frame = ("--frame", "8N1")  # all that a pseudo-terminal lets a serial server set
        with started("serve", ".", "-p", cable.names[0], *FAST, *frame, folder=ours):
            url = f"{scheme}://127.0.0.1:{port}"
            fetched = run("receive", "PART", "-p", url, *FAST, *frame, folder=theirs)
            assert (fetched.returncode, fetched.stderr) == (0, "")
        bridge.join(PATIENCE_S)
    assert (theirs / "PART.nc").read_bytes() == PROGRAM


def _bridge(listener: socket.socket, name: str) -> None:
    """A TCP serial server of one client."""
    connection, _ = listener.accept()
    line = os.open(name, os.O_RDWR | os.O_NOCTTY)
    with connection, os.fdopen(line, "r+b", buffering=0) as tty:

        def back() -> None:
            with contextlib.suppress(OSError):
                while data := tty.read(4096):
                    connection.sendall(data)

        backward = threading.Thread(target=back, daemon=True)
        backward.start()
        while data := connection.recv(4096):
            tty.write(data)


class _PseudoTerminal(serial.Serial):  # type: ignore[misc]
    """A port without modem lines."""

    cts = dsr = ri = cd = False

    def _update_dtr_state(self) -> None:
        pass

    def _update_rts_state(self) -> None:
        pass


def _rfc2217_server(listener: socket.socket, name: str) -> None:
    """A serial server that takes baud rate and frame from its client, made of pyserial's own parts."""
    connection, _ = listener.accept()

    class Locked:
        """What the port manager answers with."""

        lock = threading.Lock()

        def write(self, data: bytes) -> None:
            with self.lock, contextlib.suppress(OSError):
                connection.sendall(data)

    with connection, _PseudoTerminal(name, timeout=0.02) as port:
        client = Locked()
        manager = rfc2217.PortManager(port, client)
        ended = threading.Event()

        def back() -> None:
            while not ended.is_set():
                if data := port.read(max(port.in_waiting, 1)):
                    client.write(b"".join(manager.escape(data)))

        backward = threading.Thread(target=back)
        backward.start()
        with contextlib.suppress(OSError):
            while data := connection.recv(4096):
                port.write(b"".join(manager.filter(data)))
        ended.set()
        backward.join()


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
        (("list", "-p", "/dev/null"), 1, "/dev/null is no serial port; name a device such as /dev/ttyUSB0"),
        (("list", "-p", "."), 1, ". is no serial port; name a device"),
        (("list", "-p", ""), 1, "there is no serial port ''; check its plug"),
        (("list", "-p", "X", "--frame", "9Z1"), 2, "the character frame is '9Z1', must be like 7E1"),
        (("list", "-p", "X", "--baud", "fast"), 2, "--baud is 'fast', must be a whole number"),
        (("list", "-p", "X", "--silence", "9"), 2, "an answer may take 8 s, must be longer"),
        (("send", "none.nc", "-p", "X"), 1, "there is no file 'none.nc'"),
        (
            ("send", "tab.nc", "-p", "X"),
            1,
            "line 2 of tab.nc has the character 09 hex, which no block can carry",
        ),
        (("send", "ok.nc", "-p", "X", "--code", "77"), 2, "--code is '77', must be one letter"),
        (("receive", "A", "-p", "X", "--at", "Y"), 2, "--at says where to print; give --start, too"),
        (("drip", "-p", "X"), 2, "drip takes either a FILE"),
        (("drip", "ok.nc", "--from", "A", "-p", "X"), 2, "drip takes either a FILE"),
        (("drip", "--from", "A", "--from-control", "-p", "X"), 2, "drip takes either a FILE"),
        (("drip", "ok.nc", "-p", "X", "--at", "Y"), 2, "--at says where to print; it goes with --from"),
        (("send", "ok.nc", "--as", "peripheral", "--verify", "-p", "X"), 2, "which a peripheral cannot"),
        (("receive", "A", "-p", "X", "--start", "--token-file", "no"), 1, "there is no file 'no'"),
        (("serve", "nowhere", "-p", "X"), 1, "the folder nowhere cannot be opened"),
        (("drip", "--from", "JOB", "-p", "X", "--at", "/none.sock"), 1, "/none.sock"),
        ((), 2, "COMMAND"),
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


def test_nobody_answers_and_a_port_that_is_in_use(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "ok.nc").write_bytes(b"ok\n")
    at = ("--header-timeout", "0.2", "--answer-timeout", "0.4")
    with Cable() as cable:
        for words, what in (
            (("list",), "the request for the directory"),
            (("receive", "A", "--folder", str(tmp_path)), "the header"),
            (("send", str(tmp_path / "ok.nc")), "the header"),
        ):
            assert main(["dnc", *words, "-p", cable.names[0], *at]) == 1
            assert f"nothing came after {what} in time; check the cable" in capsys.readouterr().err
        with started("serve", ".", "-p", cable.names[0], folder=tmp_path):
            assert main(["dnc", "list", "-p", cable.names[0]]) == 1
            assert "is in use by another program; close that first" in capsys.readouterr().err


def test_the_wrong_baud_rate(tmp_path: Path) -> None:
    """Both sides are told what it may be."""

    def garble(_: int, data: bytes) -> bytes:
        return bytes(c * 7 + 3 & 0x7F | 0x40 for c in data)

    with (
        Cable(change=garble) as cable,
        started("serve", ".", "-p", cable.names[0], folder=tmp_path) as server,
    ):
        long = "A" * 30  # a NAK comes back
        asked = run("receive", long, "-p", cable.names[1], "--header-timeout", "3", folder=tmp_path)
        assert asked.stderr == (
            f"canductor: {long}.nc: what the other side answers cannot be read; check baud rate, parity and"
            " the cable\n"
        )
        server.terminate()
        _, told = server.communicate(timeout=PATIENCE_S)
        assert told.startswith("what comes cannot be read; are baud rate and frame those of the control?\n")


def test_a_line_to_oneself(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The header comes back where its answer should."""
    (tmp_path / "ok.nc").write_bytes(b"ok\n")
    words = ["dnc", "send", str(tmp_path / "ok.nc"), "-p", "loop://", "--baud", "115200"]
    assert main(words) == 1
    assert capsys.readouterr().err == "canductor: ok: the peripheral says: DokA\n"
