"""The progress display, drawn into text, its time given by the test."""

import io
from itertools import pairwise

import pytest

from coordinator.support.progress import NodeFigures, Progress, ProgressDisplay, summary


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


STATE = Progress(
    done=2_500,
    total=10_000,
    print_time_s=30.0,
    wall_time_s=20.0,
    bus_load=0.31,
    nodes=(
        NodeFigures(name="mcu", round_trip_ms=0.45, queue_depth=12, lead_ms=340.0, clock_error_us=2.5),
        NodeFigures(name="[red]zboard", retransmitted_bytes=77, lead_ms=210.0),
    ),
)


def state(done: int) -> Progress:
    return Progress(done=done, total=100, unit="lines")


def test_one_line_says_it_all() -> None:
    assert summary(STATE) == (
        "2,500/10,000 bytes (25%), print time 30.0 s, speed 1.50x, bus 31%, lead 210 ms, repeated 77 bytes"
    )
    assert summary(Progress(done=3, total=0)) == "3 bytes, print time 0.0 s, speed 0.00x"


@pytest.mark.parametrize(("done", "total", "share"), [(5, 10, 0.5), (11, 10, 1.0), (5, 0, 0.0)])
def test_the_share_stays_within_bounds(done: int, total: int, share: float) -> None:
    assert Progress(done=done, total=total).share == share


@pytest.mark.parametrize(("stdout", "quiet"), [(io.StringIO(), False), (Terminal(), True)])
def test_away_from_a_terminal_only_a_line_now_and_then(stdout: io.StringIO, quiet: bool) -> None:
    clock, stderr = Clock(), io.StringIO()
    with ProgressDisplay("demo", quiet=quiet, stdout=stdout, stderr=stderr, clock_s=clock) as display:
        for tick in range(121):  # 12 s at 10 Hz
            clock.now_s = 1000 + tick / 10
            display.update(state(tick))
    assert [line.split(" lines")[0] for line in stderr.getvalue().splitlines()] == [
        "demo: 50/100",
        "demo: 100/100",
    ]
    assert stdout.getvalue() == ""


def test_a_terminal_is_redrawn_at_most_five_times_a_second() -> None:
    clock, stdout, stderr = Clock(), Terminal(), io.StringIO()
    with ProgressDisplay("demo", stdout=stdout, stderr=stderr, clock_s=clock) as display:
        drawn = []
        for tick in range(100):  # 1 s at 100 Hz
            clock.now_s = 1000 + tick / 100
            before = len(stdout.getvalue())
            display.update(state(tick))
            if len(stdout.getvalue()) > before:
                drawn.append(tick)
        assert len(drawn) == 5
        assert all(later - earlier >= 20 for earlier, later in pairwise(drawn))
    assert "99/100 lines" in stdout.getvalue(), "the last state is left standing"
    assert stderr.getvalue() == ""


def test_a_terminal_shows_every_node() -> None:
    stdout = Terminal()
    with ProgressDisplay("demo", stdout=stdout) as display:
        display.update(STATE)
    text = stdout.getvalue()
    for word in ("25%", "mcu", "[red]zboard", "0.45", "340", "77", "2.5"):
        assert word in text


def test_the_display_ends_when_the_job_fails() -> None:
    stdout = Terminal()
    display = ProgressDisplay("demo", stdout=stdout)

    def fail() -> None:
        with display:
            display.update(state(1))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert stdout.getvalue().endswith("\x1b[?25h"), "the cursor is shown again"
