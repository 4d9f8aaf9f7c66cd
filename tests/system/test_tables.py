"""``canductor table`` with a machine of virtual nodes, all processes of their own."""

import signal
from pathlib import Path

import pytest

from tests.system.stage import Command, Hardware, canductor

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
        sent = canductor("table", "send", comp, "--axis", "x", "--at", path, "--json")
        assert sent.status == 0, sent
        (axis,) = sent.json["result"]["axes"]
        sides = [(s["direction"], s["status"], s["generation"], s["active"]) for s in axis["nodes"]]
        assert sides == [("forward", "ok", 1, True), ("reverse", "ok", 1, True)]
        unknown = canductor("table", "send", comp, "--axis", "w", "--at", path).sentence()
        assert unknown.startswith("axis w cannot have a table")
        told = canductor("table", "status", "--axis", "x", "--at", path)
        assert (told.status, told.stdout.splitlines()[0]) == (0, "axis x: 3 points")
        assert [kept.name for kept in (tmp_path / "state").rglob("*.json")] == ["x.table.json"]
        removed = canductor("table", "remove", "--axis", "x", "--at", path)
        assert (removed.status, removed.stdout.splitlines()[0]) == (0, "axis x: no table")
        command.signal(signal.SIGTERM)
        assert command.end().status == 0
    assert list((tmp_path / "state").rglob("*.json")) == []
