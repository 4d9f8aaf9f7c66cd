"""Which seed runs which scenario, what is made of the results, and the command line."""

import json
import re
from pathlib import Path

import pytest

from coordinator.cli import main as cli
from coordinator.simulate import run, scenario
from coordinator.simulate.checker import Violation
from coordinator.simulate.result import Result, SimulationReport
from coordinator.simulate.run import SimulateOptions

ALL = [scenario.find(name) for name in scenario.names()]


def tasks(*names: str, seeds: range) -> list[tuple[str, int]]:
    chosen = [scenario.find(name) for name in names] or ALL
    options = SimulateOptions(scenarios=names, seeds=seeds)
    return [(entry.name, seed) for entry, seed in run.plan(chosen, options)]


def test_named_scenarios_run_with_every_seed() -> None:
    planned = tasks("clean", "cut_long", seeds=range(3, 5))
    assert planned == [("clean", 3), ("clean", 4), ("cut_long", 3), ("cut_long", 4)]


def test_one_seed_runs_every_scenario_but_those_too_heavy() -> None:
    planned = [name for name, _ in tasks(seeds=range(1, 2))]
    assert planned == [entry.name for entry in ALL if entry.weight > 0]
    assert len(planned) < len(ALL)


def test_many_seeds_are_spread_over_the_scenarios_by_weight() -> None:
    planned = tasks(seeds=range(2000))
    assert [seed for _, seed in planned] == list(range(2000))
    total = sum(entry.weight for entry in ALL)
    for entry in ALL:
        count = sum(name == entry.name for name, _ in planned)
        assert abs(count - 2000 * entry.weight / total) <= 2000 / total + 1


def test_a_seed_falls_to_the_same_scenario_whatever_runs_beside_it() -> None:
    whole = {seed: name for name, seed in tasks(seeds=range(300))}
    assert all(whole[seed] == name for name, seed in tasks(seeds=range(100, 200)))


def result(seed: int, *violations: Violation, cause: str | None = None) -> Result:
    return Result(scenario="clean", seed=seed, violations=violations, cause=cause, steps=10, faults=2)


def test_a_failure_is_told_with_the_command_that_replays_it() -> None:
    bad = result(7, Violation("missing", "stepper_x on node mcu: 3 of 10 steps are missing"))
    report = SimulationReport([result(1), bad, result(2, cause="lost node mcu")], wall_s=2.0)
    assert not report.ok
    text = report.to_text()
    assert "stepper_x on node mcu: 3 of 10 steps are missing" in text
    assert "replay: canductor simulate clean --seed 7" in text
    assert "6 faults, 2 completed, 1 stopped with a cause, 1 failed" in text
    assert "90 a minute" in text
    values = json.loads(json.dumps(report.to_json()))
    assert values["failed"] == 1
    assert values["scenarios"]["clean"]["seeds"] == 3


def test_only_failures_are_told_in_full_when_there_are_many() -> None:
    many = [result(seed) for seed in range(100)] + [result(100, Violation("band", "late"))]
    shown = SimulationReport(many, wall_s=1.0).to_json()["results"]
    assert isinstance(shown, list)
    assert [entry["seed"] for entry in shown] == [100]


def test_the_list_names_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["simulate", "--list"]) == 0
    out = capsys.readouterr().out
    assert all(re.search(rf"^{name} ", out, re.MULTILINE) for name in scenario.names())
    assert cli.main(["simulate", "--list", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values["ok"] is True
    assert values["scenarios"]["clean"]["expect"] == "completes"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--seeds", "5"], "--seeds is '5', must be A:B"),
        (["--seeds", "5:5"], "--seeds is '5:5', must be A:B with B above A"),
        (["--seeds", "0:99999999"], "at most 10,000,000 seeds"),
        (["--seeds", "a:b"], "must be A:B, two whole numbers"),
        (["--seed", "1", "--seeds", "1:2"], "--seed and --seeds exclude each other"),
        (["--seed", "-1"], "--seed"),
        (["cleen"], "there is no scenario 'cleen'; did you mean clean?"),
    ],
)
def test_bad_words_are_told_in_one_sentence(
    words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["simulate", *words]) in (cli.EXIT_FAILED, cli.EXIT_USAGE)
    err = capsys.readouterr().err
    assert sentence in err
    assert len(err.splitlines()) == 1


def test_what_is_raised_is_a_failure_with_its_place(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_: object) -> Result:
        raise ZeroDivisionError("by design")

    monkeypatch.setattr("coordinator.simulate.run.play", fails)
    assert cli.main(["simulate", "clean", "--seed", "4"]) == cli.EXIT_FAILED
    out = capsys.readouterr().out
    assert "FAILED exception: ZeroDivisionError: by design (tests/sim/test_run.py:" in out
    assert "replay: canductor simulate clean --seed 4" in out


def test_a_seed_that_does_not_end_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    def hangs(*_: object) -> Result:
        while True:
            pass

    monkeypatch.setattr("coordinator.simulate.play.play", hangs)
    found = run.run_one(scenario.find("clean"), 1, limit_s=0.05)
    assert [v.text for v in found.violations] == ["not over after 0.05 s"]


@pytest.mark.parametrize(
    ("tail", "sentence"),
    [
        ("[buses.can7]\nloss = 0", "mine: [buses.can7]: the machine has no such bus"),
        (
            "[nodes.stray]\nppm = 0",
            "mine: [nodes.stray]: the machine has mcu, toolhead; a stranger needs uuid",
        ),
        (
            '[[faults]]\nkind = "cut"\nnode = "toolhed"\nat_s = 0',
            "mine: a fault names the node 'toolhed'; there are mcu, toolhead",
        ),
    ],
)
def test_a_mistake_in_a_file_is_told_as_such(
    tmp_path: Path, tail: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(f'about = "Wrong."\n{tail}\n', encoding="utf-8")
    assert cli.main(["simulate", str(path)]) == cli.EXIT_FAILED
    err = capsys.readouterr().err
    assert sentence in err
    assert len(err.splitlines()) == 1


def test_a_file_of_ones_own_is_replayed_by_its_path(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('about = "Never."\nexpect = "stops"\ncauses = ["never"]\n', encoding="utf-8")
    assert cli.main(["simulate", str(path), "--seed", "9"]) == cli.EXIT_FAILED
    out = capsys.readouterr().out
    assert "FAILED ending: the job completed, but it had to stop" in out
    assert f"replay: canductor simulate {path} --seed 9" in out
