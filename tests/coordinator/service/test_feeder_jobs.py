"""Jobs that are paused, gone between, resumed and cancelled, by g-code and otherwise; no clock, no thread."""

from pathlib import Path

import pytest

from coordinator.gcode.commands import AtStandstill, GCodeCommand, Vocabulary
from coordinator.gcode.events import Done, End, Event, Full, Idle, Notice, Reply, StandstillAction
from coordinator.gcode.program import Program
from coordinator.modules.programs.pause_resume import PauseResume
from coordinator.modules.status.print_stats import PrintStats
from coordinator.service.core import feeder
from coordinator.service.core.feeder import Feeder, QueuedWork
from coordinator.service.core.work import FileWork, LinesWork, MoveWork
from tests.stages.program_stage import ProgramStage

MACROS = """
[pause_resume]
[virtual_sdcard]
path: jobs
[exclude_object]
[display_status]
[gcode_macro PAUSE]
rename_existing: BASE_PAUSE
gcode:
    BASE_PAUSE
    G91
    G1 Z5 F600
    G90
    G1 X1 Y2 F6000
[gcode_macro RESUME]
rename_existing: BASE_RESUME
gcode:
    {action_respond_info("resuming")}
    BASE_RESUME VELOCITY=100
[gcode_macro CANCEL_PRINT]
rename_existing: BASE_CANCEL_PRINT
gcode:
    BASE_CANCEL_PRINT
    G1 X3 F6000
[gcode_macro HELLO]
gcode:
    M117 hello {params.NAME}
[gcode_macro JUMP]
gcode:
    G91
    G1 X50
"""


class Fed:
    """A feeder that is driven as the streamer's worker drives it."""

    def __init__(self, folder: Path, sections: str = MACROS) -> None:
        self.stage = ProgramStage(folder, sections)
        self.planner = self.stage.planner
        self.feeder = Feeder(
            self.planner,
            self.stage.description.homed_position,
            self.stage.machine,
            self.stage.modules.vocabulary,
        )
        self.output: list[str] = []

    def job(self, *lines: str) -> QueuedWork:
        work = FileWork(Program.from_lines(["\n".join(lines) + "\n"], "job.gcode"))
        return self.feeder.submit(work, is_job=True)

    def lines(self, *lines: str, while_printing: bool = False) -> QueuedWork:
        work = LinesWork(lines, while_printing=while_printing)
        return self.feeder.submit_interjection(work) if while_printing else self.feeder.submit(work)

    def step(self, *, room: bool = True) -> Event:
        event = self.feeder.step()
        if isinstance(event, Full) and room:
            self.planner.release(self.planner.take().count)
        if isinstance(event, Reply | Notice):
            self.output.append(event.text)
        return event

    def drive(self) -> None:
        """Step until nothing is left to do."""
        for _ in range(5000):
            if isinstance(self.step(), Idle | End):
                return
        raise AssertionError("the feeder does not come to an end")

    def fill(self) -> None:
        """Step until as much is planned as may be."""
        assert any(isinstance(self.step(room=False), Full) for _ in range(1000))

    @property
    def at(self) -> tuple[float, ...]:
        return tuple(round(value, 6) for value in self.planner.toolhead_position)


def finding(folder: Path) -> Fed:
    """One whose programs know FIND, which is done at rest."""
    fed = Fed(folder)

    async def perform() -> None:
        return None

    command = GCodeCommand("FIND", "for the test", lambda _: AtStandstill(perform))
    vocabulary = Vocabulary({**fed.feeder.vocabulary.commands, "FIND": command})
    fed.feeder = Feeder(fed.planner, fed.stage.description.homed_position, fed.stage.machine, vocabulary)
    return fed


@pytest.fixture
def fed(tmp_path: Path) -> Fed:
    return Fed(tmp_path)


BEGIN = ("G28", "G90", "G1 Z1 F600", "G1 X50 Y60 F6000", "M82", "G92 E0", "G1 X60 E0.2")


def test_a_job_pauses_itself_parks_and_goes_on_where_it_was(fed: Fed) -> None:
    job = fed.job(*BEGIN, "PAUSE", "G1 X70 E0.4", "M114")
    fed.drive()
    assert fed.feeder.paused
    assert fed.at == (1, 2, 6, 0.2)
    assert job.progress.line == 8
    fed.lines("G91", "G1 X10 Y10 Z1 F60", "M83", "G1 E1", "G92 X0")
    fed.drive()
    assert fed.at == (11, 12, 7, 1.2)
    assert job.progress.line == 8
    fed.lines("RESUME")
    fed.drive()
    assert "resuming" in fed.output
    assert not fed.feeder.paused
    assert job.error is None
    assert fed.at == (70, 60, 1, 1.4)
    assert fed.output[-1] == "X:70.000 Y:60.000 Z:1.000 E:0.400"
    assert fed.planner.speed_mm_s == 25.0  # the modes of what comes behind a job
    assert list(fed.feeder.finished)[-1] is job


def test_a_pause_from_beside_and_a_way_back_at_the_greater_height(fed: Fed) -> None:
    fed.planner.plan_until_s = 2.0
    job = fed.job(*BEGIN, *(f"G1 X{70 + n} Y{60 + n} E{0.4 + n / 10} F600" for n in range(40)))
    fed.fill()
    fed.planner.plan_until_s = float("inf")
    fed.feeder.pause()
    fed.lines("PAUSE")
    fed.drive()
    stood = fed.feeder.step()
    assert isinstance(stood, Idle)
    assert fed.at[:3] == (1, 2, 6)
    moves = fed.planner.moves
    fed.feeder.resume()  # as job.resume does, without any g-code
    first = fed.planner.take().count
    fed.planner.release(first)
    fed.drive()
    assert job.error is None
    assert fed.at == (109, 99, 1, 4.3)
    assert fed.planner.moves > moves + 2


@pytest.mark.parametrize("clockwise", [True, False])
def test_a_job_is_paused_in_the_middle_of_an_arc(fed: Fed, clockwise: bool) -> None:
    fed.planner.plan_until_s = 1.0
    job = fed.job("G28", "G1 X100 Y100 Z1 F6000", f"G{2 if clockwise else 3} I40 E5 F600", "M114")
    for _ in range(100):
        fed.fill()
        if fed.planner.arc_open:
            break
        fed.planner.plan_until_s += 1.0
        fed.planner.release(fed.planner.take().count)
    assert fed.planner.arc_open
    fed.planner.plan_until_s = float("inf")
    stood = fed.at
    fed.feeder.pause()
    fed.feeder.submit(MoveWork({"X": 10.0, "Y": 10.0, "E": 3.0}, 50.0, relative=True))
    fed.drive()
    assert fed.at[:2] == (stood[0] + 10, stood[1] + 10)
    fed.feeder.resume()
    fed.drive()
    assert job.error is None
    assert fed.at[:3] == (100, 100, 1)
    assert fed.output[-1] == "X:100.000 Y:100.000 Z:1.000 E:5.000"


def test_offsets_and_factors_changed_in_a_pause_stay(fed: Fed) -> None:
    fed.job(*BEGIN, "PAUSE", "G1 X70 E0.4", "M114")
    fed.drive()
    fed.lines("SET_GCODE_OFFSET Z_ADJUST=0.1", "M220 S50", "G92 X5")
    fed.lines("RESUME")
    fed.drive()
    assert fed.at == (70, 60, 1.1, 0.4)
    assert fed.output[-1] == "X:70.000 Y:60.000 Z:1.000 E:0.400"
    assert fed.planner.speed_factor == 0.5
    assert fed.planner.gcode_offset[2] == pytest.approx(0.1)


def test_without_its_homing_a_job_stays_paused(fed: Fed) -> None:
    job = fed.job(*BEGIN, "PAUSE", "G1 X70")
    fed.drive()
    fed.lines("M117 motors off")
    fed.drive()
    fed.planner.homed = "Z"
    fed.feeder.resume()
    fed.drive()
    assert fed.feeder.paused
    assert fed.output[-1] == "job.gcode stays paused: X and Y must be homed with G28 before it can go on"
    failed = fed.lines("RESUME")
    fed.drive()
    assert "home with G28 first" in str(failed.error)
    assert fed.feeder.paused
    fed.lines("G28")
    fed.lines("RESUME")
    fed.drive()
    assert job.error is None
    assert fed.at[:2] == (70, 60)


def test_a_speed_below_0_ends_the_job_before_any_state_has_it(fed: Fed) -> None:
    """Failed before: F alone was kept, a pause saved it, and resuming stopped all nodes."""
    job = fed.job(*BEGIN, "G1 F-100", "PAUSE", "G1 X70")
    fed.drive()
    assert "job.gcode:8: the speed is -1.667 mm/s, which is not above 0" in str(job.error)


def test_a_way_back_that_is_refused_leaves_the_job_paused(fed: Fed, monkeypatch: pytest.MonkeyPatch) -> None:
    job = fed.job(*BEGIN, "PAUSE", "G1 X70", "M114")
    fed.drive()

    def refuse(*_: object) -> bool:
        raise ValueError("the speed is -1.0")

    with monkeypatch.context() as refusing:
        refusing.setattr(feeder, "come_back", refuse)
        fed.feeder.resume()
        fed.drive()
    assert fed.feeder.paused
    assert fed.output[-1] == "job.gcode stays paused: the speed is -1.0"
    fed.feeder.resume()
    fed.drive()
    assert job.error is None
    assert fed.output[-1].startswith("X:70.000")


def test_a_job_cancels_itself_and_its_macro_goes_to_its_end(fed: Fed) -> None:
    job = fed.job(*BEGIN, "CANCEL_PRINT", "G1 X70")
    fed.drive()
    assert job.cancelled
    assert fed.at[:2] == (3, 60)
    assert not fed.feeder.busy


def test_a_paused_job_is_cancelled_by_a_client(fed: Fed) -> None:
    job = fed.job(*BEGIN, "PAUSE", "G1 X70")
    fed.drive()
    fed.lines("CANCEL_PRINT")
    fed.drive()
    assert job.cancelled
    assert list(fed.feeder.finished)[-1] is job
    assert fed.at[:2] == (3, 2)
    fed.feeder.resume()  # as the service does when a job has ended
    again = fed.job("G28", "G1 X5 F6000", "M114")
    fed.drive()
    assert again.error is None
    assert fed.at[0] == 5


def test_beside_a_job_macros_may_speak_but_not_move(fed: Fed) -> None:
    fed.planner.plan_until_s = 1.0
    fed.job(*BEGIN, *(f"G1 X{70 + n}" for n in range(40)))
    fed.fill()
    good = fed.lines("HELLO NAME=you", while_printing=True)
    bad = fed.lines("JUMP", while_printing=True)
    moved = fed.lines("G1 X5", while_printing=True)
    moves = fed.planner.moves
    while not moved.read:
        fed.step(room=False)
    assert fed.planner.moves == moves
    assert good.error is None
    assert fed.stage.modules.status()["display_status"]["message"] == "hello you"
    assert "[gcode_macro JUMP]: G91 cannot run while a job prints" in str(bad.error)
    assert "client:1: G1 cannot run while a job prints" in str(moved.error)
    fed.planner.plan_until_s = float("inf")
    fed.drive()
    assert fed.at[0] == 109


def test_an_object_is_left_out_from_beside_and_the_pause_within_it_moves(fed: Fed) -> None:
    fed.planner.plan_until_s = 1.5
    job = fed.job(
        *BEGIN, "EXCLUDE_OBJECT_START NAME=a", *(f"G1 X{70 + n} E{0.4 + n / 10}" for n in range(60)),
        "EXCLUDE_OBJECT_END NAME=a", "G1 X20 Y20", "M114",
    )  # fmt: skip
    fed.fill()
    asked = fed.lines("EXCLUDE_OBJECT CURRENT=1", while_printing=True)
    while not asked.read:
        fed.step(room=False)
    assert fed.planner.excluded
    stood = fed.at
    fed.feeder.pause()
    fed.feeder.submit(MoveWork({"Z": 5.0}, 5.0, relative=True))
    fed.planner.plan_until_s = float("inf")
    fed.drive()
    assert fed.at[2] == 6
    fed.feeder.resume()
    fed.drive()
    assert job.error is None
    assert not fed.planner.excluded
    assert fed.at == (20, 20, 1, stood[3])
    assert fed.output[-1].endswith("E:6.300")


def test_a_pause_takes_over_what_was_done_at_rest_before_others_move(tmp_path: Path) -> None:
    fed = finding(tmp_path)
    done = Done(("found",), position=(10.0, 20.0, 30.0, 0.0), homed="XYZ")
    job = fed.job("FIND", "G1 X50 F6000")
    event = next(event for event in (fed.step() for _ in range(99)) if isinstance(event, StandstillAction))
    fed.feeder.pause()
    event.done, event.over = done, True
    fed.feeder.submit(MoveWork({"X": 1.0}, 50.0, relative=True))
    fed.drive()
    assert fed.at == (11, 20, 30, 0)
    assert "found" in fed.output
    fed.feeder.resume()
    fed.drive()
    assert job.error is None
    assert fed.at == (50, 20, 30, 0)


def test_programs_have_files_printed_but_not_beside_a_job(fed: Fed) -> None:
    fed.lines("SDCARD_PRINT_FILE FILENAME=/a.gcode")
    fed.lines("M23 b.gcode", "M24", "M27")
    fed.drive()
    assert list(fed.feeder.to_print) == ["a.gcode", "b.gcode"]
    assert fed.output == ["File selected: b.gcode", "Not SD printing."]
    job = fed.job("G28", "SDCARD_PRINT_FILE FILENAME=c.gcode")
    fed.drive()
    assert "a job is active" in str(job.error)
    assert len(fed.feeder.to_print) == 2


def test_m25_and_m24(fed: Fed) -> None:
    job = fed.job(*BEGIN, "M25", "G1 X70")
    fed.drive()
    assert fed.feeder.paused
    assert fed.at[0] == 60
    fed.lines("M24")
    fed.drive()
    assert job.error is None
    assert fed.at[0] == 70


def test_clients_are_answered_while_a_job_waits_at_rest_but_nothing_is_planned(tmp_path: Path) -> None:
    fed = finding(tmp_path)
    fed.job(
        *BEGIN, "EXCLUDE_OBJECT_START NAME=a", "EXCLUDE_OBJECT NAME=a", "G1 E0.1 F600", "FIND", "G1 X70 E0.3"
    )  # fmt: skip
    event = next(event for event in (fed.step() for _ in range(99)) if isinstance(event, StandstillAction))
    asked = fed.lines("M114", "M220 S50", "HELLO NAME=you", while_printing=True)
    back = fed.lines("EXCLUDE_OBJECT RESET=1", while_printing=True)
    moves = fed.planner.moves
    while fed.feeder.attend_others() is not None:
        pass
    assert [output.text for output in asked.output if isinstance(output, Reply)] == [
        "X:60.000 Y:60.000 Z:1.000 E:0.100"
    ]
    assert fed.planner.speed_factor == 0.5
    # What needs a move has to wait until the machine rests no more.
    assert not back.read
    assert fed.planner.moves == moves
    event.over, event.done = True, Done()
    fed.drive()
    assert back.error is None
    assert fed.planner.moves == moves + 2
    assert fed.at == (70, 60, 1, 0.3)


def test_the_card_and_its_file(fed: Fed) -> None:
    fed.lines("M23 a.gcode", "M26 S0", "M21", "SDCARD_RESET_FILE", "M24")
    fed.drive()
    assert fed.output == ["File selected: a.gcode", "SD card ok"]
    assert "M24 comes before a file is selected" in str(fed.feeder.finished[-1].error)
    fed.lines("M26 S100")
    fed.drive()
    assert "M26 cannot begin in the middle of a file: temperatures" in str(fed.feeder.finished[-1].error)
    fed.job("G28", "SDCARD_RESET_FILE")
    fed.drive()
    assert "a job is active" in str(fed.feeder.finished[-1].error)


def test_layers_are_what_a_program_tells(fed: Fed) -> None:
    def info() -> object:
        return fed.stage.modules.status()["print_stats"]["info"]

    fed.job("SET_PRINT_STATS_INFO TOTAL_LAYER=20", "SET_PRINT_STATS_INFO CURRENT_LAYER=3")
    fed.drive()
    assert info() == {"total_layer": 20, "current_layer": 3}
    fed.lines("SET_PRINT_STATS_INFO TOTAL_LAYER=21", "SDCARD_RESET_FILE")
    fed.drive()
    assert info() == {"total_layer": None, "current_layer": None}
    fed.lines("SET_PRINT_STATS_INFO CURRENT_LAYER=-1")
    fed.drive()
    assert "CURRENT_LAYER of SET_PRINT_STATS_INFO is -1; 0 to 1e+06" in str(fed.feeder.finished[-1].error)


def test_a_pause_that_is_cleared_has_nowhere_to_go_back_to(fed: Fed) -> None:
    pauses = next(fed.stage.modules.of(PauseResume))
    fed.lines("G28", "G90", "G1 Z5 F600", "G1 X10 Y10 F6000", "BASE_PAUSE")
    fed.drive()
    assert pauses.status() == {"is_paused": True}
    fed.lines("CLEAR_PAUSE", "G1 X30", "BASE_RESUME")
    fed.drive()
    assert pauses.status() == {"is_paused": False}
    assert fed.output[-1] == "nothing is paused: RESUME does nothing"
    assert fed.at[0] == 30


def test_what_a_console_asks(fed: Fed) -> None:
    fed.lines("STATUS", "M115", "HELP")
    fed.drive()
    status, firmware, *command_help = fed.output
    assert status == "ready"
    assert firmware.startswith("FIRMWARE_NAME:canductor FIRMWARE_VERSION:")
    assert "M24: Print the selected file, or resume the paused job" in command_help
    assert "G28: Home X, Y, Z, or all axes" in command_help
    assert not [line for line in command_help if line.startswith("_")]
    fed.job("STATUS")
    stats = next(fed.stage.modules.of(PrintStats))
    stats.job = {"state": "printing", "filename": "job.gcode"}
    fed.drive()
    assert fed.output[-1] == "printing job.gcode"
