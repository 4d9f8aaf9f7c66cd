"""The feeder's promises, driven as the streamer's worker drives it; no clock, no thread."""

import tempfile
from pathlib import Path
from typing import Any

import pytest

from coordinator.assembly.load import load_machine
from coordinator.gcode.commands import GCodeCommand, Immediate, Vocabulary
from coordinator.gcode.events import Emergency, End, Event, Full, Idle, PositionSet, Progress, Reply
from coordinator.gcode.machine_state import MachineState
from coordinator.gcode.program import Program
from coordinator.motion.planner.planner import Planner
from coordinator.service.core.feeder import (
    INTERJECTIONS_MAX,
    OUTPUT_CHARS_MAX,
    WAITING_MAX,
    Feeder,
    FeederFull,
    QueuedWork,
)
from coordinator.service.core.work import FileWork, LinesWork, MoveWork, Rest, WorkError, commands_in
from coordinator.support.examples import DEMO_MACHINE

LIMITS = load_machine(str(DEMO_MACHINE)).limits


@pytest.fixture
def feeder() -> Feeder:
    return Feeder(Planner(LIMITS), {"X": 0.0, "Y": 0.0, "Z": 0.0}, MachineState())


def drive(feeder: Feeder, most: int = 1000) -> list[Event]:
    """Step until nothing is left to do, as the streamer would; trapezoids are thrown away."""
    events: list[Event] = []
    for _ in range(most):
        event = feeder.step()
        events.append(event)
        if isinstance(event, Full):
            feeder.planner.release(feeder.planner.take().count)
        if isinstance(event, Idle | End | Emergency):
            return events
    raise AssertionError("the feeder does not come to an end")


def test_what_is_kept_of_a_work_is_bounded(feeder: Feeder) -> None:
    """Failed before: only their number was, and a reply may be a list of all objects."""
    queued = feeder.submit(LinesWork([f"M118 {'a' * 3_900}"] * 100))
    drive(feeder)
    assert len(queued.output) == OUTPUT_CHARS_MAX // 3_900 + 1


def finished(feeder: Feeder) -> list[QueuedWork]:
    found = list(feeder.finished)
    feeder.finished.clear()
    return found


def file_of(*lines: str) -> FileWork:
    return FileWork(Program.from_lines(["\n".join(lines) + "\n"], "job.gcode"))


def test_works_are_done_in_order_and_replies_kept_apart(feeder: Feeder) -> None:
    first = feeder.submit(LinesWork(["G28", "G1 X10 F6000", "M114"]))
    second = feeder.submit(LinesWork(["G91", "G1 X5", "M114"]))
    events = drive(feeder)
    assert any(isinstance(event, PositionSet) for event in events)
    assert finished(feeder) == [first, second]
    assert [output.text for output in first.output if isinstance(output, Reply)] == [
        "X:10.000 Y:0.000 Z:0.000 E:0.000"
    ]
    assert [output.text for output in second.output] == ["X:15.000 Y:0.000 Z:0.000 E:0.000"]
    assert first.ends_at_s
    assert second.ends_at_s
    assert second.ends_at_s > first.ends_at_s
    assert not feeder.busy


def test_what_moves_nothing_is_done_at_once(feeder: Feeder) -> None:
    queued = feeder.submit(LinesWork(["M114"]))
    drive(feeder)
    assert queued.ends_at_s == 0.0


def test_what_has_moved_is_known(feeder: Feeder) -> None:
    works = [
        feeder.submit(LinesWork(lines, rest=Rest.OPEN))
        for lines in (["M114", "M220 S90", "G4 P1"], ["G28"], ["G1 X50 F6000"], ["G1 X50"], ["G1 X60", "G5"])
    ]
    works.append(feeder.submit(MoveWork({"X": 1.0}, 50.0, relative=True)))
    drive(feeder)
    assert [work.moved for work in works] == [False, False, True, False, True, True]


def test_an_open_end_leaves_the_moves_to_be_joined(feeder: Feeder) -> None:
    feeder.submit(LinesWork(["G28"]))
    feeder.submit(LinesWork(["G1 X50 F6000"], rest=Rest.OPEN))
    drive(feeder)
    assert not feeder.planner.at_standstill
    feeder.submit(LinesWork(["G1 X100"]))
    drive(feeder)
    assert feeder.planner.at_standstill
    one = Planner(LIMITS)
    one.homed = "XYZ"
    one.feed(b"G1 X100 F6000\n", 0, 14, final=True)
    one.flush()
    # Both halves together last as long as one move: there was no stop between them.
    began_s = 0.0
    assert feeder.planner.print_time_end_s - began_s == pytest.approx(one.print_time_end_s, abs=1e-9)


def test_a_bad_line_ends_its_own_work_at_rest(feeder: Feeder) -> None:
    bad = feeder.submit(LinesWork(["G28", "G1 X10 F6000", "G5 X1", "G1 X20"]))
    good = feeder.submit(LinesWork(["M114"]))
    drive(feeder)
    assert "client:3: G5 curves" in str(bad.error)
    assert good.error is None
    assert [output.text for output in good.output] == ["X:10.000 Y:0.000 Z:0.000 E:0.000"]


def test_a_bug_in_the_reader_of_a_command_ends_only_its_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Failed before: the exception ended the motion worker, which stopped all nodes."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def fail(*_: object) -> Any:
        raise ZeroDivisionError("of nothing")

    read = GCodeCommand("READ", "for the test", fail)
    act = GCodeCommand("ACT", "for the test", lambda _: Immediate(act=fail))
    vocabulary = Vocabulary({"READ": read, "ACT": act})
    feeder = Feeder(Planner(LIMITS), {"X": 0.0, "Y": 0.0, "Z": 0.0}, MachineState(), vocabulary)
    bad, good = (feeder.submit(LinesWork([line, "M114"])) for line in ("READ", "G28"))
    drive(feeder)
    (log,) = tmp_path.iterdir()
    assert str(bad.error) == (
        f"client:1: internal error: ZeroDivisionError: of nothing; please report it with {log}"
    )
    assert "in fail" in log.read_text()
    assert (bad.output, good.error, len(good.output)) == ([], None, 2)
    feeder.submit(LinesWork(["ACT"]))
    with pytest.raises(ZeroDivisionError):  # it may have done half of what it does
        drive(feeder)


def test_pause_reads_no_line_and_resume_the_next_one(feeder: Feeder) -> None:
    feeder.planner.plan_until_s = 0.5
    job = feeder.submit(
        file_of("G28", *(f"G1 X{100 + i} F600\nG1 X{90 - i}" for i in range(10))), is_job=True
    )
    while not isinstance(feeder.step(), Full):
        pass
    feeder.pause()
    read = feeder.planner.moves
    assert isinstance(feeder.step(), Idle)
    feeder.submit_interjection(LinesWork(["M114", "M220 S50"]))
    lines = feeder.planner.lines
    assert isinstance(drive(feeder)[-1], Idle)
    (aside,) = finished(feeder)
    assert [output.text[:2] for output in aside.output] == ["X:"]
    assert feeder.planner.speed_factor == 0.5
    assert feeder.planner.lines == lines
    assert feeder.planner.moves == read
    feeder.planner.plan_until_s = float("inf")
    feeder.resume()
    drive(feeder)
    assert finished(feeder) == [job]
    assert job.error is None
    assert feeder.planner.toolhead_position[0] == 81.0


def test_a_long_interjection_is_done_in_portions(feeder: Feeder) -> None:
    """Failed before: all of it in one call, however long, and also when its client had gone."""
    job = feeder.submit(file_of("G28", "G1 X10 F6000", "G1 X20", "M114"), is_job=True)
    asked, other = (
        feeder.submit_interjection(LinesWork([*["M220 S50"] * 200, last], while_printing=True))
        for last in ("M220 S70", "G1 X5")
    )
    while feeder.planner.speed_factor == 1:
        assert isinstance(feeder.step(), Progress)
    assert not asked.read
    feeder.cancel(asked)
    drive(feeder)
    assert finished(feeder) == [asked, other, job]
    assert feeder.planner.speed_factor == 0.5
    # The lines of both are counted by themselves, and what is read in C for the job is not for the other.
    assert str(other.error).startswith("client:201: G1 cannot run while a job prints")
    assert job.error is None
    assert [output.text for output in job.output[-1:]] == ["X:20.000 Y:0.000 Z:0.000 E:0.000"]


def test_at_the_end_no_line_of_an_interjection_is_waited_for(feeder: Feeder) -> None:
    begun, waiting = (feeder.submit_interjection(LinesWork(["M220 S50"] * 200)) for _ in range(2))
    feeder.step()
    feeder.cancel_all()
    feeder.close()
    assert len(drive(feeder)) < 4
    assert finished(feeder) == [begun, waiting]


def test_a_pause_and_a_cancel_act_among_lines_without_an_event(feeder: Feeder) -> None:
    """Failed before: all of the file's lines were read in one call."""
    job = feeder.submit(file_of(*["G28", *["G90"] * 500, "G1 X10 F6000"]), is_job=True)
    while feeder.planner.lines < 10:
        feeder.step()
    feeder.pause()
    lines = feeder.planner.lines
    assert isinstance(feeder.step(), Idle)
    feeder.resume()
    feeder.step()
    feeder.cancel(job)
    drive(feeder)
    assert finished(feeder) == [job]
    assert lines < feeder.planner.lines < 200
    assert feeder.planner.moves == 0


def test_cancel_ends_before_the_next_line_also_while_paused(feeder: Feeder) -> None:
    feeder.planner.plan_until_s = 0.5
    job = feeder.submit(
        file_of("G28", *(f"G1 X{100 + i} F600\nG1 X{90 - i}" for i in range(10))), is_job=True
    )
    while not isinstance(feeder.step(), Full):
        pass
    feeder.pause()
    feeder.cancel(job)
    drive(feeder)
    assert finished(feeder) == [job]
    assert job.cancelled
    assert feeder.planner.at_standstill
    assert feeder.planner.toolhead_position[0] != 81.0


def test_a_waiting_work_that_is_cancelled_never_begins(feeder: Feeder) -> None:
    feeder.submit(LinesWork(["G28"]))
    waiting = feeder.submit(MoveWork({"X": 10.0}, 50.0, relative=False))
    feeder.cancel(waiting)
    drive(feeder)
    assert waiting.begun_at_s is None
    assert feeder.planner.toolhead_position == (0.0, 0.0, 0.0, 0.0)


def test_moves_ignore_modes_and_modes_survive_no_job(feeder: Feeder) -> None:
    feeder.submit(LinesWork(["G28", "G91", "G20", "G92 X7", "M204 S100"]))
    feeder.submit(MoveWork({"X": 12.5, "Z": 1.0}, 50.0, relative=False))
    by = MoveWork({"X": -2.5}, 50.0, relative=True)
    feeder.submit(by)
    drive(feeder)
    assert feeder.planner.toolhead_position == (10.0, 0.0, 1.0, 0.0)
    assert by.target == [10.0, 0.0, 1.0, 0.0]
    feeder.submit(file_of("G28", "G1 X3 F6000"))
    drive(feeder)
    assert feeder.planner.toolhead_position[0] == 3.0
    assert (feeder.planner.relative, feeder.planner.unit_mm) == (False, 1.0)
    assert feeder.planner.accel == LIMITS.max_accel


def test_a_tower_is_that_of_the_next_job_and_ends_with_it(feeder: Feeder) -> None:
    feeder.submit(LinesWork(["TUNING_TOWER COMMAND=M118 PARAMETER=V START=1 FACTOR=1"]))
    for count in (1, 0):
        job = feeder.submit(file_of("G28", "M83", "G1 Z1 F600", "G1 X5 E1 F6000"))
        drive(feeder)
        assert [output.text for output in job.output][1:] == ["echo: V2.000000000"] * count
    assert feeder.machine.tower is None


def test_a_move_beyond_the_limits_says_so(feeder: Feeder) -> None:
    unhomed = feeder.submit(MoveWork({"X": 1.0}, 50.0, relative=True))
    drive(feeder)
    assert "before it is homed" in str(unhomed.error)


def test_emergency_stops_and_is_handed_on(feeder: Feeder) -> None:
    feeder.submit(LinesWork(["M112"]))
    assert isinstance(drive(feeder)[-1], Emergency)


def test_queues_are_bounded(feeder: Feeder) -> None:
    for _ in range(WAITING_MAX):
        feeder.submit(LinesWork(["M114"]))
    with pytest.raises(FeederFull):
        feeder.submit(LinesWork(["M114"]))
    for _ in range(INTERJECTIONS_MAX):
        feeder.submit_interjection(LinesWork(["M114"]))
    with pytest.raises(FeederFull):
        feeder.submit_interjection(LinesWork(["M114"]))


def test_close_ends_at_rest(feeder: Feeder) -> None:
    feeder.submit(LinesWork(["G28", "G1 X10 F6000"], rest=Rest.OPEN))
    drive(feeder)
    feeder.close()
    assert isinstance(drive(feeder)[-1], End)
    assert feeder.planner.at_standstill


def test_commands_are_found_behind_numbers_and_comments() -> None:
    assert commands_in(["N3 g1 X1 ; M112", "", "(M112) m114", "set_velocity_limit ACCEL=1"]) == [
        "G1",
        "M114",
        "SET_VELOCITY_LIMIT",
    ]
    with pytest.raises(WorkError, match="line 2"):
        commands_in(["G1", "X1"])
