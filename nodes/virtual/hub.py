"""A virtual CAN bus: connects firmware processes and hosts by a Unix socket, without root or a kernel module.

Every client connects to the bus's socket and exchanges 16-byte ``struct can_frame`` records. The bus
arbitrates by id, takes the true time of each frame at its bit rate, and delivers in the same order to all
clients; a client that does not read stops the bus instead of losing frames. It is implemented in C
(``hub.h``, ``hub_loop.h``), in a thread that never needs the interpreter.
"""

import contextlib
import errno
import os
import socket
import stat
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from nodes.support.c_structs import from_struct
from nodes.support.errors import CanductorError
from nodes.virtual._hub import ffi, lib
from nodes.virtual.faults import RULES_MAX, BusFault

STUCK_LIMIT_S = 2.0
"""Time for which a client may stop the bus by not reading, before it is disconnected."""

BITRATE_MIN, BITRATE_MAX = 1_000, 1_000_000_000
BACKLOG = 64
SOCKET_PATH_MAX = 107
"""Bytes: the kernel's ``sun_path`` without its terminating zero."""


@dataclass(frozen=True, slots=True)
class ClientStats:
    """Counters of one connected client."""

    place: int
    """Number of its connection, 0..63; reused after it leaves."""
    sent: int
    """Its frames that were transferred."""
    received: int
    """Frames of others queued for it."""
    rejected: int
    """Its records other than data frames with an 11-bit id."""


@dataclass(frozen=True, slots=True)
class FaultStats:
    """Counters of one rule."""

    picked: int
    """Frames it selected."""
    hits: int
    """Affected frames; of a timed bus-off: how often it happened."""


@dataclass(frozen=True, slots=True)
class BusStats:
    """Counters of a bus since its start."""

    frames: int
    """Frames transferred, lost ones and repetitions included."""
    bits: int
    """Their true length, stuff bits and interframe space included, and the length of error frames."""
    lost: int
    """Frames lost for all clients by a rule."""
    busy_ns: int
    """Time for which the bus was busy."""
    rejected: int
    """Records other than data frames with an 11-bit id."""
    expelled: int
    """Clients disconnected because they stopped the bus for too long."""
    refused: int
    """Connections beyond the 64 places."""
    lost_copies: int
    """Copies of frames lost for single receivers by a rule."""
    corrupted: int
    """Frames that a client received with a changed bit."""
    duplicated: int
    """Frames repeated although all clients had received them."""
    errors: int
    """Attempts that ended in an error frame."""
    delayed: int
    """Frames delayed by a rule."""
    bus_offs: int
    """How often a client left the bus."""
    unsent: int
    """Frames dropped because their sender was off the bus."""
    unheard: int
    """Copies of frames not delivered because their receiver was off the bus."""
    late_ns_max: int
    """Greatest delay of the bus at the end of a frame."""
    realtime: bool
    """Whether the bus has real-time priority; without it, expect more latency jitter."""
    clients: tuple[ClientStats, ...]
    """The clients that are connected now."""
    faults: tuple[FaultStats, ...]
    """Counters of each rule since it was set."""


class VirtualBus:
    """A virtual CAN bus at the Unix socket PATH.

    ``bitrate`` in bit/s, or None for frames that take no time. ``loss`` (0..1): share of frames that
    reach no client; ``seed`` decides which ones, also for the ``faults``. ``stuck_limit_s``: see
    STUCK_LIMIT_S. Use it as a context manager, or call start() and close(); use its methods in one thread.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        bitrate: int | None = 1_000_000,
        loss: float = 0.0,
        seed: int = 0,
        faults: Sequence[BusFault] = (),
        stuck_limit_s: float = STUCK_LIMIT_S,
    ) -> None:
        """Check the arguments; raises CanductorError. start() starts the bus."""
        self.path = Path(path)
        self.bitrate = bitrate or None
        if len(os.fsencode(self.path)) > SOCKET_PATH_MAX:
            raise CanductorError(
                f"virtual bus: the path {self.path} is longer than the {SOCKET_PATH_MAX} bytes of a Unix"
                " socket's; choose a shorter one"
            )
        if self.bitrate is not None and not BITRATE_MIN <= self.bitrate <= BITRATE_MAX:
            raise CanductorError(
                f"virtual bus {self.path}: bit rate {bitrate} is not between {BITRATE_MIN} and"
                f" {BITRATE_MAX} bit/s (0 means no limit)"
            )
        if not 0 <= loss <= 1:
            raise CanductorError(f"virtual bus {self.path}: loss {loss} is not a share between 0 and 1")
        if not 0 < stuck_limit_s < 1e6:
            raise CanductorError(
                f"virtual bus {self.path}: stuck limit {stuck_limit_s} s is not a positive time"
            )
        self._config = {
            "bitrate": self.bitrate or 0,
            "loss": loss,
            "seed": seed % 2**64,
            "stuck_limit_ns": int(stuck_limit_s * 1e9),
        }
        self._faults = self._checked(faults)
        self._listener: socket.socket | None = None
        self._inode = 0
        self._loop = ffi.NULL
        self._thread: threading.Thread | None = None
        self._final: BusStats | None = None
        self._error = 0

    def _checked(self, faults: Sequence[BusFault]) -> tuple[BusFault, ...]:
        if len(faults) > RULES_MAX:
            raise CanductorError(
                f"virtual bus {self.path}: {len(faults)} faults are more than the {RULES_MAX} it can have"
            )
        return tuple(faults)

    @property
    def faults(self) -> tuple[BusFault, ...]:
        """The current rules."""
        return self._faults

    def set_faults(self, faults: Sequence[BusFault]) -> None:
        """Replace the rules; raises CanductorError if there are too many.

        Their times and counters start now.
        """
        self._faults = self._checked(faults)
        if self._loop != ffi.NULL:
            self._set_rules()

    def _set_rules(self) -> None:
        rules: Any = ffi.new("struct hub_rule[]", [fault.to_c() for fault in self._faults])
        lib.hub_loop_set_rules(self._loop, rules, len(self._faults))

    @property
    def address(self) -> str:
        """The bus as the option of a transport."""
        return f"virtual:{self.path}"

    @property
    def running(self) -> bool:
        """Whether the bus transfers frames."""
        return self._thread is not None and self._thread.is_alive()

    def start(self) -> Self:
        """Open the socket and start the bus; raises CanductorError when the path cannot be used."""
        if self._thread is not None or self._final is not None:
            raise CanductorError(f"virtual bus {self.path}: started twice; make a new VirtualBus instead")
        self._listener = _listen(self.path)
        self._inode = self.path.stat().st_ino
        self._loop = lib.hub_loop_new(self._listener.fileno(), ffi.new("struct hub_config *", self._config))
        if self._loop == ffi.NULL:
            reason = os.strerror(ffi.errno)
            self._close_listener()
            raise CanductorError(f"virtual bus {self.path}: cannot start: {reason}")
        if self._faults:
            self._set_rules()
        self._thread = threading.Thread(target=self._run, name=f"virtual bus {self.path}", daemon=True)
        self._thread.start()
        return self

    def _run(self) -> None:
        self._error = lib.hub_loop_run(self._loop)

    @property
    def stats(self) -> BusStats:
        """The counters so far; after close(), the last ones."""
        if self._final is not None:
            return self._final
        if self._loop == ffi.NULL:
            raise CanductorError(f"virtual bus {self.path}: not started, so it has no counters yet")
        return _read_stats(self._loop, len(self._faults))

    def close(self) -> None:
        """Disconnect all clients and remove the socket; further calls do nothing.

        Raises CanductorError when the bus had failed before.
        """
        if self._thread is None:
            return
        lib.hub_loop_stop(self._loop)
        self._thread.join()
        self._thread = None
        self._final = _read_stats(self._loop, len(self._faults))
        lib.hub_loop_free(self._loop)
        self._loop = ffi.NULL
        self._close_listener()
        if self._error:
            raise CanductorError(f"virtual bus {self.path}: failed: {os.strerror(self._error)}")

    def _close_listener(self) -> None:
        assert self._listener is not None
        # Only our own socket: another bus may have replaced it.
        with contextlib.suppress(FileNotFoundError):
            if self.path.stat().st_ino == self._inode:
                self.path.unlink()
        self._listener.close()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _read_stats(loop: object, fault_count: int) -> BusStats:
    report: Any = ffi.new("struct hub_report *")
    lib.hub_loop_report(loop, report)
    return from_struct(
        BusStats,
        report.counters,
        late_ns_max=report.late_ns_max,
        realtime=report.realtime,
        clients=tuple(
            from_struct(ClientStats, client.counters, place=client.place)
            for client in report.clients[0 : report.client_count]
        ),
        faults=tuple(from_struct(FaultStats, rule) for rule in report.rules[0:fault_count]),
    )


def _listen(path: Path) -> socket.socket:
    """Open a listening socket at PATH; the file of a bus that failed is replaced."""
    _remove_stale(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listener.bind(os.fspath(path))
        listener.listen(BACKLOG)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        if error.errno == errno.EADDRINUSE:
            raise CanductorError(
                f"virtual bus {path}: another bus has just taken this path; choose another"
            ) from error
        raise CanductorError(
            f"virtual bus {path}: cannot create the socket: {error.strerror}; the folder must exist and be"
            " writable"
        ) from error
    return listener


def _remove_stale(path: Path) -> None:
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise CanductorError(
                f"virtual bus {path}: the path is a file other than a socket; choose another path"
            )
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.setblocking(False)  # a bus whose backlog is full is in use too
            probe.connect(os.fspath(path))
    except ConnectionRefusedError:
        path.unlink(missing_ok=True)
    except FileNotFoundError:
        pass
    except BlockingIOError as error:
        raise _in_use(path) from error
    except OSError as error:
        raise CanductorError(f"virtual bus {path}: cannot use this path: {error.strerror}") from error
    else:
        raise _in_use(path)


def _in_use(path: Path) -> CanductorError:
    return CanductorError(
        f"virtual bus {path}: a bus is already running there; stop it or choose another path"
    )
