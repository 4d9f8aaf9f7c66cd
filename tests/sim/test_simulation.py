"""Whole machines in virtual time: every scenario holds, seeds repeat exactly, and planted bugs are caught."""

import dataclasses
import json
from collections.abc import Callable

import pytest

from coordinator.cli import main as cli
from coordinator.motion.specs import StepperSpec
from coordinator.runtime.devices import MachineDevices
from coordinator.runtime.timebase import ClockMap, ClockPiece, TimeBase
from coordinator.simulate import scenario
from coordinator.simulate.play import play
from coordinator.simulate.result import Result
from nodes.bus.bus import BusBase
from nodes.bus.can_bus import CanBus
from nodes.link import Link

USUAL = [entry for entry in map(scenario.find, scenario.names()) if entry.weight > 0]


@pytest.mark.parametrize("entry", USUAL, ids=lambda entry: entry.name)
def test_a_scenario_holds(entry: scenario.Scenario) -> None:
    result = play(entry, 1)
    assert result.ok, result.to_text()
    if entry.expect == "completes":
        assert result.steps == result.planned > 1000


@pytest.mark.parametrize(
    ("name", "seed", "cause"),
    [
        ("clock_random", 69, "lost node toolhead: its clock is unusable: 8 readings in a row contradict"),
        ("clock_random", 494, "lost node toolhead: its clock is unusable: 8 readings in a row contradict"),
        ("clock_random", 526, "lost node toolhead: its clock is unusable: 8 readings in a row contradict"),
        (
            "clock_primary_jump",
            3,
            "Stepper too far in past (its clock was 895.5 ms ahead of what the host knows",
        ),
        ("clock_primary_jump", 40, "the clock of node mcu jumped by -753.8 ms during a move"),
        ("clock_primary_jump", 15, "the clock of node mcu jumped by +3.4 ms during a move"),
        ("forged_block", 295, "node toolhead shut down: Another host sends to this node"),
        ("cut_long", 981, "lost node toolhead: can0 node 5: lost, no acknowledgement"),
    ],
)
def test_what_a_seed_once_found(name: str, seed: int, cause: str) -> None:
    """An axis followed a clock that lies; late steps were named instead of it; a jump was found a cycle late;
    commands of ours were lost where a stranger's had met them; a long command of a slow axis was late.
    """
    result = play(scenario.find(name), seed)
    assert result.ok, result.to_text()
    assert cause in result.to_text()


@pytest.mark.parametrize("name", ["loss_5_percent", "bad_day"])
def test_a_seed_decides_everything(name: str) -> None:
    entry = scenario.find(name)
    first = play(entry, 5)
    assert play(entry, 5) == first
    assert play(entry, 6).trace != first.trace


def test_the_command_tells_how_it_went(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["simulate", "clean", "m112", "--seed", "3", "--jobs", "2", "--json"]) == 0
    values = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (values["ok"], values["seeds"], values["completed"], values["stopped"]) == (True, 2, 1, 1)
    traces = {entry["scenario"]: entry["trace"] for entry in values["results"]}
    assert traces == {name: play(scenario.find(name), 3).trace for name in ("clean", "m112")}


# ------------------------------------------------------------------------------------------ planted bugs


def rules(result: Result) -> set[str]:
    return {violation.rule for violation in result.violations}


def nth_batch(
    monkeypatch: pytest.MonkeyPatch, nth: int, what: Callable[[Link, bytes, Callable[[bytes], None]], None]
) -> None:
    """Let WHAT happen to the NTH batch of steps instead of its being sent."""
    real, count = Link.send_batch, [0]

    def send_batch(link: Link, batch: bytes) -> None:
        count[0] += 1
        if count[0] == nth:
            what(link, bytes(batch), lambda changed: real(link, changed))
        else:
            real(link, batch)

    monkeypatch.setattr(Link, "send_batch", send_batch)


def test_a_lost_batch_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    nth_batch(monkeypatch, 6, lambda _link, _batch, _send: None)
    assert rules(play(scenario.find("clean"), 1)) & {"missing", "band", "ending"}


def test_a_batch_sent_twice_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    def twice(_link: Link, batch: bytes, send: Callable[[bytes], None]) -> None:
        send(batch)
        send(batch)

    nth_batch(monkeypatch, 6, twice)
    assert rules(play(scenario.find("clean"), 1)) & {"unplanned", "band", "ending"}


def test_a_clock_that_is_off_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    real = TimeBase.secondary_map

    def late(base: TimeBase, clock: object, clock_freq: float, print_time: float) -> ClockMap:
        piece = real(base, clock, clock_freq, print_time).last  # type: ignore[arg-type]
        return ClockMap(
            clock_freq, ClockPiece(piece.print_time, piece.ticks + 120e-6 * clock_freq, piece.ticks_per_s)
        )

    monkeypatch.setattr(TimeBase, "secondary_map", late)
    assert rules(play(scenario.find("clean"), 1)) == {"band"}


def test_a_stepper_that_turns_the_wrong_way_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    real = MachineDevices.stepper_specs

    def turned(devices: MachineDevices) -> list[StepperSpec]:
        first, *others = real(devices)
        return [dataclasses.replace(first, invert_dir=not first.invert_dir), *others]

    monkeypatch.setattr(MachineDevices, "stepper_specs", turned)
    assert {"direction", "counter"} <= rules(play(scenario.find("clean"), 1))


def test_a_stop_that_is_not_sent_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BusBase, "emergency_stop", lambda _bus: None)
    monkeypatch.setattr(CanBus, "emergency_stop", lambda _bus: None)
    assert "after-stop" in rules(play(scenario.find("m112"), 1))


def test_a_stop_without_a_known_cause_is_caught() -> None:
    entry = dataclasses.replace(scenario.find("cut_long"), causes=("the printer is on fire",))
    assert rules(play(entry, 1)) == {"cause"}


def test_a_job_that_had_to_stop_but_did_not_is_caught() -> None:
    entry = dataclasses.replace(scenario.find("clean"), expect="stops", causes=("any",))
    assert rules(play(entry, 1)) == {"ending"}
