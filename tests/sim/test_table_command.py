"""What ``canductor table`` prints of the tables of a machine, in virtual time."""

from pathlib import Path
from typing import Any

import pytest

from coordinator.cli.commands.table import _answer
from coordinator.ipc.protocol.methods import ApiError
from coordinator.tables.files import read_table
from tests.stages.demo_machine import DemoMachine
from tests.stages.served import Served

TABLE = "0 0 0\n50 50.01 49.99\n100 100.02 99.98\n"


def test_a_table_from_file_to_node_and_back(tmp_path: Path) -> None:
    comp = tmp_path / "x.comp"
    comp.write_text(TABLE)
    table = read_table(comp, axis="x")
    params: dict[str, Any] = {
        "axis": table.axis,
        "unit": str(table.unit),
        "positions": list(table.positions),
        "forward": list(table.forward),
        "reverse": list(table.reverse),
    }
    tables = tmp_path / "tables"

    async def go(stage: Served) -> None:
        sent = await stage.call("table.send", **params)
        (axis,) = sent["axes"]
        sides = [(s["direction"], s["status"], s["generation"], s["active"]) for s in axis["nodes"]]
        assert sides == [("forward", "ok", 1, True), ("reverse", "ok", 1, True)]
        with pytest.raises(ApiError, match="axis w cannot have a table"):
            await stage.call("table.send", **params | {"axis": "w"})
        for number, cost in enumerate(sent["downloads"], 1):
            assert (cost["axles"], cost["words"]) == ([number], 17)
            assert cost["elapsed_s"] > cost["bound_s"] > 0
        assert _answer(await stage.call("table.status"), []).to_text().splitlines()[:6] == [
            "axis x: 3 points",
            "  stepper_x forward on node mcu (axle 1): ok, generation 1, 3 points, in use",
            "  stepper_x reverse on node mcu (axle 2): ok, generation 1, 3 points, in use",
            "axis y: no table",
            "  stepper_y forward on node mcu (axle 3): no table",
            "  stepper_y reverse on node mcu (axle 4): no table",
        ]
        assert [kept.name for kept in tables.rglob("*.json")] == ["x.table.json"]
        removed = await stage.call("table.remove", axis="x")
        told = _answer(removed, [], removed["downloads"])
        assert told.ok
        assert told.to_text().splitlines()[0] == "axis x: no table"
        assert "to axles 1, 2: 10 words in 0." in told.to_text()
        assert "of which one takes at least 0." in told.to_text()
        assert list(tables.rglob("*.json")) == []

    DemoMachine(tmp_path, sections="\n[axis_tables]\npoints: 64\n").serve(go, tables=tables)
