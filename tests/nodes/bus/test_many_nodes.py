"""Sixty-four nodes on two buses: how long until all are ready, and what that costs on the wire."""

import asyncio
from dataclasses import dataclass, field

from nodes.bus.can_bus import CanBus
from nodes.dictionary.cache import DictionaryCache
from nodes.node.states import NodeState
from tests.nodes import virtual_time
from tests.nodes.machine import make_config, stepper_x, uuid
from tests.nodes.twin_bus import TwinIO, TwinNode

CLOCK_S = 2.0
"""A node's clock is watched for so long before it is ready."""


@dataclass
class Start:
    """What one start of two buses with half of the nodes each took."""

    took_s: float = 0.0
    identify_queries: int = 0
    twins: list[TwinNode] = field(default_factory=list)


def start(cache: DictionaryCache, count: int = 64, *, loss: float = 0.0) -> Start:
    result = Start()
    result.twins = [TwinNode(uuid(n), ppm=n - 32) for n in range(count)]
    buses = [CanBus(f"can{i}", TwinIO(result.twins[i::2], loss=loss, seed=i), cache=cache) for i in (0, 1)]
    for i, bus in enumerate(buses):
        for n in range(i, count, 2):
            bus.add_node(f"node{n}", uuid(n), make_config(stepper_x()))

    async def main() -> None:
        began_s = asyncio.get_running_loop().time()
        async with asyncio.TaskGroup() as group:
            for bus in buses:
                group.create_task(bus.start())
        result.took_s = asyncio.get_running_loop().time() - began_s
        assert all(node.state is NodeState.READY for bus in buses for node in bus.nodes)
        for bus in buses:
            await bus.close()

    virtual_time.run(main())
    assert sorted(twin.nodeid for twin in result.twins) == sorted([*range(4, 4 + count // 2)] * 2)
    result.identify_queries = sum(
        line.startswith("identify") for twin in result.twins for line in twin.executed
    )
    return result


def test_all_are_ready_soon_after_their_clocks_can_be_and_download_one_dictionary() -> None:
    cache = DictionaryCache()
    first, second = start(cache), start(cache, 16)
    pieces = -(-len(first.twins[0].compressed) // 40) + 1
    assert first.identify_queries == pieces + 63 * 3
    assert second.identify_queries == 16 * 3
    # The rest: rounds of id assignment of some 37 ms each, three pieces, the configuration.
    assert second.took_s < CLOCK_S + 0.4
    assert first.took_s < CLOCK_S + 0.5


def test_frames_that_get_lost_delay_it_a_little() -> None:
    assert start(DictionaryCache(), 24, loss=0.03).took_s < CLOCK_S + 2.5
