"""Settings of a simulated world. Times are in seconds; they become integer ns of true time."""

import math
from dataclasses import dataclass, field
from typing import Any, Final

from nodes.support.errors import CanductorError

NEVER_NS: Final = (1 << 64) - 1
RECEIVE_QUEUE_MAX: Final = 4096
_NS: Final = 1_000_000_000


class WorldError(CanductorError):
    """A setting of a simulated world is invalid."""


def to_ns(seconds: float, what: str) -> int:
    """Return SECONDS (finite, not negative, below a year) in ns; WorldError names WHAT."""
    if not (math.isfinite(seconds) and 0 <= seconds < 3e7):
        raise WorldError(f"{what} of {seconds} s in a simulated world; give 0 or more, less than a year")
    return round(seconds * _NS)


def check_probability(value: float, what: str) -> float:
    """Return VALUE if it is a probability; WorldError names WHAT."""
    if not 0 <= value <= 1:
        raise WorldError(f"{what} of {value} in a simulated world; a probability lies in 0..1")
    return value


@dataclass(frozen=True, slots=True)
class Latency:
    """A random time: MIN_S plus an exponentially distributed part with mean MEAN_S, at most MAX_S in all."""

    min_s: float = 0.0
    mean_s: float = 0.0
    max_s: float = 1.0

    def as_dict(self) -> dict[str, int]:
        """Return the fields for cffi."""
        return {
            f"{name}_ns": to_ns(getattr(self, f"{name}_s"), "a latency") for name in ("min", "mean", "max")
        }


@dataclass(frozen=True, slots=True)
class NodeSettings:
    """Clock and latencies of a node."""

    ppm: float = 0.0
    """Rate error of its clock."""
    irq_jitter_s: float = 1e-6
    """Greatest delay of the receive interrupt after the frame."""
    task: Latency = Latency(5e-6, 15e-6, 1e-3)
    """Delay from the request to run tasks until they run."""
    boot_s: float = 0.002
    """From power or reset to the first instruction of the firmware."""

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for cffi."""
        return {
            "ppm": self.ppm,
            "irq_jitter_ns": to_ns(self.irq_jitter_s, "a jitter"),
            "task": self.task.as_dict(),
            "boot_ns": to_ns(self.boot_s, "a boot time"),
        }


@dataclass(frozen=True, slots=True)
class PortSettings:
    """The host's I/O thread and its kernel's receive queue."""

    wake: Latency = Latency(8e-6, 15e-6, 3e-3)
    receive_queue: int = 256
    """Frames, 1..4096."""

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for cffi."""
        if not 1 <= self.receive_queue <= RECEIVE_QUEUE_MAX:
            raise WorldError(f"a receive queue of {self.receive_queue} frames; give 1..{RECEIVE_QUEUE_MAX}")
        return {"wake": self.wake.as_dict(), "receive_queue": self.receive_queue}


@dataclass(frozen=True, slots=True)
class ControllerSettings:
    """The host's CAN controller and its SocketCAN interface."""

    queue: int = 10
    """Frames in the interface's transmit queue (txqueuelen) and the adapter, 1..1024."""
    loss: float = 0.0
    """Probability that the software does not get a good frame."""
    corruption: float = 0.0
    """Probability that a received frame has a wrong bit that the checksum does not reveal."""
    restart_s: float | None = 0.1
    """restart-ms of the interface; None: bus-off lasts until restart()."""

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for cffi."""
        return {
            "queue": self.queue,
            "mailboxes": 1,
            "drops_when_off": 1,
            "loss": check_probability(self.loss, "a loss"),
            "corruption": check_probability(self.corruption, "a corruption"),
            "restart_ns": NEVER_NS if self.restart_s is None else to_ns(self.restart_s, "a restart time"),
        }


@dataclass(frozen=True, slots=True)
class UartSettings:
    """A serial line."""

    baud: int = 250_000
    loss: float = 0.0
    """Probability that a byte is lost, in either direction; corruption: that it has one wrong bit."""
    corruption: float = 0.0
    noise_bytes: int = 0
    """Number of bytes that both ends receive when the line is opened, 0..4096."""
    read: Latency = field(default=Latency(30e-6, 30e-6, 2e-3))
    """Time for which the host's driver collects bytes before it passes them on."""

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for cffi."""
        return {
            "baud": self.baud,
            "loss": check_probability(self.loss, "a loss"),
            "corruption": check_probability(self.corruption, "a corruption"),
            "noise_bytes": self.noise_bytes,
            "read": self.read.as_dict(),
        }
