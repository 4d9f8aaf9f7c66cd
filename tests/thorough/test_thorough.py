"""The table of ``make thorough``, and what its steps consist of."""

import sys
from pathlib import Path

import pytest

from tests.thorough import run
from tests.thorough.steps import Amount, Step, steps


def step(name: str, code: str) -> Step:
    return Step(name, "about it", (sys.executable, "-c", code), r"^\d+ of \d+.*$")


def test_the_steps_are_those_of_the_manual() -> None:
    names = [entry.name for entry in steps(Amount())]
    assert names == [
        "full",
        "ties",
        "memory",
        "sim",
        "loss-5",
        "loss-10",
        "mutants",
        "mutation",
        "arm",
        "fuzz",
        "fuzz-mt",
        "fuzz-live",
        "fuzz-stops",
        "octoprint",
        "soak",
    ]


def test_a_table_shows_each_step_with_its_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = run.run(step("good", "print('1 of 3'); print('2 of 3 found'); print('bye')"), tmp_path)
    bad = run.run(step("bad", "print('why'); raise SystemExit(3)"), tmp_path)
    assert (good.passed, good.figure) == (True, "2 of 3 found")
    assert (bad.passed, bad.figure) == (False, "why")
    assert "why" in capsys.readouterr().out, "the end of what failed is shown"
    assert (tmp_path / "good.log").read_text() == "1 of 3\n2 of 3 found\nbye\n"
    lines = run.table([good, bad]).splitlines()
    assert lines[0].split() == ["what", "verdict", "seconds", "figure"]
    assert lines[1].split()[:2] == ["good", "passed"]
    assert lines[2].split()[:2] == ["bad", "FAILED"]


def test_an_unknown_step_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run.main(["sok"])
    assert "there is no step sok" in capsys.readouterr().err
