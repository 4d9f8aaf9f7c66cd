"""The states of a link: the table, its page, and that the link goes by it."""

from pathlib import Path

import pytest

from nodes.link._link import lib
from tests.nodes.link.twin import ask
from tests.nodes.link.virtual import MS, CoreLink
from tests.nodes.state_pages import LinkEvent, LinkState, following, link_page
from tests.wire_twin import block

ROOT = Path(__file__).parents[3]
START_NS = 1000 * MS
LOST_AFTER_NS = 1000 * MS


def test_the_diagram_of_the_states_is_not_stale() -> None:
    assert (ROOT / "docs" / "link-states.md").read_text() == link_page()


def test_the_words_cover_the_tables_states_and_events() -> None:
    assert [int(state) for state in LinkState] == list(range(lib.LINK_STATES))
    assert [int(event) for event in LinkEvent] == list(range(lib.LINK_EVENTS))


class Asked:
    """A link in PROBING whose empty block was sent."""

    def __init__(self) -> None:
        self.now = START_NS
        self.link = CoreLink(lost_after_ns=LOST_AFTER_NS)
        assert self.link.send(ask(1), now=self.now) == 0
        self.sequence = self.probe()

    def probe(self) -> int:
        """Take the next block, which has to be empty; return its sequence."""
        data = self.link.next_block(self.now).lstrip(b"~")
        assert len(data) == 5
        return data[1] & 15

    def is_in(self, state: LinkState) -> bool:
        return LinkState(self.link.c.state) is state

    def answer(self, sequence: int) -> None:
        self.now += MS
        self.link.receive(block(sequence), self.now)

    def be_silent(self, until_ns: int) -> None:
        while self.now < until_ns:
            self.now += MS
            self.link.handle_timer(self.now)

    def confirming(self) -> None:
        self.answer(9)
        self.sequence = self.probe()
        assert self.sequence == 9, "the one that the node named"


@pytest.mark.parametrize("event", [LinkEvent.TAKEN, LinkEvent.REFUSED])
def test_the_first_answer_is_confirmed(event: LinkEvent) -> None:
    scene = Asked()
    scene.answer(scene.sequence + (1 if event is LinkEvent.TAKEN else 5))
    assert scene.is_in(LinkState.CONFIRMING)
    assert following(LinkState.PROBING, event) is LinkState.CONFIRMING


def test_only_an_answer_behind_the_second_block_confirms() -> None:
    scene = Asked()
    scene.confirming()
    scene.answer(9)
    assert scene.is_in(LinkState.CONFIRMING), "a further answer to the first block"
    scene.answer(12)
    assert scene.is_in(LinkState.CONFIRMING)
    assert following(LinkState.CONFIRMING, LinkEvent.REFUSED) is LinkState.CONFIRMING
    assert scene.probe() == 12, "asked again, with the sequence that was named last"
    scene.answer(13)
    assert scene.is_in(LinkState.RUNNING)
    assert following(LinkState.CONFIRMING, LinkEvent.TAKEN) is LinkState.RUNNING
    data = scene.link.next_block(scene.now).lstrip(b"~")
    assert (data[1] & 15, data[2:-3]) == (13, ask(1))


@pytest.mark.parametrize("state", [LinkState.PROBING, LinkState.CONFIRMING, LinkState.RUNNING])
def test_silence_ends_every_state(state: LinkState) -> None:
    scene = Asked()
    if state is not LinkState.PROBING:
        scene.confirming()
    if state is LinkState.RUNNING:
        scene.answer(10)
        scene.link.next_block(scene.now)
    assert scene.is_in(state)
    # First contact as a whole has that time, whatever is answered meanwhile.
    since_ns = scene.now if state is LinkState.RUNNING else START_NS
    scene.be_silent(since_ns + LOST_AFTER_NS - MS)
    assert scene.is_in(state)
    scene.be_silent(since_ns + LOST_AFTER_NS)
    assert scene.is_in(LinkState.LOST)
    assert following(state, LinkEvent.SILENCE) is LinkState.LOST


def test_a_lost_link_stays_lost() -> None:
    assert {following(LinkState.LOST, event) for event in LinkEvent} == {LinkState.LOST}
    scene = Asked()
    scene.be_silent(START_NS + LOST_AFTER_NS)
    for sequence in (scene.sequence, scene.sequence + 1, 9):
        scene.answer(sequence)
        assert scene.is_in(LinkState.LOST)
    assert scene.link.send(ask(2), now=scene.now) == lib.LINK_GONE
