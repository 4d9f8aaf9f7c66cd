"""A program from its text to events and trapezoids; every error names file and line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coordinator.gcode.errors import GCodeError
from coordinator.gcode.events import (
    Emergency,
    End,
    Event,
    Full,
    Notice,
    PositionSet,
    Progress,
    Reply,
    Wait,
)
from coordinator.gcode.interpreter import MAX_NOTICES, Job
from coordinator.gcode.program import CHUNK_BYTES, Program
from coordinator.motion.planner.planner import Planner
from nodes.support.errors import CanductorError
from tests.coordinator.motion.planner_helpers import (
    LIMITS,
    Array,
    check_invariants,
    check_limits,
    drain,
    joined,
    real_file,
)
from tests.profiles import examples

HOME = {"X": 0.0, "Y": 0.0, "Z": 0.0}


def job_of(*lines: str | bytes) -> Job:
    return Job(Program.from_lines(lines, "part.gcode"), Planner(LIMITS), HOME)


def run(job: Job) -> tuple[list[Event], list[Array]]:
    """Drive JOB as the batch planner does; progress is left out of the events."""
    events: list[Event] = []
    pieces: list[Array] = []
    while True:
        event = job.step()
        pieces += drain(job.planner)
        if not isinstance(event, Progress | Full):
            events.append(event)
        if isinstance(event, End | Emergency):
            return events, pieces


def run_lines(*lines: str | bytes) -> tuple[list[Event], Array]:
    events, pieces = run(job_of(*lines))
    return events, joined(pieces)


def error_of(*lines: str | bytes) -> str:
    with pytest.raises(GCodeError) as caught:
        run(job_of(*lines))
    return str(caught.value)


def texts(events: list[Event]) -> list[str]:
    return [event.text for event in events if isinstance(event, Notice | Reply)]


# ---- Whole files ----


@pytest.mark.parametrize(
    ("name", "moves"), [("text_cube.gcode", 42_000), ("vase.gcode", 127_000), ("circles01.gcode", 53_000)]
)
def test_real_files_run_whole(name: str, moves: int) -> None:
    data = real_file(name)
    job = Job(Program.from_lines([data], name), Planner(LIMITS), HOME)
    events, pieces = run(job)
    assert isinstance(events[-1], End)
    assert events[-1].lines == data.count(b"\n")
    assert job.planner.moves_overflowed == 0
    t = joined(pieces)
    assert len(t) == job.planner.moves > moves * 0.9
    check_limits(t, LIMITS)
    assert [type(event) for event in events[:3]] == [Notice, Notice, PositionSet]
    # The one jump of the position is the homing, before the first move.
    check_invariants(t, end=job.planner.toolhead_position)


def test_memory_stays_flat_on_long_input() -> None:
    consumed = 0
    block = b"".join(b"G1 X%d.%03d Y5\n" % (i % 200, i % 1000) for i in range(3000))
    job = Job(Program.from_lines(block for _ in range(100)), Planner(LIMITS), HOME)
    job.planner.homed = "XYZ"
    window = 0
    while not isinstance(job.step(), End):
        window = max(window, len(job.program.data))
        while (batch := job.planner.take()).count:
            consumed += batch.count
            job.planner.release(batch.count)
    assert consumed > 290_000
    assert window <= 2 * len(block)


# ---- Reading ----


def test_a_file_is_read_in_pieces(tmp_path: Path) -> None:
    path = tmp_path / "part.gcode"
    path.write_bytes(b"\xef\xbb\xbfG28\r\n" + b"; filler\r\n" * 20_000 + b"G1 X10 F600")
    with Program.open(path) as program:
        job = Job(program, Planner(LIMITS), HOME)
        seen = []
        while not isinstance(event := job.step(), End):
            assert len(program.data) <= 2 * CHUNK_BYTES
            if isinstance(event, Progress):
                seen.append(event.done_bytes)
        assert program.size_bytes == path.stat().st_size == program.done_bytes
    assert len(seen) > 3
    assert seen == sorted(seen)
    assert event.lines == 20_002
    assert job.planner.toolhead_position[0] == 10


@pytest.mark.parametrize("size", [1, 2, 7, 64])
def test_pieces_of_any_size_give_the_same(size: int, tmp_path: Path) -> None:
    text = b"G28\nM83\nG1 X10 F600\nG92 E0\nG1 X20 E.5\nM204 S500\nG1 X0.5\nM400\nG1 X7"

    class Drip:
        def __init__(self) -> None:
            self.at = 0

        def read(self, _size: int, /) -> bytes:
            self.at += size
            return text[self.at - size : self.at]

        def close(self) -> None:
            pass

    _, whole = run_lines(text)
    _, pieces = run(Job(Program(Drip(), "drip"), Planner(LIMITS), HOME))
    assert joined(pieces).tobytes() == whole.tobytes()


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(CanductorError, match=r"cannot read the G-code file .*none\.gcode: no such file"):
        Program.open(tmp_path / "none.gcode")
    with pytest.raises(CanductorError, match="is a directory"):
        Program.open(tmp_path)


def test_an_endless_line_is_refused() -> None:
    class Endless:
        def read(self, size: int, /) -> bytes:
            return b"x" * size

        def close(self) -> None:
            pass

    job = Job(Program(Endless(), "endless"), Planner(LIMITS), HOME)
    with pytest.raises(GCodeError, match="endless:1: this line is longer than 1048576 bytes"):
        run(job)


# ---- Order ----


def test_a_full_ring_is_told_until_it_is_emptied() -> None:
    job = job_of("G28", *(f"G1 X{i % 2 * 10} F6000" for i in range(3000)), "M400", "G1 X5")
    while not isinstance(job.step(), Full):
        pass
    assert isinstance(job.step(), Full)
    events, pieces = run(job)
    assert [type(event) for event in events] == [Wait, End]
    assert len(joined(pieces)) == 3000  # the first goes from 0 to 0


def test_m400_waits_for_all_moves_before_it() -> None:
    events, t = run_lines("G28", "G1 X10 F600", "M400", "G1 X20")
    wait = next(event for event in events if isinstance(event, Wait))
    assert wait == Wait(3, float(t["print_time"][1]))
    assert t["start_v"][1] == 0


@pytest.mark.parametrize(("words", "seconds"), [("P1500", 1.5), ("S2", 2.0), ("", 0.0), ("P500 S1", 1.5)])
def test_dwell(words: str, seconds: float) -> None:
    _, t = run_lines("G28", "G1 X10 F600", f"G4 {words}", "G1 X20")
    gap = t["print_time"][1] - sum(t[name][0] for name in ("accel_s", "cruise_s", "decel_s"))
    assert gap == pytest.approx(seconds)


def test_homing_takes_the_axes_as_home() -> None:
    home = {"X": 250.0, "Y": 0.0, "Z": 0.2}
    job = Job(Program.from_lines(["G28 X Z", "G28 Y0", "G1 X240 Y10 F6000", "G28"]), Planner(LIMITS), home)
    events, pieces = run(job)
    sets = [event for event in events if isinstance(event, PositionSet)]
    assert [(event.axes, event.position) for event in sets] == [
        ("XZ", (250.0, 0.0, 0.2, 0.0)),
        ("Y", (250.0, 0.0, 0.2, 0.0)),
        ("XYZ", (250.0, 0.0, 0.2, 0.0)),
    ]
    assert len([text for text in texts(events) if "already home" in text]) == 1
    t = joined(pieces)
    assert sets[-1].print_time_s == pytest.approx(
        sum(t[n][-1] for n in ("print_time", "accel_s", "cruise_s", "decel_s"))
    )


def test_the_state_of_the_language() -> None:
    events, _ = run_lines(
        "G28", "G20", "G1 X1 Y1 F100", "M114", "G21", "M114", "G92 X0", "G91", "G1 X1", "G1 X1 E1", "M114",
        "G90", "M83", "M221 S50", "G1 E2", "G1 E2 X5", "M114", "G92", "M114",
    )  # fmt: skip
    assert texts(events)[1:] == [
        "X:1.000 Y:1.000 Z:0.000 E:0.000",
        "X:25.400 Y:25.400 Z:0.000 E:0.000",
        "X:2.000 Y:25.400 Z:0.000 E:1.000",
        "X:5.000 Y:25.400 Z:0.000 E:5.000",
        "X:0.000 Y:0.000 Z:0.000 E:0.000",
    ]


def test_accelerations() -> None:
    _, t = run_lines(
        "G28", "M83", "G1 X10 F6000", "M204 P3000", "G1 X20", "G1 X30 E1", "M204 T2000", "G1 X40",
        "G1 X50 E1", "M204 P1000", "G1 X60", "G1 X70 E1", "M204 S5000", "G1 X80", "G1 X90 E1",
        "M204 P6000 T4000", "G1 X100", "M204 T60000", "G1 X110",
        "SET_VELOCITY_LIMIT ACCEL=700 VELOCITY=50", "G1 X120 E1", "G1 X130",
        "RESET_VELOCITY_LIMIT", "G1 X140",
    )  # fmt: skip
    print_and_travel = [10000, 3000, 2000, 3000, 2000, 1000, 5000, 5000, 4000]
    assert t["accel"].tolist() == [10000, *print_and_travel, 10000, 700, 700, 10000]
    assert t["cruise_v"][-2:].tolist() == [50, 100]


def test_what_is_above_the_limits_is_cut_and_said() -> None:
    events, t = run_lines("G28", "M204 S20000", "G1 X10", "M204 S20000")
    assert t["accel"].tolist() == [10000]
    assert texts(events)[1:] == [
        "part.gcode:2: the acceleration 20000 is above the configured 10000: 10000 is used"
    ]


def test_the_speed_factor() -> None:
    _, t = run_lines("G28", "M220 S200", "G1 X100 F6000", "M220 S50", "G1 X200")
    assert t["cruise_v"].tolist() == [200, 50]


def test_emergency_stops_the_job_where_it_stands() -> None:
    job = job_of("G28", "G1 X10 F600", "M112", "G1 X20")
    events, _ = run(job)
    assert events[-1] == Emergency(3)
    assert job.step() == Emergency(3)
    assert job.planner.toolhead_position[0] == 10


# ---- Lines of other kinds ----


def test_commands_without_a_module_are_reported_once() -> None:
    job = job_of(
        "M104 S200", "M106 S255 ; fan", "M106 S0", "M190 S60", "M84", "M117 hello (wor", "M73 P1", "T0"
    )
    events, _ = run(job)
    accepted = "accepted, but without effect: no section of the configuration is for them"
    assert texts(events) == [
        f"part.gcode:1: heater and fan commands: {accepted}",
        f"part.gcode:5: motor-off commands: {accepted}",
    ]


def test_unknown_commands_are_said_once_and_skipped() -> None:
    events, t = run_lines("G28", "M900 K0.1", "START_PRINT BED=60", "M900", "G1 X5 S3", "G1 X6 S4")
    assert texts(events)[1:] == [
        "part.gcode:2: unknown command M900: unknown commands are skipped",
        "part.gcode:3: unknown command START_PRINT: unknown commands are skipped",
        "part.gcode:5: word S of G1: it has no meaning here and is ignored",
    ]
    assert len(t) == 2


def test_notices_end_somewhere() -> None:
    events, _ = run_lines(*(f"M{1000 + i}" for i in range(500)))
    assert len(events) == MAX_NOTICES + 2
    assert "no more are shown" in texts(events)[-1]


def test_framed_lines() -> None:
    job = job_of("N1 G28*18", "N2 G1 X10 F600", "N3 M204 S500 *64", "(a comment) M204 S600", "(only)", "%")
    run(job)
    assert job.planner.accel == 600
    assert job.planner.toolhead_position[0] == 10


def test_numbers_of_many_digits_go_the_slow_way() -> None:
    job = job_of("G28", "G1 X10.00000000000000000000000000001 F600", "G1 Y" + "0" * 30 + "7.5")
    run(job)
    assert job.planner.toolhead_position[:2] == (10.0, 7.5)


# ---- Errors ----


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("G1 X251", "the move goes to X 251 mm, outside 0 to 250 mm"),
        ("G1 X251.00000000000000000000001", "the move goes to X 251 mm, outside"),
        ("G1 X", "X of G1 has no number"),
        ("G1 Xnan", "G1 has 'Xnan' where a letter and a number belong"),
        ("G1 X1 X2", "G1 has X twice"),
        ("G1 X1.2.3", "G1 has '.3' where a letter and a number belong"),
        ("G1 X1 (open", "the comment '(open' does not end"),
        ("G1 X" + "9" * 400, "out of range"),
        ("G1 X1d3", "X of G1 is '1d3', which is not a number"),
        ("G2 X1d3 I1", "X of G2 is '1d3', which is not a number"),
        ("G1 X1*5", "the checksum is '5', but the line adds up to"),
        ("X10 Y10", "has no command; write G0 or G1"),
        ("\x00\x01\x02", "cannot read"),
        ("!!", "cannot read '!!'"),
        ("G1 " + "(" * 5000, "longer than 4096 bytes"),
        ("G5 X10 I5", "G5 curves are not supported"),
        ("G4 P-1", "G4 is to wait -0.001 s"),
        ("G28 Q", None),
        ("G92 X", "X of G92 has no number"),
        ("M204", "M204 names no acceleration"),
        ("M204 S0", "S of M204 is 0; it must be above 0"),
        ("M220 S0", "S of M220 is 0 %; 1 to 1000 %"),
        ("T1", "T1 selects a tool that does not exist"),
        ("SET_VELOCITY_LIMIT ACCEL=x", "ACCEL of SET_VELOCITY_LIMIT is 'x', which is not a number"),
        ("SET_VELOCITY_LIMIT ACCEL=nan", "out of range"),
        ("SET_VELOCITY_LIMIT 5", "where NAME=VALUE belongs"),
    ],
)
def test_errors_name_file_line_and_what(line: str, problem: str | None) -> None:
    if problem is None:
        run_lines("G28", "", line, "G1 X5")
        return
    text = error_of("G28", "", line, "G1 X5")
    assert text.startswith("part.gcode:3: ")
    assert problem in text
    assert "\n" not in text


def test_an_error_stays_and_keeps_the_moves_before_it() -> None:
    job = job_of("G28", "G1 X5 F600", "G1 X999")
    for _ in range(2):
        with pytest.raises(GCodeError, match=r"part\.gcode:3"):
            run(job)
    assert job.planner.flush()
    assert job.planner.take().count == 1


def test_moves_before_homing_are_refused() -> None:
    assert error_of("G1 E1 F60", "G28 X", "G1 X1 F600", "G1 Y1") == (
        "part.gcode:4: Y is to move before it is homed; home with G28 first"
    )


@pytest.mark.parametrize(
    ("tail", "ok"), [(b"G1 X12.", True), (b"G1 X", False), (b"G1 X12 Y-", False), (b"M204 S", False)]
)
def test_a_file_cut_within_a_word(tail: bytes, ok: bool, tmp_path: Path) -> None:
    path = tmp_path / "cut.gcode"
    path.write_bytes(b"G28\nG91\n" + tail)
    with Program.open(path) as program:
        job = Job(program, Planner(LIMITS), HOME)
        if ok:
            run(job)
            assert job.planner.toolhead_position[0] == 12
            return
        with pytest.raises(GCodeError, match=r"cut\.gcode:3: .*the file ends within this line"):
            run(job)


@settings(max_examples=examples(300))
@given(
    st.lists(
        st.one_of(
            st.binary(max_size=40),
            st.text(max_size=20).map(lambda text: text.encode("utf-8", "replace")),
            st.text('GMTN0123456789.-+XYZEFSP *;()="_\r%', max_size=25).map(str.encode),
            st.sampled_from([b"G28", b"G91", b"G20", b"M83", b"G92 E5", b"M400", b"G1 X10 F6000", b"G4 P10"]),
        ),
        max_size=30,
    )
)
def test_garbage_gives_one_sentence_or_valid_moves(lines: list[bytes]) -> None:
    job = job_of(*lines)
    pieces: list[Array] = []
    problem = "part.gcode:"
    try:
        while not isinstance(job.step(), End | Emergency):
            pieces += drain(job.planner)
    except GCodeError as error:
        problem = str(error)
    assert problem.startswith("part.gcode:")
    assert "\n" not in problem
    assert job.planner.flush()
    t = joined(pieces + drain(job.planner))
    check_limits(t, LIMITS)
    assert np.isfinite(t["print_time"]).all()
