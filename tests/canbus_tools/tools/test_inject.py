"""``canductor can inject`` as users run it, and how its faults are written."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from canbus_tools.inject.fault_options import read_fault
from canbus_tools.inject.inject_report import status
from coordinator.cli import main as cli
from nodes.support.can_protocol import ADMIN_ID, ADMIN_RESPONSE_ID, NEED_NODEID, QUERY_UNASSIGNED
from nodes.support.option_values import UsageError
from nodes.virtual.faults import BusFault, BusFaultKind
from nodes.virtual.hub import VirtualBus

WAIT_S = 30.0
QUERY = can.Message(arbitration_id=ADMIN_ID, data=[QUERY_UNASSIGNED], is_extended_id=False)


class Running:
    """The tool as a process of its own."""

    def __init__(self, path: Path, *words: str) -> None:
        self.path = path
        command = [
            sys.executable,
            "-m",
            "coordinator.cli.main",
            "can",
            "inject",
            "--json",
            "-c",
            str(path),
            *words,
        ]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.ready: dict[str, Any] = json.loads(self.process.stdout.readline())

    def end(self, number: int = signal.SIGINT) -> dict[str, Any]:
        """Its last line after a signal."""
        self.process.send_signal(number)
        out, err = self.process.communicate(timeout=WAIT_S)
        assert self.process.returncode == 0, err
        assert err == ""
        report: dict[str, Any] = json.loads(out.splitlines()[-1])
        return report

    def connect(self) -> can.BusABC:
        return can.Bus(interface="canductor", channel=str(self.path))


@contextlib.contextmanager
def running(path: Path, *words: str) -> Iterator[Running]:
    tool = Running(path, *words)
    try:
        yield tool
    finally:
        tool.process.kill()
        tool.process.communicate()


def answer(bus: can.BusABC, can_id: int) -> bytes:
    """The next frame with CAN_ID."""
    for _ in range(100):
        message = bus.recv(WAIT_S)
        if message is not None and message.arbitration_id == can_id:
            return bytes(message.data)
    raise AssertionError(f"no frame {can_id:03x} came")


def test_nodes_answer_over_the_bus_and_over_socketcand(tmp_path: Path) -> None:
    with running(tmp_path / "bus", "--nodes", "mainboard,toolhead,toolhead", "--socketcand", "0") as tool:
        uuids = tool.ready["nodes"]
        assert list(uuids) == ["mainboard", "toolhead", "toolhead2"]
        host, _, port = tool.ready["socketcand"].rpartition(":")
        remote = can.Bus(interface="socketcand", host=host, port=int(port), channel="can0")
        with tool.connect() as local, remote:
            for asking in (local, remote):
                asking.send(QUERY)
                for hearing in (local, remote):
                    answers = {answer(hearing, ADMIN_RESPONSE_ID) for _ in uuids}
                    assert answers == {
                        bytes([NEED_NODEID]) + bytes.fromhex(uuid) + b"\x01" for uuid in uuids.values()
                    }
            report = tool.end()
        assert report["ok"] is True
        assert report["frames"] == 8
        assert report["socketcand"]["clients"] == 1
        assert set(report["nodes"]) == set(uuids)
        assert [client["sent"] for client in report["clients"]] == [2, 2, 2, 1, 1]


def test_a_node_by_its_name_can_be_off_while_others_are_there(tmp_path: Path) -> None:
    words = ("--nodes", "mainboard,toolhead", "--bus-off", "1000s,at=0,sender=mainboard")
    with running(tmp_path / "bus", *words) as tool, tool.connect() as bus:
        bus.send(QUERY)
        toolhead = bytes([NEED_NODEID]) + bytes.fromhex(tool.ready["nodes"]["toolhead"]) + b"\x01"
        assert answer(bus, ADMIN_RESPONSE_ID) == toolhead
        report = tool.end()
        assert report["bus_offs"] == 1
        assert report["unheard"] == 2
        assert report["frames"] == 2
        assert report["faults"] == [
            {"fault": "bus-off 1000s,at=0,sender=mainboard", "picked": 0, "hits": 1},
        ]


def test_a_frame_by_its_number_is_lost_and_sigterm_ends_in_order_too(tmp_path: Path) -> None:
    words = ("--nodes", "toolhead", "--loss", "frame=2,id=0x3f0", "--seed", "5")
    with running(tmp_path / "bus", *words) as tool, tool.connect() as bus:
        for answered in (True, False, True):
            bus.send(QUERY)
            if answered:
                answer(bus, ADMIN_RESPONSE_ID)
        report = tool.end(signal.SIGTERM)
        assert report["seed"] == 5
        assert report["lost"] == 1
        assert report["faults"] == [{"fault": "loss frame=2,id=0x3f0", "picked": 3, "hits": 1}]


def test_ends_by_itself_and_reports_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["can", "inject", "-c", str(tmp_path / "bus"), "--duration", "0.1", "--corrupt", "1%"]
    assert cli.main([*words, "--socketcand", "0", "--bus-off", "1ms,at=0.01"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"virtual bus ready; attach with -i canductor -c {tmp_path / 'bus'}"
    assert lines[1].startswith("socketcand at 127.0.0.1:")
    assert lines[2].startswith("0.1 s at 1,000,000 bit/s, seed 0: 0 frames, load 0.0%")
    assert lines[3].split() == ["fault", "frames", "seen", "hits"]
    assert lines[4].split() == ["corrupt", "1%", "0", "0"]
    assert lines[5].split() == ["bus-off", "1ms,at=0.01", "0", "1"]
    assert lines[6].startswith("socketcand: 0 clients, 0 bad commands")
    assert not (tmp_path / "bus").exists()


def test_a_node_that_dies_ends_the_run_with_a_sentence(tmp_path: Path) -> None:
    with running(tmp_path / "bus", "--nodes", "toolhead") as tool:
        children = Path(f"/proc/{tool.process.pid}/task/").glob("*/children")
        node = next(int(pid) for child in children for pid in child.read_text().split())
        os.kill(node, signal.SIGKILL)
        out, err = tool.process.communicate(timeout=WAIT_S)
        assert tool.process.returncode == 1
        assert err == "canductor: node toolhead did not end correctly: ended by signal 9\n"
        assert json.loads(out.splitlines()[-1])["ok"] is False


def test_the_same_seed_gives_the_same_faults_in_another_process(tmp_path: Path) -> None:
    kinds = ("lost", "corrupted", "duplicated", "errors", "delayed")
    words = ["--loss", "20%,id=0x123", "--corrupt", "10%,id=0x123", "--duplicate", "20%,id=0x123"]
    words += ["--error", "20%,id=0x123", "--delay", "3us,jitter=20us,share=50%,id=0x123"]

    def run(seed: str) -> tuple[list[bytes], dict[str, Any]]:
        with (
            running(tmp_path / "bus", "--seed", seed, *words) as tool,
            tool.connect() as sender,
            tool.connect() as listener,
        ):
            for number in range(300):
                data = number.to_bytes(2)
                sender.send(can.Message(arbitration_id=0x123, data=data, is_extended_id=False))
            sender.send(can.Message(arbitration_id=0x7FF, is_extended_id=False))
            heard = []
            while (message := listener.recv(WAIT_S)) is not None and message.arbitration_id != 0x7FF:
                heard.append(bytes(message.data))
            report = tool.end()
            return heard, {kind: report[kind] for kind in kinds}

    heard, figures = run("3")
    assert run("3") == (heard, figures)
    assert run("4") != (heard, figures)
    assert all(figure > 10 for figure in figures.values())


# ------------------------------------------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("loss", "1%", BusFault(kind=BusFaultKind.LOSE, share=0.01)),
        ("loss", "0.5,id=0x109", BusFault(kind=BusFaultKind.LOSE, share=0.5, can_id=0x109, mask=0x7FF)),
        (
            "corrupt",
            "1,id=257/0x701,receiver=2,from=1.5,until=2",
            BusFault(kind=BusFaultKind.CORRUPT, can_id=0x101, mask=0x701, receiver=2, from_s=1.5, until_s=2),
        ),
        ("duplicate", "frame=7,sender=toolhead", BusFault(kind=BusFaultKind.DUPLICATE, nth=7, sender=1)),
        ("error", "10%", BusFault(kind=BusFaultKind.ERROR, share=0.1)),
        ("delay", "300us", BusFault(kind=BusFaultKind.DELAY, time_s=300e-6)),
        (
            "delay",
            "0,jitter=5ms,share=20%",
            BusFault(kind=BusFaultKind.DELAY, jitter_s=0.005, share=0.2),
        ),
        ("bus-off", "2s,at=5", BusFault(kind=BusFaultKind.BUS_OFF, time_s=2, timed=True, from_s=5)),
        ("bus-off", "2,share=0.1%", BusFault(kind=BusFaultKind.BUS_OFF, time_s=2, share=0.001)),
    ],
)
def test_faults_are_read(name: str, text: str, expected: BusFault) -> None:
    assert read_fault(name, text, {"mainboard": 0, "toolhead": 1}) == expected


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("loss", "", "--loss needs a share first, as in --loss 1%,id=0x109"),
        ("loss", "2", "--loss is '2', must be a ratio from 0 to 1"),
        ("loss", "id=1", "--loss needs a share first"),
        ("loss", "1%,id=0x800", "--loss's id is '0x800', must be a number from 0 to 0x7ff"),
        ("loss", "1%,id=1/x", "--loss's id is 'x', must be a number"),
        ("loss", "1%,colour=red", "--loss has 'colour=red', must be one of id=, sender="),
        ("loss", "1%,id=1,id=2", "--loss has id= twice"),
        ("loss", "1%,sender=hotend", "--loss: unknown node 'hotend'; the nodes are toolhead"),
        ("loss", "1%,sender=64", "--loss's client is '64', must be a whole number from 0 to 63"),
        ("loss", "1%,from=2,until=1", "--loss: fault lose: end 1 is not between 2"),
        ("loss", "1%,jitter=1ms", "--loss has no jitter="),
        ("loss", "1%,at=1", "--loss has no at="),
        ("loss", "frame=0", "--loss's frame is '0', must be a whole number of at least 1"),
        ("error", "1%,receiver=1", "only a loss or corruption can have a receiver"),
        ("delay", "5min", "--delay is '5min', must be a number with the unit us, ms or s"),
        ("delay", "nan", "--delay is 'nan', must be a number with the unit us"),
        ("delay", "share=1%", "--delay needs a time first, as in --delay 5ms,jitter=2ms"),
        ("bus-off", "2s", "--bus-off needs at=SECONDS, share= or frame= to know when"),
        ("bus-off", "2s,at=5,id=1", "--bus-off with at= takes no other key than sender="),
        ("bus-off", "0,at=5", "--bus-off: fault bus_off: its time must be above 0 s"),
    ],
)
def test_bad_faults_are_refused_with_a_sentence(name: str, text: str, said: str) -> None:
    with pytest.raises(UsageError) as refused:
        read_fault(name, text, {"toolhead": 0})
    assert str(refused.value).startswith(said) or said in str(refused.value)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--nodes", "heater"], "--nodes has 'heater', must be mainboard or toolhead"),
        (["--nodes", ",".join(["toolhead"] * 33)], "--nodes has 33 nodes, must be at most 32"),
        (["--socketcand", ":1"], "--socketcand is ':1', must be a port, or HOST:PORT"),
        (["--socketcand", "70000"], "--socketcand port is '70000', must be a whole number from 0 to 65535"),
        (["--socketcand-bus", "my bus"], "--socketcand-bus is 'my bus', must be 1 to 16 letters and digits"),
        (["--seed", "x"], "--seed is 'x', must be a whole number"),
        (["--bitrate", "fast"], "--bitrate is 'fast', must be a whole number"),
        (["--duration", "-1"], "--duration is '-1', must be a number from 0"),
        (["--loss", "x"], "--loss is 'x', must be a ratio"),
    ],
)
def test_bad_options_are_refused(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["can", "inject", *words]) == 2
    assert capsys.readouterr().err.startswith(f"canductor: {said}")


def test_a_path_or_address_that_cannot_be_had_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["can", "inject", "-c", str(tmp_path / "no" / "bus")]) == 1
    assert "the folder must exist and be writable" in capsys.readouterr().err
    words = ["can", "inject", "-c", str(tmp_path / "bus"), "--socketcand", "no.such.host.invalid:1"]
    assert cli.main(words) == 1
    assert "socketcand at no.such.host.invalid:1: cannot listen" in capsys.readouterr().err
    assert not (tmp_path / "bus").exists()


def test_the_status_line_tells_rates_and_damage(tmp_path: Path) -> None:
    with VirtualBus(tmp_path / "bus", faults=[BusFault(kind=BusFaultKind.LOSE)]) as bus:
        before = bus.stats
        with can.Bus(interface="canductor", channel=str(bus.path)) as sender:
            for _ in range(10):
                sender.send(QUERY)
            while bus.stats.frames < 10 or bus.stats.lost < 10:
                pass
            line = status(before, bus.stats, 0.5, 12.34)
        assert line.startswith("12.3 s  load 0.1%  20 frames/s  clients 1  lost 10")
