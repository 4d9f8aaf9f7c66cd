"""One simulated node: the real firmware, with its time and its wires in the caller's hand."""

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nodes.support.errors import CanductorError
from nodes.virtual._sim import ffi, lib
from nodes.virtual.plant import NodePlant
from nodes.virtual.sim_plant import SimPlant

_CLOCK_LIMIT = 1 << 47
_MOVE_COUNT_MAX = 0xFFFF
_CLOCK_FREQ_LIMIT = (1 << 31) // 5  # five seconds between statistics have to fit into 2^31 ticks
_EDGE_LEVEL_BITS, _EDGE_CLOCK_SHIFT, _EDGE_PIN_MASK = 1, 16, 0x7FFF


class SimNode:
    """A node in this process; any number may live side by side.

    UUID: 12 hex digits. START_CLOCK: its 64-bit clock at the beginning, in ticks below 2^47. TRANSPORT
    decides which of the receive and take methods act. Not thread-safe: one thread at a time.

    CLOCK_FREQ (ticks per second) and MOVE_COUNT (slots of the move queue) are those of the build's variant
    unless given; DICTIONARY (zlib-compressed) is what `identify` gives instead of the build's own, with the
    same numbers for the same commands. LEGACY: behave as firmware without this project's CAN extensions.

    Time moves only in `run_until`. Inputs act at the clock reached so far, and what they cause at once has
    happened when the call returns. Raises CanductorError for a uuid, clock, frequency, count, pin or value
    that cannot be.
    """

    def __init__(
        self,
        uuid: str = "000000000001",
        start_clock: int = 0,
        transport: Literal["can", "uart"] = "can",
        *,
        clock_freq: int | None = None,
        move_count: int | None = None,
        dictionary: bytes | None = None,
        legacy: bool = False,
    ) -> None:
        if len(uuid) != 12 or set(uuid) - set("0123456789abcdefABCDEF"):
            raise CanductorError(f"the uuid {uuid!r} of a simulated node must be 12 hex digits")
        if not 0 <= start_clock < _CLOCK_LIMIT:
            raise CanductorError(f"the start clock {start_clock} of a simulated node must lie in 0..2^47-1")
        if clock_freq is not None and not 0 < clock_freq < _CLOCK_FREQ_LIMIT:
            raise CanductorError(f"the clock of a simulated node cannot run at {clock_freq} Hz")
        if move_count is not None and not 0 < move_count <= _MOVE_COUNT_MAX:
            raise CanductorError(f"a simulated node cannot have a move queue of {move_count} slots")
        uuid_bytes = ffi.new("uint8_t[]", bytes.fromhex(uuid))
        self._dictionary = ffi.NULL if dictionary is None else ffi.new("uint8_t[]", dictionary)
        options = ffi.new(
            "struct sim_options *",
            {
                "uuid": uuid_bytes,
                "start_clock": start_clock,
                "on_can": transport == "can",
                "clock_freq": clock_freq or 0,
                "move_count": move_count or 0,
                "dictionary": self._dictionary,
                "dictionary_size": len(dictionary or b""),
                "legacy": legacy,
            },
        )
        board = lib.sim_new_with(options)
        if not board:
            raise MemoryError
        self._board = ffi.gc(board, lib.sim_free)
        self._transport = transport
        self._out = ffi.new("uint8_t[]", lib.SIM_OUT_ROOM)
        self._edges: list[npt.NDArray[np.uint64]] = []

    @property
    def clock(self) -> int:
        """The node's clock, 64 bits of ticks."""
        return int(lib.sim_clock(self._board))

    @property
    def clock_freq(self) -> int:
        """Ticks per second."""
        return int(self._counters().clock_freq)

    @property
    def node_id(self) -> int:
        """The assigned node id, 0 when there is none."""
        return int(self._counters().node_id)

    def receive_frame(self, can_id: int, data: bytes) -> None:
        """Let a CAN frame of at most 8 bytes arrive."""
        if len(data) > 8:
            raise CanductorError(f"a CAN frame holds at most 8 bytes, not {len(data)}")
        lib.sim_receive_frame(self._board, can_id, data, len(data))

    def receive_bytes(self, data: bytes) -> None:
        """Let bytes arrive on the UART, all at once: what exceeds the receive buffer is lost."""
        lib.sim_receive_bytes(self._board, data, len(data))

    def run_until(self, clock: int) -> None:
        """Execute everything due up to and including CLOCK (64 bits of ticks), which then is now."""
        lib.sim_run_until(self._board, clock)

    def next_deadline(self) -> int | None:
        """Return the clock of the next event without input; a running node always has one."""
        return int(lib.sim_next_deadline(self._board))

    def take_frames(self) -> list[tuple[int, bytes]]:
        """Return the CAN frames sent since the last call, oldest first, as (id, data)."""
        raw = self._take()
        return [
            (int.from_bytes(raw[at : at + 4], "little"), raw[at + 8 : at + 8 + raw[at + 4]])
            for at in range(0, len(raw), lib.SIM_FRAME_SIZE)
        ]

    def take_bytes(self) -> bytes:
        """Return the bytes sent on the UART since the last call."""
        return self._take()

    def _take(self) -> bytes:
        taken = b""
        while size := lib.sim_take(self._board, self._out, lib.SIM_OUT_ROOM):
            taken += bytes(ffi.buffer(self._out, size))
        return taken

    def set_input(self, pin: int, level: int) -> None:
        """Set what the input PIN (0..143) reads."""
        if lib.sim_set_input(self._board, pin, level):
            raise CanductorError(f"a simulated node has no pin {pin}")

    def set_adc(self, pin: int, value: int) -> None:
        """Set what a sample of PIN gives, 0..4095."""
        if not 0 <= value <= 4095 or lib.sim_set_adc(self._board, pin, value):
            raise CanductorError(f"a simulated node has no pin {pin} that could read {value}")

    def level(self, pin: int) -> int:
        """Return the level of PIN."""
        return int(lib.sim_level(self._board, pin))

    def pwm(self, pin: int) -> int:
        """Return the hardware PWM value of PIN."""
        return int(lib.sim_pwm(self._board, pin))

    def edges(self) -> npt.NDArray[np.uint64]:
        """Return all changes of outputs since the start: clock << 16 | pin << 1 | level, oldest first."""
        count = ffi.new("size_t *")
        first = lib.sim_edges(self._board, count)
        if count[0]:
            fresh = np.frombuffer(bytes(ffi.buffer(first, count[0] * 8)), dtype=np.uint64)
            lib.sim_edges_forget(self._board)
            self._edges.append(fresh)
        if lib.sim_edges_lost(self._board):
            raise MemoryError
        if len(self._edges) > 1:
            self._edges = [np.concatenate(self._edges)]
        return self._edges[0].copy() if self._edges else np.empty(0, np.uint64)

    def forget_edges(self) -> None:
        """Drop the changes recorded so far."""
        lib.sim_edges_forget(self._board)
        self._edges.clear()

    def start_plant(self, plant: NodePlant) -> SimPlant:
        """Connect the pins with PLANT from now on; raises CanductorError. Use it while the node lives."""
        return SimPlant(self._board, plant)

    def counters(self) -> dict[str, int]:
        """Return the node's own counters of damaged, dropped and accepted input."""
        found = self._counters()
        names = ("rx_overflow_bytes", "rx_lost", "rx_out_of_order", "rx_blocks", "tx_dropped", "timers_run")
        return {name: int(getattr(found, name)) for name in names}

    def _counters(self) -> Any:
        found = ffi.new("struct sim_counters *")
        lib.sim_counters(self._board, found)
        return found

    def reset(self) -> None:
        """Restart as by a power cycle: unconfigured and without node id. The clock goes on."""
        lib.sim_restart(self._board)


def edge_clocks(edges: npt.NDArray[np.uint64], pin: int) -> npt.NDArray[np.uint64]:
    """Return the clocks (48 bits) at which PIN changed."""
    pins = (edges >> np.uint64(_EDGE_LEVEL_BITS)) & np.uint64(_EDGE_PIN_MASK)
    clocks: npt.NDArray[np.uint64] = edges[pins == np.uint64(pin)] >> np.uint64(_EDGE_CLOCK_SHIFT)
    return clocks
