"""What others put on a bus is paid from the budget, but a debt that lies long back is forgiven."""

from typing import Any

import pytest

from nodes.link._link import ffi, lib

BITRATE = 500_000
MS, S = 1_000_000, 1_000_000_000
BLOCK_BITS = 1000
DEBT_MAX_NS, OVERDRAFT_NS = 50 * MS, 20 * MS
CEILING = 0.9
LIMIT_NS = {lib.LINK_MOTION: -OVERDRAFT_NS, lib.LINK_CONTROL: -OVERDRAFT_NS, lib.LINK_BULK: 0}
"""Credit below which a class has to wait."""


class Bus:
    """The budget of a bus, and its time."""

    def __init__(self) -> None:
        self.now = S
        self.schedule: Any = ffi.new("struct schedule *")
        lib.schedule_init(self.schedule, BITRATE, 0.0, 0, 0, self.now)

    def run(self, seconds: float, *, foreign: float = 0.0, motion: float = 0.0) -> None:
        """Let time pass with so much traffic of others, and of motion that is urgent: shares of the bus."""
        for _ in range(round(seconds * 1000)):
            self.now += MS
            lib.schedule_advance(self.schedule, self.now)
            lib.schedule_received(self.schedule, lib.SCHEDULE_WEAK, round(foreign * BITRATE / 1000))
            lib.schedule_sent(self.schedule, lib.LINK_MOTION, round(motion * BITRATE / 1000))

    def may(self, kind: int) -> bool:
        return bool(lib.schedule_allowed(self.schedule) >> kind & 1)

    def wait_ns(self, kind: int) -> int:
        """Return how long KIND has to wait from now on, if the bus stays silent."""
        return int(lib.schedule_opens_at(self.schedule, kind)) - self.now


@pytest.mark.parametrize("traffic", [{"foreign": 1.0}, {"foreign": 0.6, "motion": 0.5}, {"motion": 1.0}])
@pytest.mark.parametrize("seconds", [2.0, 20.0])
def test_what_was_overdrawn_for_long_is_forgiven_but_for_a_moment(
    seconds: float, traffic: dict[str, float]
) -> None:
    bus = Bus()
    bus.run(seconds, **traffic)
    for kind, limit_ns in LIMIT_NS.items():
        if kind != lib.LINK_MOTION:
            lib.schedule_sent(bus.schedule, kind, BLOCK_BITS)  # its own share is used up
        longest_ns = (DEBT_MAX_NS + limit_ns + bus.schedule.block_ns) / CEILING + MS
        assert 0 < bus.wait_ns(kind) <= longest_ns
    bus.run((DEBT_MAX_NS / CEILING + 3 * MS) / S)
    assert all(bus.may(kind) for kind in LIMIT_NS)


def test_what_was_overdrawn_for_short_is_paid_back_in_full() -> None:
    bus = Bus()
    bus.run(1.0)
    lib.schedule_received(bus.schedule, lib.SCHEDULE_WEAK, 20_000)  # 40 ms of the line, at once
    credit_ns = bus.schedule.credit_ns
    assert -40 * MS <= credit_ns < -35 * MS
    assert bus.wait_ns(lib.LINK_MOTION) == pytest.approx((-credit_ns - OVERDRAFT_NS) / CEILING, abs=2)
