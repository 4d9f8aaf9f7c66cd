"""Scenario files: all that come with the project are sound, and every mistake is one clear sentence."""

import re
from pathlib import Path

import pytest

from coordinator.assembly.load import load_machine
from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program as GCode
from coordinator.motion.planner.planner import Planner
from coordinator.simulate import reference, scenario
from coordinator.simulate.program import make_program
from coordinator.support.toml_values import Dice, Range, ScenarioError

GOOD = """\
about = "A test."
machine = "pair"
expect = "stops"
causes = ["lost node"]

[nodes.toolhead]
ppm = [-20, 30]

[buses.can0]
loss = 0.01

[[faults]]
kind = "cut"
node = "toolhead"
at_s = [0.5, 1]
for_s = 2
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_at_least_25_scenarios_each_about_one_thing() -> None:
    known = [scenario.find(name) for name in scenario.names()]
    assert len(known) >= 25
    assert len({entry.about for entry in known}) == len(known)
    for entry in known:
        assert entry.about.endswith("."), entry.name


@pytest.mark.parametrize("name", scenario.names())
def test_a_scenario_speaks_of_what_its_machine_has(name: str) -> None:
    entry = scenario.find(name)
    machine = load_machine(str(entry.machine))
    nodes = {node.name for node in machine.nodes}
    strangers = {n for n, setting in entry.nodes.items() if setting.uuid or setting.same_uuid_as}
    assert set(entry.nodes) - strangers <= nodes
    assert {setting.same_uuid_as for setting in entry.nodes.values()} - {""} <= nodes
    assert {fault.node for fault in entry.faults} - {"", scenario.HOST} <= nodes | strangers


@pytest.mark.parametrize("seed", range(3))
def test_programs_are_made_of_the_seed(seed: int) -> None:
    made = make_program(scenario.Program(), Dice("a", seed))
    assert made == make_program(scenario.Program(), Dice("a", seed))
    assert made != make_program(scenario.Program(), Dice("a", seed + 1))
    assert made != make_program(scenario.Program(), Dice("b", seed))
    assert len(made.splitlines()) > 20


def test_a_scenario_is_read_as_written(tmp_path: Path) -> None:
    entry = scenario.find(str(written(tmp_path, GOOD)))
    assert entry.name == "mine"
    assert entry.nodes["toolhead"].ppm == Range(-20, 30)
    assert entry.buses["can0"].loss == Range(0.01, 0.01)
    assert entry.faults[0].at_s == Range(0.5, 1)
    assert entry.faults[0].since == "job"


def test_a_draw_depends_on_its_key_alone() -> None:
    dice = Dice("x", 1)
    first = dice.draw(Range(0, 1), "a")
    dice.draw(Range(0, 1), "b")
    assert dice.draw(Range(0, 1), "a") == first
    assert Dice("x", 2).draw(Range(0, 1), "a") != first
    assert 0 <= first <= 1


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("loss", "los", r"mine.toml: \[buses.can0\]: there is no option 'los'; did you mean loss\?"),
        ("0.01", "2", r"\[buses.can0\]: loss is '2', must be a number or a range .* from 0 to 0.5"),
        ("[-20, 30]", "[30, -20]", r"ppm is '\[30, -20\]', must be a number or a range"),
        ("[-20, 30]", "true", r"ppm is 'True', must be a number"),
        ('"cut"', '"cot"', r"\[\[faults\]\] number 1: kind is 'cot', must be one of .*did you mean cut\?"),
        ("at_s = [0.5, 1]", "", r"number 1: the option at_s is missing; add it"),
        ('node = "toolhead"\n', "", r"number 1: kind cut needs a node"),
        ('"stops"', '"completes"', r"expect is 'completes' and takes no causes"),
        ('causes = ["lost node"]', "", r"expect is 'stops' and needs causes"),
        ('["lost node"]', '["lost ("]', r"causes is .*'lost \(' is none"),
        ('"pair"', '"pear"', r"there is no machine 'pear'.*pair"),
        ('"pair"', f'"{"x" * 300}"', r"mine.toml: the machine '.*x.cfg' cannot be looked at: file name too"),
        ("[[faults]]", "[faults]", r"faults must be written as \[\[faults\]\]"),
        ("[nodes.toolhead]", "[node.toolhead]", r"there is no table 'node'; did you mean \[nodes\]\?"),
        ("about", "about about", r"this is not TOML"),
        ('about = "A test."', "", r"the option about is missing"),
    ],
)
def test_a_mistake_is_one_sentence(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    assert GOOD.count(old) >= 1
    path = written(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(ScenarioError) as caught:
        scenario.load(path)
    assert "\n" not in str(caught.value)
    assert re.search(sentence, str(caught.value)), caught.value


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("cleen", "there is no scenario 'cleen'; did you mean clean?"),
        ("qqq", "there is no scenario 'qqq'; canductor simulate --list names them"),
        ("gone.toml", "cannot read the scenario 'gone.toml': No such file or directory"),
    ],
)
def test_an_unknown_scenario_is_told(name: str, sentence: str) -> None:
    with pytest.raises(ScenarioError, match=re.escape(sentence)):
        scenario.find(name)


def test_a_made_program_can_be_planned(tmp_path: Path) -> None:
    machine = load_machine(str(scenario.find("clean").machine))
    path = tmp_path / "made.gcode"
    path.write_text(make_program(scenario.Program(), Dice("a", 1)), encoding="utf-8")
    with GCode.open(path) as gcode:
        job = Job(gcode, Planner(machine.limits), machine.homed_position)
        assert job.planner.at_standstill


def test_the_page_has_the_tables() -> None:
    page = (Path(__file__).parents[2] / "docs" / "simulation.md").read_text(encoding="utf-8")
    for part in (*map(reference.table, reference.TABLES), reference.faults()):
        assert part in page, "stale: paste what `python -m coordinator.simulate.reference` prints"
