"""Who is on a bus: the two questions that everybody may ask, repeated, and their answers merged. Sans-IO.

A round asks WHO_IS_HERE (of our firmware, nodes with an id answer) and then QUERY_UNASSIGNED (all nodes
without one answer). Neither changes anything in a node. One round is not enough: answers have the same CAN
id, so two that begin in the same bit time destroy each other, and frames get lost.

Two boards with one uuid show by answering more often than they were asked. Boards that answer at the very
same moment send the very same bits and look like one: firmware without a random wait hides its twin.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from canbus_tools.bus.talk import DATA_IDS
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
"""Nodes answer within milliseconds; adapters on USB may hold frames back for 16 ms."""
LATE_NS: Final = 75_000_000
"""How much longer a round may take when nobody answers, or fewer than before: on a busy computer all take
their time."""
QUIET_ROUNDS: Final = 3
"""It goes on until so many rounds brought nobody new …"""
ROUNDS_MAX: Final = 200
"""… but ends even if new ones appear for ever."""
MAX_UUIDS: Final = 512
"""Remembered; a bus has at most 252 ids to give."""


class Application(Enum):
    """What runs on a board, as far as it says."""

    KLIPPER = "klipper-type"
    """Firmware that speaks the protocol; ours too, as long as it has no id: then they answer alike."""
    CANDUCTOR = "canductor"
    """This project's firmware."""
    KATAPULT = "katapult"
    """Only its bootloader."""
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
    """Who answered, in the order of uuids and ids, and what else was heard."""

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
    """How often it had an id after it had none, or the other way round; one board may do that once, as
    another host gives it its id, or resets it."""

    def says(self, what: int) -> None:
        self.changes += self.last not in (0, what)
        self.last = what


class NodeDiscovery:
    """Asks ROUNDS times or more. Times are nanoseconds of any one clock.

    Call ``start``, then ``frame`` for what arrives and ``timer`` when ``deadline_ns`` has come; send what
    ``frames_to_send`` returns after each; it is over when ``deadline_ns`` is None.
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
        """Answers that make no sense, or of more boards than can be remembered."""
        self.deadline_ns: int | None = None

    def start(self, now_ns: int) -> None:
        """Begin the first round."""
        self._next_round(now_ns)

    def frames_to_send(self) -> list[AdminFrame]:
        """Return what is to be sent now, once."""
        frames, self._outbox = self._outbox, []
        return frames

    def frame(self, can_id: int, data: bytes) -> None:
        """Take a received frame, whatever it is."""
        if can_id == ADMIN_RESPONSE_ID:
            self._answer(data)
        elif can_id == ADMIN_ID:
            # Another host asks too: the nodes answer both.
            if data[:1] and data[0] in self._asked:
                self._asked[data[0]] += 1
        elif can_id in DATA_IDS:
            (self._talking if can_id % 2 else self._hosted).add((can_id - 0x100) // 2)
        else:
            self._foreign_frames += 1

    def timer(self, now_ns: int) -> None:
        """Take the time; begins the next round, or ends, when the deadline has come."""
        if self.deadline_ns is None or now_ns < self.deadline_ns:
            return
        if self._answers < self._answers_max and now_ns < self._latest_ns:
            self.deadline_ns = min(now_ns + ROUND_NS, self._latest_ns)
            return
        enough = self._rounds >= self._rounds_min and self._quiet_rounds >= QUIET_ROUNDS
        if enough or self._rounds >= max(ROUNDS_MAX, self._rounds_min):
            self.deadline_ns = None
        else:
            self._next_round(now_ns)

    def result(self) -> DiscoveredNodes:
        """Return what is known so far."""
        # A board that was given its id meanwhile, or lost it, is what it said last; of twins all is told.
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

    def _next_round(self, now_ns: int) -> None:
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
        """Tell whether more than one board was heard: one answers each question once, and has one id."""
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
