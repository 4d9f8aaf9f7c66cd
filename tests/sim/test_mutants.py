"""The list of planted bugs applies to the sources as they are, and names scenarios and tests that exist."""

import ast
from pathlib import Path

import pytest

from coordinator.simulate import scenario
from tests.sim import mutants

ROOT = Path(__file__).parents[2]
MUTANTS = {mutant.name: mutant for mutant in mutants.read_list()}


@pytest.mark.parametrize("mutant", MUTANTS.values(), ids=MUTANTS)
def test_a_planted_bug_names_what_exists(mutant: mutants.Mutant) -> None:
    assert mutant.find != mutant.replace
    assert mutant.why
    assert set(mutant.scenarios) <= set(scenario.names())
    for script in mutant.modules:
        assert (ROOT / script).name.startswith("build_")
        assert (ROOT / script).is_file()
    assert bool(mutant.modules) == mutant.file.endswith((".c", ".h"))
    for test in mutant.tests:
        file, *names = test.split("[")[0].split("::")
        tree = (ROOT / file).read_text(encoding="utf-8")
        if names:
            functions = {node.name for node in ast.walk(ast.parse(tree)) if isinstance(node, ast.FunctionDef)}
            assert names[-1] in functions


def test_at_least_half_of_the_planted_bugs_are_for_the_simulation() -> None:
    """`make mutants` demands that the simulation sees them; this is what the list has to allow."""
    shown = [mutant for mutant in MUTANTS.values() if mutant.scenarios]
    assert len(shown) >= mutants.SIMULATION_SHARE * len(MUTANTS)


def test_a_text_that_is_not_in_the_code_is_reported(tmp_path: Path) -> None:
    changed = tmp_path / "mutants.toml"
    text = mutants.LIST.read_text(encoding="utf-8")
    changed.write_text(text.replace("return (int32_t)(a - b) < 0;", "return (int33_t)(a - b) < 0;"))
    with pytest.raises(
        ValueError, match=r"missed_rollover: its text occurs 0 times in firmware/core/node\.h"
    ):
        mutants.read_list(changed)


@pytest.mark.parametrize(
    ("simulation", "tests", "caught"),
    [
        (mutants.Sight(True, "FAILED"), None, True),
        (mutants.Sight(True, "FAILED"), mutants.Sight(False, "passed"), False),
        (mutants.Sight(False, "passed"), mutants.Sight(True, "FAILED"), False),
        (None, mutants.Sight(True, "FAILED"), True),
    ],
)
def test_all_that_an_entry_names_has_to_see_the_bug(
    simulation: mutants.Sight | None, tests: mutants.Sight | None, caught: bool
) -> None:
    verdict = mutants.Verdict(simulation, tests, 1.0)
    assert verdict.caught == caught
    assert verdict.line("x").startswith("caught" if caught else "SURVIVED")
