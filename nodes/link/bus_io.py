"""The Python skin of a bus's I/O thread (io_thread.h): links, raw frames, events in the asyncio loop."""

import asyncio
import math
import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from nodes.link._link import ffi, lib
from nodes.link.types import (
    Frame,
    FrameHandler,
    IOStats,
    LinkError,
    LinkSettings,
    LinkStats,
    LinkTransport,
    Response,
    TransportKind,
)

if TYPE_CHECKING:
    from typing_extensions import Buffer

_BATCH = 512
"""Events taken from the thread in one call."""
_S_PER_NS = 1e-9

ResponsesHandler = Callable[[Sequence[Response]], None]
TextHandler = Callable[[str], None]


class LinkIO:
    """One bus or serial line: starts its I/O thread and hands over what arrives in LOOP's thread.

    ON_FRAME gets CAN frames that belong to no link, ON_CLOSED one sentence when the transport ends by itself.
    The transport stays the caller's: close() here first, then the transport. Not thread-safe: use from the
    loop's thread.
    """

    def __init__(
        self,
        transport: LinkTransport,
        loop: asyncio.AbstractEventLoop,
        *,
        on_frame: FrameHandler | None = None,
        on_closed: TextHandler | None = None,
    ) -> None:
        self._transport = transport
        self._loop = loop
        self._on_frame = on_frame
        self._on_closed = on_closed
        self._links: dict[int, Link] = {}
        self._ended: str | None = None
        self._final = ffi.new("struct io_stats *")
        self._events = ffi.new("struct io_event[]", _BATCH)
        os.set_blocking(transport.fileno(), False)
        self._bus = lib.io_start(transport.fileno(), int(transport.kind))
        if self._bus == ffi.NULL:
            raise LinkError(f"{transport.name}: cannot start the I/O thread; out of memory or threads")
        self._notice_fd = lib.io_notice_fd(self._bus)
        loop.add_reader(self._notice_fd, self._handle_events)

    @property
    def name(self) -> str:
        """The transport's name."""
        return self._transport.name

    def open_link(
        self, settings: LinkSettings, *, on_responses: ResponsesHandler, on_lost: TextHandler
    ) -> "Link":
        """Add a node's link to the bus.

        ON_RESPONSES gets what arrived since its last call, in order; ON_LOST one sentence, once, after which
        the link takes no more commands. Raises LinkError on bad settings, a taken node id, an ended transport.
        """
        serial = self._transport.kind == TransportKind.BYTES
        where = f"{self.name}: node {settings.nodeid}"
        if serial != (settings.nodeid is None) or not 1 <= (settings.nodeid or 1) <= 255:
            raise LinkError(f"{where}: a link needs a node id of 1..255 on CAN and none on a serial line")
        if settings.receive_window < lib.LINK_WINDOW_MIN:
            raise LinkError(
                f"{where}: a receive window of {settings.receive_window} bytes cannot hold a block; "
                f"{lib.LINK_WINDOW_MIN} is the least"
            )
        if not 1e-3 <= settings.lost_after_s <= 3600:
            raise LinkError(f"{where}: lost_after_s={settings.lost_after_s} is not within 0.001..3600 s")
        c_settings = ffi.new("struct link_settings *")
        c_settings.receive_window = settings.receive_window
        c_settings.lost_after_ns = round(settings.lost_after_s * 1e9)
        number = ffi.new("uint32_t *")
        status = lib.io_open_link(self._live_bus(), settings.nodeid or 0, c_settings, number)
        if status == lib.IO_TAKEN:
            raise LinkError(f"{where}: there is a link with this id already, or {lib.IO_LINKS_MAX} links")
        self._check(status, where)
        link = Link(self, number[0], settings, on_responses, on_lost)
        self._links[number[0]] = link
        return link

    def send_frame(self, can_id: int, data: bytes) -> None:
        """Send one CAN frame that belongs to no link, before all data. Raises LinkError when it cannot."""
        status = lib.io_send_frame(self._live_bus(), can_id, ffi.from_buffer(data), len(data))
        if status == lib.IO_INVALID:
            raise LinkError(f"{self.name}: a frame of {len(data)} bytes; CAN frames have 0..8, serial lines none")
        if status == lib.IO_FULL:
            raise LinkError(
                f"{self.name}: {lib.IO_ADMIN_MAX} admin frames wait already; the bus does not take them"
            )
        self._check(status, self.name)

    def stats(self) -> IOStats:
        """Return the counters so far; after close(), the last ones."""
        if self._bus is not None:
            lib.io_get_stats(self._bus, self._final)
        return IOStats(**{name: getattr(self._final, name) for name in IOStats.__slots__})

    def close(self) -> None:
        """Close the links and join the thread. Further calls do nothing."""
        if self._bus is None:
            return
        for link in list(self._links.values()):
            link.close()
        self.stats()
        self._loop.remove_reader(self._notice_fd)
        bus, self._bus = self._bus, None
        lib.io_stop(bus)

    def _live_bus(self) -> Any:
        if self._bus is None:
            raise LinkError(f"{self.name}: closed by this program; open it again first")
        return self._bus

    def _check(self, status: int, where: str) -> None:
        """Raise LinkError for what can happen to any call."""
        if status == lib.IO_OK:
            return
        if status == lib.IO_CLOSED:
            # The thread may know before the notice has come through the loop.
            raise LinkError(self._ended or f"{self.name}: the transport has just failed; open it again")
        if status == lib.IO_NO_MEMORY:
            raise LinkError(f"{where}: no memory for a further link")
        raise LinkError(f"{where}: refused by the I/O thread (status {status}); the arguments are out of range")

    # ------------------------------------------------------------------------------------------- events

    def _handle_events(self) -> None:
        # A callback may close this bus or any link: every step looks again.
        taken = _BATCH
        while taken == _BATCH and self._bus is not None:
            taken = lib.io_take(self._bus, self._events, _BATCH)
            self._hand_over(taken)

    def _hand_over(self, taken: int) -> None:
        responses: dict[int, list[Response]] = {}
        others: list[tuple[int, int, int, Frame]] = []
        for i in range(taken):
            event = self._events[i]
            content = bytes(ffi.buffer(event.content)[: event.size])
            if event.notice == lib.IO_RESPONSE:
                response = Response(content, event.sent_ns, event.received_ns)
                responses.setdefault(event.link, []).append(response)
            else:
                frame = Frame(event.can_id, content, event.received_ns)
                others.append((event.notice, event.link, event.value, frame))
        for number, batch in responses.items():
            if link := self._links.get(number):
                link.handle_responses(batch)
        for notice, number, value, frame in others:
            if self._bus is not None:
                self._hand_over_other(notice, number, value, frame)

    def _hand_over_other(self, notice: int, number: int, value: int, frame: Frame) -> None:
        if notice == lib.IO_FRAME:
            if self._on_frame:
                self._on_frame(frame)
        elif notice == lib.IO_ENDED:
            self._handle_ended(value)
        elif link := self._links.get(number):
            if notice == lib.IO_DRAINED:
                link.handle_drained()
            else:
                link.handle_lost(value)

    def _handle_ended(self, cause: int) -> None:
        reason = os.strerror(cause) if cause else "its other end closed it"
        self._ended = f"{self.name}: the connection ended ({reason}); check cable and device, then start again"
        for link in list(self._links.values()):
            link.handle_ended(self._ended)
        if self._on_closed:
            self._on_closed(self._ended)

    def _forget(self, number: int) -> None:
        del self._links[number]
        lib.io_close_link(self._bus, number)


class Link:
    """One node's link: commands in, in order and reliably; responses out. Made by LinkIO.open_link()."""

    def __init__(
        self,
        io: LinkIO,
        number: int,
        settings: LinkSettings,
        on_responses: ResponsesHandler,
        on_lost: TextHandler,
    ) -> None:
        self._io = io
        self._number = number
        self._settings = settings
        self._on_responses = on_responses
        self._on_lost = on_lost
        self._name = io.name if settings.nodeid is None else f"{io.name} node {settings.nodeid}"
        self._failed: str | None = None
        self._drained: asyncio.Future[None] | None = None
        self._final = LinkStats()

    @property
    def name(self) -> str:
        """How messages to the user call it: transport and node id."""
        return self._name

    def send(self, content: bytes, *, min_clock: int = 0, req_clock: int = 0) -> None:
        """Queue one encoded control command: in order, before motion, not before MIN_CLOCK (node ticks).

        Raises LinkError when the queue is full, the command is too long, or the link is closed or lost.
        """
        data = ffi.from_buffer(content)
        status = lib.io_send(self._live(), self._number, data, len(content), min_clock, req_clock)
        self._check_command(status, len(content))

    def send_batch(self, batch: "Buffer") -> None:
        """Queue the motion commands of a batch (format: batch.h), all or none; raises LinkError as send()."""
        with memoryview(batch) as view:
            size = view.nbytes
            status = lib.io_send_batch(self._live(), self._number, ffi.from_buffer(view), size)
        if status == lib.IO_FULL:
            free = lib.IO_MOTION_BYTES - self.stats().motion_bytes
            raise LinkError(
                f"{self._name}: a batch of {size} bytes does not fit into the motion queue "
                f"({free} of {lib.IO_MOTION_BYTES} free); send less ahead, or wait until the node has taken some"
            )
        if status == lib.IO_INVALID:
            raise LinkError(f"{self._name}: a batch of {size} bytes ends within a record, or has a bad command")
        self._check(status)

    def send_urgent(self, content: bytes) -> None:
        """Drop everything that is queued and unsent and send CONTENT next; raises LinkError as send()."""
        status = lib.io_send_urgent(self._live(), self._number, ffi.from_buffer(content), len(content))
        self._check_command(status, len(content))

    def set_receive_window(self, size: int) -> None:
        """Bound the unacknowledged bytes to SIZE, at least 64; LinkError below."""
        if size < lib.LINK_WINDOW_MIN:
            raise LinkError(f"{self._name}: a receive window of {size} bytes cannot hold a block (64)")
        self._check(lib.io_set_receive_window(self._live(), self._number, size))

    def set_clock(self, freq_hz: float, at_ns: int, at_ticks: int) -> None:
        """Tell the node's clock: it reads AT_TICKS (64 bits) at host time AT_NS and runs at FREQ_HZ (> 0)."""
        if not (math.isfinite(freq_hz) and freq_hz > 0 and at_ns >= 0 and at_ticks >= 0):
            raise LinkError(
                f"{self._name}: not a clock: {freq_hz} Hz at {at_ns} ns, {at_ticks} ticks; estimate it again"
            )
        self._check(lib.io_set_clock(self._live(), self._number, freq_hz, at_ns, at_ticks))

    def pending(self) -> int:
        """Return how many commands are not yet acknowledged, queued ones included."""
        return self.stats().pending

    async def drained(self) -> None:
        """Wait until nothing is pending; raises LinkError when the link is lost or closed meanwhile."""
        if self._drained is None:
            self._check(lib.io_watch_drained(self._live(), self._number))
            self._drained = asyncio.get_running_loop().create_future()
        await asyncio.shield(self._drained)

    def stats(self) -> LinkStats:
        """Return the counters so far; after close(), the last ones."""
        if not self._closed():
            raw = ffi.new("struct io_link_stats *")
            if lib.io_get_link_stats(self._io._bus, self._number, raw) == lib.IO_OK:  # noqa: SLF001
                self._final = _convert(raw)
        return self._final

    def close(self) -> None:
        """Forget the link; what is queued is dropped. Further calls do nothing."""
        if self._closed():
            return
        self.stats()
        self._fail(f"{self._name}: the link was closed by this program")
        self._io._forget(self._number)  # noqa: SLF001

    # ------------------------------------------------------------------------- called by LinkIO

    def handle_responses(self, responses: Sequence[Response]) -> None:
        """Pass on what arrived."""
        self._on_responses(responses)

    def handle_drained(self) -> None:
        """Wake those who wait in drained()."""
        if self._drained:
            if not self._drained.done():
                self._drained.set_result(None)
            self._drained = None

    def handle_lost(self, cause: int) -> None:
        """Tell the user, once, that the node does not acknowledge any more."""
        heard = "answers, but accepts nothing" if cause == lib.LINK_CAUSE_STUCK else "does not answer at all"
        text = (
            f"{self._name}: lost, no acknowledgement for {self._settings.lost_after_s:g} s, the node {heard}; "
            "check its power, cable and termination, and whether its firmware runs"
        )
        self._fail(text)
        self._on_lost(text)

    def handle_ended(self, text: str) -> None:
        """Note that the transport is gone; LinkIO's on_closed tells the user."""
        self._fail(text)

    # ----------------------------------------------------------------------------------- inside

    def _closed(self) -> bool:
        return self._io._links.get(self._number) is not self  # noqa: SLF001

    def _live(self) -> Any:
        if self._failed:
            raise LinkError(self._failed)
        return self._io._live_bus()  # noqa: SLF001

    def _fail(self, text: str) -> None:
        self._failed = self._failed or text
        if self._drained:
            if not self._drained.done():
                self._drained.set_exception(LinkError(text))
                self._drained.exception()  # nobody has to be waiting
            self._drained = None

    def _check(self, status: int) -> None:
        if status == lib.IO_GONE:
            raise LinkError(f"{self._name}: the link is lost; open it again when the node is back")
        self._io._check(status, self._name)  # noqa: SLF001

    def _check_command(self, status: int, size: int) -> None:
        if status == lib.IO_FULL:
            raise LinkError(
                f"{self._name}: the control queue ({lib.IO_CONTROL_BYTES} bytes) is full; "
                "wait until drained() before sending more"
            )
        if status == lib.IO_INVALID:
            raise LinkError(
                f"{self._name}: a command of {size} bytes; a block holds 1..{lib.WIRE_CONTENT_MAX} bytes"
            )
        self._check(status)


def _convert(raw: Any) -> LinkStats:
    link = raw.link
    counters = (
        "blocks_sent bytes_sent commands_sent commands_dropped blocks_repeated bytes_repeated naks timeouts "
        "blocks_received bytes_received bytes_invalid acks_duplicate acks_never_sent lead_count"
    ).split()
    depths = (
        "pending flying_bytes flying_blocks control_commands control_commands_max control_bytes "
        "control_bytes_max motion_commands motion_commands_max motion_bytes motion_bytes_max"
    ).split()
    return LinkStats(
        **{name: getattr(link, name) for name in counters},
        **{name: getattr(raw, name) for name in depths},
        srtt_s=link.srtt_ns * _S_PER_NS,
        rttvar_s=link.rttvar_ns * _S_PER_NS,
        rto_s=link.rto_ns * _S_PER_NS,
        min_lead_s=link.lead_min_ns * _S_PER_NS if link.lead_count else None,
        lead_histogram=tuple(link.lead_histogram),
    )
