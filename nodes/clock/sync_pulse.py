"""Sync pulses: the clocks of a bus's nodes related by one frame that all receive at once.

Firmware of this project latches its clock in the receive interrupt of an admin frame SYNC_PULSE and reports
the pair on request (`get_sync_pulse`). The first capable node of a bus is the reference; every other is
fitted to it (`nodes.clock.pulse_fit`), far more accurately than by exchanges with the host. Nodes without the
extension keep their own estimate. `PulseRounds` is sans-IO; `PulseKeeper` sends pulses and queries nodes.
"""

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from nodes.clock.clock import HostTime, Ticks, extend32
from nodes.clock.estimated_clock import EstimatedClock
from nodes.clock.pulse_fit import JUMP_S, PAIRS_MAX, PulseFit, PulseLine
from nodes.dictionary.message_format import Message
from nodes.support.awake import sleep_between
from nodes.support.can_protocol import ADMIN_ID, SYNC_PULSE
from nodes.support.errors import CanductorError

CONSTANT: Final = "CAN_SYNC_PULSE"
"""Constant of the dictionary: the firmware supports sync pulses."""
SETTLE_ROUNDS: Final = 40
SETTLE_INTERVAL_S: Final = 0.05
INTERVAL_S: Final = 0.933
"""Not a divisor of a second: periodic work on a node must not meet every pulse."""
SLACK: Final = 0.35
"""By how much of the time between two pulses the next may be later; as that of the samples of clocks."""
IDLE_S: Final = 0.25
"""Interval of the checks for two capable nodes."""
ANSWER_TIMEOUT_S: Final = 0.2
MISSED_MAX: Final = 5
"""Rounds in a row without a node's answer after which its fit is no longer used."""


@dataclass(frozen=True, slots=True)
class PulseClock:
    """A follower's clock: the host's estimate of the reference's clock, combined with the pulses.

    When print time is the reference's own clock the host's error cancels: the same estimate turns print time
    into host time and host time into the reference's ticks.
    """

    reference: EstimatedClock
    line: PulseLine

    @property
    def error_s(self) -> float:
        """Bound of the error relative to the reference node's clock."""
        return self.line.error_s

    def ticks_at(self, at_ns: HostTime, /) -> Ticks:
        """Return the node's 64-bit ticks at a host time."""
        return self.line.ticks_at(self.reference.ticks_at(at_ns))

    def ns_at(self, ticks: Ticks, /) -> HostTime:
        """Return the host time at which the node's clock stands at TICKS."""
        return self.reference.ns_at(self.line.reference_at(ticks))


@dataclass(slots=True)
class _Follower:
    fit: PulseFit
    missed: int
    """Rounds in a row without a pair."""
    settling: int
    """Rounds for which it may still request fast pulses."""


class PulseRounds:
    """Pairs the clocks that the nodes latched. A round is one pulse; answers to an older one do not count."""

    def __init__(self) -> None:
        self.seq = 0
        """Sequence number of the last pulse, 1..255; 0 before the first."""
        self.late = 0
        """Number of answers about a pulse other than the last, or about none."""
        self.reference: str | None = None
        self._followers: dict[str, _Follower] = {}
        self._history: deque[dict[str, Ticks]] = deque(maxlen=PAIRS_MAX)
        """Latched clocks by round; the last entry is that of the current round."""

    @property
    def settling(self) -> bool:
        """Whether a node started so recently that pulses should follow each other fast."""
        return any(follower.settling > 0 for follower in self._followers.values())

    def forget(self) -> None:
        """Discard everything: there will be no pulses for a time of unknown length."""
        self.reference = None
        self._followers.clear()
        self._history.clear()

    def next_pulse(self, members: Mapping[str, int]) -> int:
        """Start a round with these nodes (nominal Hz by name, not empty, preferred first); return its seq.

        The preferred node becomes the reference once it has answered often enough for all others to follow.
        """
        self._followers = {name: f for name, f in self._followers.items() if name in members}
        preferred = next(iter(members))
        if self.reference not in members or self.line(preferred) is not None:
            self._refer_to(preferred, members)
        for name, freq_hz in members.items():
            if name not in (self.reference, *self._followers):
                self._followers[name] = self._follower(name, freq_hz, members[self.reference or preferred])
        for follower in self._followers.values():
            follower.missed += 1
            follower.settling -= follower.settling > 0
        self._history.append({})
        self.seq = self.seq % 255 + 1
        return self.seq

    def answer(self, name: str, seq: int, clock32: int, near: Ticks) -> None:
        """Process a node's answer; NEAR is an estimate of its clock, within 2^31 ticks."""
        if seq != self.seq or not self._history:
            self.late += 1
            return
        latched = self._history[-1]
        if name not in latched:
            latched[name] = extend32(clock32, near)
            for other in tuple(latched) if name == self.reference else (name,):
                self._pair(other)

    def line(self, name: str) -> PulseLine | None:
        """Return the fit of a follower if it is reliable now, else None."""
        follower = self._followers.get(name)
        if follower is None or follower.missed > MISSED_MAX or not follower.fit.settled:
            return None
        return follower.fit.line

    def line_before(self, name: str) -> PulseLine | None:
        """Return the fit of a follower before a clock jumped, while it settles after that, else None."""
        follower = self._followers.get(name)
        return follower.fit.line_before if follower is not None and follower.settling > 0 else None

    def _refer_to(self, reference: str, members: Mapping[str, int]) -> None:
        """Make REFERENCE the reference; fits to another node are converted to it at once."""
        self.reference = reference
        self._followers = {
            name: self._follower(name, freq_hz, members[reference])
            for name, freq_hz in members.items()
            if name != reference
        }

    def _follower(self, name: str, freq_hz: int, reference_hz: int) -> _Follower:
        fit = PulseFit(reference_hz, freq_hz)
        reference = self.reference or ""
        both = [reference in latched and name in latched for latched in self._history]
        fit.fill((r[reference], r[name]) for r, paired in zip(self._history, both, strict=True) if paired)
        missed = next((n for n, paired in enumerate(reversed(both)) if paired), len(both))
        return _Follower(fit, missed, settling=0 if fit.settled else SETTLE_ROUNDS)

    def _pair(self, name: str) -> None:
        latched = self._history[-1]
        follower = self._followers.get(name)
        if self.reference not in latched or follower is None:
            return
        was_settled = follower.fit.settled
        follower.fit.add(latched[self.reference], latched[name])
        follower.missed = 0
        if was_settled and not follower.fit.settled:  # it restarted
            follower.settling = SETTLE_ROUNDS


class PulseNode(Protocol):
    """Interface of a node as the keeper needs it."""

    name: str
    pulse_clock: PulseClock | None

    @property
    def clock(self) -> EstimatedClock:
        """The host's own estimate of its clock."""
        ...

    @property
    def clock_freq_hz(self) -> int:
        """Nominal."""
        ...

    async def query(
        self,
        name: str,
        response: str,
        /,
        *,
        timeout_s: float = ...,
        tries: int = ...,
        patient: bool = ...,
    ) -> Message:
        """Query the node."""
        ...


class PulseKeeper:
    """Relates the clocks of one CAN bus for as long as `run` runs.

    CAPABLE returns the nodes that support pulses and can be queried now, in order of preference as reference.
    SEND_FRAME sends a frame ahead of all data; NOW is host time.
    """

    def __init__(
        self,
        capable: Callable[[], Sequence[PulseNode]],
        send_frame: Callable[[int, bytes], None],
        now: Callable[[], HostTime],
    ) -> None:
        self._capable = capable
        self._send_frame = send_frame
        self._now = now
        self._asked: dict[str, PulseNode] = {}
        self.rounds = PulseRounds()

    async def run(self) -> None:
        """Send pulses and query the nodes until cancelled; a failure of the bus is handled elsewhere."""
        try:
            while True:
                await self._keep()
        finally:
            self._publish(())  # nothing keeps the fits up to date any more

    async def _keep(self) -> None:
        nodes = self._capable()
        if len(nodes) < 2:
            self.rounds.forget()
            self._publish(())
            await asyncio.sleep(IDLE_S)
            return
        with contextlib.suppress(CanductorError):  # the bus closes: that is reported elsewhere
            await self._round(nodes)
        self._publish(nodes)
        pause_s = SETTLE_INTERVAL_S if self.rounds.settling else INTERVAL_S
        await sleep_between(pause_s, pause_s * (1 + SLACK))

    async def _round(self, nodes: Sequence[PulseNode]) -> None:
        seq = self.rounds.next_pulse({node.name: node.clock_freq_hz for node in nodes})
        self._send_frame(ADMIN_ID, bytes((SYNC_PULSE, seq)))
        await asyncio.gather(*(self._ask(node) for node in nodes))

    async def _ask(self, node: PulseNode) -> None:
        with contextlib.suppress(CanductorError):  # the answer or the node is lost: it misses this round
            answer = await node.query(
                "get_sync_pulse",
                "sync_pulse",
                timeout_s=ANSWER_TIMEOUT_S,
                tries=1,
                patient=not self.rounds.settling,
            )
            near = node.clock.ticks_at(self._now())
            self.rounds.answer(node.name, answer.integer("seq"), answer.integer("clock"), near)

    def _publish(self, nodes: Sequence[PulseNode]) -> None:
        """Set or clear the clock by pulses of every node."""
        present = {node.name: node for node in nodes}
        for name, node in self._asked.items():
            if name not in present:
                node.pulse_clock = None
        self._asked = present
        reference = _clock_of(present.get(self.rounds.reference or ""))
        for node in nodes:
            line = self.rounds.line(node.name)
            if line is None and reference is not None:
                line = self._line_before(node, reference)
            node.pulse_clock = PulseClock(reference, line) if line and reference else None

    def _line_before(self, node: PulseNode, reference: EstimatedClock) -> PulseLine | None:
        """Return the fit before a jump while the host's own queries show no jump.

        It is more accurate than they are, and they show a real jump within about a second.
        """
        line, own = self.rounds.line_before(node.name), _clock_of(node)
        if line is None or own is None:
            return None
        now_ns = self._now()
        parted_ticks = own.ticks_at(now_ns) - line.ticks_at(reference.ticks_at(now_ns))
        return line if abs(parted_ticks) < JUMP_S * node.clock_freq_hz else None


def _clock_of(node: PulseNode | None) -> EstimatedClock | None:
    """Return the host's own estimate, if there is any yet."""
    with contextlib.suppress(CanductorError):
        return node.clock if node is not None else None
    return None
