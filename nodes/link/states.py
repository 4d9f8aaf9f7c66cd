"""The life cycle of a link as text and diagram, from the table in link_states.c.

docs/link-states.md is generated from it: ``python -m nodes.link.states > docs/link-states.md``.
"""

import sys
from enum import IntEnum
from typing import Final

from nodes.link._link import lib


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
    """Return the state after EVENT in STATE."""
    return LinkState(lib.link_following(state, event))


def page() -> str:
    """Return docs/link-states.md."""
    states = "\n".join(f"* **{state.name}**: {words}" for state, words in STATE_WORDS.items())
    arrows = "\n".join(
        f"    {state.name} --> {after.name}: {words}"
        for state in LinkState
        for event, words in EVENT_WORDS.items()
        if (after := following(state, event)) is not state or state is LinkState.CONFIRMING
    )
    return (
        "# The life of a link\n\n"
        "Generated from `nodes/link/link_states.c` by `python -m nodes.link.states`; "
        "a test fails when stale.\n\n"
        f"{states}\n\n```mermaid\nstateDiagram-v2\n    [*] --> PROBING\n{arrows}\n    LOST --> [*]\n```\n"
    )


if __name__ == "__main__":
    sys.stdout.write(page())
