"""Ways by which words of MT reach drives that cannot answer: CAN frames, bytes of a serial line, a register.

A drive as MT was made for polls a register that each frame, or each four bytes, writes: it needs one word at
a time, T apart. Others take whole frames and streams, which go within a share of the bus, or at the baud
rate.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import serial

from canbus_tools.bus.computer import Computer, FrameLine
from canbus_tools.bus.open_bus import BusOptions
from nodes.mt.cost import CanCost, RegisterCost, SerialCost, frame_bits, literals
from nodes.mt.device_job import DeviceJob, DeviceKind, Load
from nodes.mt.download import BURST_FRAMES, SLOW_BITRATE
from nodes.mt.mt import WORD_BYTES, MtError, to_bytes, to_frames, transmission
from nodes.mt.pace import NS_PER_S, PacedFrames, PacedWords
from nodes.support.errors import CanductorError
from nodes.transport import CanFrame

SILENCE_S: Final = 0.15
"""Before a stream of bytes: receivers take what follows a pause for the beginning of a word."""
PIECE_WORDS: Final = 16
"""Of a stream, written at once."""
BITS_OF_BYTE: Final = 10
WRITE_TIMEOUT_S: Final = 5.0


@dataclass(frozen=True, slots=True)
class Sent:
    """One transmission that went out."""

    load: Load
    words: int
    elapsed_s: float
    cost: CanCost | SerialCost | RegisterCost
    """With what it takes at least."""


class _Line(Protocol):
    """Carries bytes of words: a frame's on CAN, any number on a serial line."""

    def write(self, data: bytes) -> None: ...
    def pause_until(self, at_ns: int) -> None: ...
    def close(self) -> None: ...


class CanLine:
    """A bus; frames of others are read and counted, as they limit the share that is left."""

    def __init__(self, computer: Computer, bus: FrameLine, can_id: int) -> None:
        self.heard_bits = 0
        self._computer = computer
        self._bus = bus
        self._can_id = can_id

    def write(self, data: bytes) -> None:
        """Send one frame; raises CanductorError."""
        self._bus.send(CanFrame(self._can_id, data))

    def pause_until(self, at_ns: int) -> None:
        """Let others' frames come until AT_NS, and look for those that are there already."""
        while True:
            left_s = (at_ns - self._computer.monotonic_ns()) / NS_PER_S
            frame = self._bus.receive(max(0.0, left_s))
            if frame is not None:
                self.heard_bits += sum(frame_bits([frame.data], frame.id))
            elif left_s <= 0:
                return

    def close(self) -> None:
        """Send what waits, if the bus takes it."""
        self._bus.close()


class SerialLine:
    """A serial device or a pyserial URL; 8 data bits, no parity. Raises CanductorError."""

    def __init__(self, computer: Computer, name: str, baud: int) -> None:
        self._computer = computer
        self._name = name
        try:
            self._port: Any = serial.serial_for_url(
                name,
                baudrate=baud,
                timeout=0,
                write_timeout=WRITE_TIMEOUT_S,
                **({"exclusive": True} if "://" not in name else {}),
            )
        except (OSError, ValueError, OverflowError) as error:
            why = getattr(error, "strerror", None) or str(error)
            raise CanductorError(f"{name} cannot be opened at {baud} baud: {why}") from None

    def write(self, data: bytes) -> None:
        """Send DATA; raises CanductorError when the line does not take it."""
        try:
            self._port.write(data)
            self._port.flush()
        except (OSError, ValueError) as error:  # a SerialTimeoutException is an OSError
            raise CanductorError(
                f"{self._name} takes no bytes: {error}; check its plug, and send the table again"
            ) from None

    def pause_until(self, at_ns: int) -> None:
        """Wait; there are no answers."""
        self._computer.sleep(max(0, at_ns - self._computer.monotonic_ns()) / NS_PER_S)

    def close(self) -> None:
        """Let the line go."""
        with contextlib.suppress(OSError):
            self._port.close()


def send_blind(computer: Computer, job: DeviceJob, options: BusOptions | None) -> tuple[Sent, ...]:
    """Send all loads of JOB, on the bus of OPTIONS or the serial line; raises CanductorError."""
    words = [transmission(load.pairs, load.axles) for load in job.loads]  # all are right, or none is sent
    if job.kind is DeviceKind.SERIAL:
        line: _Line = SerialLine(computer, job.device, job.baud)
    else:
        assert options is not None
        line = CanLine(computer, computer.open_frames(options), job.can_id)
    with contextlib.closing(line):
        return tuple(
            _send(computer, job, line, load, sending) for load, sending in zip(job.loads, words, strict=True)
        )


def _send(computer: Computer, job: DeviceJob, line: _Line, load: Load, words: Sequence[int]) -> Sent:
    if job.delay_s is not None:
        return _to_register(computer, line, load, words, job.delay_s)
    return (
        _send_frames(computer, job, line, load, words)
        if isinstance(line, CanLine)
        else _stream(computer, job, line, load, words)
    )


def _to_register(computer: Computer, line: _Line, load: Load, words: Sequence[int], delay_s: float) -> Sent:
    """Send one word after the other, DELAY_S apart; the last one has its time too."""
    began_ns = computer.monotonic_ns()
    paced = PacedWords(words, round(delay_s * NS_PER_S), began_ns)
    while (due_ns := paced.deadline_ns) is not None:
        line.pause_until(due_ns)
        word = paced.take(computer.monotonic_ns())
        if word is not None:
            line.write(word.to_bytes(WORD_BYTES, "little"))
    line.pause_until(computer.monotonic_ns() + round(delay_s * NS_PER_S))
    elapsed_s = (computer.monotonic_ns() - began_ns) / NS_PER_S
    return Sent(load, len(words), elapsed_s, register_cost(load, words, delay_s))


def register_cost(load: Load, words: Sequence[int], delay_s: float) -> RegisterCost:
    """Return what it takes at least to send WORDS of LOAD one by one."""
    return RegisterCost(len(load.pairs), len(words), literals(words), delay_s)


def _send_frames(computer: Computer, job: DeviceJob, line: CanLine, load: Load, words: Sequence[int]) -> Sent:
    frames = to_frames(words)
    costs = frame_bits(frames, job.can_id)
    bitrate = job.bitrate or SLOW_BITRATE
    began_ns, line.heard_bits = computer.monotonic_ns(), 0
    paced = PacedFrames(costs, job.share * bitrate, BURST_FRAMES * max(costs), began_ns)
    _pace(computer, paced, line, frames)
    elapsed_s = (computer.monotonic_ns() - began_ns) / NS_PER_S
    others = min(1.0, line.heard_bits / bitrate / elapsed_s)
    return Sent(load, len(words), elapsed_s, CanCost(len(frames), sum(costs), bitrate, job.share, others))


def _stream(computer: Computer, job: DeviceJob, line: _Line, load: Load, words: Sequence[int]) -> Sent:
    data = to_bytes(words)
    size = PIECE_WORDS * WORD_BYTES
    pieces = [data[at : at + size] for at in range(0, len(data), size)]
    line.pause_until(computer.monotonic_ns() + round(SILENCE_S * NS_PER_S))
    began_ns = computer.monotonic_ns()
    costs = [len(piece) * BITS_OF_BYTE for piece in pieces]
    _pace(computer, PacedFrames(costs, job.baud, 0, began_ns), line, pieces)
    return Sent(
        load, len(words), (computer.monotonic_ns() - began_ns) / NS_PER_S, SerialCost(len(data), job.baud)
    )


def _pace(computer: Computer, paced: PacedFrames, line: _Line, pieces: Sequence[bytes]) -> None:
    """Send PIECES as PACED allows, and wait until the last one is paid for."""
    at = 0
    while (due_ns := paced.deadline_ns) is not None:
        line.pause_until(due_ns)
        count = paced.take(computer.monotonic_ns())
        for piece in pieces[at : at + count]:
            line.write(piece)
        at += count
    if at == 0:
        raise MtError("there is nothing to be sent")
    line.pause_until(paced.paid_ns)
