"""Sync pulses: fits of one clock to another, rounds, and the keeper over nodes that come and go."""

import asyncio
import math
import random
from collections.abc import Callable

import pytest

from nodes.clock.clock import HostTime, Ticks
from nodes.clock.pulse_fit import SETTLE_PAIRS, PulseFit
from nodes.clock.sync_pulse import INTERVAL_S, MISSED_MAX, SETTLE_ROUNDS, PulseClock, PulseKeeper, PulseRounds
from nodes.dictionary.message_format import Message
from nodes.node.errors import NodeLost
from tests.nodes import virtual_time

PRIMARY_HZ, SECONDARY_HZ = 168_000_000, 64_000_000
RAMP_S, RAMP_PPM = 600.0, 10.0


def warming(
    freq_hz: int, start: int, ppm: float, ramp_ppm: float, ramp_from_s: float
) -> Callable[[float], int]:
    """Return a clock PPM off that changes by RAMP_PPM within ten minutes, as a function of true time."""

    def clock(t: float) -> int:
        u = min(max(t - ramp_from_s, 0.0), RAMP_S)
        v = max(t - ramp_from_s - RAMP_S, 0.0)
        return start + round(freq_hz * (t + 1e-6 * (ppm * t + ramp_ppm * (u * u / (2 * RAMP_S) + v))))

    return clock


def follow(
    seed: int, until_s: float, *, late_share: float = 0.0, ahead_s: float = 1.5, rate: float = 1.0
) -> list[tuple[float, float, float]]:
    """Fit a warming secondary to a warming primary; return (true time, error s, bound s) AHEAD_S later."""
    rng = random.Random(seed)
    primary = warming(PRIMARY_HZ, 2**32 - 3 * PRIMARY_HZ, 50, RAMP_PPM, 60)
    secondary = warming(SECONDARY_HZ, 2**33 - 30 * SECONDARY_HZ, -50, -RAMP_PPM, 60)
    fit = PulseFit(PRIMARY_HZ, SECONDARY_HZ)

    def latency() -> float:
        return rng.uniform(0, 1e-6) + (30e-6 if rng.random() < late_share else 0)

    found = []
    t = 0.0
    while t < until_s:
        fit.add(Ticks(primary(t + latency())), Ticks(secondary(t + latency())))
        if fit.settled:
            assert fit.line is not None
            then = t + ahead_s
            error = (fit.line.ticks_at(Ticks(primary(then))) - secondary(then)) / SECONDARY_HZ
            found.append((then, error, fit.line.error_s))
        t += (0.05 if t < 2 else INTERVAL_S) / rate
    assert fit.restarts == 0
    return found


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("late_share", [0.0, 0.01])
def test_nodes_agree_within_a_microsecond_through_the_ramp(seed: int, late_share: float) -> None:
    found = [entry for entry in follow(seed, 760.0, late_share=late_share) if entry[0] > 10]
    rms = math.sqrt(sum(error * error for _, error, _ in found) / len(found))
    assert rms < 0.6e-6
    assert max(abs(error) for _, error, _ in found) < 3e-6


def test_the_bound_holds_and_is_not_absurd() -> None:
    found = [entry for seed in range(5) for entry in follow(seed, 200.0)]
    outside = sum(abs(error) > bound for _, error, bound in found)
    assert outside <= 0.003 * len(found)
    assert sorted(bound for *_, bound in found)[len(found) // 2] < 4e-6


def test_a_sudden_change_of_rate_is_followed_in_the_end() -> None:
    """Doubting what does not fit must not lock the fit out."""
    fit = PulseFit(PRIMARY_HZ, SECONDARY_HZ)
    off_s = 0.0
    for i in range(120):
        off_s += 0.0 if i < 60 else 20e-6
        fit.add(Ticks(i * PRIMARY_HZ), Ticks(round((i + off_s) * SECONDARY_HZ)))
    assert fit.line is not None
    assert fit.line.rate == pytest.approx(20e-6, abs=0.1e-6)
    assert abs(fit.line.offset_s) < 1e-6


def test_a_line_and_its_inverse_agree() -> None:
    fit = PulseFit(PRIMARY_HZ, SECONDARY_HZ)
    for i in range(30):
        fit.add(Ticks(i * PRIMARY_HZ), Ticks(5_000_000_000 + round(i * SECONDARY_HZ * (1 + 300e-6))))
    assert fit.line is not None
    for ahead_s in (-20, 0, 1, 5, 60):
        reference = Ticks(round((29 + ahead_s) * PRIMARY_HZ))
        assert (
            abs(fit.line.reference_at(fit.line.ticks_at(reference)) - reference) <= 3
        )  # a tick of the slower


def test_a_node_that_restarts_begins_anew() -> None:
    fit = PulseFit(PRIMARY_HZ, SECONDARY_HZ)
    for i in range(40):
        fit.add(Ticks(i * PRIMARY_HZ), Ticks(i * SECONDARY_HZ + 10**9))
    assert fit.settled
    fit.add(Ticks(40 * PRIMARY_HZ), Ticks(SECONDARY_HZ))
    assert (fit.restarts, fit.settled) == (1, False)
    fit.add(Ticks(41 * PRIMARY_HZ), Ticks(2 * SECONDARY_HZ))
    assert fit.line is not None
    assert abs(fit.line.ticks_at(Ticks(41 * PRIMARY_HZ)) - 2 * SECONDARY_HZ) <= 1


# ------------------------------------------------------------------------------------------------- rounds


class Play:
    """Rounds of nodes a, b and c, one a second, that all latch exactly; all clocks roll over in round 5."""

    def __init__(self) -> None:
        self.rounds = PulseRounds()
        self.played = 0
        self.restarted: dict[str, int] = {}

    def __call__(self, count: int, *, silent: str = "", members: str = "abc") -> None:
        """Play COUNT rounds of MEMBERS, which all answer but SILENT."""
        for _ in range(count):
            self.played += 1
            seq = self.rounds.next_pulse({name: hz(name) for name in members})
            for name in members:
                if name != silent:
                    clock = self.clock(name)
                    self.rounds.answer(name, seq, clock % 2**32, Ticks(clock - 1000))

    def clock(self, name: str) -> int:
        return 2**32 + (self.played - 5 - self.restarted.get(name, 0)) * hz(name)

    def off(self, name: str) -> int:
        """Return by how many ticks the fit of NAME is wrong now."""
        line = self.rounds.line(name)
        assert line is not None
        assert self.rounds.reference is not None
        return line.ticks_at(Ticks(self.clock(self.rounds.reference))) - self.clock(name)


def hz(name: str) -> int:
    return PRIMARY_HZ if name == "a" else SECONDARY_HZ


def test_the_first_node_is_the_reference_and_the_others_follow() -> None:
    play = Play()
    play(30)
    assert play.rounds.reference == "a"
    assert play.rounds.line("a") is None
    assert [abs(play.off(name)) <= 1 for name in "bc"] == [True, True]


def test_a_sequence_number_is_never_zero_and_comes_round() -> None:
    rounds = PulseRounds()
    assert (rounds.seq, rounds.late) == (0, 0)
    seen = [rounds.next_pulse({"a": 1, "b": 1}) for _ in range(600)]
    assert seen == [1 + i % 255 for i in range(600)]


def test_an_answer_about_another_pulse_does_not_count() -> None:
    rounds = PulseRounds()
    seq = rounds.next_pulse({"a": PRIMARY_HZ, "b": SECONDARY_HZ})
    rounds.answer("a", seq, 1, Ticks(0))
    rounds.answer("b", seq - 1, 1, Ticks(0))
    rounds.answer("b", 0, 1, Ticks(0))
    assert rounds.late == 2
    assert rounds.line("b") is None


def test_after_forgetting_answers_do_not_count_and_all_begins_anew() -> None:
    play = Play()
    play(30)
    assert play.rounds.settling
    play.rounds.forget()
    assert (play.rounds.reference, play.rounds.line("b"), play.rounds.settling) == (None, None, False)
    play.rounds.answer("a", play.rounds.seq, 1, Ticks(0))
    assert play.rounds.late == 1
    play(SETTLE_PAIRS - 1)
    assert play.rounds.line("b") is None
    play(1)
    assert abs(play.off("b")) <= 1


def test_after_forgetting_the_preferred_node_is_the_reference_at_once() -> None:
    play = Play()
    play(30, members="bc")
    play.rounds.forget()
    play(1, members="abc")
    assert play.rounds.reference == "a"


def test_a_node_that_misses_many_pulses_is_not_relied_on() -> None:
    play = Play()
    play(30)
    play(5, silent="b")
    assert play.rounds.line("b") is not None
    play(1, silent="b")
    assert play.rounds.line("b") is None
    assert play.rounds.line("c") is not None
    play(1)
    assert abs(play.off("b")) <= 1


def test_another_node_becomes_reference_at_once_when_the_first_is_gone() -> None:
    play = Play()
    play(30)
    play(1, members="bc")
    assert play.rounds.reference == "b"
    assert abs(play.off("c")) <= 1


def test_the_preferred_node_becomes_reference_when_it_is_known_well_enough() -> None:
    play = Play()
    play(30, members="bc")
    play(SETTLE_PAIRS, members="abc")
    assert play.rounds.reference == "b"
    assert abs(play.off("a")) <= 3  # ticks of 168 MHz against such of 64 MHz
    play(1, members="abc")
    assert play.rounds.reference == "a"
    assert [abs(play.off(name)) <= 1 for name in "bc"] == [True, True]


def test_a_preferred_node_that_never_answers_does_not_become_reference() -> None:
    play = Play()
    play(30, members="bc")
    play(60, members="abc", silent="a")
    assert play.rounds.reference == "b"
    assert abs(play.off("c")) <= 1


def test_what_was_latched_before_a_restart_does_not_count_for_another_reference() -> None:
    play = Play()
    play(30)
    play.restarted["c"] = 20
    play(5)
    assert play.rounds.line("c") is None
    play(1, members="bc")
    assert play.rounds.reference == "b"
    assert play.rounds.line("c") is None
    play(SETTLE_PAIRS, members="bc")
    assert abs(play.off("c")) <= 1


def test_the_line_before_a_jump_is_known_while_the_node_settles() -> None:
    play = Play()
    play(30)
    assert play.rounds.line_before("c") is None
    before = play.rounds.line("c")
    play.restarted["c"] = 20
    play(1)
    assert play.rounds.line("c") is None
    assert play.rounds.line_before("c") is before is not None
    assert play.rounds.line_before("a") is play.rounds.line_before("b") is None
    play(SETTLE_PAIRS - 1)
    assert play.rounds.line_before("c") is None
    assert abs(play.off("c")) <= 1


def test_a_line_before_a_jump_is_given_up_when_the_node_does_not_settle() -> None:
    play = Play()
    play(30)
    play.restarted["c"] = 20
    play(1)
    play(SETTLE_ROUNDS - 1, silent="c")
    assert play.rounds.line_before("c") is not None
    play(1, silent="c")
    assert play.rounds.line_before("c") is None


def test_a_node_that_was_away_is_relied_on_only_when_it_was_heard_again() -> None:
    play = Play()
    play(30)
    play(MISSED_MAX + 1, members="ac")
    play(1, silent="b")
    assert play.rounds.line("b") is None
    play(1)
    assert abs(play.off("b")) <= 1


def test_pulses_follow_each_other_fast_while_a_node_is_new_but_not_for_ever() -> None:
    play = Play()
    play(39)
    assert play.rounds.settling
    play(1)
    assert not play.rounds.settling
    play.restarted["c"] = 10
    play(1)
    assert play.rounds.settling
    for _ in range(SETTLE_ROUNDS):  # a node whose clock makes no sense at all
        play.restarted["c"] += 10
        play(1)
    assert not play.rounds.settling


def test_a_new_node_that_left_hastens_no_pulses() -> None:
    play = Play()
    play(50, members="ab")
    assert not play.rounds.settling
    play(1)
    assert play.rounds.settling
    play(1, members="ab")
    assert not play.rounds.settling


# ------------------------------------------------------------------------------------------------- keeper


class Bus:
    """Nodes that latch true time; frames and answers take none, but may get lost."""

    def __init__(self, seed: int, loss: float) -> None:
        self.random = random.Random(seed)
        self.loss = loss
        self.nodes: list[FakeNode] = []
        self.pulses = 0

    def send_frame(self, can_id: int, data: bytes) -> None:
        assert can_id == 0x3F0
        assert data[0] == 0x40
        self.pulses += 1
        for node in self.nodes:
            if self.random.random() >= self.loss:
                node.latched = (data[1], node.true_ticks(node.lies_s) % 2**32)


class FakeNode:
    """A node whose host-side estimate is 100 µs wrong, as an exchange's may be."""

    def __init__(self, bus: Bus, name: str, clock_freq_hz: int, ppm: float, start: int) -> None:
        self.name = name
        self.clock_freq_hz = clock_freq_hz
        self.pulse_clock: PulseClock | None = None
        self.latched = (0, 0)
        self.lost = False
        self.lies_s = 0.0
        """By how much what it latches is ahead of its clock."""
        self.seen_s = 0.0
        """By how much the host believes it to be ahead."""
        self.patient: list[bool] = []
        """Whether each question had time."""
        self._bus = bus
        self._rate = clock_freq_hz * (1 + ppm * 1e-6)
        self._start = start
        bus.nodes.append(self)

    @property
    def clock(self) -> "FakeNode":
        return self

    def true_ticks(self, ahead_s: float = 0.0) -> int:
        return self._start + round((asyncio.get_running_loop().time() + ahead_s) * self._rate)

    def ticks_at(self, at_ns: HostTime, /) -> Ticks:
        return Ticks(self._start + round((at_ns * 1e-9 + 100e-6 + self.seen_s) * self._rate))

    def ns_at(self, ticks: Ticks, /) -> HostTime:
        return HostTime(round(((ticks - self._start) / self._rate - 100e-6) * 1e9))

    async def query(
        self,
        name: str,
        response: str,
        /,
        *,
        timeout_s: float = 1.0,
        tries: int = 1,
        patient: bool = False,
    ) -> Message:
        self.patient.append(patient)
        assert (name, response, timeout_s, tries) == ("get_sync_pulse", "sync_pulse", 0.2, 1)
        if self.lost or self._bus.random.random() < self._bus.loss:
            await asyncio.sleep(timeout_s)
            raise NodeLost(f"{self.name} does not answer")
        return Message("sync_pulse", {"seq": self.latched[0], "clock": self.latched[1]})


def now() -> HostTime:
    return HostTime(round(asyncio.get_running_loop().time() * 1e9))


def keep(bus: Bus, seconds: float, *actions: Callable[[], None]) -> None:
    """Run a keeper over the bus's nodes for SECONDS, then after each of ACTIONS again."""

    async def main() -> None:
        keeper = PulseKeeper(lambda: [node for node in bus.nodes if not node.lost], bus.send_frame, now)
        task = asyncio.create_task(keeper.run())
        await asyncio.sleep(seconds)
        for action in actions:
            action()
            await asyncio.sleep(seconds)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    virtual_time.run(main())


def two_nodes(bus: Bus) -> tuple[FakeNode, FakeNode]:
    first = FakeNode(bus, "first", PRIMARY_HZ, 30, 2**32 - 1002 * PRIMARY_HZ)
    return first, FakeNode(bus, "second", SECONDARY_HZ, -80, 2**34 - 1004 * SECONDARY_HZ)


@pytest.mark.parametrize("loss", [0.0, 0.05])
def test_a_follower_agrees_with_the_reference_whatever_the_host_believes(loss: float) -> None:
    bus = Bus(1, loss)
    first, second = two_nodes(bus)
    errors: list[float] = []

    def look() -> None:
        clock = second.pulse_clock
        assert clock is not None
        at_ns = first.ns_at(
            Ticks(first.true_ticks(1.2))
        )  # print time to host time by the reference's estimate
        errors.append((clock.ticks_at(at_ns) - second.true_ticks(1.2)) / SECONDARY_HZ)
        assert first.pulse_clock is None

    keep(bus, 5.0, look, look, look)
    assert max(map(abs, errors)) < 0.5e-6


def test_a_follower_whose_pulses_lie_keeps_its_clock_until_the_host_has_seen_a_jump() -> None:
    bus = Bus(1, 0.0)
    _, second = two_nodes(bus)
    before: list[PulseClock | None] = []

    def lie() -> None:
        before.append(second.pulse_clock)
        second.lies_s = 0.2

    def see() -> None:
        assert second.pulse_clock == before[0] is not None
        assert not second.patient[-1], "it has lied"
        second.seen_s = 0.2

    def look() -> None:
        assert second.pulse_clock is None

    def look_again() -> None:
        assert second.pulse_clock is not None
        assert second.pulse_clock != before[0]

    nothing = [lambda: None]
    keep(bus, 0.5, *nothing * 5, lie, *nothing, see, look, *nothing, look_again)


def test_answers_are_urgent_until_the_clocks_are_known() -> None:
    bus = Bus(1, 0.0)
    nodes = two_nodes(bus)
    keep(bus, 5.0)
    for node in nodes:
        assert node.patient[: SETTLE_ROUNDS - 1] == [False] * (SETTLE_ROUNDS - 1)
        assert all(node.patient[SETTLE_ROUNDS:]), "and then they have time"


def test_a_lost_node_gives_up_its_clock_and_a_lonely_one_gets_no_pulses() -> None:
    bus = Bus(1, 0.0)
    first, second = two_nodes(bus)
    sent: list[int] = []

    def lose() -> None:
        assert second.pulse_clock is not None
        first.lost = True

    def count() -> None:
        assert second.pulse_clock is None
        sent.append(bus.pulses)

    keep(bus, 5.0, lose, count, count)
    assert sent[0] == sent[1]


def test_a_node_that_comes_back_to_a_lonely_one_is_learned_from_the_beginning() -> None:
    bus = Bus(1, 0.0)
    _, second = two_nodes(bus)
    sent: list[int] = []

    def lose() -> None:
        second.lost = True

    def come_back() -> None:
        second.lost = False
        sent.append(bus.pulses)

    keep(bus, 2.5, lose, come_back, lambda: sent.append(bus.pulses))
    assert sent[1] - sent[0] >= SETTLE_ROUNDS


def test_a_clock_by_pulses_goes_through_the_reference_both_ways() -> None:
    bus = Bus(1, 0.0)
    first, second = two_nodes(bus)

    def look() -> None:
        clock = second.pulse_clock
        assert clock is not None
        assert clock.error_s == clock.line.error_s > 0
        at_ns = now()
        assert clock.ticks_at(at_ns) == clock.line.ticks_at(first.ticks_at(at_ns))
        assert abs(clock.ns_at(clock.ticks_at(at_ns)) - at_ns) <= 1e9 / SECONDARY_HZ

    keep(bus, 5.0, look)


def test_a_keeper_that_ends_leaves_no_fit_in_use() -> None:
    bus = Bus(1, 0.0)
    _, second = two_nodes(bus)

    async def main() -> None:
        broken = False

        def capable() -> list[FakeNode]:
            assert not broken
            return bus.nodes

        task = asyncio.create_task(PulseKeeper(capable, bus.send_frame, now).run())
        await asyncio.sleep(5.0)
        assert second.pulse_clock is not None
        broken = True
        with pytest.raises(AssertionError):
            await task
        assert second.pulse_clock is None

    virtual_time.run(main())


def test_a_lonely_node_is_looked_at_four_times_a_second_for_company() -> None:
    looks: list[float] = []

    async def main() -> None:
        def none_capable() -> list[FakeNode]:
            looks.append(asyncio.get_running_loop().time() - virtual_time.START_S)
            return []

        def send_nothing(can_id: int, data: bytes) -> None:
            raise AssertionError

        task = asyncio.create_task(PulseKeeper(none_capable, send_nothing, now).run())
        await asyncio.sleep(0.9)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    virtual_time.run(main())
    assert looks == pytest.approx([0.0, 0.25, 0.5, 0.75], abs=1e-6)
