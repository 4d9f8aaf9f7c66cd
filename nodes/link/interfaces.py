"""Interfaces of the link as nodes need them; a simulation or a test may implement them instead.

``nodes.link`` implements all of them; its classes are documented there.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from nodes.link.types import BusLoad, Forecast, Frame, IOStats, LinkSettings, Response

OnResponses = Callable[[Sequence[Response]], None]
OnLost = Callable[[str], None]
OnFrame = Callable[[Frame], None]


class LinkInterface(Protocol):
    """The reliable connection to one node. Callbacks run on the control loop."""

    on_silent: Callable[[], None]

    def send(  # noqa: D102
        self, content: bytes, *, min_clock: int = 0, req_clock: int = 0, bulk: bool = False
    ) -> None: ...
    def send_batch(self, buffer: bytes, /) -> None: ...  # noqa: D102
    def send_urgent(self, content: bytes) -> None: ...  # noqa: D102
    def set_receive_window(self, size: int, /) -> None: ...  # noqa: D102
    def set_clock(self, freq_hz: float, at_ns: int, at_ticks: int) -> None: ...  # noqa: D102
    def let_wait(self, message_id: bytes, seconds: float, together: int = 0, /) -> None: ...  # noqa: D102
    def hurry(self, *, hurry: bool) -> None: ...  # noqa: D102
    def take(self) -> None: ...  # noqa: D102
    async def drained(self) -> None: ...  # noqa: D102
    def stats(self) -> Any: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


class LinkIoInterface(Protocol):
    """All links over one transport."""

    def open_link(  # noqa: D102
        self, settings: LinkSettings, *, on_responses: OnResponses, on_lost: OnLost
    ) -> LinkInterface: ...
    def send_frame(self, can_id: int, data: bytes) -> None: ...  # noqa: D102
    def learn_bitrate(self, bitrate: int) -> None: ...  # noqa: D102
    def forecast(self) -> Forecast: ...  # noqa: D102
    def stats(self) -> IOStats: ...  # noqa: D102
    def load(self) -> BusLoad: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


class IoFactory(Protocol):
    """Starts the I/O of a bus; on_frame is None on a UART."""

    def __call__(self, *, on_frame: OnFrame | None, on_closed: OnLost) -> LinkIoInterface: ...  # noqa: D102
