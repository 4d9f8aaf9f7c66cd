"""The seed's pseudo code of MT, sender and receiver, as literally as Python goes.

Kept only as a peer for tests. What the pseudo code leaves open is a parameter: INCLUSIVE sends i = 0..l as
written, which is one pair more than it announces.
"""

from collections.abc import Iterator, Sequence

ESC = 0x80000000
LIT = 0x80000001
MASK_ = 0x10000000
START_ = 0x20000000
CKLOW_ = 0x30000000
CKHIGH_ = 0x40000000
DATMASK = 0x0FFFFFFF
CMDMASK = 0xF0000000
U32 = 0xFFFFFFFF

STATUS_OK, STATUS_TRANSMITTING, STATUS_CHECKSUM_ERROR, STATUS_LENGTH_ERROR = range(4)
MODE_COMMAND, MODE_VALUE, MODE_LITERAL = range(3)

Pairs = Sequence[tuple[int, int]]


def send(table: Pairs, mask: int, *, inclusive: bool = False) -> Iterator[int]:
    """Yield what the literal sender sends of TABLE; INCLUSIVE announces its last index as l."""
    l = len(table) - 1 if inclusive else len(table)  # noqa: E741
    checksum = sum(x + y for x, y in table) & U32  # of 32-bit integers
    yield ESC
    yield ESC
    yield MASK_ + mask
    yield CKHIGH_ + (checksum >> 16)
    yield CKLOW_ + (checksum & 0xFFFF)
    yield START_ + l
    last = ESC
    for x, y in table:
        for signed in (x, y):
            val = signed & U32
            if val in (ESC, LIT, last):
                yield LIT
            yield val
            last = val
    yield ESC
    yield ESC


class Receiver:
    """The literal receiver; ``table`` and ``length`` are what it serves."""

    def __init__(self, my_axle_index: int) -> None:
        self.my_axle_index = my_axle_index
        self.mode = MODE_COMMAND
        self.is_selected = False
        self.table_status = STATUS_OK
        self.checksum = 0
        self.current_checksum = 0
        self.status = STATUS_OK
        self.announced = 0
        self.current_length = 0
        self.transfer_y = True
        self.X: dict[int, int] = {}
        self.Y: dict[int, int] = {}
        self.table_length = 0

    @property
    def table(self) -> list[tuple[int, int]]:
        """The table as signed pairs."""
        return [(_signed(self.X[i]), _signed(self.Y[i])) for i in range(self.table_length)]

    def read(self, val: int) -> None:
        """One turn of the loop."""
        if self.mode in (MODE_VALUE, MODE_LITERAL):
            new_data = True
            if self.mode == MODE_LITERAL:
                self.mode = MODE_VALUE
            elif val == ESC:
                self.mode = MODE_COMMAND
                new_data = False
                if self.is_selected:
                    self.status = STATUS_OK
                    if self.current_checksum != self.checksum:
                        self.status = STATUS_CHECKSUM_ERROR
                    if self.current_length != self.announced:
                        self.status = STATUS_LENGTH_ERROR
                    if self.status != STATUS_OK:
                        self.table_length = 0
                    else:
                        self.table_length = self.current_length
                    self.table_status = self.status
            elif val == LIT:
                self.mode = MODE_LITERAL
                new_data = False
            if self.is_selected and new_data:
                if not self.transfer_y:
                    self.X[self.current_length] = val
                    self.transfer_y = True
                else:
                    self.Y[self.current_length] = val
                    self.transfer_y = False
                    self.current_length = self.current_length + 1
                self.current_checksum = (self.current_checksum + val) & U32
        elif self.mode == MODE_COMMAND:
            code = val & CMDMASK
            if code == MASK_:
                self.is_selected = bool(val & (1 << (self.my_axle_index - 1)))
            elif code == CKHIGH_:
                if self.is_selected:
                    self.checksum = (val & DATMASK) << 16
            elif code == CKLOW_:
                if self.is_selected:
                    self.checksum = self.checksum | (val & DATMASK)
            elif code == START_ and self.is_selected:
                self.announced = val & DATMASK
                self.current_length = 0
                self.transfer_y = False
                self.current_checksum = 0
                self.status = STATUS_TRANSMITTING
                self.mode = MODE_VALUE


class ChangedOnly:
    """The register between sender and receiver: "the read value is different each time"."""

    def __init__(self) -> None:
        self._last: int | None = None

    def pass_on(self, words: Iterator[int]) -> Iterator[int]:
        """Yield those of WORDS that a poll sees."""
        for word in words:
            if word != self._last:
                yield word
            self._last = word


def _signed(word: int) -> int:
    return word - (1 << 32) if word & ESC else word
