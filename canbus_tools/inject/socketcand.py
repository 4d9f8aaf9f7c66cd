"""The server's side of one socketcand connection, without any I/O.

socketcand is the text protocol by which Linux programs reach a CAN bus over TCP
(github.com/linux-can/socketcand, doc/protocol.md). Commands and answers stand between ``<`` and ``>``. A
client is greeted, opens a bus and is then in BCM mode, where it hears only the ids it subscribed to; most go
on to raw mode, where they hear everything. Here both modes have ``send``, ``echo`` and the change to the
other; BCM mode also has ``subscribe``, ``filter``, ``unsubscribe`` and the cyclic ``add``, ``update`` and
``delete``. ISO-TP, multiplex filters and statistics are refused.

Bad input gets ``< error … >`` and is counted; nothing a client sends raises. The buses carry data frames with
11-bit ids only.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from nodes.transport.frame import DATA_MAX, ID_MAX, CanFrame

COMMAND_MAX: Final = 256
"""Bytes of one command; the longest that is understood has 60."""
JOBS_MAX: Final = 64
"""Cyclic jobs of one client."""
INTERVAL_MIN_S: Final = 0.001
"""A shorter one would be more than a bus carries."""
SETTLE_S: Final = 0.02
"""How long after the change to raw mode frames are held back. Clients (python-can's is one) read the answer
``< ok >`` and fail when a frame comes in the same packet, which on a busy bus would be the rule."""
HELD_MAX: Final = 4096
"""Frames held back meanwhile; more than any bus carries in that time."""


class Mode(Enum):
    """What the client may do next."""

    NO_BUS = "no bus"
    BCM = "bcmmode"
    RAW = "rawmode"


@dataclass(slots=True)
class Job:
    """A frame sent again and again."""

    frame: CanFrame
    interval_s: float
    due_s: float


@dataclass(slots=True)
class Subscription:
    """What a client in BCM mode wants to hear of one id."""

    interval_s: float
    """At most one frame in this time; what comes sooner waits, only the latest is kept."""
    mask: bytes | None
    """None: every frame; else only frames in which these bits, or the length, changed."""
    last: CanFrame | None = None
    """The last frame that was sent to the client."""
    next_s: float = -math.inf
    waiting: tuple[CanFrame, float] | None = None
    """A frame and its Unix time, to be sent to the client at ``next_s``."""

    def is_new(self, frame: CanFrame) -> bool:
        """Whether the client wants to hear this frame."""
        if self.mask is None or self.last is None or len(frame.data) != len(self.last.data):
            return True
        return any((a ^ b) & bit for a, b, bit in zip(frame.data, self.last.data, self.mask, strict=False))


class _RefusedError(Exception):
    """A command that cannot be done; the sentence goes to the client."""


@dataclass(slots=True)
class SocketcandSession:
    """One connection to a server of BUSES. Bytes in by ``receive``, frames of the bus by ``receive_frame``.

    After each call take ``frames_to_send`` (to the bus) and ``output`` (to the client), and call
    ``handle_timer`` at ``next_deadline()``. Times are seconds of one monotonic clock, ``unix_s`` is for the
    client to read.
    """

    buses: Sequence[str]
    mode: Mode = Mode.NO_BUS
    closing: bool = False
    """The connection is to be closed when the output has been sent."""
    errors: int = 0
    """Commands that were refused."""
    _input: bytearray = field(default_factory=bytearray)
    _output: bytearray = field(default_factory=lambda: bytearray(b"< hi >"))
    _frames: list[CanFrame] = field(default_factory=list)
    _jobs: dict[int, Job] = field(default_factory=dict)
    _subscriptions: dict[int, Subscription] = field(default_factory=dict)
    _held: list[tuple[CanFrame, float]] = field(default_factory=list)
    _held_until_s: float = -math.inf

    # ------------------------------------------------------------------------------------------- the client

    def receive(self, data: bytes, now_s: float) -> None:
        """Take bytes of the client; in whatever pieces they come."""
        if self.closing:
            return
        self._input += data
        at = 0
        while not self.closing:
            begin = self._input.find(b"<", at)
            if begin < 0:
                at = len(self._input)  # between commands nothing has a meaning
                break
            at, end = begin, self._input.find(b">", begin)
            if end < 0:
                break
            at = end + 1
            self._obey(bytes(self._input[begin + 1 : end]), now_s)
        del self._input[:at]
        if len(self._input) > COMMAND_MAX:
            self._input.clear()
            self._refuse(f"a command has at most {COMMAND_MAX} bytes")

    def output(self) -> bytes:
        """Return what is to be sent to the client, and forget it."""
        data = bytes(self._output)
        self._output.clear()
        return data

    def _say(self, text: str) -> None:
        self._output += f"< {text} >".encode("ascii", "replace")

    def _refuse(self, sentence: str) -> None:
        self.errors += 1
        # What the client sent must not end the answer.
        self._say("error " + sentence.translate({ord("<"): "?", ord(">"): "?"}))

    def _obey(self, command: bytes, now_s: float) -> None:
        if len(command) > COMMAND_MAX:
            self._refuse(f"a command has at most {COMMAND_MAX} bytes")
            return
        name, *words = command.decode("ascii", "replace").split() or [""]
        try:
            _command(name, self.mode)(self, words, now_s)
        except _RefusedError as refused:
            self._refuse(str(refused))
            self.closing = self.mode is Mode.NO_BUS

    # --------------------------------------------------------------------------------------------- commands

    def _open(self, words: list[str], _: float) -> None:
        name = " ".join(words)
        if name not in self.buses:
            raise _RefusedError(f"there is no bus '{name[:16]}' here, only {', '.join(self.buses)}")
        self.mode = Mode.BCM
        self._say("ok")

    def _change_mode(self, mode: Mode, words: list[str], now_s: float) -> None:
        _no_more(mode.value, words)
        self.mode = mode
        # The protocol ends the jobs and subscriptions of BCM mode with it.
        self._jobs.clear()
        self._subscriptions.clear()
        self._held.clear()
        self._held_until_s = now_s + SETTLE_S if mode is Mode.RAW else -math.inf
        self._say("ok")

    def _echo(self, words: list[str], _: float) -> None:
        _no_more("echo", words)
        self._say("echo")

    def _send(self, words: list[str], _: float) -> None:
        self._frames.append(_frame("send", words))

    def _add(self, words: list[str], now_s: float) -> None:
        interval_s, frame = _interval("add", words), _frame("add", words[2:])
        if interval_s < INTERVAL_MIN_S:
            raise _RefusedError(f"add: an interval has at least {INTERVAL_MIN_S * 1e6:.0f} microseconds")
        if frame.id not in self._jobs and len(self._jobs) == JOBS_MAX:
            raise _RefusedError(f"add: there are {JOBS_MAX} cyclic frames already")
        self._jobs[frame.id] = Job(frame, interval_s, now_s + interval_s)
        self._frames.append(frame)

    def _update(self, words: list[str], _: float) -> None:
        frame = _frame("update", words)
        if frame.id not in self._jobs:
            raise _RefusedError(f"update: no cyclic frame {frame.id:03X}")
        self._jobs[frame.id].frame = frame

    def _delete(self, words: list[str], _: float) -> None:
        can_id = _only_id("delete", words)
        if self._jobs.pop(can_id, None) is None:
            raise _RefusedError(f"delete: no cyclic frame {can_id:03X}")

    def _subscribe(self, words: list[str], _: float) -> None:
        interval_s, can_id = _interval("subscribe", words), _only_id("subscribe", words[2:])
        self._subscriptions[can_id] = Subscription(interval_s, None)

    def _filter(self, words: list[str], _: float) -> None:
        interval_s, mask = _interval("filter", words), _frame("filter", words[2:])
        self._subscriptions[mask.id] = Subscription(interval_s, mask.data)

    def _unsubscribe(self, words: list[str], _: float) -> None:
        can_id = _only_id("unsubscribe", words)
        if self._subscriptions.pop(can_id, None) is None:
            raise _RefusedError(f"unsubscribe: no subscription of {can_id:03X}")

    # ----------------------------------------------------------------------------------------------- the bus

    def frames_to_send(self) -> list[CanFrame]:
        """Return what is to go over the bus, and forget it."""
        frames, self._frames = self._frames, []
        return frames

    def receive_frame(self, frame: CanFrame, now_s: float, unix_s: float) -> None:
        """Take a frame from the bus."""
        if self.mode is Mode.RAW:
            if now_s < self._held_until_s and len(self._held) < HELD_MAX:
                self._held.append((frame, unix_s))
            else:
                self._let_go()
                self._send_frame(frame, unix_s)
        elif (wanted := self._subscriptions.get(frame.id)) is not None and wanted.is_new(frame):
            wanted.waiting = (frame, unix_s)
            self._send_waiting(wanted, now_s)

    def next_deadline(self) -> float:
        """When ``handle_timer`` has something to do; infinite when it has not."""
        dues_s = [job.due_s for job in self._jobs.values()]
        dues_s += [wanted.next_s for wanted in self._subscriptions.values() if wanted.waiting]
        if self._held:
            dues_s.append(self._held_until_s)
        return min(dues_s, default=math.inf)

    def handle_timer(self, now_s: float) -> None:
        """Do what is due."""
        if now_s >= self._held_until_s:
            self._let_go()
        for wanted in self._subscriptions.values():
            self._send_waiting(wanted, now_s)
        for job in self._jobs.values():
            if now_s >= job.due_s:
                self._frames.append(job.frame)
                # Who comes late does not make up for what was missed, nor loses the beat.
                missed = math.floor((now_s - job.due_s) / job.interval_s)
                job.due_s += (missed + 1) * job.interval_s

    def _let_go(self) -> None:
        for frame, unix_s in self._held:
            self._send_frame(frame, unix_s)
        self._held.clear()

    def _send_waiting(self, wanted: Subscription, now_s: float) -> None:
        if wanted.waiting is None or now_s < wanted.next_s:
            return
        frame, unix_s = wanted.waiting
        wanted.waiting, wanted.last, wanted.next_s = None, frame, now_s + wanted.interval_s
        self._send_frame(frame, unix_s)

    def _send_frame(self, frame: CanFrame, unix_s: float) -> None:
        # Data in one word, as socketcand itself does (its document shows spaces); without any, two spaces.
        self._say(f"frame {frame.id:03X} {unix_s:.6f} {frame.data.hex().upper()}")


# ------------------------------------------------------------------------------------------------- words


def _unknown(name: str, mode: Mode) -> str:
    if mode is Mode.NO_BUS:
        return "open a bus first: open NAME"
    if any(name in commands for commands in _COMMANDS.values()):
        return f"{name} is no command of {mode.value}"
    return f"unknown command '{name[:32]}'"


def _command(name: str, mode: Mode) -> "_Command":
    commands = _COMMANDS[mode]
    if name not in commands:
        raise _RefusedError(_unknown(name, mode))
    return commands[name]


def _no_more(name: str, words: list[str]) -> None:
    if words:
        raise _RefusedError(f"{name} takes no words")


def _decimal(name: str, what: str, text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= 9):
        raise _RefusedError(f"{name}: {what} is '{text[:16]}', must be a decimal number")
    return int(text)


def _hex(name: str, what: str, text: str, high: int) -> int:
    if not (1 <= len(text) <= 8 and all(c in "0123456789abcdefABCDEF" for c in text)):
        raise _RefusedError(f"{name}: {what} is '{text[:16]}', must be a hexadecimal number")
    value = int(text, 16)
    if value > high:
        raise _RefusedError(f"{name}: {what} is {text}, must be at most {high:X}")
    return value


def _interval(name: str, words: list[str]) -> float:
    if len(words) < 3:
        raise _RefusedError(f"{name} needs seconds, microseconds and an id")
    return _decimal(name, "seconds", words[0]) + _decimal(name, "microseconds", words[1]) * 1e-6


def _id(name: str, text: str) -> int:
    if len(text) > 3:  # eight digits are how the protocol writes an extended id, however small
        raise _RefusedError(f"{name}: this bus has only 11-bit ids, of at most three hexadecimal digits")
    return _hex(name, "the id", text, ID_MAX)


def _only_id(name: str, words: list[str]) -> int:
    if len(words) != 1:
        raise _RefusedError(f"{name} needs one id")
    return _id(name, words[0])


def _frame(name: str, words: list[str]) -> CanFrame:
    if len(words) < 2:
        raise _RefusedError(f"{name} needs an id, a length and as many bytes")
    can_id, length = _id(name, words[0]), _hex(name, "the length", words[1], DATA_MAX)
    if len(words) != 2 + length:
        raise _RefusedError(f"{name}: the length is {length}, and there are {len(words) - 2} bytes")
    return CanFrame(can_id, bytes(_hex(name, "a byte", word, 0xFF) for word in words[2:]))


_Command = Callable[[SocketcandSession, list[str], float], None]
# The methods are this class's own, only their names are not for others.
_BOTH: Final[dict[str, _Command]] = {
    "send": SocketcandSession._send,  # noqa: SLF001
    "echo": SocketcandSession._echo,  # noqa: SLF001
    "rawmode": lambda self, *given: self._change_mode(Mode.RAW, *given),
    "bcmmode": lambda self, *given: self._change_mode(Mode.BCM, *given),
}
_COMMANDS: Final[dict[Mode, dict[str, _Command]]] = {
    Mode.NO_BUS: {"open": SocketcandSession._open, "echo": SocketcandSession._echo},  # noqa: SLF001
    Mode.RAW: _BOTH,
    Mode.BCM: _BOTH
    | {
        "add": SocketcandSession._add,  # noqa: SLF001
        "update": SocketcandSession._update,  # noqa: SLF001
        "delete": SocketcandSession._delete,  # noqa: SLF001
        "subscribe": SocketcandSession._subscribe,  # noqa: SLF001
        "filter": SocketcandSession._filter,  # noqa: SLF001
        "unsubscribe": SocketcandSession._unsubscribe,  # noqa: SLF001
    },
}
