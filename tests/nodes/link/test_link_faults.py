"""One conversation of some forty blocks, and every fault at every one of its blocks, in both directions."""

import random
from collections.abc import Iterable

import pytest

from tests.nodes.link.damages import DAMAGES
from tests.nodes.link.twin import NodeTwin, WindowObserver, answer, ask, store
from tests.nodes.link.virtual import MS, TO_HOST, TO_NODE, CoreLink, Delivery, Fault, Line, no_fault
from tests.profiles import examples

COUNT = 52
COMMANDS = [store(i, 44) if i % 4 else ask(i) for i in range(COUNT)]
ASKED = [answer(i) for i in range(0, COUNT, 4)]


def converse(fault: Fault, expected: int = 5, block_ns: int = 0) -> Line:
    """Hold the whole conversation and check that everything was executed once, in order."""
    line = Line(CoreLink(), NodeTwin(expected), fault, block_ns=block_ns, observer=WindowObserver())
    for command in COMMANDS:
        assert line.link.send(command) == 0
    line.run()
    assert not line.link.lost
    assert line.node.executed == COMMANDS
    asked = [content for content, _ in line.responses]
    assert all(content in ASKED for content in asked)
    assert line.node.overflows == 0
    return line


CLEAN = converse(no_fault)
CLEAN_NS = CLEAN.now - 1000 * MS


def test_the_clean_conversation_is_what_the_faults_assume() -> None:
    assert 2 * 16 + 5 < CLEAN.counts[TO_NODE] <= 50, "block numbers, of 4 bits, wrap twice"
    assert [content for content, _ in CLEAN.responses] == ASKED
    assert CLEAN.link.stats.blocks_repeated == CLEAN.link.stats.naks == CLEAN.link.stats.timeouts == 0
    assert CLEAN.observer is not None
    assert CLEAN.observer.most_bytes > 128


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("direction", [TO_NODE, TO_HOST])
def test_one_fault_anywhere(direction: int, damage: str) -> None:
    for index in range(CLEAN.counts[direction]):

        def fault(way: int, at: int, data: bytes, index: int = index) -> Iterable[Delivery]:
            return DAMAGES[damage](data) if (way, at) == (direction, index) else [(0, data)]

        line = converse(fault)
        # One first timeout of 100 ms, one delay of 150 ms, and a second timeout are the worst of it.
        assert line.now - 1000 * MS <= CLEAN_NS + 420 * MS, f"index {index}"
        if direction == TO_NODE:
            assert [content for content, _ in line.responses] == ASKED, f"index {index}"


@pytest.mark.parametrize("seed", range(examples(80)))
def test_two_faults_anywhere(seed: int) -> None:
    chance = random.Random(seed)
    places = {
        (way, chance.randrange(CLEAN.counts[way])): DAMAGES[chance.choice(list(DAMAGES))]
        for way in (chance.randrange(2), chance.randrange(2))
    }

    def fault(way: int, at: int, data: bytes) -> Iterable[Delivery]:
        return places[way, at](data) if (way, at) in places else [(0, data)]

    line = converse(fault, expected=seed % 16)
    assert line.now - 1000 * MS <= CLEAN_NS + 840 * MS


@pytest.mark.parametrize("seed", range(examples(20)))
def test_a_bad_line_all_the_time(seed: int) -> None:
    chance = random.Random(seed)

    def fault(way: int, at: int, data: bytes) -> Iterable[Delivery]:
        return chance.choice(list(DAMAGES.values()))(data) if chance.random() < 0.15 else [(0, data)]

    line = converse(fault, expected=seed % 16)
    assert line.now - 1000 * MS <= 20_000 * MS


@pytest.mark.parametrize("direction", [TO_NODE, TO_HOST])
def test_repeats_do_not_cause_repeats(direction: int) -> None:
    """Needless repeats are each refused by the node; taken for naks, the refusals would go on for ever."""

    def fault(way: int, at: int, data: bytes) -> Iterable[Delivery]:
        return [(25 * MS if (way, at) == (direction, 12) else 0, data)]

    line = converse(fault, block_ns=MS // 2)
    assert line.link.stats.timeouts == 1
    assert 1 <= line.link.stats.blocks_repeated <= 6
