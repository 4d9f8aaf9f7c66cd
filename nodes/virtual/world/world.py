"""A simulated world (world.h): creates its parts, advances its time, and reads its true state."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from nodes.virtual._sim import ffi, lib
from nodes.virtual.plant import NodePlant
from nodes.virtual.sim_plant import SimPlant
from nodes.virtual.world.parts import CanController, CanPort, CanWire, Uart, UartPort, counters
from nodes.virtual.world.settings import (
    ControllerSettings,
    Latency,
    NodeSettings,
    PortSettings,
    UartSettings,
    WorldError,
    to_ns,
)

START_NS: Final = 1_000_000_000_000
"""Host time at which a world begins: not zero, like real clocks."""
EDGE_DTYPE: Final = np.dtype(
    [
        ("true_ps", "<i8"),
        ("clock", "<u8"),
        ("pin", "<u2"),
        ("level", "u1"),
        ("padding", "u1"),
        ("life", "<u4"),
    ]
)
_SEED_LIMIT: Final = 1 << 64
_CLOCK_LIMIT: Final = 1 << 47
_CLOCK_FREQ_LIMIT: Final = (1 << 31) // 5  # five seconds between statistics have to fit into 2^31 ticks
_MOVE_COUNT_MAX: Final = 0xFFFF


class World:
    """A world determined by SEED (0..2^64-1). Not thread-safe; WorldError for invalid arguments."""

    def __init__(self, seed: int, *, start_ns: int = START_NS, python: Latency | None = None) -> None:
        if not 0 <= seed < _SEED_LIMIT:
            raise WorldError(f"the seed {seed} of a simulated world must lie in 0..2^64-1")
        self.seed = seed
        self._raw = ffi.gc(_made(lib.world_new(seed, start_ns)), lib.world_free)
        self._handlers: dict[int, Callable[[], None]] = {}
        self._keep: list[object] = []
        if python is not None:
            _assign(lib.world_python_latency(self._raw), python.as_dict())

    # ------------------------------------------------------------------------------------------------ time

    @property
    def now_ns(self) -> int:
        """True time: the host's CLOCK_MONOTONIC."""
        return int(lib.world_now(self._raw))

    def run_until(self, until_ns: int) -> bool:
        """Advance time; return True when it stopped earlier because ports have something (`noticed`)."""
        return bool(lib.world_run(self._raw, until_ns))

    def run_for(self, duration_s: float) -> None:
        """Advance time by DURATION_S, and handle notices as they occur."""
        until_ns = self.now_ns + to_ns(duration_s, "a duration")
        while self.run_until(until_ns):
            for handler in self.noticed():
                handler()

    def noticed(self) -> list[Callable[[], None]]:
        """Return the handlers to be called for the notices so far."""
        handlers = []
        while (port := lib.world_noticed(self._raw)) != ffi.NULL:
            handler = self._handlers.get(int(ffi.cast("uintptr_t", port)))
            if handler is not None:
                handlers.append(handler)
        return handlers

    def listen(self, port: Any, handler: Callable[[], None] | None) -> None:
        """Call HANDLER for the notices of PORT (``struct world_port *``); None: no handler."""
        key = int(ffi.cast("uintptr_t", port))
        if handler is None:
            self._handlers.pop(key, None)
        else:
            self._handlers[key] = handler

    @property
    def listening(self) -> bool:
        """Whether any port has a handler."""
        return bool(self._handlers)

    def python_wakes_ns(self, due_ns: int) -> int:
        """Return when Python code that waits until DUE_NS continues: after its latency, or a stall."""
        return int(lib.world_python_wakes(self._raw, due_ns))

    @property
    def python_stalled_ns(self) -> int:
        """Time until which Python does not run."""
        return int(lib.world_python_stalled(self._raw))

    def stall(self, duration_s: float, *, io: bool = True, python: bool = True) -> None:
        """Stall the host's I/O threads (IO) and its Python (PYTHON) for DURATION_S from now."""
        lib.world_stall(self._raw, self.now_ns + to_ns(duration_s, "a stall"), io, python)

    @property
    def trace(self) -> int:
        """Hash of all events so far: equal in two runs with the same events."""
        return int(lib.world_trace(self._raw))

    @property
    def events(self) -> int:
        """Number of events so far."""
        return int(lib.world_events(self._raw))

    # ------------------------------------------------------------------------------------------ parts

    def add_can(self, name: str = "can0", *, bitrate: int = 1_000_000, bit_errors: float = 0.0) -> CanWire:
        """Add a CAN bus (BITRATE 10000..1000000)."""
        if not 10_000 <= bitrate <= 1_000_000:
            raise WorldError(f"{name}: a CAN bus of {bitrate} bit/s; give 10000..1000000")
        settings = ffi.new("struct can_wire_settings *", {"bitrate": bitrate})
        wire = CanWire(self, _made(lib.world_add_can(self._raw, settings)), name, bitrate)
        wire.set_bit_errors(bit_errors)
        return wire

    def add_can_port(
        self,
        wire: CanWire,
        *,
        name: str | None = None,
        controller: ControllerSettings | None = None,
        settings: PortSettings | None = None,
    ) -> CanPort:
        """Add an interface of the host on WIRE."""
        controller = controller or ControllerSettings()
        if not 1 <= controller.queue <= lib.CAN_QUEUE_MAX:
            raise WorldError(f"{wire.name}: a transmit queue of {controller.queue} frames; give 1..1024")
        c_controller = ffi.new("struct can_controller_settings *", controller.as_dict())
        c_settings = ffi.new("struct world_port_settings *", (settings or PortSettings()).as_dict())
        raw = _made(lib.world_add_can_port(self._raw, wire.raw, c_controller, c_settings))
        return CanPort(self, raw, name or wire.name, wire.bitrate)

    def add_uart(self, name: str = "uart", settings: UartSettings | None = None) -> Uart:
        """Add a serial line."""
        settings = settings or UartSettings()
        if not 300 <= settings.baud <= 20_000_000 or not 0 <= settings.noise_bytes <= lib.WORLD_UART_MAX:
            raise WorldError(f"{name}: a line of {settings.baud} baud, {settings.noise_bytes} bytes of noise")
        raw = _made(
            lib.world_add_uart(self._raw, ffi.new("struct world_uart_settings *", settings.as_dict()))
        )
        return Uart(self, raw, name, settings.baud)

    def add_uart_port(self, uart: Uart, *, settings: PortSettings | None = None) -> UartPort:
        """Add the host's end of UART; there is one."""
        c_settings = ffi.new("struct world_port_settings *", (settings or PortSettings()).as_dict())
        raw = _made(lib.world_add_uart_port(self._raw, uart.raw, c_settings))
        return UartPort(self, raw, uart.name, uart.baud)

    def add_node(
        self,
        wire: CanWire | Uart,
        uuid: str,
        *,
        settings: NodeSettings | None = None,
        start_clock: int = 0,
        clock_freq: int = 0,
        move_count: int = 0,
        dictionary: bytes | None = None,
        legacy: bool = False,
    ) -> "WorldNode":
        """Add a node with UUID (12 hex digits) on WIRE; it is powered and boots.

        The other options are those of ``struct sim_options``.
        """
        if len(uuid) != 12 or set(uuid) - set("0123456789abcdefABCDEF"):
            raise WorldError(f"the uuid {uuid!r} of a simulated node must be 12 hex digits")
        _check_clock(start_clock)
        if not (0 <= clock_freq < _CLOCK_FREQ_LIMIT and 0 <= move_count <= _MOVE_COUNT_MAX):
            raise WorldError(
                f"node {uuid}: no clock of {clock_freq} Hz or queue of {move_count} slots; 0: the default"
            )
        on_can = isinstance(wire, CanWire)
        c_dictionary = ffi.NULL if dictionary is None else ffi.new("uint8_t[]", dictionary)
        self._keep.append(c_dictionary)  # the node uses it until the world ends
        raw_uuid = ffi.new("uint8_t[]", bytes.fromhex(uuid))
        options = ffi.new(
            "struct sim_options *",
            {
                "uuid": raw_uuid,
                "start_clock": start_clock,
                "on_can": on_can,
                "clock_freq": clock_freq,
                "move_count": move_count,
                "dictionary": c_dictionary,
                "dictionary_size": len(dictionary or b""),
                "legacy": legacy,
            },
        )
        pace = ffi.new("struct world_node_settings *", (settings or NodeSettings()).as_dict())
        can, uart = (wire.raw, ffi.NULL) if on_can else (ffi.NULL, wire.raw)
        return WorldNode(self, _made(lib.world_add_node(self._raw, options, pace, can, uart)), uuid)


class WorldNode:
    """A node of the world, and its true state."""

    def __init__(self, world: World, raw: Any, uuid: str) -> None:
        self.uuid = uuid
        self._world = world
        self.raw = raw
        controller = lib.world_node_controller(raw)
        self.controller = None if controller == ffi.NULL else CanController(world, controller, uuid)
        """None on a serial line."""

    # ------------------------------------------------------------------------------------- power and faults

    def reset(self) -> None:
        """Reset it now; it boots again, its clock continues."""
        lib.world_node_reset(self.raw)

    def power_off(self) -> None:
        """Switch its power off: outputs fall, it neither sends nor receives."""
        lib.world_node_power_off(self.raw)

    def power_on(self, start_clock: int = 0) -> None:
        """Switch its power on again; its clock begins with START_CLOCK."""
        _check_clock(start_clock)
        lib.world_node_power_on(self.raw, start_clock)

    def carries(self, port: CanPort | UartPort, gone_s: float) -> None:
        """Have PORT be a USB device on this board, which disappears at resets and comes back after GONE_S."""
        lib.world_node_carries(self.raw, port.raw, to_ns(gone_s, "an absence"))

    def set_pace(self, *, task: Latency | None = None, irq_jitter_s: float | None = None) -> None:
        """Change its latencies."""
        settings = lib.world_node_settings(self.raw)
        if task is not None:
            _assign(settings.task, task.as_dict())
        if irq_jitter_s is not None:
            settings.irq_jitter_ns = to_ns(irq_jitter_s, "a jitter")

    def set_boot(self, boot_s: float) -> None:
        """From the next reset on its firmware starts after BOOT_S."""
        lib.world_node_settings(self.raw).boot_ns = to_ns(boot_s, "a boot time")

    def set_rate(self, ppm: float, ppm_per_s: float = 0.0) -> None:
        """From now on its clock runs PPM above nominal, rising by PPM_PER_S: a board that warms up."""
        if lib.world_node_set_rate(self.raw, ppm, ppm_per_s):
            raise WorldError(
                f"node {self.uuid}: its clock's rate was changed {lib.WORLD_RATES_MAX} times already"
            )

    def lie(self, clock_hz: int, offset_s: float, spread_s: float = 0.0) -> None:
        """From now on it answers by a clock (CLOCK_HZ) wrong by OFFSET_S, up to SPREAD_S more at random.

        Its timers, and so the steps that it was sent already, stay right.
        """
        board = lib.world_node_board(self.raw)
        lib.sim_lie(board, round(offset_s * clock_hz), round(spread_s * clock_hz))

    @property
    def expected(self) -> tuple[int, int]:
        """Its node id, and the sequence number of the block that it would accept next."""
        board = lib.world_node_board(self.raw)
        return int(lib.sim_node_id(board)), int(lib.sim_expected(board))

    def set_input(self, pin: int, level: int, at_ns: int = 0) -> None:
        """Set the input PIN at AT_NS (or now); it persists over resets."""
        self._plan(lib.world_node_set_input(self.raw, pin, level, at_ns), pin)

    def set_adc(self, pin: int, value: int, at_ns: int = 0) -> None:
        """Set the sample value of PIN (0..4095), at AT_NS (or now)."""
        self._plan(-1 if value < 0 else lib.world_node_set_adc(self.raw, pin, value, at_ns), pin)

    def _plan(self, status: int, pin: int) -> None:
        if status:
            limit = lib.WORLD_ACTIONS_MAX
            raise WorldError(
                f"node {self.uuid}: no such pin or value ({pin}), or {limit} changes wait already"
            )

    def start_plant(self, plant: NodePlant) -> SimPlant:
        """Connect the pins with PLANT from now on; raises CanductorError.

        Its pins no longer follow set_input and set_adc. `connect_plants` connects several.
        """
        return SimPlant(lib.world_node_board(self.raw), plant, lambda: self._world.now_ns)

    # ------------------------------------------------------------------------------------------ true state

    @property
    def clock(self) -> int:
        """Its clock now, 64 bits of ticks."""
        return int(lib.world_node_clock(self.raw))

    @property
    def ppm(self) -> float:
        """Its clock's rate error now."""
        return float(lib.world_node_ppm(self.raw))

    def true_ps(self, clocks: npt.NDArray[np.uint64]) -> npt.NDArray[np.int64]:
        """Return the true times, in ps, at which its clock became CLOCKS (since the last power on)."""
        clocks = np.ascontiguousarray(clocks, np.uint64)
        out = np.empty(len(clocks), np.int64)
        raw_in = ffi.cast("uint64_t *", clocks.ctypes.data)
        lib.world_node_true_ps(self.raw, raw_in, len(clocks), ffi.cast("int64_t *", out.ctypes.data))
        return out

    def edges(self) -> npt.NDArray[Any]:
        """Return all changes of outputs so far, oldest first: EDGE_DTYPE; WorldError when some were lost."""
        if self.counters()["edges_lost"]:
            raise WorldError(f"node {self.uuid} had more than {lib.WORLD_EDGES_MAX} edges; simulate less")
        count = ffi.new("size_t *")
        first = lib.world_node_edges(self.raw, count)
        raw = bytes(ffi.buffer(first, count[0] * EDGE_DTYPE.itemsize)) if count[0] else b""
        return np.frombuffer(raw, EDGE_DTYPE)

    def level(self, pin: int) -> int:
        """Return the level of PIN now."""
        return int(lib.sim_level(lib.world_node_board(self.raw), pin))

    def counters(self) -> dict[str, int]:
        """Return the counters of the world and of the firmware (the firmware's restart at a reset)."""
        firmware = ffi.new("struct sim_counters *")
        lib.sim_counters(lib.world_node_board(self.raw), firmware)
        return counters(lib.world_node_counters(self.raw)) | counters(firmware)


def _made(raw: Any) -> Any:
    if raw == ffi.NULL:
        raise WorldError(
            "cannot create a part of a simulated world: its place is taken, or memory is exhausted"
        )
    return raw


def _assign(struct: Any, values: dict[str, int]) -> None:
    for name, value in values.items():
        setattr(struct, name, value)


def _check_clock(clock: int) -> None:
    if not 0 <= clock < _CLOCK_LIMIT:
        raise WorldError(f"the start clock {clock} of a simulated node must lie in 0..2^47-1")
