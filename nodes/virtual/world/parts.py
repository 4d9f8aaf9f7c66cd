"""Wires of a simulated world, their controllers, and the host's ports on them. Made by `World`."""

from collections.abc import Callable
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final

from nodes.link.types import BusSettings
from nodes.support.c_structs import field_names
from nodes.virtual._sim import ffi, lib
from nodes.virtual.world.settings import WorldError, check_probability, to_ns

if TYPE_CHECKING:
    from nodes.virtual.world.world import World

ID_MAX: Final = 0x7FF
DATA_MAX: Final = 8


class CanState(IntEnum):
    """A controller's state (``enum can_state``)."""

    ACTIVE = 0
    WARN = 1
    PASSIVE = 2
    OFF = 3


def counters(struct: Any) -> dict[str, int]:
    """Return the counters of the C struct at STRUCT by name."""
    return {name: int(getattr(struct, name)) for name in field_names(struct)}


class CanController:
    """A controller on a CAN wire: faults, state, counters."""

    def __init__(self, world: "World", raw: Any, name: str) -> None:
        self.name = name
        self._world = world
        self._raw = raw

    def set_faults(self, *, loss: float | None = None, corruption: float | None = None) -> None:
        """Change the probabilities that a received frame is lost, or has an unnoticed wrong bit."""
        _set_faults(lib.world_can_controller_settings(self._raw), loss, corruption)

    def status(self) -> dict[str, int]:
        """Return tec, rec, retries, queued frames and state (a CanState)."""
        status = ffi.new("struct can_controller_status *")
        lib.world_can_status(self._raw, status)
        return counters(status)

    @property
    def state(self) -> CanState:
        """The state by its error counters."""
        return CanState(self.status()["state"])

    def counters(self) -> dict[str, int]:
        """Return its counters since it was created."""
        return counters(lib.world_can_controller_counters(self._raw))

    def send(self, can_id: int, data: bytes = b"") -> bool:
        """Queue a frame; return False when the queue is full."""
        _check_frame(can_id, data)
        return bool(lib.world_can_send(self._raw, can_id, data, len(data)) == 0)

    def babble(self, can_id: int, data: bytes, duration_s: float) -> None:
        """Send the frame continuously for DURATION_S from now."""
        _check_frame(can_id, data)
        until_ns = self._world.now_ns + to_ns(duration_s, "a babble")
        lib.world_can_babble(self._raw, can_id, data, len(data), until_ns)

    def cut(self, segment: int) -> None:
        """Move this end of the cable to SEGMENT (0..3); all begin on 0."""
        if not 0 <= segment < lib.CAN_SEGMENTS_MAX:
            raise WorldError(f"a simulated cable has no segment {segment}; cut it into segments 0..3")
        lib.can_cut(self._raw, segment)

    def restart(self) -> None:
        """Start the recovery from bus-off."""
        lib.can_restart(self._raw)


def _set_faults(settings: Any, loss: float | None, corruption: float | None) -> None:
    if loss is not None:
        settings.loss = check_probability(loss, "a loss")
    if corruption is not None:
        settings.corruption = check_probability(corruption, "a corruption")


def _check_frame(can_id: int, data: bytes) -> None:
    if not (0 <= can_id <= ID_MAX and len(data) <= DATA_MAX):
        raise WorldError(f"not a CAN frame: id {can_id:#x} with {len(data)} bytes; give 0..0x7ff and 0..8")


class CanWire:
    """A CAN bus."""

    def __init__(self, world: "World", raw: Any, name: str, bitrate: int) -> None:
        self.name = name
        self.bitrate = bitrate
        self._world = world  # owns RAW
        self.raw = raw

    def set_bit_errors(self, probability: float) -> None:
        """Change the probability that a bit is disturbed for all controllers."""
        lib.world_can_settings(self.raw).bit_errors = check_probability(probability, "bit errors")

    def counters(self) -> dict[str, int]:
        """Return the counters of the wire."""
        return counters(lib.world_can_counters(self.raw))


class Uart:
    """A serial line."""

    def __init__(self, world: "World", raw: Any, name: str, baud: int) -> None:
        self.name = name
        self.baud = baud
        self._world = world  # owns RAW
        self.raw = raw

    def set_faults(self, *, loss: float | None = None, corruption: float | None = None) -> None:
        """Change the probabilities that a byte is lost, or has a wrong bit."""
        _set_faults(lib.world_uart_settings(self.raw), loss, corruption)

    def inject(self, data: bytes) -> None:
        """Put DATA on the line in both directions, among what is sent; what has no room is lost."""
        for to_node in (0, 1):
            lib.world_uart_inject(self.raw, to_node, data, len(data))

    def counters(self) -> dict[str, int]:
        """Return the counters of the line."""
        return counters(lib.world_uart_counters(self.raw))


class Port:
    """A port of the host; `open` returns the driver for ``LinkIO.driven_by``."""

    serial = False

    def __init__(self, world: "World", raw: Any, name: str, bitrate: int) -> None:
        self.name = name
        self.bitrate = bitrate
        self._world = world
        self._raw = raw

    def open(self, settings: BusSettings | None = None) -> "SimDriver":
        """Start a bus; SETTINGS: as for a real one, by default with the wire's bit rate."""
        if not lib.world_port_there(self._raw):
            raise WorldError(f"{self.name}: there is no such device")
        known = settings or BusSettings(bitrate=self.bitrate)
        bus = lib.world_port_open(self._raw, ffi.new("struct io_settings *", known.as_dict()))
        if bus == ffi.NULL:
            raise WorldError(f"{self.name}: the port is in use; close the bus on it first")
        return SimDriver(self._world, self._raw, bus, self.name, serial=self.serial)

    @property
    def raw(self) -> Any:
        """The port in C."""
        return self._raw

    @property
    def there(self) -> bool:
        """Whether the device is there, to be opened."""
        return bool(lib.world_port_there(self._raw))

    def fail(self, cause: int = 0) -> None:
        """Remove the adapter: the bus ends with errno CAUSE (0: end of file)."""
        lib.world_port_fail(self._raw, cause)

    def counters(self) -> dict[str, int]:
        """Return the counters of the kernel's queues and the I/O thread."""
        return counters(lib.world_port_counters(self._raw))


class CanPort(Port):
    """A CAN interface of the host."""

    def __init__(self, world: "World", raw: Any, name: str, bitrate: int) -> None:
        super().__init__(world, raw, name, bitrate)
        self.controller = CanController(world, lib.world_port_controller(raw), name)


class UartPort(Port):
    """A serial device of the host."""

    serial = True


class SimDriver:
    """Driver of one bus inside the world; its interface is described in nodes/link/io/io_core.h."""

    def __init__(self, world: "World", raw: Any, bus: Any, name: str, *, serial: bool) -> None:
        self.name = name
        self.serial = serial
        self.ffi = ffi
        self.lib = lib
        self.bus = bus
        self._world = world
        self._raw = raw

    def listen(self, handler: Callable[[], None]) -> None:
        """Call HANDLER, in the world's loop, when io_take() has something."""
        self._world.listen(self._raw, handler)

    def close(self) -> None:
        """End the bus; the port can be opened again."""
        self._world.listen(self._raw, None)
        lib.world_port_close(self._raw)
