"""Samples, the order of tests, the verdict, and the list of explained survivors."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from tests.mutation import areas, explained, run
from tests.mutation.coverage_map import CoverageMap, CoveringTest
from tests.mutation.mutation import Mutation

SCHED = "firmware/core/sched.c"


def mutation(file: str = SCHED, line: int = 1) -> Mutation:
    return Mutation(file, line, line + 1, "<=", "<", line, "a < b")


def test_every_area_has_files_and_every_file_mutations() -> None:
    assert all(areas.files(area) for area in areas.AREAS)
    assert set(areas.SAFETY) <= set(areas.files())
    assert all((areas.ROOT / script).exists() for script in areas.MODULES)
    # As of tests, a header may have nothing but declarations.
    assert all(run.find_mutations(file) for file in areas.SAFETY)


def test_every_explanation_is_of_a_change_that_exists_once() -> None:
    entries = explained.read_list()
    assert all(entry.reason for entry in entries)
    possible = [m for file in sorted({entry.file for entry in entries}) for m in run.find_mutations(file)]
    stale = [entry for entry in entries if not any(entry.matches(m) for m in possible)]
    assert not stale, "the line or the change is no longer in the code"
    assert len({(e.file, e.line, e.change, e.above) for e in entries}) == len(entries)


def test_an_explanation_follows_its_line(tmp_path: Path) -> None:
    path = tmp_path / "list.toml"
    path.write_text(f'[[equivalent]]\nfile = "{SCHED}"\nline = "a < b"\nchange = ["< -> <="]\nreason = "r"\n')
    entries = explained.read_list(path)
    assert explained.reason(mutation(line=7), entries) == "r"
    assert explained.reason(mutation("firmware/core/base.c"), entries) is None
    path.write_text(path.read_text() + 'above = "x = 1"\n')
    entries = explained.read_list(path)
    assert explained.reason(mutation(line=7), entries) is None
    assert explained.reason(replace(mutation(line=7), above="x = 1"), entries) == "r"


def test_a_sample_depends_on_its_seed_alone() -> None:
    population = [mutation(line=line) for line in range(100)]
    assert run.draw(population, 1, 10) == run.draw(population, 1, 10)
    assert run.draw(population, 1, 10) != run.draw(population, 2, 10)
    assert len(set(run.draw(population, 1, 200))) == 100


def test_tests_run_in_the_order_in_which_they_promise_to_fail() -> None:
    tests = [CoveringTest("tests/nodes/test_a.py::x", 0.1), CoveringTest("tests/firmware/test_b.py::y", 1.0)]
    tests += [CoveringTest("tests/firmware/test_b.py::z", 0.5), CoveringTest("tests/sim/test_c.py::w", 50.0)]
    names = [test.name[-1] for test in run.in_order(set(tests), SCHED, Counter(), 99.0)]
    assert names == ["z", "y", "x", "w"], "what mirrors the file first, then what is quick"
    history = Counter({"tests/sim/test_c.py": 1})
    names = [test.name[-1] for test in run.in_order(set(tests), SCHED, history, 99.0)]
    assert names == ["w", "z", "y", "x"], "what has killed before comes first"
    short = run.in_order(set(tests), SCHED, Counter(), 3.0)
    assert [test.name[-1] for test in short] == ["z", "y", "x"], "what is too slow is left out"


def verdicts(**outcomes: int) -> list[run.Verdict]:
    file = "nodes/link/core/link.c"
    return [
        run.Verdict(mutation(file), outcome.replace("_", " "))
        for outcome, count in outcomes.items()
        for _ in range(count)
    ]


@pytest.mark.parametrize(
    ("found", "good"),
    [
        (verdicts(killed=95, survived=5), True),
        (verdicts(killed=94, survived=6), False),
        (verdicts(killed=94, survived=3, not_covered=3), False),
        (verdicts(killed=90, survived=5, explained=5, same_code=50, does_not_compile=50), True),
        ([*verdicts(killed=99), run.Verdict(mutation(SCHED), run.SURVIVED)], False),
    ],
)
def test_too_many_survivors_fail_and_one_where_motion_stops(found: list[run.Verdict], good: bool) -> None:
    lines, verdict = run.report(found)
    assert verdict == good
    assert "100 mutants" in lines[-2]


def test_constants_are_covered_by_all_tests_of_their_file() -> None:
    test, other = CoveringTest("tests/a.py::a", 1.0), CoveringTest("tests/a.py::b", 1.0)
    covered = CoverageMap()
    covered.by_file["x.c"] = {test, other}
    covered.by_statement["x.c", 0] = {test}
    source = b"enum { A = 1 };\nint f(void) { return A < 2; }\n"
    constant, comparison = (Mutation("x.c", source.index(t), 0, "", "", 1, "") for t in (b"1", b"<"))
    assert covered.tests(constant, source) == {test, other}
    assert covered.tests(comparison, source) == {test}
    covered.by_file["x.py"], covered.by_line["x.py", 3] = {test, other}, {other}
    covered.imported |= {("x.py", 1), ("x.py", 2)}
    source = b"A = 1\ndef f():\n    return (A\n     < 2)\n"
    constant = Mutation("x.py", source.index(b"1"), 0, "", "", 1, "")
    comparison = Mutation("x.py", source.index(b"<"), 0, "", "", 4, "")
    assert covered.tests(constant, source) == {test, other}
    assert covered.tests(comparison, source) == {other}, "by the first line of the statement"


def test_a_header_of_constants_is_covered_by_all_tests_of_its_folder() -> None:
    near, far = CoveringTest("tests/a.py::a", 1.0), CoveringTest("tests/a.py::b", 1.0)
    covered = CoverageMap()
    covered.by_file["x/y.c"], covered.by_file["z/y.c"] = {near}, {far}
    source = b"enum { A = 1 };\n"
    assert covered.tests(Mutation("x/y.h", source.index(b"1"), 0, "", "", 1, ""), source) == {near}
