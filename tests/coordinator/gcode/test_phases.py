"""A command that stands for readings which follow one another, each knowing what came of those before."""

from collections.abc import Iterator

import pytest

from coordinator.gcode.builtins.state import go
from coordinator.gcode.commands import (
    AtStandstill,
    Call,
    GCodeCommand,
    Immediate,
    Lines,
    Phases,
    ProgramAction,
    ProgramContext,
    Reading,
    Vocabulary,
)
from coordinator.gcode.errors import GCodeError
from coordinator.gcode.events import Done, End, Event, Full, Reply, StandstillAction
from coordinator.gcode.interpreter import Job
from coordinator.gcode.machine_state import MachineState
from coordinator.gcode.parser import WordError
from coordinator.gcode.program import Program
from coordinator.motion.planner.planner import Planner
from coordinator.service.core.feeder import Feeder
from coordinator.service.core.work import LinesWork
from tests.coordinator.motion.planner_helpers import LIMITS, drain

HOME = {"X": 0.0, "Y": 0.0, "Z": 0.0}


async def nothing() -> None:
    return None


class Probing:
    """PROBE: activates, goes down, deactivates, lifts; twice."""

    def __init__(self) -> None:
        self.found: list[float] = []
        self.seen: list[tuple[float, ...]] = []

    def read(self, call: Call) -> Reading:
        return Phases(lambda job: self.run(job, call))

    def run(self, job: ProgramContext, call: Call) -> Iterator[Reading]:
        for number in range(2):
            yield Lines("M118 down\nG1 X1 F6000\nG1 X0")
            self.seen.append(job.call(call.command).position[:3])
            yield AtStandstill(nothing)
            if len(self.found) <= number:
                return
            yield Immediate((f"found {self.found[number]:g}",))
            x, y, z, e = job.planner.toolhead_position
            yield ProgramAction(lambda job, to=(x, y, z + 2, e): go(job, list(to), 10.0))  # type: ignore[misc]


def job(probing: Probing, *lines: str) -> Job:
    commands = {"PROBE": GCodeCommand("PROBE", "for the test", probing.read)}
    program = Program.from_lines(lines, "part.gcode")
    return Job(program, Planner(LIMITS), HOME, vocabulary=Vocabulary(commands))


def replies(work: Job, probing: Probing, heights: tuple[float, ...], *, room: int = 1000) -> list[str]:
    """Run WORK, whose planner is emptied when ROOM readings were made or it is full."""
    told: list[str] = []
    steps = 0
    heights_left = list(heights)
    event: Event | None = None
    while not isinstance(event, End):
        event = work.step()
        steps += 1
        if isinstance(event, Full) or steps % room == 0 or isinstance(event, StandstillAction):
            drain(work.planner)
        if isinstance(event, StandstillAction) and heights_left:
            height = heights_left.pop(0)
            probing.found.append(height)
            event.done, event.over = Done(position=(0.0, 0.0, height, 0.0)), True
        if isinstance(event, Reply):
            told.append(event.text)
    return told


def test_each_knows_what_came_of_those_before() -> None:
    probing = Probing()
    told = replies(job(probing, "G28", "G1 Z5 F600", "PROBE", "M114"), probing, (1.5, 1.25))
    assert told == ["echo: down", "found 1.5", "echo: down", "found 1.25", "X:0.000 Y:0.000 Z:3.250 E:0.000"]
    assert probing.seen == [(0.0, 0.0, 5.0), (0.0, 0.0, 3.5)]


def test_a_plan_ends_them_where_nothing_comes() -> None:
    probing = Probing()
    work = job(probing, "G28", "PROBE", "M114")
    assert replies(work, probing, ()) == ["echo: down", "X:0.000 Y:0.000 Z:0.000 E:0.000"]
    assert work.planner.lines == 3


def test_a_mistake_names_the_line_of_the_command() -> None:
    class Wrong(Probing):
        def run(self, job: ProgramContext, call: Call) -> Iterator[Reading]:
            del job, call
            yield Immediate(("begun",))
            raise WordError("the samples are too far apart")

    work = job(Wrong(), "G28", "PROBE")
    with pytest.raises(GCodeError, match=r"^part\.gcode:2: the samples are too far apart$"):
        replies(work, Wrong(), ())


def test_a_command_that_calls_itself_is_refused() -> None:
    class Again(Probing):
        def run(self, job: ProgramContext, call: Call) -> Iterator[Reading]:
            del job, call
            yield Lines("PROBE")

    work = job(Again(), "PROBE")
    with pytest.raises(GCodeError, match=r"PROBE calls itself"):
        replies(work, Again(), ())


class Tidy(Probing):
    """Notes when its end has come, whatever the end is."""

    def __init__(self, *rest: Reading) -> None:
        super().__init__()
        self.rest = rest
        self.ended = False

    def run(self, job: ProgramContext, call: Call) -> Iterator[Reading]:
        del job, call
        try:
            yield AtStandstill(nothing)
            yield from self.rest
        finally:
            self.ended = True


def fail(job: ProgramContext) -> bool:
    del job
    raise WordError("X is outside")


@pytest.mark.parametrize("reading", [ProgramAction(fail), Lines("G28 X1 Y=")])
def test_they_end_with_the_error_of_what_they_yield(reading: Reading) -> None:
    """Failed before: they ended when the program was forgotten, which may be much later."""
    tidy = Tidy(reading)
    work = job(tidy, "G28", "PROBE")
    with pytest.raises(GCodeError):
        replies(work, tidy, (1.0,))
    assert tidy.ended


def test_they_end_with_what_fails_at_standstill() -> None:
    tidy = Tidy()
    work = job(tidy, "G28", "PROBE")
    while not isinstance(event := work.step(), StandstillAction):
        drain(work.planner)
    event.over, event.failure = True, "no trigger"
    with pytest.raises(GCodeError, match="no trigger"):
        work.step()
    assert tidy.ended


def test_they_end_with_the_work_that_is_cancelled() -> None:
    tidy = Tidy()
    commands = {"PROBE": GCodeCommand("PROBE", "for the test", tidy.read)}
    feeder = Feeder(Planner(LIMITS), HOME, MachineState(), Vocabulary(commands))
    queued = feeder.submit(LinesWork(["PROBE"]))
    while not isinstance(feeder.step(), StandstillAction):
        drain(feeder.planner)
    assert not tidy.ended
    feeder.cancel(queued)
    while not feeder.finished:
        feeder.step()
        drain(feeder.planner)
    assert tidy.ended
