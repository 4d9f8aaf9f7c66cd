"""Executes a node's finished command stream into step clocks, whole files at a time.

Knows the wire (batch records, VLQ values, what the three stepper commands do on a node) and nothing of how
the stream was made. Vectorised twin of ``steps_oracle.Node``.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coordinator.motion.specs import NodeStreamSpec, StepperSpec

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
HEADER = 17
VALUES_MAX = 5
WRAP = 1 << 32


@dataclass(frozen=True)
class Stream:
    """Every queue_step of one stepper, in order, with the 64-bit clock from which it counts."""

    clock: Ints
    interval: Ints
    count: Ints
    add: Ints
    direction: Ints
    """+1, -1"""
    position: Ints
    """Steps done before, from 0."""
    req: Ints

    @property
    def steps(self) -> int:
        return int(self.count.sum())

    @property
    def first(self) -> Ints:
        return self.clock + self.interval

    @property
    def finish(self) -> Ints:
        return self.clock + _way(self.interval, self.add, self.count)

    @property
    def end_position(self) -> int:
        return int((self.direction * self.count).sum())

    def between(self, first: int, last: int) -> "Stream":
        """Return segments FIRST to LAST - 1."""
        cut = slice(first, last)
        columns = (self.clock, self.interval, self.count, self.add, self.direction, self.position, self.req)
        return Stream(*(column[cut] for column in columns))

    def chunks(self, steps: int) -> Iterator["Stream"]:
        """Yield the segments in pieces of about STEPS steps."""
        ends = np.cumsum(self.count)
        at = 0
        while at < len(ends):
            behind = ends[at - 1] if at else 0
            to = max(int(np.searchsorted(ends, behind + steps, side="right")), at + 1)
            yield self.between(at, to)
            at = to

    def expand(self) -> tuple[Ints, Ints, Ints]:
        """Return (clock, direction, position before) of every step."""
        which = np.repeat(np.arange(len(self.count)), self.count)
        i = np.arange(len(which)) - np.repeat(np.cumsum(self.count) - self.count, self.count)
        clock = self.clock[which] + _way(self.interval[which], self.add[which], i + 1)
        direction = self.direction[which]
        return clock, direction, self.position[which] + direction * i


def _way(interval: Ints, add: Ints, count: Ints) -> Ints:
    """Return the ticks that COUNT steps take."""
    return interval * count + add * (count * (count - 1) // 2)


def replay(batch: bytes, node: NodeStreamSpec, steppers: Sequence[StepperSpec]) -> dict[str, Stream]:
    """Return what each of STEPPERS (all of NODE) is made to do by BATCH; asserts what the wire demands."""
    req, values, size = _decode(batch)
    known = np.isin(values[:, 0], [node.queue_step_id, node.set_next_step_dir_id, node.reset_step_clock_id])
    assert (size[known] == np.where(values[known, 0] == node.queue_step_id, 5, 3)).all()
    assert (np.diff(req) >= 0).all(), "the stream is not ordered by req_clock"
    streams = {}
    for stepper in steppers:
        mine = known & (values[:, 1] == stepper.oid)
        streams[stepper.name] = _one(req[mine], values[mine], node, invert=stepper.invert_dir)
    return streams


def _one(req: Ints, values: Ints, node: NodeStreamSpec, *, invert: bool) -> Stream:
    queued = values[:, 0] == node.queue_step_id
    turns = _latest(values[:, 0] == node.set_next_step_dir_id)[queued]
    resets = _latest(values[:, 0] == node.reset_step_clock_id)[queued]
    assert (turns >= 0).all(), "a queue_step before the first direction"
    assert (resets >= 0).all(), "a queue_step before the first reset_step_clock"
    interval, count, add = values[queued, 2] % WRAP, values[queued, 3], values[queued, 4]
    direction = np.where((values[turns, 2] != 0) != invert, 1, -1)
    assert ((count >= 1) & (count <= 65535) & (add >= -32768) & (add <= 32767)).all()
    last = interval + add * (count - 1)
    assert ((interval > 0) & (last > 0) & (last < WRAP)).all(), "an interval that is none"
    way = _way(interval, add, count)
    total = np.cumsum(way) - way
    begins = np.flatnonzero(np.diff(resets, prepend=-1))  # the first segment behind each reset
    anchor = np.repeat(total[begins], np.diff(begins, append=len(resets)))
    clock = values[resets, 2] + total - anchor
    # The node has 32 bits; the host says which 2^31 ticks are meant.
    first = req[queued] + (clock + interval - req[queued]) % WRAP
    assert (first - req[queued] < WRAP // 2).all(), "a step more than 2^31 ticks from its command"
    clock = first - interval
    joined = np.diff(resets) == 0
    assert ((clock[1:] == (clock + way)[:-1]) | ~joined).all(), "32-bit clocks do not join"
    assert (clock[1:] >= (clock + way)[:-1])[~joined].all(), "a reset into the past"
    moved = direction * count
    return Stream(clock, interval, count, add, direction, np.cumsum(moved) - moved, req[queued])


def _latest(marks: Bools) -> Ints:
    """Return for every row the last row up to it that is marked; -1: none."""
    return np.maximum.accumulate(np.where(marks, np.arange(len(marks)), -1))


def _decode(batch: bytes) -> tuple[Ints, Ints, Ints]:
    """Return req_clock, up to five values, and how many there are, of every record."""
    starts, at = [], 0
    while at < len(batch):
        starts.append(at)
        at += HEADER + batch[at + HEADER - 1]
    assert at == len(batch), "the batch is cut short"
    start = np.array(starts, np.int64)
    data = np.frombuffer(batch, np.uint8)
    req = np.zeros(len(start), np.int64)
    for byte in range(8):
        req |= data[start + 8 + byte].astype(np.int64) << 8 * byte
    values, size = _vlq(data, start + HEADER, start + HEADER + data[start + HEADER - 1])
    return req, values, size


def _vlq(data: NDArray[np.uint8], at: Ints, end: Ints) -> tuple[Ints, Ints]:
    """Decode the values from AT to END of every row, VALUES_MAX at most."""
    data = np.concatenate((data, np.zeros(8, np.uint8)))
    values = np.zeros((len(at), VALUES_MAX), np.int64)
    size = np.zeros(len(at), np.int64)
    for column in range(VALUES_MAX):
        more = at < end
        size += more
        byte = data[at].astype(np.int64)
        value = byte & 0x7F
        value -= np.where(value & 0x60 == 0x60, 0x80, 0)
        at = at + more
        more &= byte >= 0x80
        while more.any():
            byte = data[at].astype(np.int64)
            value = np.where(more, value << 7 | byte & 0x7F, value)
            at = at + more
            more &= byte >= 0x80
        values[:, column] = (value + WRAP // 2) % WRAP - WRAP // 2
    size[at != end] = -1
    return values, size


def replay_all(
    streams: Mapping[int, bytes], nodes: Sequence[NodeStreamSpec], steppers: Sequence[StepperSpec]
) -> dict[str, Stream]:
    """Return every stepper's stream by its name; STREAMS is by node index."""
    found: dict[str, Stream] = {}
    for index, node in enumerate(nodes):
        found |= replay(streams[index], node, [s for s in steppers if s.node == index])
    return {stepper.name: found[stepper.name] for stepper in steppers}
