"""Discovery of nodes: repeats the two broadcast queries and merges their answers. Sans-IO.

A round sends WHO_IS_HERE (answered by nodes with our firmware and an id) and then QUERY_UNASSIGNED (answered
by all nodes without an id). Neither changes anything in a node. One round is not enough: answers have the
same CAN id, so two that begin in the same bit time destroy each other, and frames get lost.

Two boards with one uuid are detected as they answer more often than they were queried. Boards that answer at
the same moment send the same bits and look like one, if their firmware does not wait for a random time.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from canbus_tools.protocol.protocol import Direction, owner_of
from nodes.bus.assign import ANSWER_NS, AdminFrame, Uuid
from nodes.support.can_protocol import (
    ADMIN_ID,
    ADMIN_RESPONSE_ID,
    NEED_NODEID,
    NODE_IS_HERE,
    QUERY_UNASSIGNED,
    SET_NODEID,
    SET_NODEID_BOOTLOADER,
    UUID_SIZE,
    WHO_IS_HERE,
)

ROUNDS: Final = 5
ROUND_NS: Final = 40_000_000
"""Nodes answer within milliseconds; adapters on USB may delay frames by 16 ms."""
LATE_NS: Final = 75_000_000
"""Extension of a round without answers, or with fewer than before, for the case of a busy computer."""
QUIET_ROUNDS: Final = 3
"""Number of rounds without a new node after which discovery ends."""
ROUNDS_MAX: Final = 200
"""Number of rounds after which it ends even if new nodes keep appearing."""
MAX_UUIDS: Final = 512
"""Most uuids remembered; a bus has 252 ids to assign."""


class Application(Enum):
    """Software on a board, as far as it reports it."""

    KLIPPER = "klipper-type"
    """Firmware with this protocol; includes ours while it has no id, as both then answer alike."""
    CANDUCTOR = "canductor"
    """This project's firmware."""
    KATAPULT = "katapult"
    """The bootloader."""
    UNKNOWN = "unknown"


SET_COMMANDS: Final[Mapping[int, Application]] = {
    SET_NODEID: Application.KLIPPER,
    SET_NODEID_BOOTLOADER: Application.KATAPULT,
}


@dataclass(frozen=True, slots=True)
class WaitingNode:
    """A node that waits for an id."""

    uuid: Uuid
    application: Application
    set_command: int
    answers: int
    """In how many answers it was heard."""
    twins: bool
    """More than one board has this uuid."""


@dataclass(frozen=True, slots=True)
class NodeHere:
    """A node of our firmware that has an id."""

    uuid: Uuid
    nodeid: int
    answers: int
    twins: bool


@dataclass(frozen=True, slots=True)
class DiscoveredNodes:
    """The nodes that answered, ordered by uuid or id, and other traffic."""

    waiting: tuple[WaitingNode, ...]
    here: tuple[NodeHere, ...]
    rounds: int
    hosted: frozenset[int]
    """Node ids to which another host sent something."""
    talking: frozenset[int]
    """Node ids from which something came."""
    foreign_frames: int
    """Frames of other protocols."""

    @property
    def twins(self) -> tuple[Uuid, ...]:
        """Uuids that more than one board has."""
        nodes: list[WaitingNode | NodeHere] = [*self.waiting, *self.here]
        return tuple(dict.fromkeys(node.uuid for node in nodes if node.twins))


@dataclass(slots=True)
class _Heard:
    answers: int = 0
    set_commands: set[int] = field(default_factory=set)
    here: dict[int, int] = field(default_factory=dict)
    """Answers to WHO_IS_HERE by node id."""
    last: int = 0
    changes: int = 0
    """Number of changes between having an id and having none; one board may change once, as another host
    assigns its id or resets it."""

    def says(self, what: int) -> None:
        self.changes += self.last not in (0, what)
        self.last = what


class NodeDiscovery:
    """Discovery in at least ROUNDS rounds. Times are nanoseconds of any one clock.

    Call ``start``, then ``frame`` for every received frame and ``timer`` at ``deadline_ns``; send the
    ``frames_to_send`` after each call; it ends when ``deadline_ns`` is None.
    """

    def __init__(self, rounds: int = ROUNDS) -> None:
        self._rounds_min = rounds
        self._heard: dict[Uuid, _Heard] = {}
        self._outbox: list[AdminFrame] = []
        self._rounds = 0
        self._quiet_rounds = 0
        self._answers = 0
        self._answers_max = 1
        self._latest_ns = 0
        self._asked = {QUERY_UNASSIGNED: 0, WHO_IS_HERE: 0}
        self._hosted: set[int] = set()
        self._talking: set[int] = set()
        self._foreign_frames = 0
        self.ignored = 0
        """Number of invalid answers, or of answers from boards beyond MAX_UUIDS."""
        self.deadline_ns: int | None = None

    def frames_to_send(self) -> list[AdminFrame]:
        """Return the frames to be sent now, once."""
        frames, self._outbox = self._outbox, []
        return frames

    def frame(self, can_id: int, data: bytes) -> None:
        """Take any received frame."""
        if can_id == ADMIN_RESPONSE_ID:
            self._answer(data)
        elif can_id == ADMIN_ID:
            # A query of another host: nodes answer both.
            if data[:1] and data[0] in self._asked:
                self._asked[data[0]] += 1
        elif owner := owner_of(can_id):
            (self._hosted if owner[1] is Direction.TO_NODE else self._talking).add(owner[0])
        else:
            self._foreign_frames += 1

    def timer(self, now_ns: int) -> None:
        """Start the next round, or end, if the deadline has come."""
        if self.deadline_ns is None or now_ns < self.deadline_ns:
            return
        if self._answers < self._answers_max and now_ns < self._latest_ns:
            self.deadline_ns = min(now_ns + ROUND_NS, self._latest_ns)
            return
        enough = self._rounds >= self._rounds_min and self._quiet_rounds >= QUIET_ROUNDS
        if enough or self._rounds >= max(ROUNDS_MAX, self._rounds_min):
            self.deadline_ns = None
        else:
            self.start(now_ns)

    def result(self) -> DiscoveredNodes:
        """Return the nodes found so far."""
        # The last answer of a board counts, as ids are assigned and lost; of twins all answers count.
        waiting = [
            self._waiting(uuid, heard)
            for uuid, heard in self._heard.items()
            if heard.answers and (heard.last == NEED_NODEID or self._has_twin(heard))
        ]
        here = [
            NodeHere(uuid, nodeid, answers, self._has_twin(heard))
            for uuid, heard in self._heard.items()
            for nodeid, answers in heard.here.items()
            if heard.last == NODE_IS_HERE or self._has_twin(heard)
        ]
        return DiscoveredNodes(
            waiting=tuple(sorted(waiting, key=lambda node: node.uuid.raw)),
            here=tuple(sorted(here, key=lambda node: (node.nodeid, node.uuid.raw))),
            rounds=self._rounds,
            hosted=frozenset(self._hosted),
            talking=frozenset(self._talking),
            foreign_frames=self._foreign_frames,
        )

    # ----------------------------------------------------------------------------------------------- inside

    def start(self, now_ns: int) -> None:
        """Start a round."""
        self._rounds += 1
        self._quiet_rounds += 1
        for question in (WHO_IS_HERE, QUERY_UNASSIGNED):
            self._asked[question] += 1
            self._outbox.append(AdminFrame(ADMIN_ID, bytes((question,))))
        self._answers_max = max(self._answers_max, self._answers)
        self._answers = 0
        self.deadline_ns = now_ns + ROUND_NS + len(self._heard) * ANSWER_NS
        self._latest_ns = self.deadline_ns + LATE_NS

    def _answer(self, data: bytes) -> None:
        if len(data) != UUID_SIZE + 2 or data[0] not in (NEED_NODEID, NODE_IS_HERE):
            self.ignored += 1
            return
        uuid = Uuid(data[1 : 1 + UUID_SIZE])
        if uuid not in self._heard:
            if len(self._heard) >= MAX_UUIDS:
                self.ignored += 1
                return
            self._heard[uuid] = _Heard()
            self._quiet_rounds = 0
        heard = self._heard[uuid]
        heard.says(data[0])
        self._answers += 1
        if data[0] == NEED_NODEID:
            heard.answers += 1
            heard.set_commands.add(data[-1])
        else:
            heard.here[data[-1]] = heard.here.get(data[-1], 0) + 1

    def _has_twin(self, heard: _Heard) -> bool:
        """Return whether more than one board was heard: one answers each query once, and has one id."""
        return (
            heard.answers > self._asked[QUERY_UNASSIGNED]
            or sum(heard.here.values()) > self._asked[WHO_IS_HERE]
            or len(heard.here) > 1
            or len(heard.set_commands) > 1
            or heard.changes > 1
        )

    def _waiting(self, uuid: Uuid, heard: _Heard) -> WaitingNode:
        command = min(heard.set_commands)
        application = SET_COMMANDS.get(command, Application.UNKNOWN)
        return WaitingNode(uuid, application, command, heard.answers, self._has_twin(heard))
