"""A short run of live.py: clients do their worst to a machine that prints; no step is the worse for it."""

from pathlib import Path

from tests.fuzz.live import fuzz_a_print
from tests.stages.demo_machine import SQUARE
from tests.stages.processes import write_gcode

FUZZ_S = 1.0
"""One print under fuzzers, of a few seconds, and then a quiet one."""


def test_no_client_does_harm_to_a_print(tmp_path: Path) -> None:
    found = fuzz_a_print(write_gcode(tmp_path, SQUARE), FUZZ_S, seed=20)
    assert not found.problems
    assert found.proof["ok"]
    assert [printed.fuzzed for printed in found.prints] == [True, False]
    assert found.counts["visits"] > 20
    assert len({tuple(printed.steps.items()) for printed in found.prints}) == 1
