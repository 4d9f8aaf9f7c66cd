"""Download of a table to axles on several nodes, each of them verified.

First by broadcast, which serves all nodes of a bus at once; then, for the nodes that still lack it, through
their links, which repeat lost blocks. A long table rarely arrives complete by broadcast on a bus that loses
frames, so the number of nodes that a broadcast reached decides whether there is another.
"""

import asyncio
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

from nodes.mt.cost import CanCost, frame_bits
from nodes.mt.mt import MtError, MtStatus, Pair, to_bytes, to_frames, transmission
from nodes.mt.pace import NS_PER_S, PacedFrames
from nodes.mt.table import AxleTable, TableNode, TableState
from nodes.node.request_reply import QueryTimeout
from nodes.support.can_protocol import MT_CAN_ID
from nodes.support.errors import CanductorError

BROADCASTS_MAX: Final = 6
LINK_TRIES: Final = 2
BUS_SHARE: Final = 0.2
"""Share of a CAN bus for broadcasts; nodes on it continue to move meanwhile."""
BURST_FRAMES: Final = 8
"""Room that an interface's queue has besides motion."""
LINK_BYTES: Final = 48
"""Bytes of the stream in one command: twelve words."""
LINK_WINDOW_WORDS: Final = 2048
"""Most words sent and not yet confirmed: bounds the link's queue."""
POLL_S: Final = 0.02
QUICK_S: Final = 0.08
QUICK_TRIES: Final = 3
"""On a bus that loses frames, one of many answers is nearly always missing; slow lines get more time then."""
STUCK_S: Final = 5.0
"""Time without progress after which a node is given up."""
SETTLE_S: Final = 0.01
"""Time from the last frame passed to the bus to the queries; frames before a query stay before it."""
SLOW_BITRATE: Final = 250_000
"""Bit rate assumed for a bus whose bit rate is unknown."""


class Bus(Protocol):
    """Interface of a CAN bus; ``nodes.bus.can_bus.CanBus`` implements it."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def bitrate(self) -> int: ...  # noqa: D102
    @property
    def load(self) -> float: ...  # noqa: D102
    def send_frame(self, can_id: int, data: bytes, /) -> None: ...  # noqa: D102


@dataclass(frozen=True, slots=True)
class DownloadTarget:
    """Destination of a table: TABLE on NODE, which is on BUS; None: on a serial line."""

    table: AxleTable
    node: TableNode
    bus: Bus | None


@dataclass(frozen=True, slots=True)
class DownloadOutcome:
    """Result of a download at one place."""

    place: DownloadTarget
    ok: bool
    state: TableState | None
    """State of the table on the node; None when the node does not answer."""
    broadcasts: int
    """Number of broadcasts that addressed it."""
    by_link: int
    """How often it was sent through the node's link."""
    problem: str
    """A sentence about the failure; empty when there is none."""

    @property
    def generation(self) -> int:
        """Generation of the table that the node keeps; 0 when that is not known."""
        return 0 if self.state is None else self.state.generation


@dataclass(frozen=True, slots=True)
class Cast:
    """The broadcasts on one bus."""

    bus: str
    cost: CanCost
    """Cost of the first; later ones address fewer axles, with as many words."""
    times: int
    elapsed_s: float
    """Duration of all, from the first frame until the share of time of the last one has passed."""

    def text(self) -> str:
        """Return it for a reader."""
        times = "once" if self.times == 1 else f"{self.times} times"
        return (
            f"broadcast {times} on {self.bus} in {self.elapsed_s:.3f} s, of which one takes at least "
            f"{self.cost.bound_s:.3f} s ({self.cost.text()})"
        )


@dataclass(frozen=True, slots=True)
class DownloadReport:
    """What a download did and cost."""

    outcomes: tuple[DownloadOutcome, ...]
    """Results in the order of the places."""
    words: int
    """Number of words of one transmission."""
    casts: tuple[Cast, ...]
    """By bus; empty when there was none."""
    asking_s: float
    """Time of queries before, between and after broadcasts, settling times included."""
    links_s: float
    """Time of transfers over links, to the nodes that broadcasts did not reach."""
    elapsed_s: float
    """Total time."""

    @property
    def ok(self) -> bool:
        """Whether every place has the table."""
        return all(outcome.ok for outcome in self.outcomes)

    @property
    def bound_s(self) -> float:
        """Least time: one broadcast on each bus without losses or queries; 0 without a broadcast."""
        return sum(cast.cost.bound_s for cast in self.casts)

    def text(self) -> str:
        """Return the cost as text for a user."""
        parts = [f"{self.words} words in {self.elapsed_s:.3f} s", *(cast.text() for cast in self.casts)]
        if self.casts:
            parts.append(f"querying the nodes took {self.asking_s:.3f} s, links {self.links_s:.3f} s")
        return "; ".join(parts)


class _Aim:
    """One place during the download."""

    def __init__(self, place: DownloadTarget) -> None:
        self.place = place
        self.state: TableState | None = None
        """The node's last report."""
        self.done = False
        self.broadcasts = self.by_link = 0
        self.problem = ""

    async def look(self) -> TableState | None:
        """Query the node; return None (and set a problem) when it does not answer."""
        table, node = self.place.table, self.place.node
        try:
            try:
                self.state = await table.state(node, timeout_s=QUICK_S, tries=QUICK_TRIES)
            except QueryTimeout:
                self.state = await table.state(node)
        except CanductorError as error:
            self.state, self.problem = None, str(error)
        return self.state

    async def judge(self, pairs: Sequence[Pair], before: TableState | None) -> None:
        """Check whether the node has the table, with a later generation than BEFORE."""
        state = await self.look()
        if state is None:
            return
        fresh = before is not None and state.generation != before.generation
        self.done = fresh and state.status is MtStatus.OK and state.holds(pairs)
        self.problem = "" if self.done else _why(self.place, state, fresh=fresh)

    def outcome(self) -> DownloadOutcome:
        return DownloadOutcome(self.place, self.done, self.state, self.broadcasts, self.by_link, self.problem)


def _why(place: DownloadTarget, state: TableState, *, fresh: bool) -> str:
    table, node = place.table, place.node
    if state.status is MtStatus.LENGTH_ERROR:
        reason = f"values were lost, or it has room for {table.capacity} points only"
    elif state.status is MtStatus.CHECKSUM_ERROR:
        reason = "values arrived damaged"
    elif state.status is MtStatus.TRANSMITTING:
        reason = "the end did not arrive"
    else:
        reason = "it has another table" if fresh else "the transmission did not reach it"
    return f"{table.name} on node {node.name}: {reason} ({state.status.name.lower()}); send it again"


async def download(
    pairs: Sequence[Pair],
    places: Iterable[DownloadTarget],
    *,
    now_ns: Callable[[], int],
    share: float = BUS_SHARE,
    broadcasts_max: int = BROADCASTS_MAX,
) -> DownloadReport:
    """Transfer PAIRS (none: remove the table) to PLACES; return the result, which includes failures of nodes.

    Concurrent downloads on one bus corrupt each other. Raises MtError for values that MT cannot carry.
    """
    aims = [_Aim(place) for place in places]
    words = transmission(pairs, {aim.place.table.axle for aim in aims})
    began_ns = now_ns()
    for aim in aims:
        if len(pairs) > aim.place.table.capacity:
            raise MtError(
                f"{aim.place.table.name} has room for {aim.place.table.capacity} points on node "
                f"{aim.place.node.name}, not for {len(pairs)}; thin the table out, or configure more points"
            )
    caster = _Caster(pairs, now_ns, share)
    buses = {id(aim.place.bus): aim.place.bus for aim in aims if aim.place.bus is not None}
    for bus in buses.values():
        await caster.reach([aim for aim in aims if aim.place.bus is bus], bus, broadcasts_max)
    links_begin_ns = now_ns()
    await asyncio.gather(*(_by_link(pairs, group) for group in _by_node(aims).values()))
    casts = tuple(caster.casts.values())
    return DownloadReport(
        tuple(aim.outcome() for aim in aims),
        len(words),
        casts,
        (links_begin_ns - began_ns) / NS_PER_S - sum(cast.elapsed_s for cast in casts),
        (now_ns() - links_begin_ns) / NS_PER_S,
        (now_ns() - began_ns) / NS_PER_S,
    )


def _by_node(aims: Iterable[_Aim]) -> dict[TableNode, list[_Aim]]:
    """Return the places without the table, by node."""
    groups: dict[TableNode, list[_Aim]] = {}
    for aim in aims:
        if not aim.done:
            groups.setdefault(aim.place.node, []).append(aim)
    return groups


async def _look_all(aims: Iterable[_Aim]) -> None:
    await asyncio.gather(*(aim.look() for aim in aims))


# --------------------------------------------------------------------------------------------- broadcast


class _Caster:
    """Broadcasts PAIRS on one bus after another and records the cost."""

    def __init__(self, pairs: Sequence[Pair], now_ns: Callable[[], int], share: float) -> None:
        self.casts: dict[int, Cast] = {}
        """By the id of the bus."""
        self._pairs = pairs
        self._now_ns = now_ns
        self._share = share

    async def reach(self, aims: Sequence[_Aim], bus: Bus, tries: int) -> None:
        """Broadcast on BUS to AIMS; repeat for those that missed it, as long as each repeat serves a node."""
        for _ in range(tries):
            groups = _by_node(aims)
            if not groups:
                return
            await _look_all(aim for group in groups.values() for aim in group)
            heard = [aim for group in groups.values() for aim in group if aim.state is not None]
            if not heard:
                return
            before = {aim: aim.state for aim in heard}
            try:
                await self._cast(bus, {aim.place.table.axle for aim in heard})
            except CanductorError as error:  # the bus ended; the reports of its nodes are evaluated below
                for aim in heard:
                    aim.problem = str(error)
                return
            for aim in heard:
                aim.broadcasts += 1
            await asyncio.gather(*(aim.judge(self._pairs, before[aim]) for aim in heard))
            missed = len(_by_node(aims))
            # The next broadcast is expected to reach the same share of the remaining nodes.
            reached = len(groups) - missed
            if missed * (reached + 0.5) < len(groups) + 1:
                return

    async def _cast(self, bus: Bus, axles: set[int]) -> None:
        frames = to_frames(transmission(self._pairs, axles))
        costs = frame_bits(frames)
        bitrate = bus.bitrate or SLOW_BITRATE
        bits_per_s, began_ns = self._share * bitrate, self._now_ns()
        cost = CanCost(len(frames), sum(costs), bitrate, self._share, bus.load)
        paced = PacedFrames(costs, bits_per_s, BURST_FRAMES * max(costs), self._now_ns())
        at = 0
        while paced.deadline_ns is not None:
            count = paced.take(self._now_ns())
            for frame in frames[at : at + count]:
                bus.send_frame(MT_CAN_ID, frame)
            at += count
            if paced.deadline_ns is not None:
                await asyncio.sleep(max(0, paced.deadline_ns - self._now_ns()) / NS_PER_S)
        await asyncio.sleep(max(0, paced.paid_ns - self._now_ns()) / NS_PER_S)  # the last one's duration
        past = self.casts.get(id(bus), Cast(bus.name, cost, 0, 0.0))
        elapsed_s = past.elapsed_s + (self._now_ns() - began_ns) / NS_PER_S
        self.casts[id(bus)] = Cast(bus.name, past.cost, past.times + 1, elapsed_s)
        await asyncio.sleep(SETTLE_S)


# -------------------------------------------------------------------------------------------------- link


async def _by_link(pairs: Sequence[Pair], aims: Sequence[_Aim]) -> None:
    """Send to AIMS, all of one node, through its link."""
    for _ in range(LINK_TRIES):
        left = [aim for aim in aims if not aim.done]
        await _look_all(left)
        heard = [aim for aim in left if aim.state is not None]
        if not heard:
            return
        before = {aim: aim.state for aim in heard}
        try:
            await _stream(pairs, heard)
        except CanductorError as error:
            for aim in heard:
                aim.problem = str(error)
            return
        for aim in heard:
            aim.by_link += 1
        await asyncio.gather(*(aim.judge(pairs, before[aim]) for aim in heard))


async def _stream(pairs: Sequence[Pair], aims: Sequence[_Aim]) -> None:
    """Send the words to the node of AIMS in commands, never far ahead of what it has received."""
    node, first = aims[0].place.node, aims[0]
    words = transmission(pairs, {aim.place.table.axle for aim in aims})
    assert first.state is not None
    begin = first.state.words
    sent = heard = 0
    silent_s = 0.0
    while heard < len(words):
        while sent < len(words) and sent - heard < LINK_WINDOW_WORDS:
            piece = to_bytes(words[sent : sent + LINK_BYTES // 4])
            node.link.send(node.dictionary.encode("table_bytes", data=piece), bulk=True)
            sent += len(piece) // 4
        await asyncio.sleep(POLL_S)
        now_heard = ((await first.place.table.state(node)).words - begin) & 0xFFFFFFFF
        silent_s = 0.0 if now_heard > heard else silent_s + POLL_S
        heard = now_heard
        if silent_s > STUCK_S:
            raise MtError(
                f"node {node.name} took {heard} of {len(words)} words of {first.place.table.name} and no more"
                f" for {STUCK_S:g} s; its bus may be too busy: send it again when the machine is idle"
            )
