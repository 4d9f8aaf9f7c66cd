"""A few hundred of the ordeal's transfers; ``python -m tests.coordinator.dnc.ordeal`` plays 10,000."""

import pytest

from tests.coordinator.dnc.ordeal import judge, make_case

BLOCKS = 5
EACH = 60


@pytest.mark.parametrize("block", range(BLOCKS))
def test_transfers_end_whole_or_not_at_all(block: int) -> None:
    numbers = range(block * EACH, (block + 1) * EACH)
    verdicts = [judge(make_case(number)) for number in numbers]
    kept = sum(verdict.kept for verdict in verdicts)
    assert EACH // 2 < kept < EACH, "faults are too rare or too many to show anything"
    assert sum(verdict.repeats for verdict in verdicts)
    assert sum(verdict.noise_bytes for verdict in verdicts)


def test_damage_that_no_check_sees_is_damage_within_lines() -> None:
    for number in range(60):
        judge(make_case(number, visible=False))
