"""The data types exchanged between a link and its users."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

from nodes.support.errors import CanductorError


class LinkError(CanductorError):
    """A link or its transport cannot do what was asked; the sentence says why and what to do."""


class TransportKind(IntEnum):
    """How a transport's file descriptor carries data (``enum io_kind`` of io_thread.h)."""

    CAN_STREAM = 0
    """A byte stream of 16-byte ``struct can_frame``."""
    CAN_PACKET = 1
    """One ``struct can_frame`` per read and write: SocketCAN."""
    BYTES = 2
    """A serial line: the bytes of one node's blocks."""


class LinkTransport(Protocol):
    """Interface of a transport as a link needs it; ``nodes.transport`` implements it."""

    @property
    def name(self) -> str:
        """Name in messages to the user, for example ``can0`` or ``/dev/ttyACM0``."""

    @property
    def kind(self) -> TransportKind:
        """How to read and write the file descriptor."""

    def fileno(self) -> int:
        """Return the file descriptor, open until close()."""

    def close(self) -> None:
        """Close the file descriptor."""


@dataclass(frozen=True, slots=True)
class BusSettings:
    """Properties of a bus or serial line (``struct io_settings`` of io_core.h)."""

    bitrate: int = 0
    """Bits per second; 0: unlimited or unknown, nothing is budgeted."""
    ceiling: float = 0.9
    """Share of the bit rate that may be used, 0.1..1."""
    queue_frames: int = 0
    """Most frames (a serial line: bytes) that may sit in the kernel or adapter; 0: from the bit rate."""

    def __post_init__(self) -> None:
        """Raise LinkError when a value is out of its range."""
        if not 0 <= self.bitrate <= 100_000_000:
            raise LinkError(f"a bus of {self.bitrate} bit/s; give 1..100000000, or 0 when it is unknown")
        if not 0.1 <= self.ceiling <= 1.0:
            raise LinkError(f"a ceiling of {self.ceiling} of the bit rate; give 0.1..1")
        if not 0 <= self.queue_frames <= 1000:
            raise LinkError(
                f"a kernel queue of {self.queue_frames} frames; give 1..1000, or 0 for the default"
            )

    def as_dict(self) -> dict[str, float]:
        """Return the fields for cffi."""
        return {"bitrate": self.bitrate, "ceiling": self.ceiling, "queue_frames": self.queue_frames}


class BusDriver(Protocol):
    """Driver of a bus, which transfers its bytes: its I/O thread, or a simulation (io_core.h)."""

    @property
    def name(self) -> str:
        """Name of the bus in messages to the user."""

    @property
    def serial(self) -> bool:
        """Whether it is a serial line: one link, without a node id."""

    @property
    def ffi(self) -> Any:
        """The cffi module that the bus was made with, and its lib."""

    @property
    def lib(self) -> Any:
        """The functions of io_api.h."""

    @property
    def bus(self) -> Any:
        """The ``struct io_bus *``."""

    def listen(self, handler: Callable[[], None]) -> None:
        """Call HANDLER in the event loop's thread whenever io_take() has something."""

    def close(self) -> None:
        """End the driver and free the bus; nothing is called any more."""


class Response(NamedTuple):
    """One response of a node: the checked content of a block."""

    content: bytes
    sent_ns: int
    """Host time at which the acknowledged block was sent; 0 when it was repeated (ambiguous)."""
    received_ns: int
    """Host time at which it was read."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A CAN frame that belongs to no link, for example an admin response."""

    can_id: int
    """With the flag bits of ``struct can_frame`` for extended, remote and error frames."""
    data: bytes
    received_ns: int


@dataclass(frozen=True, slots=True)
class LinkSettings:
    """Properties of a node that its link needs."""

    nodeid: int | None
    """1..255 on CAN, None on a serial line."""
    receive_window: int = 192
    """Bytes the node can buffer, at least 64: RECEIVE_WINDOW of its dictionary."""
    lost_after_s: float = 1.0
    """Time without an acknowledgement after which the link is lost."""
    ahead_s: float = 1.2
    """Motion is sent so long before it is due at most, three quarters of that at least: a node goes on for so
    long when its host is gone. 0: it is sent as soon as the node has room for it."""


@dataclass(frozen=True, slots=True)
class Flow:
    """Traffic on the wire. Bits are the true lengths of frames, 0 while the bit rate is unknown."""

    frames: int = 0
    bits: int = 0
    blocks: int = 0


@dataclass(frozen=True, slots=True)
class LinkStats:
    """Counters of one link, since it was opened. Times in s; queue depths in commands and bytes."""

    blocks_sent: int = 0
    """Everything sent, repeats included; bytes_sent also counts the sync bytes."""
    bytes_sent: int = 0
    commands_sent: int = 0
    commands_dropped: int = 0
    """Queued commands dropped by send_urgent."""
    blocks_repeated: int = 0
    bytes_repeated: int = 0
    naks: int = 0
    timeouts: int = 0
    blocks_received: int = 0
    bytes_received: int = 0
    bytes_invalid: int = 0
    """Received bytes that were part of no valid block."""
    acks_duplicate: int = 0
    acks_never_sent: int = 0
    """Acknowledgements of blocks that were never sent: ignored."""
    srtt_s: float = 0.0
    """Smoothed round trip; 0 until one was measured."""
    rttvar_s: float = 0.0
    rto_s: float = 0.0
    """Timeout in use."""
    pending: int = 0
    """Commands queued or not acknowledged."""
    in_flight_bytes: int = 0
    in_flight_blocks: int = 0
    control_commands: int = 0
    control_commands_max: int = 0
    control_bytes: int = 0
    control_bytes_max: int = 0
    motion_commands: int = 0
    motion_commands_max: int = 0
    motion_bytes: int = 0
    motion_bytes_max: int = 0
    lead_count: int = 0
    """Motion commands whose lead (time left until due, when acknowledged) is known."""
    min_lead_s: float | None = None
    """The smallest lead of all; negative: a command came too late. None: no lead is known."""
    lead_histogram: tuple[int, ...] = ()
    """Commands by lead: late, < 1 ms, < 2 ms, < 4 ms, …, and the last: 2^13 ms or more."""
    bulk_commands: int = 0
    bulk_commands_max: int = 0
    bulk_bytes: int = 0
    bulk_bytes_max: int = 0
    motion: Flow = Flow()
    """What was sent, by the class of each block's first command; repeats included."""
    control: Flow = Flow()
    bulk: Flow = Flow()
    received: Flow = Flow()


@dataclass(frozen=True, slots=True)
class BusLoad:
    """Shares of the bit rate within the last second; all 0 while it is unknown."""

    motion: float = 0.0
    control: float = 0.0
    bulk: float = 0.0
    acks: float = 0.0
    """Received acknowledgements."""
    data: float = 0.0
    """Received otherwise; a serial line: all that was received."""
    weak: float = 0.0
    """Received with ids above those of nodes and host: frames of lower priority than all of these."""

    @property
    def total(self) -> float:
        """Sum of all shares."""
        return self.motion + self.control + self.bulk + self.acks + self.data + self.weak


@dataclass(frozen=True, slots=True)
class IOStats:
    """Counters of one bus, since its thread was started."""

    frames_sent: int
    frames_received: int
    frames_unclaimed: int
    """Received frames that belong to no link."""
    frames_dropped: int
    """Of those, frames dropped (the oldest first) because Python was too slow."""
    frames_malformed: int
    responses_dropped: int
    """Responses dropped because Python was too slow."""
    responses_max: int
    unclaimed_max: int
    admin_max: int
    bytes_sent: int
    bytes_received: int
    waits: int
    """Number of pauses in sending because the kernel accepted no more."""
    wakeups: int
    bitrate: int
    """Bit rate of the line, 0: unknown; then all fields below are 0 too."""
    motion_bits: int
    """Sent so far, true frame lengths."""
    control_bits: int
    """With admin frames."""
    bulk_bits: int
    received_bits: int
    load: BusLoad
    queue_frames: int
    """Most frames that may sit in the kernel (a serial line: bytes; 0: not bounded)."""
    queued_max: int
    """Largest number so far."""
    queue_waits: int
    held_s: float
    """Time for which the budget delayed frames."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """Whether the queued motion of a bus will be in time, if the bus goes on as in the last second."""

    now_ns: int
    """Host time of this forecast."""
    worst_ratio: float
    """Highest demand of any interval, relative to what the bus can carry in it; above 1: too much."""
    at_ns: int
    """Host time at which that interval ends; 0 without demand, or while the bit rate is unknown."""
    late_ns: int | None
    """Host time at which the first command that would be late is due; None: none would be late."""
    motion_bits_per_s: float
    """Capacity of the bus for motion, besides the other traffic and below the ceiling; 0: unknown."""
    queued_bits: int
    """Demand of the queued motion, acknowledgements included."""

    @property
    def warning_s(self) -> float | None:
        """Time from this forecast to the first late command; None: nothing would be late."""
        return None if self.late_ns is None else (self.late_ns - self.now_ns) * 1e-9
