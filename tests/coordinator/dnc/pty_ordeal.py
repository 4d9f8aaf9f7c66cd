"""The ordeal's transfers over a pseudo-terminal pair in real time: real ports, two threads, a bad cable.

Usage, from the project's root: python -m tests.coordinator.dnc.pty_ordeal [--transfers N] [--seed N]
"""

import argparse
import collections
import random
import sys
import threading
import time
from dataclasses import replace

from coordinator.dnc.driver import Driver
from coordinator.dnc.port import Port
from coordinator.dnc.protocol.engine import Engine, State
from tests.coordinator.dnc.cable import Cable
from tests.coordinator.dnc.line import Owner, Wire
from tests.coordinator.dnc.ordeal import Case, Verdict, make_case, verdict_of

LOOK_S = 0.02
QUIET_S = 0.4
"""After which nothing more comes of a transfer."""


class Faulty:
    """What the cable does, with the faults of CASE, to what is sent over it."""

    def __init__(self, case: Case) -> None:
        self._chance = random.Random(case.number)
        self._wires = tuple(
            Wire(case.faults, case.options, random.Random(case.number * 3 + i)) for i in range(2)
        )

    def change(self, who: int, data: bytes) -> bytes:
        """See cable.Change; noise follows at once."""
        wire = self._wires[who]
        arrives = b"".join(piece for _, piece in wire.send(data, wire.busy_until_s))
        if self._chance.random() < wire.faults.noise:
            arrives += b"".join(piece for _, piece in wire.noise(wire.busy_until_s))
        return arrives


def quick(case: Case) -> Case:
    """Return CASE with the patience of a machine."""
    options = replace(case.options, baud=115200, paced=False)
    options = replace(options, character_s=0.1, nak_quiet_s=0.12, answer_s=2.0, decide_s=2.0)
    return replace(case, options=options)


class End(threading.Thread):
    """An owner on a port, until nothing more comes of its transfer."""

    def __init__(self, port: Port, owner: Owner, control_is_over: threading.Event) -> None:
        super().__init__()
        self.wrong: BaseException | None = None
        self._driver = Driver(port, owner.engine)
        self._owner, self._control_is_over = owner, control_is_over

    def run(self) -> None:
        try:
            self._run()
        except BaseException as error:  # noqa: BLE001 (handed on to who waits)
            self.wrong = error
            self._control_is_over.set()

    def _run(self) -> None:
        engine, heard_s = self._driver.engine, time.monotonic()
        while True:
            for event in self._driver.wait(time.monotonic() + LOOK_S):
                self._owner.act(event)
                heard_s = time.monotonic()
            self._driver.flush()
            if engine.state is not State.IDLE:
                heard_s = time.monotonic()
            elif not engine.is_peripheral:
                self._control_is_over.set()
            if self._control_is_over.is_set() and time.monotonic() - heard_s > QUIET_S:
                return


def judge(number: int) -> Verdict:
    """Play the case NUMBER; raises AssertionError if it ends as no transfer may."""
    case = quick(make_case(number))
    with Cable(change=Faulty(case).change) as cable:
        ports = [Port(name, case.options) for name in cable.names]
        now_s, sends = time.monotonic(), case.control_sends
        control = Owner(Engine(case.options, now_s, peripheral=False), case.lines if sends else None)
        peripheral = Owner(Engine(case.options, now_s, peripheral=True), None if sends else case.lines)
        (control.engine.send if sends else control.engine.fetch)("D", "PART1")
        over = threading.Event()
        ends = [End(port, owner, over) for port, owner in zip(ports, (control, peripheral), strict=True)]
        for end in reversed(ends):
            end.start()
        for end in ends:
            end.join(120)
            assert not end.is_alive(), "the two never come to an end"
        for port in ports:
            port.close()
    for end in ends:
        if end.wrong is not None:
            raise end.wrong
    return verdict_of(case, control, peripheral)


def main() -> int:
    """Play many, tell the numbers of those that ended wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--transfers", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0, help="number of the first transfer")
    given = parser.parse_args()
    tally = collections.Counter[str](kept=0, failed=0, wrong=0)
    for number in range(given.seed, given.seed + given.transfers):
        try:
            verdict = judge(number)
        except AssertionError as error:
            tally["wrong"] += 1
            sys.stdout.write(f"transfer {number}: {error}\n")
            continue
        tally["kept" if verdict.kept else "failed"] += 1
        tally["blocks sent again"] += verdict.repeats
        tally["bytes of noise"] += verdict.noise_bytes
    sys.stdout.write(f"{given.transfers} transfers over pseudo-terminals: {dict(tally)}\n")
    return 1 if tally["wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
