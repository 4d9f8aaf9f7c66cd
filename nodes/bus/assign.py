"""Node ids on a CAN bus: finding the nodes that wait for one, and giving each its own. Sans-IO.

A round queries which nodes wait for an id (QUERY_UNASSIGNED) and, with firmware that supports it, which have
one already (WHO_IS_HERE). The answers of a round are merged with those before, since frames get lost and
answers collide: older firmware answers at once, all nodes with the same CAN id, and two that begin in the
same bit destroy each other's frame. A frame of the host right behind the query would make them wait for its
end and so begin together: nothing follows QUERY_UNASSIGNED, and some rounds send it alone. Nodes that still
collide get their ids without having answered, and then collide no more.

Setting an id is not acknowledged. It counts as done when the node reports it (WHO_IS_HERE), or when it no
longer answers SILENT_ROUNDS queries in a row; until then it is sent again in every round, as the silence may
be due to lost frames. A node that has an id from before answers no query, so a node that never answers gets
its id all the same and remains *unheard*: only identifying it shows whether it is there.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from nodes.support.can_protocol import (
    ADMIN_ID,
    ADMIN_RESPONSE_ID,
    FIRST_NODEID,
    LAST_NODEID,
    NEED_NODEID,
    NODE_IS_HERE,
    QUERY_UNASSIGNED,
    SET_NODEID,
    SET_NODEID_BOOTLOADER,
    UUID_SIZE,
    WHO_IS_HERE,
)
from nodes.support.errors import CanductorError

ROUND_NS: Final = 20_000_000
"""Time for the answers of one round; nodes answer within a few milliseconds."""
ALL_ASKED_ROUNDS: Final = 3
"""Number of rounds after which only every other one sends WHO_IS_HERE."""
SLOW_ROUND_NS: Final = 100_000_000
QUICK_ROUNDS: Final = 10
ANSWER_NS: Final = 540_000
"""Time of one answer on the wire at 250 kbit/s: the more nodes may answer, the longer a round lasts."""
PATIENCE_NS: Final = 1_200_000_000
"""How long a silent node is queried after the last new one appeared: it may still be booting."""
MAX_NS: Final = 5_000_000_000
"""Time after which the assignment ends even if new nodes keep appearing."""
SILENT_ROUNDS: Final = 3
"""With 1 % of frames lost, an unassigned node stays silent for so many rounds once in 10^5 rounds."""
UNHEARD_ROUNDS: Final = 4
"""Number of rounds after which a node that never answered is sent its id."""
MAX_STRANGERS: Final = 512
"""Most uuids remembered that are not wanted."""
_UUID: Final = re.compile(r"[0-9a-fA-F]{12}\Z")


class AssignError(CanductorError):
    """A node cannot get its id: not found, in its bootloader, or not alone with its uuid."""


@dataclass(frozen=True, slots=True)
class Uuid:
    """Identity of a board: six bytes in the order of the wire; printed as 12 hex digits."""

    raw: bytes

    def __post_init__(self) -> None:
        if len(self.raw) != UUID_SIZE:
            raise AssignError(f"a uuid has {UUID_SIZE} bytes, not {len(self.raw)}")

    @classmethod
    def parse(cls, text: str) -> "Uuid":
        """Read 12 hex digits; raises AssignError."""
        if _UUID.match(text.strip()):
            return cls(bytes.fromhex(text.strip()))
        raise AssignError(f"{text!r} is not a uuid: give the 12 hex digits that 'canductor can query' prints")

    def __str__(self) -> str:
        return self.raw.hex()


@dataclass(frozen=True, slots=True)
class AdminFrame:
    """A frame to send."""

    can_id: int
    data: bytes


def waiting_uuid(data: bytes) -> Uuid | None:
    """Return the uuid that waits for an id, from an admin response; None for any other response."""
    if len(data) == UUID_SIZE + 2 and data[0] == NEED_NODEID:
        return Uuid(data[1 : 1 + UUID_SIZE])
    return None


def number_nodes(uuids: Iterable[Uuid]) -> dict[Uuid, int]:
    """Assign node ids 4, 5, 6, … in the order of UUIDS; raises AssignError."""
    found: dict[Uuid, int] = {}
    for nodeid, uuid in enumerate(uuids, FIRST_NODEID):
        if uuid in found:
            raise AssignError(f"uuid {uuid} is configured twice; every node needs its own")
        if nodeid > LAST_NODEID:
            raise AssignError(f"more than {LAST_NODEID - FIRST_NODEID + 1} nodes on one bus cannot get ids")
        found[uuid] = nodeid
    return found


@dataclass(slots=True)
class _Seen:
    """What is known of one uuid."""

    nodeid: int | None = None
    answers: int = 0
    here: int = 0
    """Answers to WHO_IS_HERE."""
    answered_round: bool = False
    needs_id: bool = False
    """In this round it reported no id or another one, or another node reported the same id."""
    silent_rounds: int = 0
    bootloader: bool = False
    settled: bool = False


@dataclass(frozen=True, slots=True)
class Assignment:
    """Result: ids are set for all wanted uuids; the presence of those UNHEARD is not yet proved."""

    nodeids: Mapping[Uuid, int]
    unheard: tuple[Uuid, ...]
    in_bootloader: tuple[Uuid, ...]
    duplicates: tuple[Uuid, ...]
    """Uuids with which more than one board answered."""
    strangers: Mapping[Uuid, str] = field(default_factory=dict)
    """Uuids that wait for an id and are not wanted, with their kind."""
    displaced: Mapping[Uuid, int] = field(default_factory=dict)
    """Uuids that are not wanted and had an id that was assigned to a wanted one."""

    def check(self, bus: str) -> None:
        """Raise AssignError when a wanted node cannot be used for certain."""
        for uuid in self.nodeids:
            self.check_node(uuid, bus)

    def check_node(self, uuid: Uuid, bus: str) -> None:
        """Raise AssignError when this node cannot be used for certain."""
        if uuid in self.duplicates:
            raise AssignError(
                f"two boards on bus {bus} have the uuid {uuid} (cloned chips?); take one of them off"
            )
        if uuid in self.in_bootloader:
            raise AssignError(
                f"node {uuid} on bus {bus} is in its bootloader (Katapult) and has no firmware running; "
                "flash it or reset it"
            )

    def not_found(self, uuid: Uuid, bus: str) -> AssignError:
        """Return the error for a node that neither answered a query nor identifies."""
        waiting = ", ".join(f"{stranger} ({kind})" for stranger, kind in self.strangers.items()) or "none"
        return AssignError(
            f"node {uuid} not found on bus {bus}; nodes waiting there: {waiting}; "
            "check its wiring and power, the bus's bit rate, and the uuid"
        )


class IdAssignment:
    """Assigns node ids to the uuids of WANTED. Times are nanoseconds of any one clock.

    Call ``start``, then ``frame`` for each received frame and ``timer`` when ``deadline_ns`` has come; send
    what ``frames_to_send`` returns after each. The assignment is over when ``result`` is not None. With
    nothing WANTED it finds the nodes that wait for an id (``strangers``), until SILENT_ROUNDS rounds found
    no new one.
    """

    def __init__(self, wanted: Mapping[Uuid, int]) -> None:
        self._wanted = dict(wanted)
        self._seen: dict[Uuid, _Seen] = {uuid: _Seen(nodeid) for uuid, nodeid in wanted.items()}
        self._outbox: list[AdminFrame] = []
        self._started_ns = 0
        self._news_ns = 0
        self._rounds = 0
        self._rounds_asking_here = 0
        self._rounds_without_news = 0
        self._displaced: dict[Uuid, int] = {}
        self.deadline_ns: int | None = None
        self.result: Assignment | None = None
        self.ignored_frames = 0

    def start(self, now_ns: int) -> None:
        """Begin the first round."""
        self._started_ns = self._news_ns = now_ns
        self._next_round(now_ns)

    def frames_to_send(self) -> list[AdminFrame]:
        """Return the frames to be sent now; each is returned once."""
        frames, self._outbox = self._outbox, []
        return frames

    def frame(self, can_id: int, data: bytes, now_ns: int) -> None:
        """Handle a received frame; anything but an answer of a node is ignored."""
        if can_id != ADMIN_RESPONSE_ID or len(data) != UUID_SIZE + 2 or self.result is not None:
            self.ignored_frames += can_id == ADMIN_RESPONSE_ID
            return
        uuid = Uuid(data[1 : 1 + UUID_SIZE])
        seen = self._remember(uuid, now_ns) if data[0] in (NEED_NODEID, NODE_IS_HERE) else None
        if seen is None:
            self.ignored_frames += 1
        elif data[0] == NEED_NODEID:
            self._node_waits(seen, data[-1])
        else:
            self._node_is_here(uuid, seen, data[-1])

    def timer(self, now_ns: int) -> None:
        """Close the round if its deadline has come."""
        if self.deadline_ns is None or now_ns < self.deadline_ns:
            return
        for uuid, seen in self._seen.items():
            if seen.nodeid is not None:
                self._close_round(uuid, seen)
        impatient = now_ns - self._news_ns >= PATIENCE_NS or now_ns - self._started_ns >= MAX_NS
        if impatient or self._all_settled():
            self._finish()
        else:
            self._next_round(now_ns)

    # ------------------------------------------------------------------------------------------------ rounds

    def _all_settled(self) -> bool:
        if not self._wanted:
            return self._rounds_without_news >= SILENT_ROUNDS
        return all(seen.settled for seen in self._seen.values() if seen.nodeid is not None)

    def _remember(self, uuid: Uuid, now_ns: int) -> _Seen | None:
        if uuid not in self._seen:
            if len(self._seen) >= len(self._wanted) + MAX_STRANGERS:
                return None
            self._seen[uuid] = _Seen()
        seen = self._seen[uuid]
        if not seen.answers and not seen.here:
            self._news_ns = now_ns
            self._rounds_without_news = -1  # this round does not count
        return seen

    @staticmethod
    def _node_waits(seen: _Seen, set_command: int) -> None:
        seen.answers += 1
        seen.answered_round = seen.needs_id = True
        seen.settled = False
        seen.bootloader = set_command == SET_NODEID_BOOTLOADER

    def _node_is_here(self, uuid: Uuid, seen: _Seen, nodeid: int) -> None:
        seen.here += 1
        if seen.nodeid is not None:
            seen.settled = seen.nodeid == nodeid
            seen.needs_id |= not seen.settled
            return
        for other in self._seen.values():
            if other.nodeid == nodeid:
                # The id is sent once more: the wanted node keeps it, this one drops it and shuts down.
                self._displaced[uuid] = nodeid
                other.needs_id = True

    def _close_round(self, uuid: Uuid, seen: _Seen) -> None:
        """Evaluate the round for a wanted node, and send its id when it does not seem to have it."""
        if seen.answered_round:
            seen.silent_rounds = 0
        else:
            seen.silent_rounds += 1
            if seen.answers and not seen.bootloader and seen.silent_rounds >= SILENT_ROUNDS:
                seen.settled = True
        unheard = not seen.answers and not seen.settled and seen.silent_rounds >= UNHEARD_ROUNDS
        silent = seen.answers and not seen.settled  # it has its id, or the queries got lost
        if seen.nodeid is not None and not seen.bootloader and (seen.needs_id or silent or unheard):
            data = bytes((SET_NODEID, *uuid.raw, seen.nodeid))
            self._outbox.append(AdminFrame(ADMIN_ID, data))

    def _next_round(self, now_ns: int) -> None:
        for seen in self._seen.values():
            seen.answered_round = seen.needs_id = False
        self._rounds += 1
        self._rounds_without_news += 1
        if self._rounds <= ALL_ASKED_ROUNDS or self._rounds % 2:
            self._rounds_asking_here += 1
            self._outbox.append(AdminFrame(ADMIN_ID, bytes((WHO_IS_HERE,))))
        self._outbox.append(AdminFrame(ADMIN_ID, bytes((QUERY_UNASSIGNED,))))
        quiet_ns = ROUND_NS if self._rounds <= QUICK_ROUNDS else SLOW_ROUND_NS
        self.deadline_ns = now_ns + quiet_ns + len(self._seen) * ANSWER_NS

    def _finish(self) -> None:
        wanted = [(uuid, self._seen[uuid]) for uuid in self._wanted]
        self.deadline_ns = None
        self.result = Assignment(
            nodeids=self._wanted,
            unheard=tuple(uuid for uuid, seen in wanted if not seen.settled and not seen.bootloader),
            in_bootloader=tuple(uuid for uuid, seen in wanted if seen.bootloader),
            # A node answers a query at most once, so more answers than queries come from more than one.
            duplicates=tuple(
                uuid
                for uuid, seen in self._seen.items()
                if seen.answers > self._queries_for(seen) or seen.here > self._rounds_asking_here
            ),
            strangers={
                uuid: "in its bootloader" if seen.bootloader else "ready for an id"
                for uuid, seen in self._seen.items()
                if seen.nodeid is None and seen.answers
            },
            displaced=self._displaced,
        )

    def _queries_for(self, seen: _Seen) -> int:
        return self._rounds - seen.silent_rounds if seen.nodeid is not None else self._rounds
