"""Every fault of one character, at every place of a small transfer: what becomes of the file.

A character is replaced by each other one, gets lost, or noise of each value comes: right before it, or into
the pause behind it. Frame 8N1: no parity betrays anything. Lines that follow one another are the same twice.

Usage, from the project's root: python -m tests.coordinator.dnc.corruption [--answers]
"""

import argparse
import collections
import itertools
import random
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from coordinator.dnc.options import DncOptions, read_frame
from coordinator.dnc.protocol import events
from coordinator.dnc.protocol.blocks import ACK, DC1, DC3, EOT, ETB, ETX, NAK, SOH, STX
from coordinator.dnc.protocol.engine import Engine
from tests.coordinator.dnc.line import Faults, Line, Owner, Wire

LINES = (b"X1", b"X1", b"", b"Y7")
PAUSES_S = {"insert": 0.0, "noise at once": 0.0005, "noise": 0.05}
ALL = range(256)
TELLING = (SOH, STX, ETX, EOT, ACK, DC1, DC3, NAK, ETB, 0x00, ord("X"), 0x80 | ACK)
"""Values that mean something, and some that do not."""


@dataclass(frozen=True)
class Fault:
    """What happens to the character AT of those that the end WHO sends."""

    who: int
    at: int
    kind: str
    value: int = 0


class FaultyWire(Wire):
    """One that does it; counts what is sent."""

    def __init__(self, options: DncOptions, fault: Fault | None) -> None:
        super().__init__(Faults(), options, random.Random(1))
        self.fault = fault
        self.count = 0
        self.sent = bytearray()

    def send(self, data: bytes, now_s: float) -> list[tuple[float, bytes]]:
        arrives: list[tuple[float, bytes]] = []
        for at_s, character in super().send(data, now_s):
            fault = self.fault
            hit = fault is not None and fault.at == self.count
            self.count += 1
            self.sent += character
            if not hit or fault is None:
                arrives.append((at_s, character))
            elif fault.kind == "replace":
                arrives.append((at_s, bytes([fault.value])))
            elif fault.kind == "insert":
                arrives.append((at_s, bytes([fault.value]) + character))
            elif fault.kind != "lose":
                arrives += [(at_s, character), (at_s + PAUSES_S[fault.kind], bytes([fault.value]))]
        return sorted(arrives, key=lambda arrival: arrival[0])


@dataclass(frozen=True)
class Result:
    """How a transfer ended."""

    kept: tuple[bytes, ...] | None
    sender: events.Event | None
    receiver: events.Event | None
    sent: tuple[bytes, bytes]
    """By whom: control, peripheral."""

    @property
    def verdict(self) -> str:
        """same, none (with a sentence), silent (without), doubled, missing, other."""
        if self.kept is None:
            told = isinstance(self.sender, events.Failed) or isinstance(self.receiver, events.Failed)
            return "none" if told else "silent"
        if self.kept == LINES:
            return "same"
        if len(self.kept) > len(LINES):
            return "doubled"
        return "missing" if len(self.kept) < len(LINES) else "other"


def play(fault: Fault | None, *, control_sends: bool, paced: bool) -> Result:
    """Play the transfer with FAULT."""
    options = DncOptions(frame=read_frame("8N1"), paced=paced, dc1=False)
    control = Owner(Engine(options, 0.0, peripheral=False), LINES if control_sends else None)
    peripheral = Owner(Engine(options, 0.0, peripheral=True), None if control_sends else LINES)
    (control.engine.send if control_sends else control.engine.fetch)("D", "P")
    # The wire to the control carries what the peripheral sends.
    wires = tuple(
        FaultyWire(options, fault if fault is not None and fault.who == who else None) for who in (1, 0)
    )
    line = Line((control, peripheral), (wires[0], wires[1]), random.Random(1))
    line.run()
    sender, receiver = (control, peripheral) if control_sends else (peripheral, control)
    kept = None if receiver.kept is None else tuple(receiver.kept)
    return Result(kept, sender.outcome, receiver.outcome, (bytes(wires[1].sent), bytes(wires[0].sent)))


def faults(sent: tuple[bytes, bytes], values: Iterable[int], *, answers: bool) -> Iterator[Fault]:
    """Return the faults of a transfer in which the two SENT that; ANSWERS: of single characters alone."""
    for who, at in ((end, n) for end in (0, 1) for n in range(len(sent[end]))):
        if answers and sent[who][at] not in (ACK, NAK, ETX, EOT):
            continue
        yield Fault(who, at, "lose")
        for kind, value in itertools.product(("replace", *PAUSES_S), values):
            yield Fault(who, at, kind, value)


def search(values: Iterable[int], *, answers: bool) -> tuple[collections.Counter[str], list[str]]:
    """Play all; return how many ended how, and what is said of those that ended wrong."""
    tally: collections.Counter[str] = collections.Counter()
    wrong = []
    for control_sends, paced in itertools.product((True, False), (True, False)):
        sound = play(None, control_sends=control_sends, paced=paced)
        assert sound.verdict == "same"
        for fault in faults(sound.sent, values, answers=answers):
            result = play(fault, control_sends=control_sends, paced=paced)
            tally[result.verdict] += 1
            if result.verdict not in ("same", "none"):
                was = sound.sent[fault.who][fault.at]
                wrong.append(f"{result.verdict}: {fault.kind} {was:02X} {fault.value:02X}")
    return tally, wrong


def main() -> int:
    """Play all, and tell what ended wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--answers", action="store_true", help="faults of answers and ends alone")
    given = parser.parse_args()
    tally, wrong = search(ALL, answers=given.answers)
    for sentence, count in collections.Counter(wrong).most_common():
        sys.stdout.write(f"{count:6} {sentence}\n")
    sys.stdout.write(f"{sum(tally.values())} transfers: {dict(tally)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
