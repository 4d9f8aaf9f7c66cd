"""One node's link, as Python uses it."""

import asyncio
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from nodes.link.handle import BusHandle
from nodes.link.interfaces import OnLost, OnResponses
from nodes.link.types import Flow, LinkError, LinkSettings, LinkStats
from nodes.support.c_structs import from_struct

if TYPE_CHECKING:
    from typing_extensions import Buffer  # comes with mypy

_S_PER_NS = 1e-9


class Link:
    """One node's link: commands in, in order and reliably; responses out. Made by LinkIO.open_link()."""

    def __init__(
        self,
        bus: BusHandle,
        number: int,
        settings: LinkSettings,
        *,
        on_responses: OnResponses,
        on_lost: OnLost,
        on_close: Callable[[int], object],
        take: Callable[[], None],
    ) -> None:
        self._on_close = on_close
        self.take = take
        """Hands over at once what has arrived on the bus, as much as in a turn of the loop."""
        self._bus = bus
        self._lib, self._ffi = bus.lib, bus.ffi
        self._number = number
        self._settings = settings
        self.on_responses = on_responses
        """Gets what arrives."""
        self._on_lost = on_lost
        self._name = bus.name if settings.nodeid is None else f"{bus.name} node {settings.nodeid}"
        self.on_silent: Callable[[], None] = _ignore
        """Called on the control loop when the node owes an acknowledgement and nothing has come from it for
        LINK_SILENCE_MS, and again after as long."""
        self._failed: str | None = None
        self._drained: asyncio.Future[None] | None = None
        self._final: LinkStats | None = None
        """The last counters, once it is closed."""

    @property
    def name(self) -> str:
        """Name in messages to the user: transport and node id."""
        return self._name

    def send(self, content: bytes, *, min_clock: int = 0, req_clock: int = 0, bulk: bool = False) -> None:
        """Queue one encoded command: in order within its class, not before MIN_CLOCK (node ticks).

        A control command is sent within milliseconds, BULK data when motion and control leave room for it.
        Raises LinkError when the queue is full, the command is too long, or the link is closed or lost.
        """
        kind = self._lib.LINK_BULK if bulk else self._lib.LINK_CONTROL
        status = self._lib.io_send(
            self._live(), self._number, kind, content, len(content), min_clock, req_clock
        )
        if status != self._lib.IO_OK:
            self._check_command(status, len(content), "bulk" if bulk else "control")

    def send_batch(self, batch: "Buffer") -> None:
        """Queue the motion commands of a batch (format: batch.h), all or none; raises LinkError as send()."""
        with memoryview(batch) as view:
            size = view.nbytes
            status = self._lib.io_send_batch(self._live(), self._number, self._ffi.from_buffer(view), size)
        if status == self._lib.IO_FULL:
            free = self._lib.IO_MOTION_BYTES - self.stats().motion_bytes
            raise LinkError(
                f"{self._name}: a batch of {size} bytes does not fit into the motion queue "
                f"({free} of {self._lib.IO_MOTION_BYTES} free); send less ahead, or wait for drained()"
            )
        if status == self._lib.IO_INVALID:
            raise LinkError(
                f"{self._name}: a batch of {size} bytes ends within a record, or has a bad command"
            )
        self._check(status)

    def send_urgent(self, content: bytes) -> None:
        """Drop everything that is queued but unsent and send CONTENT next; raises LinkError as send().

        From any thread: an emergency stop does not wait for the loop.
        """
        with self._bus.lock:
            status = self._lib.io_send_urgent(
                self._live(), self._number, self._ffi.from_buffer(content), len(content)
            )
        self._check_command(status, len(content))

    def set_receive_window(self, size: int) -> None:
        """Bound the unacknowledged bytes to SIZE, at least 64; LinkError below."""
        if size < self._lib.LINK_WINDOW_MIN:
            raise LinkError(f"{self._name}: a receive window of {size} bytes cannot hold a block (64)")
        self._check(self._lib.io_set_receive_window(self._live(), self._number, size))

    def set_clock(self, freq_hz: float, at_ns: int, at_ticks: int) -> None:
        """Set the node's clock: it reads AT_TICKS (64 bits) at host time AT_NS and runs at FREQ_HZ (> 0)."""
        if not (math.isfinite(freq_hz) and freq_hz > 0 and at_ns >= 0 and at_ticks >= 0):
            raise LinkError(
                f"{self._name}: not a clock: {freq_hz} Hz at {at_ns} ns, {at_ticks} ticks; estimate it again"
            )
        self._check(self._lib.io_set_clock(self._live(), self._number, freq_hz, at_ns, at_ticks))

    def let_wait(self, message_id: bytes, seconds: float, together: int = 0) -> None:
        """From now on let responses with MESSAGE_ID (as on the wire) wait for others, up to SECONDS; 0: not.

        What may wait wakes the loop only when it has waited, or when TOGETHER of them are there (0: not for
        their number). Raises LinkError when too many may.
        """
        content, wait_ns = self._ffi.from_buffer(message_id), round(seconds * 1e9)
        status = self._lib.io_let_wait(
            self._live(), self._number, content, len(message_id), wait_ns, together
        )
        if status in (self._lib.IO_FULL, self._lib.IO_INVALID):
            raise LinkError(f"{self._name}: no room to let responses with the id {message_id.hex()} wait")
        self._check(status)

    def hurry(self, *, hurry: bool) -> None:
        """Let no response wait while HURRY; raises LinkError."""
        self._check(self._lib.io_hurry(self._live(), self._number, hurry))

    def pending(self) -> int:
        """Return how many commands are not yet acknowledged, queued ones included."""
        return self._final.pending if self._final else int(self._raw_stats().pending)

    async def drained(self) -> None:
        """Wait until nothing is pending; raises LinkError when the link is lost or closed meanwhile."""
        if self._drained is None:
            self._check(self._lib.io_watch_drained(self._live(), self._number))
            self._drained = asyncio.get_running_loop().create_future()
        await asyncio.shield(self._drained)

    def stats(self) -> LinkStats:
        """Return the counters so far; after close(), the last ones."""
        if self._final:
            return self._final
        return _convert(self._raw_stats(), self._lib)

    def close(self) -> None:
        """Forget the link; what is queued is dropped. Further calls do nothing."""
        if self._final:
            return
        self._final = self.stats()
        self._fail(f"{self._name}: the link was closed by this program")
        self._lib.io_close_link(self._bus.live(), self._number)
        self._on_close(self._number)

    # ------------------------------------------------------------------------- called by LinkIO

    def handle_drained(self) -> None:
        """Wake the tasks that wait in drained()."""
        if self._drained:
            self._drained.set_result(None)  # it is shielded, so it was not cancelled
            self._drained = None

    def handle_lost(self, cause: int) -> None:
        """Notify the user, once, that the node no longer acknowledges."""
        heard = (
            "answers, but accepts nothing"
            if cause == self._lib.LINK_CAUSE_STUCK
            else "does not answer at all"
        )
        silence_s = self._settings.lost_after_s
        text = (
            f"{self._name}: lost, no acknowledgement for {silence_s:g} s, the node {heard}; "
            "check its power, cable and termination, and whether its firmware runs"
        )
        self._fail(text)
        self._on_lost(text)

    def handle_ended(self, text: str) -> None:
        """Record that the transport is gone; LinkIO's on_closed notifies the user."""
        self._fail(text)

    # ----------------------------------------------------------------------------------- inside

    def _live(self) -> Any:
        if self._failed:
            raise LinkError(self._failed)
        return self._bus.live()

    def _raw_stats(self) -> Any:
        raw = self._ffi.new("struct io_link_stats *")
        self._check(self._lib.io_get_link_stats(self._bus.live(), self._number, raw))
        return raw

    def _fail(self, text: str) -> None:
        self._failed = self._failed or text
        if self._drained:
            self._drained.set_exception(LinkError(text))
            self._drained.exception()  # there may be no waiter
            self._drained = None

    def _check(self, status: int) -> None:
        if status == self._lib.IO_GONE:
            raise LinkError(f"{self._name}: the link is lost; open it again when the node is back")
        self._bus.check(status, self._name)

    def _check_command(self, status: int, size: int, queue: str = "control") -> None:
        if status == self._lib.IO_FULL:
            limit = self._lib.IO_BULK_BYTES if queue == "bulk" else self._lib.IO_CONTROL_BYTES
            raise LinkError(
                f"{self._name}: the {queue} queue ({limit} bytes) is full; "
                "wait until drained() before sending more"
            )
        if status == self._lib.IO_INVALID:
            raise LinkError(
                f"{self._name}: a command of {size} bytes; "
                f"a block holds 1..{self._lib.WIRE_CONTENT_MAX} bytes"
            )
        self._check(status)


def _ignore() -> None:
    """Do nothing."""


def _flow(raw: Any) -> Flow:
    return from_struct(Flow, raw)


def _convert(raw: Any, lib: Any) -> LinkStats:
    link = raw.link
    depths: dict[str, int] = {}
    for kind, number in (("control", lib.LINK_CONTROL), ("motion", lib.LINK_MOTION), ("bulk", lib.LINK_BULK)):
        depth = raw.queues[number]
        depths |= {
            f"{kind}_commands": depth.commands,
            f"{kind}_commands_max": depth.commands_max,
            f"{kind}_bytes": depth.bytes,
            f"{kind}_bytes_max": depth.bytes_max,
        }
    return from_struct(
        LinkStats,
        link,
        pending=raw.pending,
        in_flight_bytes=raw.in_flight_bytes,
        in_flight_blocks=raw.in_flight_blocks,
        **depths,
        srtt_s=link.srtt_ns * _S_PER_NS,
        rttvar_s=link.rttvar_ns * _S_PER_NS,
        rto_s=link.rto_ns * _S_PER_NS,
        min_lead_s=link.lead_min_ns * _S_PER_NS if link.lead_count else None,
        lead_histogram=tuple(link.lead_histogram),
        motion=_flow(raw.flows[lib.LINK_MOTION]),
        control=_flow(raw.flows[lib.LINK_CONTROL]),
        bulk=_flow(raw.flows[lib.LINK_BULK]),
        received=Flow(raw.received.frames, raw.received.bits, link.blocks_received),
    )
