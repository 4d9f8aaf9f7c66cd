"""Transfers over a line that flips bits, loses characters and answers, and makes noise, in virtual time.

Each ends with the identical file or with a sentence and no file; no line is ever doubled or missing, and
whoever is told that his file was kept is told the truth.

Usage, from the project's root: python -m tests.coordinator.dnc.ordeal
[--transfers N] [--seed N] [--any-damage] [--verify N] [--trace]
"""

import argparse
import collections
import random
import sys
from dataclasses import dataclass

from coordinator.dnc.options import DncOptions, read_frame
from coordinator.dnc.protocol import events
from coordinator.dnc.protocol.engine import Engine
from tests.coordinator.dnc.line import Faults, Line, Owner, Wire

FRAMES = ("7E1", "7O1", "8N1", "8E1", "7N2", "8N2")
BAUD = (1200, 9600, 19200, 115200)
WORDS = b'N0123456789 XYZ+-.GFMLRB777"BEGIN PGM CCDFAUT'


@dataclass(frozen=True)
class Case:
    """One transfer."""

    number: int
    options: DncOptions
    faults: Faults
    lines: tuple[bytes, ...]
    control_sends: bool


@dataclass(frozen=True)
class Verdict:
    """What became of it: kept, failed; and the number of blocks that were sent again."""

    kept: bool
    unseen: bool
    repeats: int
    sentence: str
    sender_says: str
    noise_bytes: int


def make_case(number: int, *, visible: bool = True) -> Case:
    """Return the case of that NUMBER, always the same."""
    chance = random.Random(number)
    options = DncOptions(
        frame=read_frame(chance.choice(FRAMES)),
        baud=chance.choice(BAUD),
        dc1=chance.random() < 0.5,
        avoid_control=chance.random() < 0.5,
        transmissions=chance.choice((3, 15)),
        paced=True,
    )
    quiet = chance.random() < 0.05
    faults = Faults(
        bit_errors=0.0 if quiet else chance.choice((0, 1e-5, 1e-4, 5e-4)),
        lost=0.0 if quiet else chance.choice((0, 1e-4, 1e-3)),
        lost_answers=0.0 if quiet else chance.choice((0, 0, 0, 0.01)),
        noise=0.0 if quiet else chance.choice((0, 0, 0.02, 0.2)),
        chunk=chance.choice((1, 1, 16, 64)),
        delay_s=chance.choice((0, 0, 0.0005, 0.016)),
        visible=visible,
    )
    longest = chance.choice((8, 30, 80, 198))
    lines = tuple(
        bytes(chance.choices(WORDS, k=chance.randint(0, longest)))
        for _ in range(chance.choice((0, 1, 5, 30)))
    )
    return Case(number, options, faults, lines, chance.random() < 0.5)


def build(case: Case, again: int = 0) -> tuple[Line, Owner, Owner]:
    """Return the line, the control and the peripheral; AGAIN: with other faults."""
    control = Engine(case.options, 0.0, peripheral=False)
    peripheral = Engine(case.options, 0.0, peripheral=True)
    owners = (
        Owner(control, case.lines if case.control_sends else None),
        Owner(peripheral, None if case.control_sends else case.lines),
    )
    chances = [random.Random(case.number * 3 + i + again * 1_000_003) for i in range(3)]
    wires = (Wire(case.faults, case.options, chances[0]), Wire(case.faults, case.options, chances[1]))
    (control.send if case.control_sends else control.fetch)("D", "PART1")
    return Line(owners, wires, chances[2]), *owners


def judge_twice(case: Case, times: range = range(1, 2)) -> tuple[bool, bool]:
    """Play CASE twice, with each of TIMES as the second; AssertionError: both bring the same wrong file.

    Returns whether the first brought a wrong one, and whether any two were alike.
    """
    first, alike = _received(case, 0), False
    if first is None:
        return False, False
    for again in times:
        second = _received(case, again)
        alike = alike or second == first
        assert second != first or first == case.lines, f"the same wrong file twice ({again})"
    return first != case.lines, alike


def _received(case: Case, again: int) -> tuple[bytes, ...] | None:
    """Return the lines that are kept."""
    line, control, peripheral = build(case, again)
    line.run()
    kept = (peripheral if case.control_sends else control).kept
    return None if kept is None else tuple(kept)


def judge(case: Case) -> Verdict:
    """Play CASE; raises AssertionError if it ends as no transfer may."""
    line, control, peripheral = build(case)
    line.run()
    return verdict_of(case, control, peripheral)


def verdict_of(case: Case, control: Owner, peripheral: Owner) -> Verdict:
    """Tell what became of CASE; raises AssertionError if it ended as no transfer may."""
    sender, receiver = (control, peripheral) if case.control_sends else (peripheral, control)
    unseen = False
    if receiver.kept is not None:
        unseen = not case.faults.visible and tuple(receiver.kept) != case.lines
        assert unseen or tuple(receiver.kept) == case.lines, "the file that was kept differs"
    elif receiver.outcome is not None:
        assert isinstance(receiver.outcome, events.Failed), receiver.outcome
        assert receiver.outcome.sentence
    else:
        assert receiver.header is None, "a transfer that began ended without a word"
        assert isinstance(sender.outcome, events.Failed)
    if isinstance(sender.outcome, events.Sent) and sender.outcome.confirmed:
        assert receiver.kept is not None, "the sender was told that the file was kept"
    assert sender.outcome is not None or sender.header is None, "the sender was not told what became of it"
    engines = (control.engine, peripheral.engine)
    failed = next((o for o in (receiver.outcome, sender.outcome) if isinstance(o, events.Failed)), None)
    return Verdict(
        receiver.kept is not None,
        unseen,
        sum(engine.repeats for engine in engines),
        "" if failed is None else failed.sentence,
        "nothing" if sender.outcome is None else type(sender.outcome).__name__,
        sum(engine.noise_bytes for engine in engines),
    )


def main() -> int:
    """Play many, tell the numbers of those that ended wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--transfers", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0, help="number of the first transfer")
    parser.add_argument("--any-damage", action="store_true", help="also damage that nobody can see; counted")
    parser.add_argument(
        "--verify", type=int, default=0, metavar="N", help="compare with N second transfers each"
    )
    parser.add_argument("--trace", action="store_true", help="show what went over the line")
    given = parser.parse_args()
    if given.verify:
        return verify(given)
    tally: collections.Counter[str] = collections.Counter(kept=0, failed=0, wrong=0)
    why: collections.Counter[str] = collections.Counter()
    for number in range(given.seed, given.seed + given.transfers):
        case = make_case(number, visible=not given.any_damage)
        if given.trace:
            trace(case)
        try:
            verdict = judge(case)
        except AssertionError as error:
            tally["wrong"] += 1
            sys.stdout.write(f"transfer {number}: {error}\n")
            continue
        tally["kept" if verdict.kept else "failed"] += 1
        tally["kept, with damage that nobody can see"] += verdict.unseen
        tally["blocks sent again"] += verdict.repeats
        tally["bytes of noise"] += verdict.noise_bytes
        if not verdict.kept:
            why[verdict.sentence] += 1
    for sentence, count in why.most_common(25):
        sys.stdout.write(f"{count:6} {sentence}\n")
    sys.stdout.write(f"{given.transfers} transfers: {dict(tally)}\n")
    return 1 if tally["wrong"] else 0


def verify(given: argparse.Namespace) -> int:
    """Play each N times more, and compare; tell how many that came wrong were found out."""
    tally: collections.Counter[str] = collections.Counter(wrong=0)
    for number in range(given.seed, given.seed + given.transfers):
        try:
            was_wrong, alike = judge_twice(
                make_case(number, visible=not given.any_damage), range(1, 1 + given.verify)
            )
        except AssertionError as error:
            tally["wrong"] += 1
            sys.stdout.write(f"transfer {number}: {error}\n")
        else:
            tally["alike"] += alike
            tally["came wrong and found out"] += was_wrong
    sys.stdout.write(f"{given.transfers} transfers, {given.verify} second ones each: {dict(tally)}\n")
    return 1 if tally["wrong"] else 0


def trace(case: Case) -> None:
    """Show CASE byte by byte."""
    line, control, peripheral = build(case)
    sys.stdout.write(f"{case}\n")
    try:
        line.run()
    finally:
        log = [(at, who, text) for who, wire in enumerate(line.wires) for at, text in wire.log]
        for at_s, who, text in sorted(log):
            sys.stdout.write(f"{at_s:10.5f} {'to control   ' if who == 0 else 'to peripheral'} {text}\n")
        sys.stdout.write(f"control {control.outcome}, peripheral {peripheral.outcome}\n")


if __name__ == "__main__":
    sys.exit(main())
