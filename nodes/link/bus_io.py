"""Python wrapper of a bus's I/O thread (io_thread.h): links, raw frames, events in the asyncio loop."""

import asyncio
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Self

from nodes.link.handle import BusHandle
from nodes.link.interfaces import OnFrame, OnLost, OnResponses
from nodes.link.link import Link
from nodes.link.thread_driver import ThreadDriver
from nodes.link.types import (
    BusDriver,
    BusLoad,
    BusSettings,
    Forecast,
    Frame,
    IOStats,
    LinkError,
    LinkSettings,
    LinkTransport,
    Response,
    TransportKind,
)
from nodes.support.bug_reports import BugReports
from nodes.support.c_structs import from_struct

_BATCH = 128
"""Most events taken from the bus and handled in one turn of the loop, some ms: normal traffic is a dozen."""
_EVENT: Final = "@2B i 2I 2Q {}s 0Q"
"""``struct io_event`` as the struct module sees it; to be given the size of a content."""


class LinkIO:
    """One bus or serial line: its links, and what arrives on it, handed over in the event loop's thread.

    LinkIO(transport, loop) starts an I/O thread for the transport, which stays the caller's: close() here
    first, then the transport. LinkIO.driven_by() uses a bus with another driver, for example a simulation.
    ON_FRAME gets CAN frames that belong to no link, ON_CLOSED one sentence when the transport ends by itself.
    SETTINGS define what the bus can carry; without them a CAN transport's bit rate counts, if it is known.
    Not thread-safe: use from the loop's thread, but for ``send_frame`` and ``Link.send_urgent``.
    """

    def __init__(
        self,
        transport: LinkTransport,
        loop: asyncio.AbstractEventLoop,
        *,
        on_frame: OnFrame | None = None,
        on_closed: OnLost | None = None,
        settings: BusSettings | None = None,
    ) -> None:
        if settings is None:
            # A serial line's rate may be nominal only, as on USB: nothing is budgeted unless requested.
            serial = transport.kind == TransportKind.BYTES
            settings = BusSettings(bitrate=0 if serial else getattr(transport, "bitrate", None) or 0)
        self._attach(ThreadDriver(transport, loop, settings), on_frame, on_closed)

    @classmethod
    def driven_by(
        cls,
        driver: BusDriver,
        *,
        on_frame: OnFrame | None = None,
        on_closed: OnLost | None = None,
    ) -> Self:
        """Use the bus of DRIVER, and close it with this object."""
        io = cls.__new__(cls)
        io._attach(driver, on_frame, on_closed)  # noqa: SLF001
        return io

    def _attach(self, driver: BusDriver, on_frame: OnFrame | None, on_closed: OnLost | None) -> None:
        self._serial = driver.serial
        self._on_frame = on_frame
        self._on_closed = on_closed
        self._links: dict[int, Link] = {}
        self._bus = BusHandle(driver)
        self._lib, self._ffi = driver.lib, driver.ffi
        self._final = self._ffi.new("struct io_stats *")
        self._events = self._ffi.new("struct io_event[]", _BATCH)
        self._events_view = memoryview(self._ffi.buffer(self._events))
        self._event = struct.Struct(_EVENT.format(self._lib.WIRE_CONTENT_MAX))
        self._goes_on = False
        """Whether the next turn of the loop takes what is left."""
        self._bugs = BugReports()
        driver.listen(self._handle_events)

    @property
    def name(self) -> str:
        """The transport's name."""
        return self._bus.name

    def open_link(self, settings: LinkSettings, *, on_responses: OnResponses, on_lost: OnLost) -> Link:
        """Add a node's link to the bus.

        ON_RESPONSES gets what arrived since its last call, in order; ON_LOST one sentence, once, after which
        the link takes no more commands. Raises LinkError on bad settings, a taken node id, or
        a transport that has ended.
        """
        where = f"{self.name}: node {settings.nodeid}"
        nodeid = settings.nodeid
        if not (nodeid is None if self._serial else 1 <= (nodeid or 0) <= 255):
            raise LinkError(f"{where}: a link needs a node id of 1..255 on CAN and none on a serial line")
        if settings.receive_window < self._lib.LINK_WINDOW_MIN:
            raise LinkError(
                f"{where}: a receive window of {settings.receive_window} bytes cannot hold a block; "
                f"{self._lib.LINK_WINDOW_MIN} is the least"
            )
        if not 1e-3 <= settings.lost_after_s <= 3600:
            raise LinkError(f"{where}: lost_after_s={settings.lost_after_s} is not within 0.001..3600 s")
        if not 0 <= settings.ahead_s <= 3600:
            raise LinkError(f"{where}: ahead_s={settings.ahead_s} is not within 0..3600 s")
        times_ns = (round(seconds * 1e9) for seconds in (settings.lost_after_s, settings.ahead_s))
        c_settings = self._ffi.new("struct link_settings *", (settings.receive_window, *times_ns))
        number = self._ffi.new("uint32_t *")
        status = self._lib.io_open_link(self._bus.live(), nodeid or 0, c_settings, number)
        if status == self._lib.IO_TAKEN:
            raise LinkError(
                f"{where}: there is a link with this id already, or {self._lib.IO_LINKS_MAX} links"
            )
        self._bus.check(status, where)
        link = Link(
            self._bus,
            number[0],
            settings,
            on_responses=on_responses,
            on_lost=on_lost,
            on_close=self._links.pop,
            take=self._take,
        )
        self._links[number[0]] = link
        return link

    def learn_bitrate(self, bitrate: int) -> None:
        """Set BITRATE (bit/s, 0: unknown) as the capacity of the bus, unless that is known already."""
        if self.stats().bitrate == 0:
            self._lib.io_set_bitrate(self._bus.live(), bitrate)

    def send_frame(self, can_id: int, data: bytes) -> None:
        """Send one CAN frame that belongs to no link, before all data; from any thread.

        A stop (an id below those of data) goes at once, whatever the bus is taken to carry.
        Raises LinkError when that fails.
        """
        content = self._ffi.from_buffer(data)
        with self._bus.lock:
            status = self._lib.io_send_frame(self._bus.live(), can_id, content, len(data))
        if status == self._lib.IO_INVALID:
            raise LinkError(
                f"{self.name}: a frame of {len(data)} bytes; CAN frames have 0..8, serial lines none"
            )
        if status == self._lib.IO_FULL:
            raise LinkError(
                f"{self.name}: {self._lib.IO_ADMIN_MAX} admin frames wait already; the bus does not take them"
            )
        self._bus.check(status, self.name)

    def stats(self) -> IOStats:
        """Return the counters so far; after close(), the last ones."""
        self._look()
        return _convert(self._final, self._lib)

    def load(self) -> BusLoad:
        """Return the bus's load as in ``stats``, in a fraction of the time."""
        self._look()
        return _load(self._final, self._lib)

    def _look(self) -> None:
        if self._bus.open:
            self._lib.io_get_stats(self._bus.live(), self._final)

    def forecast(self) -> Forecast:
        """Return whether the queued motion will be in time; raises LinkError after close()."""
        out = self._ffi.new("struct io_forecast *")
        self._lib.io_forecast(self._bus.live(), out)
        return Forecast(
            now_ns=out.now_ns,
            worst_ratio=out.worst_ratio,
            at_ns=out.at_ns,
            late_ns=out.late_ns or None,
            motion_bits_per_s=out.motion_bits_per_s,
            queued_bits=out.queued_bits,
        )

    def close(self) -> None:
        """Close the links and join the thread. Further calls do nothing."""
        if not self._bus.open:
            return
        for link in list(self._links.values()):
            link.close()
        self.stats()
        self._bus.close()

    def _handle_events(self) -> None:
        """Take what has arrived. A flood has one batch of each turn of the loop, others have the rest."""
        if not self._goes_on:
            self._take()

    def _go_on(self) -> None:
        self._goes_on = False
        self._take()

    def _take(self) -> None:
        """Hand over one batch of what has arrived; what is left follows in the next turn of the loop."""
        if not self._bus.open:
            return
        taken = self._lib.io_take(self._bus.live(), self._events, _BATCH)
        if taken == _BATCH and not self._goes_on:
            self._goes_on = True
            asyncio.get_running_loop().call_soon(self._go_on)
        self._hand_over(taken)

    def _hand_over(self, taken: int) -> None:
        # A callback may close this bus or any link: every step checks again. One that fails must not keep the
        # others from theirs: notices come once.
        responses: dict[int, list[Response]] = {}
        frames: list[Frame] = []
        notices: list[tuple[int, int, int]] = []
        events = self._event.iter_unpack(self._events_view[: taken * self._event.size])
        for notice, size, value, link, can_id, sent_ns, received_ns, content in events:
            if notice == self._lib.IO_RESPONSE:
                responses.setdefault(link, []).append(Response(content[:size], sent_ns, received_ns))
            elif notice == self._lib.IO_FRAME:
                frames.append(Frame(can_id, content[:size], received_ns))
            else:
                notices.append((notice, link, value))
        # Frames first: the frame with which a node stops its bus has the reason, later reports do not.
        for frame in frames:
            if self._on_frame:
                self._guarded("a frame", self._on_frame, frame)
        if responses and self._bus.open:
            self._pass_on(responses)
        for notice in notices:
            self._guarded("a notice", self._handle_notice, *notice)

    def _guarded(self, what: str, handle: Callable[..., None], *args: object) -> None:
        """Call HANDLE, unless the bus was closed; if it fails, that is reported."""
        if self._bus.open:
            try:
                handle(*args)
            except Exception as bug:  # noqa: BLE001
                self._bugs.add(f"{self.name}: {what}", bug)

    def _pass_on(self, responses: Mapping[int, Sequence[Response]]) -> None:
        """Pass RESPONSES on so that the commands that follow from them share blocks."""
        self._lib.io_cork(self._bus.live(), 1)
        try:
            for number, batch in responses.items():
                if link := self._links.get(number):
                    self._guarded("responses", link.on_responses, batch)
        finally:
            if self._bus.open:
                self._lib.io_cork(self._bus.live(), 0)

    def _handle_notice(self, notice: int, number: int, value: int) -> None:
        if notice == self._lib.IO_ENDED:
            self._handle_ended(value)
        elif link := self._links.get(number):
            if notice == self._lib.IO_DRAINED:
                link.handle_drained()
            elif notice == self._lib.IO_SILENT:
                link.on_silent()
            else:
                link.handle_lost(value)

    def _handle_ended(self, cause: int) -> None:
        text = self._bus.ended_because(cause)
        for link in list(self._links.values()):
            link.handle_ended(text)
        if self._on_closed:
            self._on_closed(text)


def _load(raw: Any, lib: Any) -> BusLoad:
    bits, rate = raw.recent_bits, raw.bitrate or 1
    return BusLoad(
        motion=bits[lib.LINK_MOTION] / rate,
        control=bits[lib.LINK_CONTROL] / rate,
        bulk=bits[lib.LINK_BULK] / rate,
        acks=bits[lib.SCHEDULE_ACKS] / rate,
        data=bits[lib.SCHEDULE_DATA] / rate,
        weak=bits[lib.SCHEDULE_WEAK] / rate,
    )


def _convert(raw: Any, lib: Any) -> IOStats:
    return from_struct(
        IOStats,
        raw,
        motion_bits=raw.sent_bits[lib.LINK_MOTION],
        control_bits=raw.sent_bits[lib.LINK_CONTROL],
        bulk_bits=raw.sent_bits[lib.LINK_BULK],
        load=_load(raw, lib),
        held_s=raw.held_ns * 1e-9,
    )
