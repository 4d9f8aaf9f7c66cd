"""``motion_report/dump_stepper``: one stepper's commands, for programs that analyse motion; no I/O."""

import asyncio
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any, Final

from coordinator.runtime.machine import Machine
from coordinator.service.core.motion import Motion
from coordinator.service.state.sent_commands import read_batch
from coordinator.service.state.trace import Sent
from nodes.dictionary.dictionary import Dictionary

HEADER: Final = ("interval", "count", "add")
"""Of each row: ticks of the node's clock from the step before to the first of COUNT steps; from each of these
to the next it is ADD ticks more than before. COUNT is negative where they lead back."""
COMMANDS_AT_A_TIME: Final = 50
"""The control loop has other things to do in between."""
_CLOCK_BITS: Final = 32


class StepDump:
    """The commands of NAME, a stepper of MACHINE, that are sent from now on, up to 1.2 s before their steps.

    Messages are made from TEMPLATE. What the trace has forgotten before it was taken is left out.
    """

    def __init__(self, name: str, template: Mapping[str, Any], motion: Motion, machine: Machine) -> None:
        self.template = template
        steppers = enumerate(machine.description.steppers)
        self._index, self._stepper = next((i, each) for i, each in steppers if each.name == name)
        nodes = [node.name for node in machine.moving]
        self._node = nodes.index(self._stepper.node)
        oid = machine.devices.steppers[name].oid
        assert oid is not None, "of a machine that is ready"
        dictionary = machine.moving[self._node].dictionary
        self._reader = StepReader(dictionary, oid, inverted=self._stepper.dir_pin.invert)
        self._seen, _ = motion.trace.batches_after(self._node, 0)
        self._begin(motion.trace.sent)

    def _begin(self, sent: Sent) -> None:
        """Begin behind what was SENT."""
        self._count = sent.counts[self._index] if sent.counts else 0
        self._reader.begin(sent.clocks[self._index] if sent.clocks else 0)

    async def take(self, motion: Motion, machine: Machine) -> Mapping[str, Any] | None:
        """Return a message about the commands that were not returned before; None: there are none."""
        sent, seen = motion.trace.sent, self._seen
        self._seen, batches = motion.trace.batches_after(self._node, seen)
        if len(batches) < self._seen - seen:
            self._begin(sent)
            return None
        if not batches:
            return None
        piece = motion.streamer.worker.maps[self._node].last
        before, last_count = self._count, sent.counts[self._index] if sent.counts else 0
        self._count = last_count
        rows = await self._reader.read(batches, last_count - before)
        if not rows:
            return None
        first_count = last_count - sum(count for _, count, _ in rows)
        last_clock = self._reader.clock
        first_clock = last_clock - sum(_ticks(row) for row in rows) + rows[0][0]
        names = (stepper.name for stepper in machine.description.steppers)
        counts = {**dict(zip(names, sent.counts, strict=True)), self._stepper.name: first_count}
        first_s, last_s = (
            piece.print_time + (clock - piece.ticks) / piece.ticks_per_s
            for clock in (first_clock, last_clock)
        )
        return {
            "first_clock": first_clock,
            "first_time": first_s,
            "first_position": machine.stepper_positions.positions(counts).get(self._stepper.name),
            "first_count": first_count,
            "step_distance": self._stepper.step_distance,
            "last_clock": last_clock,
            "last_time": last_s,
            "data": rows,
        }


class StepReader:
    """Reads the commands of the stepper OID from batches for a node with DICTIONARY.

    INVERTED: its direction pin is high for steps back.
    """

    def __init__(self, dictionary: Dictionary, oid: int, *, inverted: bool) -> None:
        self._dictionary = dictionary
        self._inverted = inverted
        self._starts = tuple(  # id and oid; a value of 0 takes one byte
            dictionary.encode(command, oid=oid, **dict.fromkeys(others, 0))[: -len(others)]
            for command, others in (
                ("queue_step", HEADER),
                ("set_next_step_dir", ("dir",)),
                ("reset_step_clock", ("clock",)),
            )
        )
        self.begin(0)

    def begin(self, clock: int) -> None:
        """Begin behind a step at the node's CLOCK."""
        self.clock = clock
        self._direction = 0
        """0: not known, since it was set before."""

    async def read(self, batches: Sequence[bytes], steps: int) -> list[list[int]]:
        """Return the rows of BATCHES, whose commands lead STEPS on; ``clock`` is then its last step's."""
        rows: list[list[int]] = []
        begin, of_unknown_direction = self.clock, 0
        for number, (due, command) in enumerate(chain.from_iterable(map(read_batch, batches)), 1):
            if number % COMMANDS_AT_A_TIME == 0:
                await asyncio.sleep(0)
            if not command.startswith(self._starts):
                continue
            for message in self._dictionary.decode_commands(command) or ():
                if message.name == "reset_step_clock":
                    begin = _extend(message.integer("clock"), due)
                elif message.name == "set_next_step_dir":
                    forward = bool(message.integer("dir")) != self._inverted
                    self._direction = 1 if forward else -1
                else:
                    interval, count, add = (message.integer(name) for name in HEADER)
                    rows += self._rows(begin + interval, interval, count, add)
                    begin = self.clock
                    of_unknown_direction = of_unknown_direction if self._direction else len(rows)
        if of_unknown_direction:
            forward = sum(count for _, count, _ in rows) == steps
            self._direction = self._direction or (1 if forward else -1)
            for row in rows[: 0 if forward else of_unknown_direction]:
                row[1] = -row[1]
        return rows

    def _rows(self, first: int, interval: int, count: int, add: int) -> list[list[int]]:
        """Return what a queue_step of COUNT does whose first step comes at the clock FIRST."""
        sign = self._direction or 1
        gap = first - self.clock
        self.clock = first + _ticks((interval, count, add)) - interval
        if gap == interval or count == 1:
            return [[gap, sign * count, add if count > 1 else 0]]
        return [[gap, sign, 0], [interval + add, sign * (count - 1), add]]  # behind a rest


def _ticks(row: Sequence[int]) -> int:
    """Return how long ROW takes."""
    interval, count, add = row[0], abs(row[1]), row[2]
    return interval * count + add * count * (count - 1) // 2


def _extend(clock: int, near: int) -> int:
    """Return the 64-bit clock with the lower half CLOCK that is closest to NEAR."""
    half = 1 << _CLOCK_BITS - 1
    return near + (clock - near + half) % (2 * half) - half
