"""How a homing move ends when its nodes do not carry out its commands."""

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from coordinator.runtime.moves.homing import HomingMove, MoveEndedError, _Leg
from nodes.devices.trsync import TriggerReason, TrsyncState
from nodes.link import LinkError
from nodes.node.errors import NodeError
from nodes.support.errors import CanductorError

ENDED = TrsyncState(armed=False, reason=TriggerReason.ENDSTOP, clock32=7)


class Sync:
    """A stop group that ends as the test says: in a state, or with an error."""

    def __init__(self, end: TrsyncState | CanductorError) -> None:
        self.end = end
        self.triggered = 0

    def trigger_now(self, _: object) -> None:
        if isinstance(self.end, LinkError):
            raise self.end
        self.triggered += 1

    async def finish(self, _: object) -> TrsyncState:
        if isinstance(self.end, CanductorError):
            raise self.end
        return self.end


def leg_of(*syncs: Sync) -> _Leg:
    """Return the leg of an axis whose nodes n0, n1, … have SYNCS."""
    nodes: list[Any] = [SimpleNamespace(name=f"n{at}", talks=True, failure=None) for at in range(len(syncs))]

    def end(_: object) -> None:
        if isinstance(syncs[0].end, LinkError):
            raise syncs[0].end

    endstop: Any = SimpleNamespace(end=end)
    rail: Any = SimpleNamespace(axis="x")
    groups: Any = list(zip(nodes, syncs, strict=True))
    return _Leg(rail, 0, endstop, nodes[0], (), groups, by_group=False, triggered=asyncio.Event())


def test_it_says_why_it_is_not_known_how_a_node_ended() -> None:
    leg = leg_of(Sync(ENDED), Sync(NodeError("the stop group has not triggered")))
    states = asyncio.run(HomingMove._end(leg))
    assert states == {"n0": ENDED}
    move: Any = SimpleNamespace()
    with pytest.raises(MoveEndedError, match="axis x was not homed: the stop group has not triggered"):
        HomingMove._check(move, leg, states)


def test_a_node_whose_link_is_lost_keeps_no_other_from_being_stopped() -> None:
    """Before the loop is notified, the node still counts as one that takes commands."""
    lost, other = Sync(LinkError("can0 node 4: the link is lost")), Sync(ENDED)
    leg = leg_of(lost, other)
    move: Any = SimpleNamespace(_heard_s={}, _changed=asyncio.Event())
    single: Any = SimpleNamespace(print_time_now=lambda: 1.5)
    hear = HomingMove._hear(move, leg, leg.syncs[1][0], single)
    hear(ENDED)
    assert (leg.triggered_s, other.triggered) == (1.5, 1)
    assert asyncio.run(HomingMove._end(leg)) == {"n1": ENDED}
    assert other.triggered == 2
