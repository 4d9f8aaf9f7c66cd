"""A host that is killed, or stopped, with the heater on, as processes: the node ends the heat by itself."""

import pytest

from coordinator.simulate import safety_real
from coordinator.simulate.safety_row import MAX_DURATION_S

BUSY_S = 1.0
"""A machine that is busy with other tests may give the node its turn so late."""


@pytest.mark.parametrize(
    ("end", "told"), [(safety_real.killed, ""), (safety_real.stopped, "node toolhead shut down")]
)
def test_the_heater_ends_within_its_max_duration(end: safety_real.End, told: str) -> None:
    row = safety_real.row("a host that ends", end)
    assert 0 < row.off_after_s <= MAX_DURATION_S + BUSY_S
    assert told in row.told
