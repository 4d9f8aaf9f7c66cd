"""Files that have to come twice: whatever the block check lets pass is no file."""

from pathlib import Path

import pytest

from coordinator.dnc.files import FileRefused, Folder
from coordinator.dnc.protocol.blocks import Header
from coordinator.dnc.verify import Compare, TwoPassFolder
from tests.coordinator.dnc.ordeal import judge_twice, make_case
from tests.coordinator.dnc.virtual_cable import PROGRAM, VirtualCable

HEADER = Header("D", "PART", "A")
LINES = [b"G28", b"", b"G1 X1"]


def come(twice: TwoPassFolder, lines: list[bytes], header: Header = HEADER) -> None:
    sink = twice.take(header)
    try:
        for line in lines:
            sink.write(line)
        sink.keep()
    except FileRefused:
        sink.drop()
        raise


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_same_twice_is_kept(tmp_path: Path) -> None:
    twice = TwoPassFolder(Folder(tmp_path, newline=b"\r\n"), 100)
    come(twice, LINES)
    assert twice.waits_for == "PART.nc"
    assert [name[:5] for name in names(tmp_path)] == [".dnc-"]
    come(twice, LINES)
    assert twice.waits_for is None
    assert names(tmp_path) == ["PART.nc"]
    assert (tmp_path / "PART.nc").read_bytes() == b"G28\r\n\r\nG1 X1\r\n"


@pytest.mark.parametrize(
    ("second", "line"),
    [
        ([b"G28", b"", b"G1 X2"], 3),
        ([b"G28", b""], 3),  # truncated
        ([b"G28", b"G1 X1"], 2),  # a line is missing
        ([b"G28", b"G28", b"", b"G1 X1"], 2),  # one is doubled
        ([*LINES, b""], 4),
    ],
)
def test_what_differs_is_not_kept(tmp_path: Path, second: list[bytes], line: int) -> None:
    twice = TwoPassFolder(Folder(tmp_path), 100)
    come(twice, LINES)
    with pytest.raises(
        FileRefused, match=f"line {line} of PART.nc differs between the two transfers: one was damaged"
    ):
        come(twice, second)
    assert names(tmp_path) == []
    come(twice, LINES)
    come(twice, LINES)
    assert names(tmp_path) == ["PART.nc"]


def test_another_file_makes_the_one_before_forgotten(tmp_path: Path) -> None:
    twice = TwoPassFolder(Folder(tmp_path), 100)
    come(twice, LINES)
    come(twice, LINES, Header("D", "OTHER", "A"))
    assert twice.waits_for == "OTHER.nc"
    come(twice, LINES)
    assert twice.waits_for == "PART.nc"
    assert len(names(tmp_path)) == 1
    twice.close()
    assert names(tmp_path) == []


def test_a_second_time_that_breaks_off_leaves_nothing(tmp_path: Path) -> None:
    twice = TwoPassFolder(Folder(tmp_path), 100)
    come(twice, LINES)
    sink = twice.take(HEADER)
    assert isinstance(sink, Compare)
    sink.write(LINES[0])
    sink.drop("the line broke")
    assert names(tmp_path) == []


def unseen(who: int, data: bytes) -> bytes:
    """Flip one bit in two characters of a block: the check character is right all the same."""
    return data.replace(b"X77.5", b"X66.5")


def test_asked_for_twice(tmp_path: Path) -> None:
    """The first time comes damaged, so that nobody sees it; then both are alike."""
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    ours.mkdir()
    theirs.mkdir()
    (ours / "part.nc").write_bytes(PROGRAM)
    times = [0]

    def change(who: int, data: bytes) -> bytes:
        times[0] += b"X77.5" in data
        return unseen(who, data) if times[0] == 1 else data

    cable = VirtualCable(change)
    with cable.started("serve", str(ours), "-p", "0"):
        words = ("receive", "PART", "-p", "1", "--verify", "--folder", str(theirs))
        bad = cable.run(*words)
        assert bad.status == 1
        assert "line 12 of PART.nc differs between the two transfers: one was damaged" in bad.sentences[-1]
        assert names(theirs) == []
        assert cable.run(*words).text == f"PART.nc: 60 lines are in {theirs}, identical twice"
    assert (theirs / "PART.nc").read_bytes() == PROGRAM
    assert names(ours) == ["part.nc"]


def test_what_a_control_sends_twice(tmp_path: Path) -> None:
    """At once, and something else in between."""
    (tmp_path / "part.nc").write_bytes(PROGRAM)
    (tmp_path / "other.nc").write_bytes(b"M30\n")
    there = tmp_path / "there"
    there.mkdir()
    cable = VirtualCable()
    with cable.started("receive", "-p", "0", "--verify", "--folder", str(there)) as taking:
        for name in ("part.nc", "other.nc", "part.nc", "part.nc"):
            assert list(there.glob("*.nc")) == []
            assert cable.run("send", str(tmp_path / name), "-p", "1").status == 0
        took = taking.end()
    assert (took.status, took.text) == (0, f"part.nc: 60 lines are in {there}, identical twice")
    once = "was received once, {} lines; send it again, to compare"
    assert took.sentences[1:] == [
        f"part.nc {once.format(60)}",
        f"other.nc {once.format(1)}",
        f"part.nc {once.format(60)}",
    ]
    assert (there / "part.nc").read_bytes() == PROGRAM


def test_sent_and_fetched_back(tmp_path: Path) -> None:
    (tmp_path / "part.nc").write_bytes(PROGRAM)
    times = [0]

    def change(who: int, data: bytes) -> bytes:
        times[0] += who == 1 and b"X77.5" in data
        return unseen(who, data) if times[0] == 2 and who == 1 else data

    there = tmp_path / "there"
    there.mkdir()
    cable = VirtualCable(change)
    with cable.started("serve", str(there), "-p", "0"):
        words = ("send", str(tmp_path / "part.nc"), "-p", "1", "--verify")
        good = cable.run(*words, "--name", "GOOD")
        bad = cable.run(*words, "--name", "BAD")
    assert good.figures["confirmed"] is True
    assert bad.sentences[-1] == (
        "BAD was sent, but not confirmed: line 12 of BAD differs between the two transfers:"
        " delete it at the other side"
    )


WRONG = (424, 671, 3638, 4130, 4581, 4786, 4892, 5136, 5215, 5586, 5712, 6962, 7855, 9900)
"""Of the first 10,000 cases with any damage, those of which a single transfer brings a wrong file."""


@pytest.mark.parametrize("number", WRONG[::4])
def test_damage_that_nobody_can_see_is_seen_in_two(number: int) -> None:
    was_wrong, _ = judge_twice(make_case(number, visible=False), range(1, 3))
    assert was_wrong
