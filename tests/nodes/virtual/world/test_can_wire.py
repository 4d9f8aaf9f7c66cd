"""The CAN wire against ISO 11898-1 and arithmetic done by hand."""

import math

import pytest

from nodes.virtual._hub import lib as hub
from nodes.virtual._sim import lib
from nodes.virtual.world import CanController, CanState, CanWire, ControllerSettings, World, WorldError
from tests.nodes.virtual.world.machines import uuid

BIT_NS = 2000  # at 500 kbit/s
SAME = 0x123


class Bench:
    """Controllers of closed ports on one wire: they acknowledge, and send by hand."""

    def __init__(self, count: int, *, seed: int = 1, restart_s: float | None = None, queue: int = 10) -> None:
        self.world = World(seed)
        self.wire: CanWire = self.world.add_can(bitrate=500_000)
        settings = ControllerSettings(restart_s=restart_s, queue=queue)
        self.at: list[CanController] = [
            self.world.add_can_port(self.wire, name=str(i), controller=settings).controller
            for i in range(count)
        ]

    def run_bits(self, bits: int) -> None:
        self.world.run_until(self.world.now_ns + bits * BIT_NS)

    def until(self, counter: str, value: int, limit_bits: int = 100_000) -> int:
        """Return after how many bits the wire's COUNTER is VALUE."""
        for bit in range(1, limit_bits):
            self.run_bits(1)
            if self.wire.counters()[counter] >= value:
                return bit
        raise AssertionError(f"{counter} never became {value}")


def state_of(bench: Bench) -> CanState:
    return bench.at[0].state


def frame_bits(can_id: int, data: bytes) -> int:
    return int(hub.can_frame_bits(can_id, len(data), data))


@pytest.mark.parametrize("data", [b"", b"\0" * 8, b"\x55" * 8, bytes(range(5))])
def test_a_frame_ends_with_its_last_bit_and_the_next_begins_after_three_more(data: bytes) -> None:
    bench = Bench(2)
    bits = frame_bits(SAME, data)
    assert bench.at[0].send(SAME, data)
    assert bench.at[0].send(SAME, data)
    assert bench.until("frames", 1) == bits - 3
    assert bench.until("frames", 2) == bits


def test_arbitration_is_by_id_whoever_came_first() -> None:
    bench = Bench(4)
    bench.at[0].send(0x700)  # occupies the bus
    bench.run_bits(10)
    for controller, can_id in ((1, 0x300), (2, 0x100), (3, 0x200)):
        bench.at[controller].send(can_id)
    bench.until("frames", 1)
    order: list[int] = []
    while len(order) < 3:
        bench.run_bits(1)
        order += [i for i in (1, 2, 3) if bench.at[i].counters()["sent"] and i not in order]
    assert order == [2, 3, 1]


def test_who_comes_within_the_first_bit_takes_part_and_who_comes_later_waits() -> None:
    for delay_ns, first in ((BIT_NS - 1, 1), (BIT_NS + 1, 0)):
        bench = Bench(3)
        bench.at[0].send(0x200)
        bench.world.run_until(bench.world.now_ns + delay_ns)
        bench.at[1].send(0x100)
        bench.until("frames", 1)
        assert [bench.at[i].counters()["sent"] for i in (0, 1)] == [1 - first, first]


def test_equal_frames_of_two_senders_are_one() -> None:
    bench = Bench(3)
    for i in (0, 1):
        bench.at[i].send(SAME, b"same")
    bench.run_bits(500)
    counters = bench.wire.counters()
    assert (counters["frames"], counters["same"], counters["errors"]) == (1, 1, 0)
    assert [bench.at[i].counters()["sent"] for i in (0, 1)] == [1, 1]


def test_different_frames_of_one_id_collide_until_passive_senders_give_way() -> None:
    bench = Bench(3)
    bench.at[0].send(SAME, b"\x00")
    bench.at[1].send(SAME, b"\x80")
    # SOF, 11 bits of id, 3 control, 4 length; stuff bits: 0 0010 0100 011|000 0001 has none before the data,
    # but five zeros in "000 00" are followed by one: 19 bits + 1, and the first data bit is wrong.
    first = bench.until("collisions", 1)
    assert first == 21
    assert [bench.at[i].status()["tec"] for i in (0, 1, 2)] == [8, 8, 0]
    assert bench.at[2].status()["rec"] == 1
    assert bench.until("collisions", 2) == lib.CAN_ERROR_BITS + first
    bench.run_bits(3000)
    # 16 collisions of 8 make 128, error-passive: the recessive sender's flag no longer disturbs the other.
    counters = bench.wire.counters()
    assert (counters["collisions"], counters["yielded"], counters["frames"]) == (16, 1, 2)
    assert [bench.at[i].counters()["sent"] for i in (0, 1)] == [1, 1]
    assert [bench.at[i].status()["tec"] for i in (0, 1)] == [127, 135]
    assert bench.at[1].state is CanState.PASSIVE


def test_alone_a_sender_becomes_passive_after_sixteen_errors_and_stays_so() -> None:
    bench = Bench(1)
    bench.at[0].send(SAME, b"hello")
    bits = frame_bits(SAME, b"hello")
    # To the end of the acknowledge slot, then an error frame nobody else takes part in.
    attempt = bits - 11 + lib.CAN_LONELY_ERROR_BITS
    assert bench.until("unacknowledged", 1) == bits - 11
    bench.run_bits(14 * attempt)
    assert (bench.at[0].status()["tec"], bench.at[0].state) == (15 * 8, CanState.WARN)
    bench.run_bits(attempt)
    assert (bench.at[0].status()["tec"], bench.at[0].state) == (128, CanState.PASSIVE)
    seen = bench.wire.counters()["unacknowledged"]
    bench.run_bits(10 * (attempt + lib.CAN_SUSPEND_BITS))
    assert bench.wire.counters()["unacknowledged"] == seen + 10
    assert bench.at[0].status()["tec"] == 128


def broken(bench: Bench) -> None:
    """Take controller 0 to bus-off: 32 frames in a row are disturbed."""
    bench.wire.set_bit_errors(1.0)
    bench.at[0].send(SAME)
    while state_of(bench) != CanState.OFF:
        bench.run_bits(1)
    bench.wire.set_bit_errors(0.0)


def test_bus_off_after_32_errors_and_recovery_after_128_times_11_recessive_bits() -> None:
    bench = Bench(2, restart_s=0.0)
    broken(bench)
    counters = bench.at[0].counters()
    assert (counters["retries"], counters["passive"], counters["off"]) == (32, 1, 1)
    assert counters["dropped"] == 1
    assert bench.at[1].status()["rec"] == 32
    bench.run_bits(lib.CAN_ERROR_BITS + 128 * 11 - 1)
    assert state_of(bench) == CanState.OFF
    bench.run_bits(2)
    assert state_of(bench) == CanState.ACTIVE
    assert bench.at[0].status()["tec"] == 0


def test_on_a_busy_bus_every_frame_counts_one_sequence() -> None:
    bench = Bench(3, restart_s=0.0)
    broken(bench)
    bench.at[1].babble(0x10, b"\x55" * 8, 1.0)
    bits = frame_bits(0x10, b"\x55" * 8)
    bench.run_bits(120 * bits)
    assert state_of(bench) == CanState.OFF
    bench.run_bits(12 * bits)
    assert state_of(bench) == CanState.ACTIVE


def test_without_restart_bus_off_lasts_until_somebody_restarts_it() -> None:
    bench = Bench(2)
    broken(bench)
    bench.run_bits(100_000)
    assert state_of(bench) == CanState.OFF
    assert bench.at[0].send(SAME)  # as SocketCAN: taken, and lost
    assert bench.at[0].counters()["dropped"] == 2
    bench.at[0].restart()
    bench.run_bits(128 * 11 + 1)
    assert state_of(bench) == CanState.ACTIVE


def test_a_full_transmit_queue_refuses() -> None:
    bench = Bench(2, queue=4)
    assert [bench.at[0].send(SAME, bytes([i])) for i in range(6)] == [True] * 4 + [False] * 2
    assert bench.at[0].counters()["refused"] == 2
    bench.run_bits(1000)
    assert bench.at[0].counters()["sent"] == 4


def test_loss_and_bit_errors_are_as_frequent_as_they_are_set() -> None:
    bench = Bench(2, seed=5)
    bench.at[1].set_faults(loss=0.1, corruption=0.05)
    bench.wire.set_bit_errors(1e-3)
    bench.at[0].babble(SAME, b"12345678", 2.0)
    bench.run_bits(1_000_000)
    wire, receiver = bench.wire.counters(), bench.at[1].counters()
    frames = receiver["received"] + receiver["lost"]
    assert frames == wire["frames"]
    assert receiver["lost"] / frames == pytest.approx(0.1, abs=4 * math.sqrt(0.09 / frames))
    assert receiver["corrupted"] / receiver["received"] == pytest.approx(
        0.05, abs=4 * math.sqrt(0.05 / frames)
    )
    attempts = wire["frames"] + wire["disturbed"]
    expected = 1 - (1 - 1e-3) ** (frame_bits(SAME, b"12345678") - 3)
    assert wire["disturbed"] / attempts == pytest.approx(expected, abs=4 * math.sqrt(expected / attempts))


def test_a_babbling_node_with_a_low_id_starves_the_others_until_it_stops() -> None:
    bench = Bench(3)
    bench.at[0].babble(0x001, b"", 0.01)
    bench.run_bits(1)
    bench.at[1].send(0x200)
    bench.run_bits(4900)
    assert bench.at[1].counters()["sent"] == 0
    bench.run_bits(300)
    assert bench.at[1].counters()["sent"] == 1


def test_a_cut_cable_makes_two_buses_and_a_joined_one_again_one() -> None:
    bench = Bench(4)
    for i in (2, 3):
        bench.at[i].cut(1)
    bench.at[0].send(0x100, b"a")
    bench.at[2].send(0x100, b"b")
    bench.run_bits(200)
    assert [at.counters()["received"] for at in bench.at] == [0, 1, 0, 1]
    for i in (2, 3):
        bench.at[i].cut(0)
    bench.at[0].send(0x100, b"a")
    bench.run_bits(200)
    assert [at.counters()["received"] for at in bench.at] == [0, 2, 1, 2]


def test_a_sender_cut_off_within_its_frame_repeats_it() -> None:
    bench = Bench(3)
    bench.at[0].send(0x100, b"12345678")
    bench.run_bits(50)
    bench.at[0].cut(1)
    bench.run_bits(200)
    assert bench.wire.counters()["disturbed"] == 1
    assert bench.at[1].status()["rec"] == 1
    bench.at[0].cut(0)
    bench.run_bits(300)
    assert bench.at[1].counters()["received"] == 1


def test_one_node_more_changes_nothing_for_the_others() -> None:
    def lost(more: int) -> int:
        bench = Bench(2, seed=3)
        for n in range(more):
            bench.world.add_node(bench.wire, uuid(n + 1))
        bench.at[1].set_faults(loss=0.5)
        for i in range(200):
            bench.at[0].send(SAME, bytes([i]))
            bench.run_bits(200)
        return bench.at[1].counters()["lost"]

    assert lost(0) == lost(3)


def test_what_cannot_be_is_refused_in_words() -> None:
    bench = Bench(1)
    with pytest.raises(WorldError, match=r"probability lies in 0\.\.1"):
        bench.at[0].set_faults(loss=1.5)
    with pytest.raises(WorldError, match=r"segments 0\.\.3"):
        bench.at[0].cut(4)
    with pytest.raises(WorldError, match="0x800"):
        bench.at[0].send(0x800)
    with pytest.raises(WorldError, match="2\\^64"):
        World(-1)
