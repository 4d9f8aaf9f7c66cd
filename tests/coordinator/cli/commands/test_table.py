"""``canductor table check`` and ``plot``: no machine needed; and the words of all actions."""

import json
from pathlib import Path

import pytest

from coordinator.cli import main as cli
from coordinator.cli.commands.table import _side
from tests.stages.own_sockets import own_sockets

TABLE = "0 0 0\n100 100.01 99.99\n"
MACHINE = Path("config/demo/machine.cfg")


def ended(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, str, str]:
    status = cli.main(["table", *map(str, words)])
    out, err = capsys.readouterr()
    return status, out, err


@pytest.fixture
def comp(tmp_path: Path) -> Path:
    path = tmp_path / "x.comp"
    path.write_text(TABLE)
    return path


def test_check_tells_what_a_table_holds(comp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = ended(capsys, "check", comp)
    assert (status, out.splitlines()[0]) == (0, "axis x: 2 points from 0 to 100 mm")
    assert "backlash up to 0.02 mm" in out
    assert "error between points up to 0 mm" in out
    comp.write_text("0 0 0\n100000 5 -1\n")
    status, out, _ = ended(capsys, "check", comp, "--axis", "y", "--type", "1", "--unit", "um", "--json")
    assert (status, json.loads(out)["greatest_correction"]) == (0, pytest.approx(0.005))


def test_check_compares_with_a_machine(comp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = ended(capsys, "check", comp, "--machine", MACHINE)
    assert status == 0
    assert "note: axis x travels from 0 to 250 mm" in out
    assert "add [axis_tables] to its configuration" in out
    status, _, err = ended(capsys, "check", comp, "--axis", "w", "--machine", MACHINE)
    assert (status, "has no axis w; its axes are x, y, z" in err) == (1, True)


def test_an_axis_may_be_given_in_capitals(comp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = ended(capsys, "check", comp, "--axis", "Y", "--machine", MACHINE)
    assert (status, out.splitlines()[0]) == (0, "axis y: 2 points from 0 to 100 mm")


@pytest.mark.parametrize(
    ("config", "axis"), [("delta", "a"), ("delta", "x"), ("winch", "d"), ("polar", "z"), ("idex", "x")]
)
@pytest.mark.parametrize("section", ["", "\n[axis_tables]\n"])
def test_check_refuses_axes_that_are_not_corrected(
    comp: Path, config: str, axis: str, section: str, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = comp.with_suffix(".cfg")
    machine.write_text(Path(f"config/{config}.cfg").read_text() + section)
    status, out, err = ended(capsys, "check", comp, "--axis", axis, "--machine", machine)
    assert (status, out) == (1, "")
    assert err == (
        f"canductor: axis {axis} is not corrected: that is for x, y and z of machines whose steppers move in "
        "proportion to them, without towers, arms, winches or dual carriages\n"
    )


def test_check_refuses_degrees_of_an_axis_in_mm(comp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, _, err = ended(capsys, "check", comp, "--unit", "deg", "--machine", MACHINE)
    assert status == 1
    assert err == "canductor: axis x is not corrected: its table is in degrees, the axis moves in mm\n"


def test_check_of_what_is_no_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad").write_text("0 0 0\n1 0\n")
    status, _, err = ended(capsys, "check", tmp_path / "bad", "--json")
    assert status == 1
    assert err == f"canductor: {tmp_path}/bad:2: 2 values, must be three: nominal, forward, reverse\n"


def test_plot_draws(comp: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "x.svg"
    status, out, _ = ended(capsys, "plot", comp, "-o", picture)
    assert (status, f"drawn in {picture}" in out) == (0, True)
    assert picture.read_text().startswith("<svg")
    status, _, err = ended(capsys, "plot", comp, "-o", tmp_path / "no" / "x.svg")
    assert (status, "cannot be written: No such file" in err) == (1, True)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ((), "the following arguments are required: ACTION"),
        (("check",), "the following arguments are required: file"),
        (("check", "none"), "none"),
        (("plot", MACHINE, "-o", "x.png"), "must be a file that ends in .svg"),
        (("check", MACHINE, "--unit", "ell"), "invalid choice: 'ell'"),
        (("send", MACHINE), "'send' needs --axis of a running machine, or --device"),
        (("remove",), "'remove' needs --axis of a running machine, or --device"),
    ],
)
def test_words_that_do_not_do(
    words: tuple[str | Path, ...], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, _, err = ended(capsys, *words)
    assert status in (1, 2)
    assert sentence in err


def test_without_a_machine_send_says_so(
    comp: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    own_sockets(monkeypatch, tmp_path)
    status, _, err = ended(capsys, "send", comp, "--axis", "x", "--at", str(tmp_path / "none.sock"))
    assert status == 1
    assert "none.sock" in err


@pytest.mark.parametrize(
    ("state", "told"),
    [
        ({"status": "not known"}, "not known"),
        ({"status": "ok", "generation": 0, "points": 0, "active": True}, "no table"),
        (
            {"status": "ok", "generation": 2, "points": 0, "active": False},
            "no table; the one before is still in use",
        ),
        (
            {"status": "ok", "generation": 0, "points": 0, "active": True, "problem": "it did not arrive"},
            "no table; it did not arrive",
        ),
        (
            {"status": "ok", "generation": 2, "points": 3, "active": False},
            "ok, generation 2, 3 points, not in use yet",
        ),
        (
            {"status": "length_error", "generation": 1, "points": 0, "active": False},
            "length_error, generation 1, 0 points, not in use yet",
        ),
    ],
)
def test_what_is_told_of_a_node(state: dict[str, object], told: str) -> None:
    side = {"stepper": "stepper_x", "direction": "forward", "node": "mcu", "axle": 1, **state}
    assert _side(side) == f"stepper_x forward on node mcu (axle 1): {told}"
