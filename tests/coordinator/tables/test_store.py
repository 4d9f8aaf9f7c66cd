"""Tables outlive the coordinator: whole or not at all."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from coordinator.tables.axis_table import AxisTable, TableError, Unit
from coordinator.tables.store import TableStore, table_folder

TABLE = AxisTable(axis="x", positions=(0.0, 0.1), forward=(1e-3 / 3, 0.0), reverse=(0.0, 0.0), unit=Unit.DEG)


def test_what_was_saved_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    store = TableStore(tmp_path / "a" / "b")
    assert store.load() == ({}, [])
    store.save(TABLE)
    store.save(replace(TABLE, axis="y"))
    store.save(TABLE)
    assert TableStore(store.folder).load() == ({"x": TABLE, "y": replace(TABLE, axis="y")}, [])
    store.remove("x")
    store.remove("x")
    assert list(store.load()[0]) == ["y"]
    assert [path.name for path in store.folder.iterdir()] == ["y.table.json"]


@pytest.mark.parametrize("name", ["", "..", "../x", "a/b", ".x", "x" * 65, "a\nb"])
def test_nothing_is_kept_outside_the_folder(tmp_path: Path, name: str) -> None:
    with pytest.raises(TableError, match="is no name of an axis"):
        TableStore(tmp_path).save(replace(TABLE, axis=name))
    with pytest.raises(TableError, match="is no name of an axis"):
        TableStore(tmp_path).remove(name)


@pytest.mark.parametrize(
    "content", ["", "[]", "{", '{"version": 2}', '{"version": 1, "axis": "x"}', "[" * 100_000, "\x00"]
)
def test_a_damaged_file_is_told_and_left_out(tmp_path: Path, content: str) -> None:
    store = TableStore(tmp_path)
    store.save(replace(TABLE, axis="y"))
    (tmp_path / "x.table.json").write_text(content)
    tables, (problem,) = store.load()
    assert list(tables) == ["y"]
    assert "x.table.json" in problem
    assert "send the table again" in problem


def test_a_table_that_cannot_be_is_told(tmp_path: Path) -> None:
    store = TableStore(tmp_path)
    store.save(TABLE)
    path = tmp_path / "x.table.json"
    raw = json.loads(path.read_text())
    path.write_text(json.dumps({**raw, "positions": [1, 0]}))
    assert "must ascend" in store.load()[1][0]
    path.write_text(json.dumps({**raw, "axis": "y"}))
    assert "is no kept table" in store.load()[1][0]


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(TableError, match="cannot be kept in"):
        TableStore(tmp_path / "file").save(TABLE)


def test_each_machine_has_its_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", "/state")
    assert table_folder("a/b") == Path("/state/canductor/a_b/tables")
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    assert table_folder("m") == Path.home() / ".local/state/canductor/m/tables"
