"""Faults of the virtual bus with real sockets; what each kind does is tested in test_hub_faults.c."""

import contextlib
import os
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from nodes.support.errors import CanductorError
from nodes.transport.frame import RECORD_SIZE, CanFrame
from nodes.virtual.faults import RULES_MAX, BusFault, BusFaultKind
from nodes.virtual.hub import FaultStats, VirtualBus

WAIT_S = 20.0
END = CanFrame(0x7FF).to_record()


@contextlib.contextmanager
def client(bus: VirtualBus) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.connect(str(bus.path))
        sock.settimeout(WAIT_S)
        yield sock


def numbered(can_id: int, number: int) -> bytes:
    return CanFrame(can_id, number.to_bytes(8)).to_record()


def read_to_end(sock: socket.socket) -> list[bytes]:
    """All records up to the first with the id 7FF."""
    records: list[bytes] = []
    while not records or records[-1] != END:
        records.append(sock.recv(RECORD_SIZE, socket.MSG_WAITALL))
    return records[:-1]


def yield_until(condition: Callable[[], object]) -> None:
    """Give the bus's thread its turns until CONDITION is true: its counters cannot be waited for."""
    end_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end_s
        os.sched_yield()


def heard(folder: Path, seed: int, faults: list[BusFault]) -> list[bytes]:
    with (
        VirtualBus(folder / "bus", bitrate=None, seed=seed, faults=faults) as bus,
        client(bus) as sender,
        client(bus) as listener,
    ):
        sender.sendall(b"".join(numbered(0x123, number) for number in range(900)) + END)
        return read_to_end(listener)


def test_the_same_seed_hits_the_same_frames(tmp_path: Path) -> None:
    faults = [
        BusFault(kind=BusFaultKind.LOSE, share=0.1, can_id=0x123, mask=0x7FF),
        BusFault(kind=BusFaultKind.CORRUPT, share=0.1),
        BusFault(kind=BusFaultKind.DUPLICATE, share=0.1),
    ]
    first = heard(tmp_path, 1, faults)
    assert heard(tmp_path, 1, faults) == first
    assert heard(tmp_path, 2, faults) != first
    good = {numbered(0x123, number) for number in range(900)}
    assert 40 < len([record for record in first if record not in good]) < 160


def test_rules_can_change_while_the_bus_runs_and_count_for_themselves(tmp_path: Path) -> None:
    with VirtualBus(tmp_path / "bus", bitrate=None) as bus, client(bus) as sender, client(bus) as listener:
        sender.sendall(numbered(1, 1) + END)
        assert read_to_end(listener) == [numbered(1, 1)]
        assert not bus.stats.faults
        bus.set_faults([BusFault(kind=BusFaultKind.LOSE, can_id=1, mask=0x7FF)])
        sender.sendall(numbered(1, 2) + numbered(2, 3) + END)
        assert read_to_end(listener) == [numbered(2, 3)]
        assert bus.stats.faults == (FaultStats(picked=1, hits=1),)
        bus.set_faults([])
        sender.sendall(numbered(1, 4) + END)
        assert read_to_end(listener) == [numbered(1, 4)]
        assert bus.stats.lost == 1


def test_bus_off_begins_without_any_traffic(tmp_path: Path) -> None:
    """The thread sleeps without a deadline when the rule comes: it has to be woken."""
    with VirtualBus(tmp_path / "bus", bitrate=None) as bus, client(bus) as sender, client(bus) as listener:
        sender.sendall(END)
        assert read_to_end(listener) == []
        off = BusFault(kind=BusFaultKind.BUS_OFF, timed=True, sender=0, time_s=1000.0)
        bus.set_faults([off])
        yield_until(lambda: bus.stats.bus_offs)
        sender.sendall(numbered(1, 1))
        yield_until(lambda: bus.stats.unsent)
        listener.sendall(END)
        yield_until(lambda: bus.stats.unheard)
        assert bus.stats.frames == 2


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"kind": BusFaultKind.LOSE, "share": 1.5}, "fault lose: share 1.5 is not between 0 and 1"),
        ({"kind": BusFaultKind.LOSE, "can_id": 0x800}, "fault lose: id 2048 is not between 0 and 2047"),
        ({"kind": BusFaultKind.LOSE, "nth": 0}, "fault lose: frame 0 is not between 1"),
        ({"kind": BusFaultKind.LOSE, "sender": 64}, "fault lose: sender 64 is not between 0 and 63"),
        ({"kind": BusFaultKind.LOSE, "from_s": 2, "until_s": 1}, "fault lose: end 1 is not between 2"),
        ({"kind": BusFaultKind.DELAY, "time_s": -1}, "fault delay: time -1 is not between 0"),
        ({"kind": BusFaultKind.DELAY, "receiver": 1}, "only a loss or corruption can have a receiver"),
        ({"kind": BusFaultKind.BUS_OFF}, "fault bus_off: its time must be above 0 s"),
        ({"kind": BusFaultKind.LOSE, "timed": True}, "only bus-off can be timed"),
    ],
)
def test_impossible_faults_are_refused(fields: dict[str, object], said: str) -> None:
    with pytest.raises(CanductorError, match=said):
        BusFault(**fields)  # type: ignore[arg-type]


def test_too_many_faults_are_refused(tmp_path: Path) -> None:
    bus = VirtualBus(tmp_path / "bus", faults=[BusFault(kind=BusFaultKind.LOSE)] * RULES_MAX)
    with pytest.raises(CanductorError, match="33 faults are more than the 32 it can have"):
        bus.set_faults([BusFault(kind=BusFaultKind.LOSE)] * (RULES_MAX + 1))
    assert len(bus.faults) == RULES_MAX
