"""Commands that nothing acts on: an error in a job that needs them, else a notice."""

import pytest

from coordinator.gcode.absent_commands import ABSENT
from coordinator.gcode.commands import Call, GCodeCommand, Immediate, Reading, Vocabulary, renamed
from coordinator.gcode.errors import GCodeError
from coordinator.gcode.events import End, Event, Notice, Reply
from coordinator.gcode.interpreter import Job
from coordinator.gcode.program import Program
from coordinator.motion.planner.planner import Planner
from tests.coordinator.motion.planner_helpers import LIMITS

HOME = {"X": 0.0, "Y": 0.0, "Z": 0.0}


def run(line: str, vocabulary: Vocabulary, *, strict: bool) -> list[Event]:
    job = Job(
        Program.from_lines([line], "part.gcode"), Planner(LIMITS), HOME, vocabulary=vocabulary, strict=strict
    )
    found: list[Event] = []
    while True:
        event = job.step()
        if isinstance(event, End):
            return found
        found.append(event)


def notices(line: str, vocabulary: Vocabulary | None = None, *, strict: bool = True) -> list[str]:
    events = run(line, vocabulary or Vocabulary({}), strict=strict)
    return [event.text for event in events if isinstance(event, Notice)]


@pytest.mark.parametrize("name", [name for name, absent in ABSENT.items() if absent.harmless])
def test_harmless_ones_are_skipped_with_a_notice(name: str) -> None:
    if not name.startswith("M10"):  # those are a machine's own, whatever it has
        assert len(notices(name)) == 1
    why = Vocabulary({}, unsupported={name: "[it] is not supported yet"})
    (said,) = notices(name, why)
    assert "[it] is not supported yet" in said


OWN = ("M104", "M109", "M140", "M190")


@pytest.mark.parametrize("name", [name for name, absent in ABSENT.items() if not absent.harmless])
def test_others_end_a_job_and_are_told_of_in_a_plan(name: str) -> None:
    line = f"{name} S200" if name in OWN else name
    because = Vocabulary({}, unsupported={name: "[it] is not supported yet"})
    with pytest.raises(GCodeError) as error:
        run(line, because, strict=True)
    assert "[it] is not supported yet; remove the line" in str(error.value)
    (said,) = notices(line, because, strict=False)
    assert "a job would end here" in said
    if name not in ("M104", "M109", "M140", "M190"):
        assert notices(line) == [f"part.gcode:1: unknown command {name}: unknown commands are skipped"]


def test_heat_for_what_a_machine_does_not_have_is_no_error() -> None:
    assert len(notices("M140 S60")) == 1


def test_turning_a_heater_off_that_does_not_act_is_no_error() -> None:
    off = Vocabulary({}, unsupported={"M140": "[heater_bed] is not supported yet"})
    assert len(notices("M140 S0", off)) == 1


def test_what_nobody_knows_is_skipped() -> None:
    assert notices("WHAT_IS_THIS A=1") == [
        "part.gcode:1: unknown command WHAT_IS_THIS: unknown commands are skipped"
    ]


@pytest.mark.parametrize("line", ["M104.0 S3", "m104.0 S3"])
def test_a_name_as_it_is_written_comes_before_what_it_usually_means(line: str) -> None:
    def says(text: str) -> GCodeCommand:
        def read(call: Call) -> Reading:
            return Immediate((f"{text} {call.command.text}",))

        return GCodeCommand("M104", text, read)

    base = renamed(says("base"), "M104", "M104.0", while_printing=False)
    events = run(line, Vocabulary({"M104": says("macro"), "M104.0": base}), strict=True)
    assert [event.text for event in events if isinstance(event, Reply)] == ["base S3"]


def test_a_move_under_another_name_is_a_move() -> None:
    commands = {
        "G0": GCodeCommand("G0", "a macro", lambda _: Immediate(("macro",))),
        "G00": renamed(None, "G0", "G00", while_printing=False),
    }
    events = run("G00 F600", Vocabulary(commands), strict=True)
    assert not [event for event in events if isinstance(event, Reply | Notice)]


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("SET_VELOCITY_LIMIT ACCEL=500 ACCEL_TO_DECEL=250", "ACCEL_TO_DECEL of SET_VELOCITY_LIMIT"),
        ("M220 S100 B", "B of M220"),
        ("G4 P0 X1", "X of G4"),
        ("G92 E0 A1", "A of G92"),
        ("M204 S500 Q1", "Q of M204"),
        ("M205 J0.02", "J of M205"),
        ("M201 X500 S1", "S of M201"),
        ("SET_GCODE_OFFSET Z=0 FOO=1", "FOO of SET_GCODE_OFFSET"),
    ],
)
def test_parameters_that_mean_nothing_are_ignored_with_one_notice(line: str, what: str) -> None:
    assert notices(line) == [f"part.gcode:1: {what}: it has no meaning here and is ignored"]
    assert notices(f"{line}\n{line}") == notices(line)


@pytest.mark.parametrize("tool", ["T255", "T1000"])
def test_a_tool_that_stands_for_none_is_ignored(tool: str) -> None:
    assert len(notices(tool)) == 1


def test_g92_of_nothing_that_it_knows_is_not_the_bare_one() -> None:
    lines = "G92 X5 Y6 Z7\nG92 F1\nM114"
    events = run(lines, Vocabulary({}), strict=True)
    (place,) = [event.text for event in events if isinstance(event, Reply)]
    assert place.startswith("X:5.000 Y:6.000 Z:7.000")


def test_numbers_with_a_plus_are_numbers() -> None:
    job = Job(Program.from_lines(["G92 X+10 Y+.5", "M114"], "part.gcode"), Planner(LIMITS), HOME)
    reply = job.step()
    while not isinstance(reply, Reply):
        reply = job.step()
    assert reply.text.startswith("X:10.000 Y:0.500")
    assert notices("SET_VELOCITY_LIMIT ACCEL=+500") == []


def planner_after(*lines: str) -> Planner:
    planner = Planner(LIMITS)
    job = Job(Program.from_lines(lines, "part.gcode"), planner, HOME, strict=True)
    while not isinstance(job.step(), End):
        pass
    return planner


def test_limits_that_slicers_write_hold_up_to_the_configured_ones_until_the_next_program() -> None:
    planner = planner_after("M201 X500 Y100000000 Z20 E900", "M203 X90 Y100000000 Z4 E30", "M205 X3 Y2 Z1 E5")
    core = planner._core
    assert (core.limits.max_x_accel, core.limits.max_z_accel) == (500, min(20, LIMITS.max_z_accel))
    assert core.limits.max_y_accel == LIMITS.max_accel
    assert (core.limits.max_x_velocity, core.limits.max_y_velocity) == (90, LIMITS.max_velocity)
    assert core.limits.max_z_velocity == min(4, LIMITS.max_z_velocity)
    assert core.limits.max_extrude_only_velocity == min(30, LIMITS.max_extrude_only_velocity)
    assert core.limits.square_corner_velocity == min(2, LIMITS.square_corner_velocity)
    planner.reset_modes()
    fresh = Planner(LIMITS)._core
    for name in ("x_accel", "x_velocity", "z_accel", "z_velocity", "extrude_only_velocity"):
        assert getattr(core.limits, f"max_{name}") == getattr(fresh.limits, f"max_{name}")


@pytest.mark.parametrize("line", ["M201 X0", "M203 Z-1", "M205 X0"])
def test_limits_are_above_0(line: str) -> None:
    with pytest.raises(GCodeError, match="must be above 0"):
        planner_after(line)
