"""Which dictionary of the user's cache explains the traffic of a node that was never asked. Sans-IO.

A message's number means something else in each firmware, so that a wrong dictionary soon meets a block that
it cannot read, to the byte. What it can read may still be chance: therefore one counts only when the node's
clock, which every host asks for about once a second, runs at the rate that the dictionary names. When several
are left, they have to agree on the name of everything heard. It stays a guess, is called one, and is taken
back as soon as a block contradicts it.
"""

from collections.abc import Iterable
from typing import Final

from canbus_tools.protocol.protocol import Direction
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.message_format import Message
from nodes.dictionary.parts import DictionaryError

CLOCK_RESPONSES: Final = ("clock", "uptime")
SPAN_MIN_S: Final = 0.2
SPAN_MAX_S: Final = 10.0
"""Between two answers that are compared."""
LATE_S: Final = 0.03
"""How much longer one of them may have taken than the other, on a busy computer."""
RATE_TOLERANCE: Final = 0.002
_WRAP: Final = 1 << 32


class Guess:
    """One node's blocks, tried with every dictionary that it might have."""

    def __init__(self, candidates: Iterable[Dictionary]) -> None:
        self._left = [_Candidate(dictionary) for dictionary in candidates]

    @property
    def is_open(self) -> bool:
        """Whether hearing more may find one."""
        return bool(self._left)

    def take(self, direction: Direction, content: bytes, time_s: float) -> tuple[Dictionary, ...]:
        """Take what a block holds; returns the dictionaries that fit, which is none while that is open.

        In the order in which they were given; of everything heard until now all of them say the same.
        """
        self._left = [candidate for candidate in self._left if candidate.explains(direction, content, time_s)]
        fitting = [candidate for candidate in self._left if candidate.clock_fits]
        if any(candidate.heard != fitting[0].heard for candidate in fitting):
            return ()
        return tuple(candidate.dictionary for candidate in fitting)

    def refuse(self, dictionary: Dictionary) -> None:
        """Take note that it is not this one."""
        self._left = [candidate for candidate in self._left if candidate.dictionary is not dictionary]


class _Candidate:
    """A dictionary that has explained everything so far."""

    def __init__(self, dictionary: Dictionary) -> None:
        self.dictionary = dictionary
        self.clock_fits = False
        self.heard: set[tuple[Direction, int, str]] = set()
        """Numbers of messages, and what they are called here."""
        self._clock: tuple[float, int] | None = None
        """Time and value of the node's last clock report."""
        try:
            self._clock_hz = dictionary.clock_freq_hz
        except DictionaryError:
            self._clock_hz = 0

    def explains(self, direction: Direction, content: bytes, time_s: float) -> bool:
        if direction is Direction.TO_NODE:
            commands = self.dictionary.decode_commands(content)
            if commands is None:
                return False
            self.heard |= {
                (direction, self.dictionary.commands[command.name].message_id, command.name)
                for command in commands
            }
            return True
        response = self.dictionary.decode(content)
        if response is None:
            return False
        format_ = self.dictionary.responses.get(response.name)
        if format_ is not None:  # else a debug output, which no other firmware has alike
            self.heard.add((direction, format_.message_id, response.name))
            self._compare_clock(response, time_s)
        return True

    def _compare_clock(self, response: Message, time_s: float) -> None:
        ticks = response.params.get("clock")
        if response.name not in CLOCK_RESPONSES or not isinstance(ticks, int) or not self._clock_hz:
            return
        before, self._clock = self._clock, (time_s, ticks)
        if before is None or not SPAN_MIN_S <= time_s - before[0] <= SPAN_MAX_S:
            if before is not None and 0 <= time_s - before[0] < SPAN_MIN_S:
                self._clock = before  # or else one that is asked often would never be compared
            return
        span_s = time_s - before[0]
        # Both counts are modulo 2^32, as the clock on the wire is.
        off = (ticks - before[1] - round(span_s * self._clock_hz) + _WRAP // 2) % _WRAP - _WRAP // 2
        if abs(off) <= (LATE_S + RATE_TOLERANCE * span_s) * self._clock_hz:
            self.clock_fits = True
