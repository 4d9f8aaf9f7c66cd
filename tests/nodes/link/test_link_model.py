"""The C link against the model in plain lists: after every call, all that can be seen of both is the same.

Time stops where boundaries are: at deadlines, one ns before and behind them, and anywhere between.
"""

import random
import struct
from typing import Any

import pytest

from nodes.link._link import ffi, lib
from tests.nodes.link.link_model import ALL, BULK, CONTROL, MOTION, MS, NEVER, OK, Command, LinkModel
from tests.profiles import examples
from tests.wire_twin import block

SIZES = {MOTION: 1024, CONTROL: 512, BULK: 512}
STATES = ("probing", "confirming", "running", "lost")
CAUSES = ("", "silent", "stuck")
STEPS = 400
NOISE = (b"~", b"~~", b"\x05", b"\x40\x10", b"\x07\x11ab", b"\x03", b"\x05\x33")


class CLink:
    """The C struct, its queues of SIZES."""

    def __init__(self, window: int, lost_after_ns: int) -> None:
        settings = ffi.new("struct link_settings *", (window, lost_after_ns))
        self._memory = [ffi.new("uint8_t[]", SIZES[kind]) for kind in range(3)]
        memories = ffi.new("struct link_memory[]", [(at, len(at)) for at in self._memory])
        self.c: Any = ffi.new("struct link *")
        self._out = ffi.new("uint8_t[]", lib.LINK_WIRE_MAX)
        self._response: Any = ffi.new("struct link_response *")
        self._offer: Any = ffi.new("struct link_offer *")
        self._stats: Any = ffi.new("struct link_stats *")
        lib.link_init(self.c, settings, memories)

    def receive(self, data: bytes, now: int) -> list[tuple[bytes, int]]:
        keep = ffi.from_buffer(data)
        at, size = ffi.new("uint8_t **", keep), ffi.new("size_t *", len(data))
        found = []
        while lib.link_receive(self.c, ffi.cast("const uint8_t **", at), size, now, self._response):
            assert self._response.received_ns == now
            content = bytes(ffi.buffer(self._response.content)[: self._response.size])
            found.append((content, self._response.sent_ns))
        assert size[0] == 0
        return found

    def next_block(self, now: int, allowed: int) -> bytes:
        return bytes(ffi.buffer(self._out)[: lib.link_next_block(self.c, now, allowed, self._out)])

    def offer(self, now: int, allowed: int) -> tuple[int, int, bool] | None:
        if not lib.link_next_offer(self.c, now, allowed, self._offer):
            return None
        return self._offer.kind, self._offer.due_ns, bool(self._offer.urgent)

    def stats(self) -> Any:
        lib.link_get_stats(self.c, self._stats)
        return self._stats


class Pair:
    """Both, in step; the node's side is bytes that the test makes up."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        window = self.random.choice((64, 65, 100, 128, 192, 400))
        lost_after_ns = self.random.choice((400 * MS, 1000 * MS, 1001 * MS + 3))
        self.real = CLink(window, lost_after_ns)
        self.model = LinkModel(window, lost_after_ns, SIZES)
        self.now = self.random.choice((0, 1, 1000 * MS))
        self.hz = self.random.choice((1e6, 1.6e7, 16_000_123.456, 1.8e8))
        self.loss = self.random.choice((0.0, 0.02, 0.1))
        self.noise = self.random.choice((1e-9, 0.1, 1.0))
        self.restarts = self.random.random() < 0.1
        self.answers: list[tuple[int, bytes]] = []
        """When what comes from the node comes."""
        self.expected = self.random.randrange(16)
        if self.random.random() < 0.8:
            self.set_clock()

    def set_clock(self) -> None:
        at_ticks = self.ticks(0)
        assert lib.link_set_clock(self.real.c, self.hz, self.now, at_ticks) == OK
        assert self.model.set_clock(self.hz, self.now, at_ticks) == OK

    def play(self) -> None:
        for _ in range(STEPS):
            act = self.random.choices(
                (self.queue, self.batch, self.pass_time, self.hear, self.transmit, self.seldom),
                (3, 4, 8, 2, 8, 1),
            )[0]
            act()
            self.compare()
            if self.model.state == "lost" and self.random.random() < 0.1:
                return

    # ----------------------------------------------------------------------------------------------- acts

    def ticks(self, away_ns: int) -> int:
        return max(0, int((self.now + away_ns) * self.hz / 1e9) + (1 << 20))

    def content(self) -> bytes:
        return self.random.randbytes(self.random.choice((1, 3, 8, 12, 17, 25, 30, 54, 59)))

    def clocks(self) -> tuple[int, int]:
        """Return min_clock and req_clock."""
        ahead_ns = self.random.choice((-50, -1, 0, 1, 3, 20, 90, 99, 130, 400, 1500, 5000)) * MS
        min_clock = 0 if self.random.random() < 0.4 else self.ticks(ahead_ns - self.random.randrange(90 * MS))
        far = self.random.random() < 0.04
        req_clock = 0 if self.random.random() < 0.15 else self.ticks(ahead_ns) + (far << 30)
        return min_clock, req_clock

    def queue(self) -> None:
        kind = self.random.choice((CONTROL, CONTROL, BULK))
        content, (min_clock, req_clock) = self.content(), self.clocks()
        if self.random.random() < 0.7:
            min_clock = 0
        if self.random.random() < 0.7:
            req_clock = 0
        real = lib.link_send(self.real.c, kind, content, len(content), min_clock, req_clock, self.now)
        assert real == self.model.send(kind, content, min_clock, req_clock, self.now)

    def batch(self) -> None:
        commands = [Command(self.content(), *self.clocks()) for _ in range(self.random.randrange(1, 6))]
        data = b"".join(
            struct.pack("=QQB", c.min_clock, c.req_clock, len(c.content)) + c.content for c in commands
        )
        assert lib.link_send_batch(self.real.c, data, len(data)) == self.model.send_batch(commands)

    def pass_time(self) -> None:
        kind = self.random.random()
        deadline = self.model.deadline(self.now, self.random.choice((ALL, self.random.randrange(ALL + 1))))
        if deadline == self.model.lost_at and self.random.random() < 0.95:
            deadline = NEVER  # once it is lost nothing more happens
        if self.answers and kind < 0.55:
            self.now = max(self.now, min(at_ns for at_ns, _ in self.answers))
        elif deadline != NEVER and kind < 0.75:
            late = self.random.choice((-1, 0, 0, 0, 1, 9 * MS, 10 * MS, 10 * MS + 1))
            self.now = max(self.now, deadline + late)
        elif deadline != NEVER and kind < 0.78:
            quarter_ns = self.model.lost_after_ns // 4
            self.now = max(self.now, deadline + quarter_ns + self.random.choice((-1, 0, 1, 50 * MS)))
        elif kind < 0.998:
            self.now += self.random.choice((0, 1, 1000, 130_000, MS, 5 * MS, 30 * MS))
        else:
            self.now += self.random.randrange(1500 * MS)
        self.hear()
        if self.random.random() < 0.9:
            assert self.real.receive(b"", self.now) == self.model.receive(b"", self.now)
        lib.link_handle_timer(self.real.c, self.now)
        self.model.handle_timer(self.now)

    def transmit(self) -> None:
        allowed = self.random.choice((ALL, ALL, ALL, self.random.randrange(ALL + 1)))
        for _ in range(self.random.choice((1, 2, 20))):
            real = self.real.next_block(self.now, allowed)
            assert real == self.model.next_block(self.now, allowed)
            if not real:
                return
            self.node_hears(real)

    def node_hears(self, data: bytes) -> None:
        """Take DATA as a node does, which may lose it, and answer, which may get lost."""
        if self.random.random() < self.loss:
            return
        whole = data.lstrip(b"~\0")
        if whole[1] & 15 == self.expected:
            self.expected = (self.expected + 1) & 15
        at_ns = self.now + self.random.choice((0, 300_000, MS, 2 * MS, 40 * MS))
        at_ns = max([at_ns, *(earlier_ns for earlier_ns, _ in self.answers)])
        if self.random.random() < 0.2:
            self.answers.append((at_ns, block(self.expected, self.random.randbytes(4))))
        if self.random.random() >= self.loss:
            self.answers.append((at_ns, block(self.expected)))

    def hear(self) -> None:
        """Let what is due arrive, perhaps damaged or cut; or, seldom, anything."""
        due = [data for at_ns, data in self.answers if at_ns <= self.now]
        self.answers = [(at_ns, data) for at_ns, data in self.answers if at_ns > self.now]
        data = b"".join(due)
        chance = self.random.random() / self.noise
        if chance < 0.03:
            data += block(self.random.randrange(16), self.random.randbytes(self.random.choice((0, 0, 5))))
        elif chance < 0.06:
            data += self.random.choice(
                (b"~", b"~~", b"\x05", b"\x40\x10", b"\x07\x11ab", b"\x03", b"\x05\x33")
            )
        elif chance < 0.08 and data:
            data = data[: self.random.randrange(len(data))]
        elif chance < 0.1 and data:
            at = self.random.randrange(len(data))
            data = data[:at] + bytes([data[at] ^ 1 << self.random.randrange(8)]) + data[at + 1 :]
        if data:
            assert self.real.receive(data, self.now) == self.model.receive(data, self.now)

    def seldom(self) -> None:
        kind = self.random.random()
        if kind < 0.55:
            self.set_clock()
        elif kind < 0.8:
            size = self.random.choice((63, 64, 70, 192, 300))
            assert lib.link_set_receive_window(self.real.c, size) == self.model.set_receive_window(size)
        elif kind < 0.9:
            content = self.random.choice((b"", b"stop", bytes(60)))
            real = lib.link_send_urgent(self.real.c, content, len(content), self.now)
            assert real == self.model.send_urgent(content, self.now)
        elif self.restarts:  # the node began again
            self.expected = self.random.randrange(16)

    # -------------------------------------------------------------------------------------------- comparing

    def compare(self) -> None:
        real, model, now = self.real.c, self.model, self.now
        assert STATES[real.state] == model.state
        assert CAUSES[real.cause] == model.cause
        assert lib.link_pending(real) == model.pending
        assert lib.link_unanswered_since(real) == model.unanswered_since
        assert real.motion_content == model.motion_content
        assert real.silences == model.silences
        for allowed in range(ALL + 1):
            offer = model.next_offer(now, allowed)
            expected = None if offer is None else (offer.kind, offer.due_ns, offer.urgent)
            assert self.real.offer(now, allowed) == expected
            assert lib.link_deadline(real, now, allowed) == model.deadline(now, allowed)
        stats = self.real.stats()
        assert {name: getattr(stats, name) for name in model.count} == model.count
        assert list(stats.lead_histogram) == model.lead_histogram
        assert stats.rto_ns == model.rto_ns
        for kind, (commands, size) in model.most.items():
            assert (real.queues[kind].commands_max, real.queues[kind].bytes_max) == (commands, size)


@pytest.mark.parametrize("seed", range(examples(60)))
def test_the_link_is_its_model(seed: int) -> None:
    Pair(seed).play()


@pytest.mark.parametrize("ticks", [0, 1, 999, 1_000_000, 1 << 62, (1 << 64) - 1])
@pytest.mark.parametrize(
    "clock", [(1e6, 5, 1000), (1.6e7, 10**18, 1 << 40), (1e3, 0, 0), (2.0, 100, 1 << 63)]
)
def test_motion_due_at_any_time_of_any_clock(ticks: int, clock: tuple[float, int, int]) -> None:
    pair = Pair(1)
    assert lib.link_set_clock(pair.real.c, *clock) == pair.model.set_clock(*clock) == OK
    assert lib.link_motion_due(pair.real.c, ticks) == pair.model.motion_due(ticks)
