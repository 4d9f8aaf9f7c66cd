"""The pages docs/link-states.md and docs/node-states.md, from the tables that the product follows.

``python -m tests.nodes.state_pages`` writes both.
"""

from collections.abc import Iterable
from enum import IntEnum
from pathlib import Path
from typing import Final

from nodes.link._link import lib
from nodes.node.states import TRANSITIONS, NodeState

DOCS: Final = Path(__file__).parents[2] / "docs"


class LinkState(IntEnum):
    """``enum link_state``."""

    PROBING = lib.LINK_PROBING
    CONFIRMING = lib.LINK_CONFIRMING
    RUNNING = lib.LINK_RUNNING
    LOST = lib.LINK_LOST


class LinkEvent(IntEnum):
    """``enum link_event``."""

    TAKEN = lib.LINK_EVENT_TAKEN
    REFUSED = lib.LINK_EVENT_REFUSED
    SILENCE = lib.LINK_EVENT_SILENCE


STATE_WORDS: Final = {
    LinkState.PROBING: "the sequence that the node expects is unknown; an empty block asks for it",
    LinkState.CONFIRMING: "the node has reported it; a second empty block checks that it is still valid",
    LinkState.RUNNING: "commands are sent, acknowledged and repeated",
    LinkState.LOST: "given up permanently: a new link has to be opened",
}
EVENT_WORDS: Final = {
    LinkEvent.TAKEN: "an answer acknowledges the empty block",
    LinkEvent.REFUSED: "an answer reports another sequence",
    LinkEvent.SILENCE: "no acknowledgement for lost_after_s",
}


def following(state: LinkState, event: LinkEvent) -> LinkState:
    """Return the state of a link after EVENT in STATE."""
    return LinkState(lib.link_following(state, event))


def link_page() -> str:
    """Return docs/link-states.md."""
    arrows = (
        f"{state.name} --> {after.name}: {words}"
        for state in LinkState
        for event, words in EVENT_WORDS.items()
        if (after := following(state, event)) is not state or state is LinkState.CONFIRMING
    )
    states = (f"* **{state.name}**: {words}" for state, words in STATE_WORDS.items())
    return _page(
        "link", "nodes/link/core/link_states.c", states=states, arrows=arrows, first="PROBING", last="LOST"
    )


def node_page() -> str:
    """Return docs/node-states.md."""
    arrows = (
        f"{before.name} --> {after.name}: {event.value}" for (before, event), after in TRANSITIONS.items()
    )
    states = (f"* **{state.name}**: {state.value}" for state in NodeState)
    return _page(
        "node", "nodes/node/states.py", states=states, arrows=arrows, first="CONNECTING", last="CLOSED"
    )


def _page(
    subject: str, source: str, *, states: Iterable[str], arrows: Iterable[str], first: str, last: str
) -> str:
    shown = "".join(f"    {arrow}\n" for arrow in (f"[*] --> {first}", *arrows, f"{last} --> [*]"))
    return (
        f"# The life of a {subject}\n\n"
        f"Generated from `{source}` by `python -m tests.nodes.state_pages`; a test fails when stale.\n\n"
        + "\n".join(states)
        + f"\n\n```mermaid\nstateDiagram-v2\n{shown}```\n"
    )


if __name__ == "__main__":
    (DOCS / "link-states.md").write_text(link_page())
    (DOCS / "node-states.md").write_text(node_page())
