"""Commands of modules in a program: when each kind is done, and what a plan makes of it."""

from collections.abc import Callable

import pytest

from coordinator.gcode import interpreter
from coordinator.gcode.commands import (
    AtStandstill,
    Call,
    GCodeCommand,
    Immediate,
    Lines,
    Reading,
    Synchronized,
    Vocabulary,
)
from coordinator.gcode.errors import GCodeError
from coordinator.gcode.events import (
    Done,
    End,
    Event,
    Full,
    Notice,
    PositionSet,
    Progress,
    Reply,
    StandstillAction,
    Timed,
)
from coordinator.gcode.interpreter import LINES_AT_ONCE, MAX_DEPTH, Job
from coordinator.gcode.parser import WordError
from coordinator.gcode.program import Program
from coordinator.motion.planner.planner import Planner
from tests.coordinator.motion.planner_helpers import LIMITS, drain

HOME = {"X": 0.0, "Y": 0.0, "Z": 0.0}


async def nothing() -> None:
    return None


def job(*lines: str, home: Callable[[Call, str], Reading] | None = None, **read: Reading) -> Job:
    """A program whose vocabulary reads each of the names in READ as that."""

    def reader(reading: Reading) -> Callable[[Call], Reading]:
        return lambda _: reading

    commands = {name: GCodeCommand(name, "for the test", reader(reading)) for name, reading in read.items()}
    return Job(
        Program.from_lines(lines, "part.gcode"), Planner(LIMITS), HOME, vocabulary=Vocabulary(commands, home)
    )


def events(work: Job, perform: Callable[[StandstillAction], None] = lambda _: None) -> list[Event]:
    found: list[Event] = []
    while not (found and isinstance(found[-1], End)):
        event = work.step()
        drain(work.planner)
        if isinstance(event, StandstillAction):
            assert work.planner.at_standstill
            perform(event)
        if not isinstance(event, Progress | Full | Notice):
            found.append(event)
    return found


def replies(found: list[Event]) -> list[str]:
    return [event.text for event in found if isinstance(event, Reply)]


def test_what_is_done_at_once_is_done_in_order() -> None:
    said: list[int] = []
    work = job("HELLO", "HELLO", HELLO=Immediate(("hi", "there"), lambda: said.append(len(said))))
    assert replies(events(work)) == ["hi", "there", "hi", "there"]
    assert said == [0, 1]


def test_what_is_done_in_time_knows_its_place_among_the_moves() -> None:
    work = job("G28", "BLOW", "G1 X10 F6000", "G1 X20", "BLOW", "G1 X30", BLOW=Synchronized(lambda _: None))
    found = [event for event in events(work) if isinstance(event, Timed)]
    assert [(event.line, event.after_moves) for event in found] == [(2, 0), (5, 2)]


def test_what_is_done_at_rest_comes_to_rest_first_and_hands_back_where_the_machine_stands() -> None:
    def probed(event: StandstillAction) -> None:
        event.done, event.over = Done(("at 1.5",), position=(10.0, 0.0, 1.5, 0.0), homed="Z"), True

    work = job("G28", "G92 Z7", "G1 X10 F6000", "PROBE", "M114", PROBE=AtStandstill(nothing))
    found = events(work, probed)
    assert replies(found) == ["at 1.5", "X:10.000 Y:0.000 Z:1.500 E:0.000"]
    (_, event) = [event for event in found if isinstance(event, PositionSet)]
    assert event.position == (10.0, 0.0, 1.5, 0.0)
    assert event.axes == "Z"


def test_a_plan_takes_what_the_command_says_for_granted() -> None:
    planned = Done(position=(1.0, 2.0, 3.0, 0.0), homed="XYZ")
    work = job("FIND", "M114", FIND=AtStandstill(nothing, planned))
    assert replies(events(work)) == ["X:1.000 Y:2.000 Z:3.000 E:0.000"]
    assert set(work.planner.homed) == set("XYZ")


def test_what_failed_on_its_way_leaves_nothing_homed_and_ends_the_program() -> None:
    def lost(event: StandstillAction) -> None:
        event.done, event.over, event.moved, event.failure = None, True, True, "the probe did not switch"

    work = job("G28", "PROBE", "G1 X10 F6000", PROBE=AtStandstill(nothing))
    with pytest.raises(GCodeError, match=r"^part\.gcode:2: the probe did not switch$"):
        events(work, lost)
    assert work.planner.homed == ""


def test_axes_can_be_forgotten() -> None:
    def off(event: StandstillAction) -> None:
        event.done, event.over = Done(unhomed="XY"), True

    work = job("G28", "OFF", OFF=AtStandstill(nothing))
    events(work, off)
    assert work.planner.homed == "Z"


def test_lines_take_a_commands_place() -> None:
    inner = Lines("G1 X10 F6000\nHELLO\n\nG1 X20 ; the last line has no line feed")
    work = job("G28", "GO", "M114", GO=inner, HELLO=Immediate(("hi",)))
    assert replies(events(work)) == ["hi", "X:20.000 Y:0.000 Z:0.000 E:0.000"]
    assert work.planner.moves == 2
    assert work.planner.lines == 3


def test_a_mistake_within_lines_is_told_with_all_places() -> None:
    def refuse(_: Call) -> Reading:
        raise WordError("there is no such fan")

    commands = {
        "OUTER": GCodeCommand("OUTER", "", lambda _: Lines("\nINNER")),
        "INNER": GCodeCommand("INNER", "", lambda _: Lines("G4 P1\n\nBLOW")),
        "BLOW": GCodeCommand("BLOW", "", refuse),
    }
    lines = Program.from_lines(["G28", "OUTER"], "part.gcode")
    work = Job(lines, Planner(LIMITS), HOME, vocabulary=Vocabulary(commands))
    with pytest.raises(GCodeError, match=r"^part\.gcode:2: OUTER:2: INNER:3: there is no such fan$"):
        events(work)


def test_moves_within_lines_are_refused_like_others() -> None:
    work = job("G28", "GO", GO=Lines("G1 X10 F6000\nG1 X100000"))
    with pytest.raises(GCodeError, match=r"^part\.gcode:2: GO:2: .*100000"):
        events(work)


def test_lines_that_stand_for_themselves_end() -> None:
    with pytest.raises(GCodeError, match=rf"part\.gcode:1: .*GO calls itself, {MAX_DEPTH} levels deep"):
        events(job("GO", GO=Lines("GO")))


@pytest.mark.parametrize(("text", "ticks"), [("TICK\n" * 1000, 1000), ("MANY", 1000), ("TWICE\n" * 100, 200)])
def test_lines_without_an_event_are_read_in_portions(text: str, ticks: int) -> None:
    """Failed before: one call read all of them, for hours where macros call one another twice."""
    read = 0

    def count() -> None:
        nonlocal read
        read += 1

    work = job(text, TICK=Immediate(act=count), MANY=Lines("TICK\n" * 1000), TWICE=Lines("TICK\nTICK"))
    portions, before = [], 0
    while not isinstance(work.step(), End):
        portions.append(read - before)
        before = read
    assert read == ticks
    # A template that was rendered may have taken its time: nothing follows in the same call.
    assert 0 < max(portions) <= (2 if ticks == 200 else LINES_AT_ONCE)


def test_lines_that_stand_for_ever_more_lines_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interpreter, "MAX_LINES", 1_000)
    work = job("G28", "FEW", "FEW", "GO", FEW=Lines("G90\n" * 600), GO=Lines("FEW\n" * 3))
    with pytest.raises(GCodeError, match=r"^part\.gcode:4: GO:2: FEW:399: GO stands for more than 1,000"):
        events(work)


def test_callers_are_known() -> None:
    seen: list[tuple[str, ...]] = []

    def look(call: Call) -> Reading:
        seen.append(call.callers)
        return Immediate()

    commands = {
        "OUTER": GCodeCommand("OUTER", "", lambda _: Lines("LOOK")),
        "LOOK": GCodeCommand("LOOK", "", look),
    }
    lines = Program.from_lines(["LOOK", "OUTER", "LOOK"], "part.gcode")
    events(Job(lines, Planner(LIMITS), HOME, vocabulary=Vocabulary(commands)))
    assert seen == [(), ("OUTER",), ()]


def test_homing_is_the_modules_business_and_a_plan_knows_where_it_ends() -> None:
    asked: list[str] = []

    def home(_: Call, axes: str) -> Reading:
        asked.append(axes)
        return AtStandstill(nothing)

    def found(event: StandstillAction) -> None:
        event.done, event.over = Done(position=(0.0, 0.0, 0.25, 0.0), homed="Z"), True

    planned = job("G28 Z", "M114", home=home)
    assert replies(events(planned)) == ["X:0.000 Y:0.000 Z:0.000 E:0.000"]
    real = job("G28 Z", "M114", home=home)
    assert replies(events(real, found)) == ["X:0.000 Y:0.000 Z:0.250 E:0.000"]
    assert set(asked) == {"Z"}
    assert real.planner.homed == "Z"


def test_homing_may_be_replaced_by_lines_that_home() -> None:
    def home(call: Call, _: str) -> Reading:
        return AtStandstill(nothing) if "G28" in call.callers else Lines("G28 Z\nG28 X Y")

    work = job("G28", home=home)
    found = events(work)
    assert [event.axes for event in found if isinstance(event, PositionSet)] == ["Z", "XY"]
