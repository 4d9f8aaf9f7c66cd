"""``canductor can nodes``: the whole stage, another host's nodes, conflicts, an empty bus."""

from typing import Any

import pytest

from canbus_tools.discovery.inventory import DAMAGED_BLOCK
from nodes.support.can_protocol import ADMIN_ID, QUERY_UNASSIGNED, SET_NODEID
from nodes.transport import CanFrame
from nodes.virtual.firmware import TOOLHEAD
from tests import wire_twin
from tests.canbus_tools.command import Command, Said
from tests.stages.can_stage import (
    BED,
    BOOT,
    MAIN,
    MAIN_ID,
    TOOL,
    TOOL_ID,
    TWIN,
    CanStage,
    SixNodes,
    set_nodeid,
    six_nodes,
)


def by_uuid(said: Said) -> dict[str, dict[str, Any]]:
    assert said.status == 0, said
    nodes = said.json["nodes"]
    found = {node["uuid"]: node for node in nodes}
    assert len(found) == len(nodes)
    return found


def test_the_whole_stage(six: SixNodes, can_tool: Command) -> None:
    six.stage.wire.set_bit_errors(2e-4)  # every fiftieth frame is disturbed, and sent again
    nodes = by_uuid(can_tool("nodes", "--json"))
    what = {
        uuid: (n["nodeid"], n["application"], n["state"], n["several_boards"]) for uuid, n in nodes.items()
    }
    assert what == {
        str(MAIN): (MAIN_ID, "canductor", "idle", False),
        str(TOOL): (TOOL_ID, "klipper-type", "shutdown", False),
        str(BED): (None, "klipper-type", "waiting", False),
        str(TWIN): (None, "klipper-type", "waiting", True),
        str(BOOT): (None, "katapult", "bootloader", False),
    }
    main, tool = nodes[str(MAIN)], nodes[str(TOOL)]
    assert (main["configured"], main["shut_down"], tool["shut_down"]) == (False, False, True)
    firmware = main["firmware"]
    assert (firmware["mcu"], firmware["clock_hz"], firmware["bitrate"]) == (
        "virtual-mainboard",
        168_000_000,
        1_000_000,
    )
    assert (firmware["app"], tool["firmware"]["mcu"]) == ("canductor", "virtual-toolhead")
    assert six.main.controller is not None
    truth = six.main.controller
    assert 0 < main["can"]["tx_retries"] <= truth.counters()["retries"]
    assert main["can"]["tx_errors"] >= truth.status()["tec"]
    assert 0 < main["uptime_s"] <= six.main.clock / 168e6
    assert nodes[str(BOOT)]["firmware"] is None
    assert {node["trouble"] for node in nodes.values()} == {None}


def test_again_and_as_a_table(six: SixNodes, can_tool: Command) -> None:
    can_tool("nodes")
    said = can_tool("nodes")  # with the dictionaries in the cache, and nodes that were talked to
    assert said.status == 0
    lines = said.out.splitlines()
    assert lines[0] == f"6 nodes on {six.stage.options.name}"
    rows = {line.split()[1]: " ".join(line.split()) for line in lines if line.startswith("  ")}
    assert rows[str(MAIN)].startswith(
        f"{MAIN_ID} {MAIN} canductor idle virtual-mainboard 168 MHz canductor 0.1.0"
    )
    assert rows[str(TOOL)].startswith(f"{TOOL_ID} {TOOL} Klipper-type SHUT DOWN virtual-toolhead 64 MHz")
    assert rows[str(TOOL)].endswith(" s 0/0 0 active")
    assert rows[str(BED)] == f"- {BED} Klipper-type waits for an id"
    assert rows[str(TWIN)] == f"- {TWIN} Klipper-type waits for an id, two boards!"
    assert rows[str(BOOT)] == f"- {BOOT} Katapult in its bootloader"
    assert f"Two boards have the uuid {TWIN}" in said.words
    assert f"Node {TOOL_ID} is shut down" in said.words
    assert f"Node {BOOT} runs its bootloader" in said.words


def test_a_node_in_use_is_listed_and_left_alone(six: SixNodes, can_tool: Command) -> None:
    block = b"\x05\x10\x00\x00\x7e"
    with six.stage.other_host(MAIN_ID, block), six.stage.user() as witness:
        nodes = by_uuid(can_tool("nodes", "--json"))
        text = can_tool("nodes")
    main = nodes[str(MAIN)]
    assert (main["nodeid"], main["application"], main["state"]) == (MAIN_ID, "canductor", "in use")
    assert (main["firmware"], main["can"]) == (None, None)
    assert nodes[str(TOOL)]["state"] == "shutdown"
    assert set(witness.sent_to(MAIN_ID)) == {block}
    assert DAMAGED_BLOCK in witness.sent_to(TOOL_ID)
    assert "in use by a host" in text.out
    assert "Nodes in use were not queried" in text.words


def test_a_klipper_board_in_use_is_known_by_its_id(six: SixNodes, can_tool: Command) -> None:
    with six.stage.other_host(TOOL_ID, b"\x05\x10\x00\x00\x7e"), six.stage.other_host(30):
        nodes = {node["nodeid"]: node for node in can_tool("nodes", "--json").json["nodes"]}
    tool = nodes[TOOL_ID]
    assert (tool["uuid"], tool["application"], tool["state"]) == (None, "klipper-type", "in use")
    nobody = nodes[30]
    assert (nobody["state"], nobody["application"]) == ("unclear", "unknown")
    assert nobody["trouble"] == "another program sends to this id, but no node answers"


def test_a_probe_is_answered_and_changes_nothing_in_a_node(stage: CanStage) -> None:
    """The number of the next block that a node expects stays what it is."""
    stage.add_node(TOOL, TOOL_ID, build=TOOLHEAD, legacy=True)
    with stage.user() as host:

        def answer_to(block: bytes) -> bytes:
            host.send(CanFrame(TOOL_ID * 2 + 0x100, block))
            frame = host.receive(1.0)
            assert frame is not None
            assert frame.id == TOOL_ID * 2 + 0x101
            return frame.data

        for expected in range(3):
            for _ in range(2):
                assert answer_to(DAMAGED_BLOCK) == wire_twin.block(expected)
            assert answer_to(wire_twin.block(expected)) == wire_twin.block(expected + 1)


def test_only_listening_and_asking_by_uuid(six: SixNodes, can_tool: Command) -> None:
    with six.stage.user() as witness:
        said = can_tool("nodes", "--probe", "none", "--json")
    nodes = by_uuid(said)
    assert nodes[str(MAIN)]["state"] == "idle"
    assert str(TOOL) not in nodes
    assert witness.sent_to(TOOL_ID) == []
    assert said.json["probed"] == [MAIN_ID]


def test_a_high_id_when_asked_for(stage: CanStage, can_tool: Command) -> None:
    stage.add_node(TOOL, 255, build=TOOLHEAD, legacy=True)
    assert can_tool("nodes", "--json").json["nodes"] == []
    node = by_uuid(can_tool("nodes", "--json", "--probe", "200-255"))[str(TOOL)]
    assert node["nodeid"] == 255
    assert node["can"] == {"rx_errors": 0, "tx_errors": 0, "tx_retries": 0, "state": "active"}


def test_two_boards_with_one_id_are_not_asked(stage: CanStage, can_tool: Command) -> None:
    for uuid in (MAIN, TWIN, TWIN):
        stage.add_node(uuid, build=TOOLHEAD)
    with stage.user() as host:
        set_nodeid(host, MAIN, 4)
        set_nodeid(host, TWIN, 5)
    with stage.user() as witness:
        nodes = by_uuid(can_tool("nodes", "--json"))
    assert nodes[str(MAIN)]["state"] == "idle"
    twin = nodes[str(TWIN)]
    assert (twin["nodeid"], twin["state"], twin["several_boards"]) == (5, "unclear", True)
    assert "more than one board has this id" in twin["trouble"]
    assert set(witness.sent_to(5)) == {DAMAGED_BLOCK}


def test_nobody(stage: CanStage, can_tool: Command) -> None:
    said = can_tool("nodes")
    assert said.status == 0
    assert said.out.startswith("0 nodes on ")
    assert "none of ids 4 to 67 answered" in said.words
    with stage.other_host(0x300):  # far above the ids of nodes: another protocol
        said = can_tool("nodes")
    assert "of other protocols were seen" in said.words


@pytest.mark.parametrize("ids", ["0-9", "9-4", "x", "4-256", ""])
def test_bad_ids_are_refused(can_tool: Command, ids: str) -> None:
    said = can_tool("nodes", "--probe", ids)
    assert said.status == 2
    assert "--probe" in said.err


def test_a_node_that_cannot_be_read_is_listed_with_the_reason(stage: CanStage, can_tool: Command) -> None:
    """It answers every block, and accepts none."""

    def refuse(frame: CanFrame) -> CanFrame | None:
        return CanFrame(frame.id + 1, wire_twin.block(3)) if frame.id == 20 * 2 + 0x100 else None

    with stage.user(refuse):
        (node,) = can_tool("nodes", "--json").json["nodes"]
        text = can_tool("nodes")
    assert (node["nodeid"], node["uuid"], node["state"], node["firmware"]) == (20, None, "unclear", None)
    assert "node 20" in node["trouble"]
    assert "answers, but accepts nothing" in node["trouble"]
    assert "Node 20: " in text.out


@pytest.mark.parametrize(
    "bus", [{"bitrate": 250_000}, {"loss": 0.01, "seed": 3}], ids=["250 kbit/s", "1 % of frames lost"]
)
def test_the_whole_stage_on_a_bad_bus(capsys: pytest.CaptureFixture[str], bus: dict[str, Any]) -> None:
    stage = CanStage(**bus)
    six_nodes(stage)
    nodes = by_uuid(Command(stage.computer, capsys, stage.words)("nodes", "--json"))
    assert nodes.keys() == {str(uuid) for uuid in (MAIN, TOOL, BED, TWIN, BOOT)}
    assert {node["trouble"] for node in nodes.values()} == {None}
    assert [nodes[str(uuid)]["firmware"]["mcu"] for uuid in (MAIN, TOOL)] == [
        "virtual-mainboard",
        "virtual-toolhead",
    ]


def test_a_board_that_gets_its_id_meanwhile_is_one_board(six: SixNodes, can_tool: Command) -> None:
    """A host gives BED the id 6 as soon as somebody asks who waits a second time."""
    questions = 0

    def assign(frame: CanFrame) -> CanFrame | None:
        nonlocal questions
        questions += frame == CanFrame(ADMIN_ID, bytes([QUERY_UNASSIGNED]))
        return CanFrame(ADMIN_ID, bytes([SET_NODEID, *BED.raw, 6])) if questions == 2 else None

    with six.stage.user(assign):
        nodes = by_uuid(can_tool("nodes", "--json"))
    assert (nodes[str(BED)]["nodeid"], nodes[str(BED)]["several_boards"]) == (6, False)


def test_twins_of_which_one_has_an_id(stage: CanStage, can_tool: Command) -> None:
    stage.add_node(TWIN, 5, build=TOOLHEAD, legacy=True)
    stage.add_node(TWIN, build=TOOLHEAD, legacy=True)
    nodes = can_tool("nodes", "--json").json["nodes"]
    assert [(n["uuid"], n["nodeid"], n["state"], n["several_boards"]) for n in nodes] == [
        (str(TWIN), 5, "idle", True),
        (str(TWIN), None, "waiting", True),
    ]
