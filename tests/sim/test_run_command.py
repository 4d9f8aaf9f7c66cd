"""``canductor run`` in virtual time: files, typed commands, one job after the other, and what ends them."""

import asyncio
import signal
from pathlib import Path

import pytest

from coordinator.cli.commands.run import RunReport
from coordinator.gcode.errors import GCodeError
from coordinator.runtime.machine import MachineStopped
from coordinator.service.jobs.outcome import Outcome
from coordinator.streaming.move_source import ProgramOutput
from coordinator.support.interrupts import Terminated
from nodes.support.errors import CanductorError
from tests.stages.demo_machine import NODES, SQUARE, DemoMachine, TypedRun

LONG = "G28\nG1 X200 F360\nG1 X1 Z20 E50 F360\n"
"""More than half a minute."""
MIDST_S = 6.0
"""From the start of a command that prints LONG: it moves then."""
STOP_S = 0.02
"""Within which all nodes that can be reached are shut down, and the host knows."""


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep what commands cache out of the user's home."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def steps(report: RunReport) -> dict[str, int]:
    assert report.ok
    for stepper in report.outcome.positions:
        assert report.outcome.positions[stepper] == report.outcome.issued[stepper]
    return dict(report.outcome.positions)


def test_a_file_is_printed_and_every_node_counts_what_it_was_sent(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path)
    report = machine.print(SQUARE)
    moved = steps(report)
    assert (moved["stepper_x"], moved["stepper_y"], moved["stepper_z"]) == (8000, -1600, 240)
    assert moved["extruder"] > 2000
    output = report.to_json()
    assert set(output["nodes"]) == set(NODES)  # type: ignore[call-overload]
    assert "stepper_x: moved by +8,000 steps, as its node counts them" in report.to_text()
    assert all(node.link.min_lead_s is not None and node.link.min_lead_s > 0 for node in report.outcome.nodes)
    assert machine.shut_down == set()
    # The next job finds the nodes configured; another configuration configures them again.
    resets = {name: machine.node(name).counters()["resets"] for name in NODES}
    assert steps(machine.print(SQUARE)) == moved
    finer = machine.write_config("finer.cfg", {"step_pin: PB0": "step_pin: PB6"})
    assert steps(machine.print(SQUARE, finer)) == moved
    assert machine.edges("PB6", "mcu")
    assert {name: machine.node(name).counters()["resets"] for name in NODES} == resets


@pytest.mark.parametrize(
    ("last", "about"),
    [("G1 X999 Y10", "999"), ("G1 X2", None), ("G1 X30 Y", "Y"), ("G1 X30 Y1.5.", "cut short")],
    ids=["outside the limits", "ends in a whole word", "ends after a letter", "ends within a number"],
)
def test_a_bad_last_line_is_reported_after_what_came_before_it(
    tmp_path: Path, last: str, about: str | None
) -> None:
    machine = DemoMachine(tmp_path)
    text = b"G28\nG1 X20 F6000\n" + last.encode()
    if about is None:
        assert machine.print(text).ok
    else:
        with pytest.raises(GCodeError, match=r"job\.gcode:3: ") as error:
            machine.print(text)
        assert about in str(error.value)
    assert machine.shut_down == set()
    assert sum(len(machine.edges(pin, "mcu")) for pin in ("PB0", "PB3")) >= 2 * 2 * 20 * 160


def test_typed_commands_are_answered_as_they_come(tmp_path: Path) -> None:
    async def main(typed: TypedRun) -> Outcome:
        await typed.type("G28", "G1 X10 Y5 F6000", "M400", "M114", answer="X:10.00")
        await typed.type("G91", "G1 X5", "G92 X100", "M114", answer="X:100.00")
        await typed.type("G90", "G1 X105", "G4 P200", "G1 Z1 F600", "G28", "M114", answer="X:0.00")
        await typed.type("G1 X2 F3000", "M400", "M114", answer="X:2.00")
        return await typed.end()

    outcome, _ = DemoMachine(tmp_path).typed(main)
    # What G28 declares moves nothing: 20 + 5 mm of corexy, 160 steps per mm; then 2 mm.
    assert outcome.positions["stepper_x"] == (20 + 5 + 2) * 160
    assert outcome.positions["stepper_y"] == (20 - 5 + 2) * 160
    assert outcome.positions["stepper_z"] == 400
    assert outcome.positions == outcome.issued


def test_a_pause_in_typing_lets_the_machine_stand_and_start_again(tmp_path: Path) -> None:
    """The clocks are followed meanwhile, or the next steps were late."""

    async def main(typed: TypedRun) -> Outcome:
        await typed.type("G28", "G1 X10 F6000", "M400", "M114", answer="X:10.00")
        await asyncio.sleep(10)
        await typed.type("G1 X20 Z0.5 E1", "M400", "M114", answer="X:20.00")
        return await typed.end()

    outcome, _ = DemoMachine(tmp_path).typed(main)
    assert (outcome.positions["stepper_x"], outcome.positions["stepper_z"]) == (20 * 160, 200)
    assert outcome.positions == outcome.issued
    for node in outcome.nodes:
        assert node.link.min_lead_s is not None
        assert node.link.min_lead_s > 0, node.name
        assert node.clock_error_s < 500e-6, node.name  # the bound that a round trip on a UART leaves


def test_one_long_move_is_sent_piece_by_piece(tmp_path: Path) -> None:
    """All of half a minute's motion is read at once, but not all is at the nodes when the user ends it."""
    machine = DemoMachine(tmp_path)
    machine.host.signal(signal.SIGTERM, MIDST_S)
    with pytest.raises(Terminated):
        machine.print("G28\nG1 X30 F60\n")
    assert machine.shut_down == set(NODES)
    assert 100 < len(machine.edges("PB0", "mcu")) < 1000  # of 9,600: those still queued were dropped


@pytest.mark.parametrize("stopped_by", ["M112", "SIGTERM"])
def test_a_new_job_works_after_an_emergency_stop(tmp_path: Path, stopped_by: str) -> None:
    machine = DemoMachine(tmp_path)
    if stopped_by == "SIGTERM":
        machine.host.signal(signal.SIGTERM, MIDST_S)
        with pytest.raises(Terminated):
            machine.print(LONG)
    else:
        with pytest.raises(MachineStopped, match=r"job\.gcode:3: M112 stopped the machine"):
            machine.print("G28\nG1 X50 F600\nM112\n")
    assert machine.shut_down == set(NODES)
    assert steps(machine.print(SQUARE))["stepper_x"] == 8000


@pytest.mark.parametrize("dwells", [True, False])
def test_a_dwell_before_the_first_move_outlasts_links_that_stand_still(tmp_path: Path, dwells: bool) -> None:
    """Its commands are sent 1.2 s ahead, those of a move at once 0.25 s; tests/smoke relies on this."""
    machine = DemoMachine(tmp_path)

    def output(event: ProgramOutput) -> None:
        if "already home" in event.text:
            machine.stage._world.stall(0.9, python=False)  # the threads of its links get no turn

    def go() -> Outcome:
        dwell = ("G4 P1500",) if dwells else ()
        return machine.print_lines(("G28", *dwell, "G1 X5 F300"), on_output=output)

    if dwells:
        outcome = go()
        assert outcome.positions == outcome.issued
    else:
        with pytest.raises(MachineStopped, match=r"in past|too close|late"):
            go()


# -------------------------------------------------------------------------------------------- what ends it


@pytest.mark.parametrize("victim", NODES)
def test_a_node_lost_in_mid_print_stops_all_others(tmp_path: Path, victim: str) -> None:
    machine = DemoMachine(tmp_path)
    machine.at(MIDST_S, machine.node(victim).power_off)
    with pytest.raises(MachineStopped) as error:
        machine.print(LONG)
    sentence, _, confirmed = str(error.value).rpartition(" (")
    assert sentence.startswith(f"lost node {victim}: ")
    others = set(NODES) - {victim}
    delays = dict(part.rstrip(")").split(" after ") for part in confirmed.split(", "))
    assert delays.keys() == others
    assert all(int(delay.removesuffix(" ms")) <= STOP_S * 1e3 for delay in delays.values()), confirmed
    assert others <= machine.shut_down


def test_a_bus_that_ends_in_mid_print_stops_the_node_on_another(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path)
    machine.at(MIDST_S, machine.stage.port("can0").fail)
    with pytest.raises(MachineStopped, match=r"can0.*\(zboard after \d+ ms\)$"):
        machine.print(LONG)
    assert "zboard" in machine.shut_down


@pytest.mark.parametrize(
    ("number", "times", "exception"),
    [
        (signal.SIGINT, 1, KeyboardInterrupt),
        (signal.SIGTERM, 1, Terminated),
        (signal.SIGHUP, 1, Terminated),
        (signal.SIGINT, 3, KeyboardInterrupt),
    ],
    ids=["Ctrl-C", "SIGTERM", "SIGHUP", "Ctrl-C three times"],
)
def test_a_print_ended_by_the_user_leaves_all_nodes_shut_down(
    tmp_path: Path, number: signal.Signals, times: int, exception: type[BaseException]
) -> None:
    machine = DemoMachine(tmp_path)
    for n in range(times):
        machine.host.signal(number, MIDST_S + 0.002 * n)
    with pytest.raises(exception) as error:
        machine.print(LONG)
    assert type(error.value) is exception
    assert machine.shut_down == set(NODES)


@pytest.mark.parametrize(
    ("number", "exception"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)]
)
def test_a_start_ended_by_the_user_ends_at_once(
    tmp_path: Path, number: signal.Signals, exception: type[BaseException]
) -> None:
    machine = DemoMachine(tmp_path)
    machine.node("mcu").power_off()  # so that the start cannot come to its end before the signal
    since_s = machine.now_s()
    machine.host.signal(number, 0.3)
    with pytest.raises(exception):
        machine.print(LONG)
    assert machine.now_s() - since_s < 0.31


# ------------------------------------------------------------------------------------------- bad beginnings


def failure(machine: DemoMachine, config: Path | None = None) -> str:
    with pytest.raises(CanductorError) as error:
        machine.print(SQUARE, config)
    sentence = str(error.value)
    assert "\n" not in sentence
    assert len(sentence) < 600
    return sentence


def test_a_pin_that_the_board_does_not_have(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path, changes={"step_pin: PB0": "step_pin: PZ99"})
    text = machine.config.read_text(encoding="utf-8").splitlines()
    line = next(number for number, line in enumerate(text, 1) if "PZ99" in line)
    sentence = failure(machine)
    assert sentence.startswith(f"{machine.config}:{line}: ")
    assert "PZ99" in sentence


def test_a_wrong_uuid_is_reported_with_those_that_wait_and_disturbs_no_other_node(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path)
    wrong = machine.write_config("wrong.cfg", {"5e1ec7ab1e02": "0123456789ab"})
    sentence = failure(machine, wrong)
    assert "0123456789ab" in sentence
    assert "5e1ec7ab1e02" in sentence
    assert machine.shut_down == set()


def test_a_serial_device_where_nothing_answers(tmp_path: Path) -> None:
    machine = DemoMachine(tmp_path)
    machine.node("zboard").power_off()
    assert failure(machine).startswith("no answer on /dev/ttyUSB0; ")
