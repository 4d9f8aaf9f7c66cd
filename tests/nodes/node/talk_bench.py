"""A RequestReply, its link, and the twin node at the other end."""

from nodes.node.request_reply import RequestReply
from tests.nodes.twin_bus import TwinIO, TwinLink, TwinNode

BOTH = (("get_config", "config"), ("get_uptime", "uptime"))
"""Questions that go together."""


class TalkBench:
    """TALK with TWIN over LINK, its dictionary known."""

    def __init__(self) -> None:
        self.twin = TwinNode()
        self.talk = RequestReply("mainboard")
        self.link = TwinLink(TwinIO([self.twin]), self.twin, self.talk.receive, lambda _: None)
        self.talk.attach(self.link)
        self.talk.dictionary = self.twin.dictionary

    def id_of(self, response: str) -> bytes:
        """Return the id of RESPONSE as on the wire."""
        return self.twin.dictionary.responses[response].prefix
