"""``canductor can query``: on the stage, on an empty bus, on one where all have their ids."""

from tests.canbus_tools.command import Command
from tests.stages.can_stage import BED, BOOT, MAIN, MAIN_ID, TWIN, CanStage, SixNodes


def test_who_waits_on_the_stage(six: SixNodes, can_tool: Command) -> None:
    del six
    said = can_tool("query", "--json")
    assert said.status == 0
    nodes = {node["uuid"]: node for node in said.json["nodes"]}
    assert {uuid: (n["application"], n["set_command"], n["several_boards"]) for uuid, n in nodes.items()} == {
        str(BED): ("klipper-type", 0x01, False),
        str(TWIN): ("klipper-type", 0x01, True),
        str(BOOT): ("katapult", 0x11, False),
    }
    assert said.json["rounds"] >= 5
    assert nodes[str(BED)]["answers"] == said.json["rounds"]
    assert said.json["duplicate_uuids"] == [str(TWIN)]
    assert said.json["assigned_nodeids"] == [MAIN_ID]


def test_as_a_table_with_what_to_know(six: SixNodes, can_tool: Command) -> None:
    said = can_tool("query")
    assert said.status == 0
    lines = said.out.splitlines()
    assert lines[0].startswith(f"3 uuids wait for an id on {six.stage.options.name} (asked 5 times in 0.")
    rows = {line.split()[0]: line for line in lines if line.startswith("  ")}
    assert "Katapult bootloader" in rows[str(BOOT)]
    assert "Klipper-type firmware" in rows[str(BED)]
    assert "two boards!" in rows[str(TWIN)]
    assert "two boards!" not in rows[str(BED)]
    assert str(MAIN) not in said.out
    assert f"Two boards have the uuid {TWIN}" in said.words
    assert "'canductor can nodes' lists those as well" in said.words
    assert max(map(len, lines)) <= 98


def test_nobody_on_the_bus_is_explained(can_tool: Command) -> None:
    said = can_tool("query")
    assert said.status == 0
    assert said.out.startswith("0 uuids wait for an id")
    for hint in ("Only nodes without an id answer", "bit rate", "120 ohm", "can nodes", "can doctor"):
        assert hint in said.words
    assert "canductor can nodes -i canductor -c can0" in said.out


def test_nobody_waits_because_all_have_ids(stage: CanStage, can_tool: Command) -> None:
    stage.add_node(MAIN, 9)
    said = can_tool("query")
    assert "The bus works: 1 node with an id was heard (9)" in said.words
    assert "120 ohm" not in said.out


def test_more_rounds_when_asked_for(can_tool: Command) -> None:
    assert can_tool("query", "--rounds", "9", "--json").json["rounds"] == 9
    assert can_tool("query", "--rounds", "0").status == 2
