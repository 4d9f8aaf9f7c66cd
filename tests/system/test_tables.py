"""``canductor table`` with a machine of virtual nodes, all processes of their own."""

import signal
from pathlib import Path

import pytest

from tests.stages.processes import Command, Hardware, canductor

TABLE = "0 0 0\n50 50.01 49.99\n100 100.02 99.98\n"


def test_a_table_from_file_to_node_and_back(
    machine: Hardware, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    comp = tmp_path / "x.comp"
    comp.write_text(TABLE)
    config = machine.config
    config.write_text(config.read_text() + "\n[axis_tables]\npoints: 64\n")
    path = machine.folder / "run.sock"

    with Command("run", config, "--ipc", path) as command:
        command.stdout.wait_for("ready")
        sent = canductor("table", "send", comp, "--axis", "X", "--at", path, "--json")
        assert sent.status == 0, sent
        (axis,) = sent.json["result"]["axes"]
        sides = [(s["direction"], s["status"], s["generation"], s["active"]) for s in axis["nodes"]]
        assert sides == [("forward", "ok", 1, True), ("reverse", "ok", 1, True)]
        unknown = canductor("table", "send", comp, "--axis", "w", "--at", path).sentence()
        assert unknown.startswith("axis w cannot have a table")
        for number, cost in enumerate(sent.json["result"]["downloads"], 1):
            assert (cost["axles"], cost["words"]) == ([number], 17)
            assert cost["elapsed_s"] > cost["bound_s"] > 0
        every = canductor("table", "status", "--at", path)
        assert every.stdout.splitlines()[:6] == [
            "axis x: 3 points",
            "  stepper_x forward on node mcu (axle 1): ok, generation 1, 3 points, in use",
            "  stepper_x reverse on node mcu (axle 2): ok, generation 1, 3 points, in use",
            "axis y: no table",
            "  stepper_y forward on node mcu (axle 3): no table",
            "  stepper_y reverse on node mcu (axle 4): no table",
        ]
        told = canductor("table", "status", "--axis", "X", "--at", path)
        assert (told.status, told.stdout.splitlines()[0]) == (0, "axis x: 3 points")
        assert [kept.name for kept in (tmp_path / "state").rglob("*.json")] == ["x.table.json"]
        removed = canductor("table", "remove", "--axis", "X", "--at", path)
        assert (removed.status, removed.stdout.splitlines()[0]) == (0, "axis x: no table")
        assert "to axles 1, 2: 10 words in 0." in removed.stdout
        assert "of which one takes at least 0." in removed.stdout
        command.signal(signal.SIGTERM)
        assert command.end().status == 0
    assert list((tmp_path / "state").rglob("*.json")) == []
