"""``canductor can nodes``: the whole stage, another host's nodes, conflicts, an empty bus."""

import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest

from canbus_tools.survey import DAMAGED_BLOCK
from nodes.assign import ADMIN_ID, QUERY_UNASSIGNED
from nodes.transport import CanFrame
from nodes.virtual.hub import VirtualBus
from tests import wire_twin
from tests.canbus_tools.command import Command, Said
from tests.canbus_tools.other_host import OtherHost, Witness
from tests.canbus_tools.stage import (
    BED,
    BOOT,
    MAIN,
    MAIN_ID,
    PATIENCE_S,
    TOOL,
    TOOL_ID,
    TWIN,
    Place,
    Stage,
    set_nodeid,
    six_nodes,
)

QUICK = ("--listen", "0.2")
"""Nobody else is on these buses, but where a test says so."""
BESIDE = ("--listen", "1")
"""A busy computer may keep another host from its turn for so long."""


def by_uuid(said: Said) -> dict[str, dict[str, Any]]:
    assert said.status == 0, said
    nodes = said.json["nodes"]
    found = {node["uuid"]: node for node in nodes}
    assert len(found) == len(nodes)
    return found


def test_the_whole_stage(stage: Stage, can_tool: Command) -> None:
    began_s = time.monotonic()
    nodes = by_uuid(can_tool("nodes", "--json", *QUICK))
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
    assert main["can"] == {"rx_errors": 0, "tx_errors": 0, "tx_retries": 0, "state": "active"}
    assert 0 < main["uptime_s"] < 60 + time.monotonic() - began_s
    assert nodes[str(BOOT)]["firmware"] is None
    assert {node["trouble"] for node in nodes.values()} == {None}


def test_again_and_as_a_table(stage: Stage, can_tool: Command) -> None:
    can_tool("nodes", *QUICK)
    said = can_tool("nodes", *QUICK)  # with the dictionaries in the cache, and nodes that were talked to
    assert said.status == 0
    lines = said.out.splitlines()
    assert lines[0] == f"6 nodes on {stage.place.options.name}"
    rows = {line.split()[1]: " ".join(line.split()) for line in lines if line.startswith("  ")}
    assert rows[str(MAIN)].startswith(
        f"{MAIN_ID} {MAIN} canductor idle virtual-mainboard 168 MHz canductor 0.1.0"
    )
    assert rows[str(MAIN)].endswith(" s 0/0 0 active")
    assert rows[str(TOOL)].startswith(f"{TOOL_ID} {TOOL} Klipper-type SHUT DOWN virtual-toolhead 64 MHz")
    assert rows[str(BED)] == f"- {BED} Klipper-type waits for an id"
    assert rows[str(TWIN)] == f"- {TWIN} Klipper-type waits for an id, two boards!"
    assert rows[str(BOOT)] == f"- {BOOT} Katapult in its bootloader"
    assert f"Two boards have the uuid {TWIN}" in said.words
    assert f"Node {TOOL_ID} has shut down" in said.words
    assert f"Node {BOOT} runs no firmware" in said.words


def test_a_node_in_use_is_listed_and_left_alone(stage: Stage, can_tool: Command) -> None:
    with OtherHost(stage.place, MAIN_ID, b"\x05\x10\x00\x00\x7e"), Witness(stage.place) as witness:
        nodes = by_uuid(can_tool("nodes", "--json", *BESIDE))
        text = can_tool("nodes", *BESIDE)
    main = nodes[str(MAIN)]
    assert (main["nodeid"], main["application"], main["state"]) == (MAIN_ID, "canductor", "in use")
    assert (main["firmware"], main["can"]) == (None, None)
    assert nodes[str(TOOL)]["state"] == "shutdown"
    assert set(witness.sent_to(MAIN_ID)) == {b"\x05\x10\x00\x00\x7e"}
    assert DAMAGED_BLOCK in witness.sent_to(TOOL_ID)
    assert "in use by a host" in text.out
    assert "Nodes in use were not asked" in text.words


def test_a_klipper_board_in_use_is_known_by_its_id(stage: Stage, can_tool: Command) -> None:
    with OtherHost(stage.place, TOOL_ID, b"\x05\x10\x00\x00\x7e"), OtherHost(stage.place, 30):
        nodes = {node["nodeid"]: node for node in can_tool("nodes", "--json", *BESIDE).json["nodes"]}
    tool = nodes[TOOL_ID]
    assert (tool["uuid"], tool["application"], tool["state"]) == (None, "klipper-type", "in use")
    nobody = nodes[30]
    assert (nobody["state"], nobody["application"]) == ("unclear", "unknown")
    assert nobody["trouble"] == "another program sends to this id, and nobody answers"


def test_a_probe_is_answered_and_changes_nothing_in_a_node(place: Place) -> None:
    """The number of the next block that a node expects stays what it is."""
    with place.start_node("toolhead", TOOL, legacy=True) as node, closing(place.open()) as host:
        node.wait_ready()
        set_nodeid(host, TOOL, TOOL_ID)

        def answer_to(block: bytes) -> bytes:
            host.send(CanFrame(TOOL_ID * 2 + 0x100, block))
            frame = host.receive(PATIENCE_S)
            assert frame is not None
            assert frame.id == TOOL_ID * 2 + 0x101
            return frame.data

        for expected in range(3):
            for _ in range(2):
                assert answer_to(DAMAGED_BLOCK) == wire_twin.block(expected)
            assert answer_to(wire_twin.block(expected)) == wire_twin.block(expected + 1)


def test_only_listening_and_asking_by_uuid(stage: Stage, can_tool: Command) -> None:
    with Witness(stage.place) as witness:
        said = can_tool("nodes", "--probe", "none", "--json", *QUICK)
    nodes = by_uuid(said)
    assert nodes[str(MAIN)]["state"] == "idle"
    assert str(TOOL) not in nodes
    assert witness.sent_to(TOOL_ID) == []
    assert said.json["probed"] == [MAIN_ID]


def test_a_high_id_when_asked_for(place: Place, can_tool: Command) -> None:
    with place.start_node("toolhead", TOOL, legacy=True) as node:
        node.wait_ready()
        with closing(place.open()) as host:
            set_nodeid(host, TOOL, 255)
        assert can_tool("nodes", "--json", *QUICK).json["nodes"] == []
        assert by_uuid(can_tool("nodes", "--json", "--probe", "200-255", *QUICK))[str(TOOL)]["nodeid"] == 255


def test_two_boards_with_one_id_are_not_asked(place: Place, can_tool: Command) -> None:
    with ExitStack() as stack:
        for uuid in (MAIN, TWIN, TWIN):
            stack.enter_context(place.start_node("toolhead", uuid)).wait_ready()
        with closing(place.open()) as host:
            set_nodeid(host, MAIN, 4)
            set_nodeid(host, TWIN, 5)
        with Witness(place) as witness:
            nodes = by_uuid(can_tool("nodes", "--json", *QUICK))
    assert nodes[str(MAIN)]["state"] == "idle"
    twin = nodes[str(TWIN)]
    assert (twin["nodeid"], twin["state"], twin["several_boards"]) == (5, "unclear", True)
    assert "more than one board has this id" in twin["trouble"]
    assert set(witness.sent_to(5)) == {DAMAGED_BLOCK}


def test_nobody(place: Place, can_tool: Command) -> None:
    said = can_tool("nodes", *QUICK)
    assert said.status == 0
    assert said.out.startswith("0 nodes on ")
    assert "of ids 4 to 67 none answered" in said.words
    with OtherHost(place, 0x300):  # far above the ids of nodes: another protocol
        said = can_tool("nodes", *BESIDE)
    assert "of other protocols came by" in said.words


@pytest.mark.parametrize("ids", ["0-9", "9-4", "x", "4-256", ""])
def test_bad_ids_are_refused(place: Place, can_tool: Command, ids: str) -> None:
    said = can_tool("nodes", "--probe", ids)
    assert said.status == 2
    assert "--probe" in said.err


class Refusing(OtherHost):
    """A node that answers every block, and accepts none."""

    def _run(self) -> None:
        with closing(self._transport):
            self._began.set()
            while not self._ending.is_set():
                frame = self._transport.receive(0.02)
                if frame is not None and frame.id == self._frame.id:
                    self._transport.send(CanFrame(frame.id + 1, wire_twin.block(3)))


def test_a_node_that_cannot_be_read_is_listed_with_the_reason(place: Place, can_tool: Command) -> None:
    with Refusing(place, 20):
        (node,) = can_tool("nodes", "--json", *QUICK).json["nodes"]
        text = can_tool("nodes", *QUICK)
    assert (node["nodeid"], node["uuid"], node["state"], node["firmware"]) == (20, None, "unclear", None)
    assert "node 20" in node["trouble"]
    assert "answers, but accepts nothing" in node["trouble"]
    assert "Node 20: " in text.out


@pytest.mark.parametrize(
    "bus", [{"bitrate": 250_000}, {"loss": 0.01, "seed": 3}], ids=["250 kbit/s", "1 % of frames lost"]
)
def test_the_whole_stage_on_a_bad_bus(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bus: dict[str, Any]
) -> None:
    with VirtualBus(tmp_path / "bad", **bus) as hub:
        place = Place("canductor", str(hub.path))
        with six_nodes(place):
            nodes = by_uuid(Command(place, capsys)("nodes", "--json", "--listen", "0.3"))
    assert nodes.keys() == {str(uuid) for uuid in (MAIN, TOOL, BED, TWIN, BOOT)}
    assert {node["trouble"] for node in nodes.values()} == {None}
    assert [nodes[str(uuid)]["firmware"]["mcu"] for uuid in (MAIN, TOOL)] == [
        "virtual-mainboard",
        "virtual-toolhead",
    ]


class Assigning(OtherHost):
    """A host that gives BED the id 6 as soon as somebody asks who waits a second time."""

    def _run(self) -> None:
        questions = 0
        with closing(self._transport):
            self._began.set()
            while not self._ending.is_set():
                frame = self._transport.receive(0.02)
                if frame == CanFrame(ADMIN_ID, bytes([QUERY_UNASSIGNED])):
                    questions += 1
                    if questions == 2:
                        set_nodeid(self._transport, BED, 6)


def test_a_board_that_gets_its_id_meanwhile_is_one_board(stage: Stage, can_tool: Command) -> None:
    with Assigning(stage.place, 6):
        nodes = by_uuid(can_tool("nodes", "--json", *QUICK))
    assert (nodes[str(BED)]["nodeid"], nodes[str(BED)]["several_boards"]) == (6, False)


def test_twins_of_which_one_has_an_id(place: Place, can_tool: Command) -> None:
    with ExitStack() as stack:
        stack.enter_context(place.start_node("toolhead", TWIN, legacy=True)).wait_ready()
        with closing(place.open()) as host:
            set_nodeid(host, TWIN, 5)
        stack.enter_context(place.start_node("toolhead", TWIN, legacy=True)).wait_ready()
        nodes = can_tool("nodes", "--json", *QUICK).json["nodes"]
    assert [(n["uuid"], n["nodeid"], n["state"], n["several_boards"]) for n in nodes] == [
        (str(TWIN), 5, "idle", True),
        (str(TWIN), None, "waiting", True),
    ]
