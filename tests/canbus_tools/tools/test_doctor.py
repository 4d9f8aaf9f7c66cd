"""``canductor can doctor`` names faults that are planted on a bus."""

import re
from functools import partial

import pytest

from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.discovery.inventory import Inventory
from canbus_tools.discovery.node_discovery import NodeDiscovery
from canbus_tools.doctor.facts import NodeFacts
from canbus_tools.doctor.gather import ASKED
from canbus_tools.doctor.population import check_nodes
from nodes.transport import CanFrame
from tests.canbus_tools.command import Command
from tests.canbus_tools.findings import BITRATE, examine, expect, problems
from tests.stages.can_stage import BED, BOOT, MAIN, MAIN_ID, TOOL, TWIN, CanStage, SixNodes


def test_a_good_bus_has_nothing_wrong(stage: CanStage, can_tool: Command) -> None:
    stage.add_node(MAIN, MAIN_ID)
    said = examine(can_tool)
    expect(said)
    ping = said.json["pings"][0]
    assert (ping["nodeid"], ping["asked"], ping["lost"]) == (MAIN_ID, ASKED, 0)
    assert 0 < ping["rtt_median_s"] <= ping["rtt_p99_s"]


def test_the_stage(six: SixNodes, can_tool: Command) -> None:
    del six
    found = expect(examine(can_tool), "duplicate-uuid", "node-shutdown", "node-in-bootloader")
    assert str(TWIN) in found["duplicate-uuid"]["seen"]
    assert str(TOOL) in found["node-shutdown"]["seen"]
    assert "reset" in found["node-shutdown"]["do"]
    assert str(BOOT) in found["node-in-bootloader"]["seen"]
    assert str(BED) in found["node-waits"]["seen"]


def test_as_text(six: SixNodes, can_tool: Command) -> None:
    del six
    said = can_tool("doctor")
    assert said.status == 1
    assert "1 problem" in said.out.splitlines()[0]
    for words in ("PROBLEM duplicate-uuid", "seen", "means", "do", "WARNING node-shutdown", "p99"):
        assert words in said.out
    assert said.out.index("PROBLEM") < said.out.index("WARNING") < said.out.index("NOTE")


def test_nobody_on_the_bus(can_tool: Command) -> None:
    assert "0 uuids found" in expect(examine(can_tool), "no-nodes")["no-nodes"]["seen"]


def test_two_boards_with_one_id(stage: CanStage, can_tool: Command) -> None:
    stage.add_node(MAIN, MAIN_ID)
    with stage.squatter(TOOL, MAIN_ID):
        said = examine(can_tool)
    seen = expect(said, "duplicate-nodeid")["duplicate-nodeid"]["seen"]
    assert f"{TOOL}, {MAIN}" in seen
    assert "node id 4" in seen


def test_a_node_that_another_host_lost(stage: CanStage, can_tool: Command) -> None:
    """It says that it is here, but nobody answers on its id."""
    with stage.squatter(TOOL, 9):
        said = examine(can_tool)
    assert "does not answer on its id" in expect(said, "node-unclear")["node-unclear"]["seen"]


def test_loss(capsys: pytest.CaptureFixture[str]) -> None:
    stage = CanStage(loss=0.03, seed=3)
    stage.add_node(MAIN, MAIN_ID)
    said = examine(Command(stage.computer, capsys, stage.words))
    assert said.status == 1
    assert "frames-lost" in problems(said), said.out
    ping = said.json["pings"][0]
    assert ping["lost"] + ping["invalid_bytes"] > 0


def test_a_host_whose_blocks_get_lost(capsys: pytest.CaptureFixture[str]) -> None:
    """Somebody else's host repeats blocks, and an onlooker finds pieces of them: it only listens."""
    stage = CanStage(loss=0.1, seed=2)
    stage.add_node(MAIN, MAIN_ID)
    with stage.asking_host(MAIN_ID):
        said = examine(Command(stage.computer, capsys, stage.words), "--quiet-bus")
    assert said.status == 1
    assert {"bytes-retransmit", "bytes-invalid"} <= problems(said), said.out


def test_a_node_that_goes_off_the_bus_while_it_is_asked(stage: CanStage, can_tool: Command) -> None:
    node = stage.add_node(MAIN, MAIN_ID)
    expect(examine(can_tool))
    assert node.controller is not None
    cut = partial(node.controller.cut, 1)
    frames = 0

    def count(frame: CanFrame) -> None:
        nonlocal frames
        frames += frame.id == MAIN_ID * 2 + 0x101
        # With the dictionary in the cache it says what it is in some forty frames.
        if frames == 100:
            cut()

    with stage.user(count):
        said = examine(can_tool)
    finding = expect(said, "node-went-silent")["node-went-silent"]
    assert finding["seen"].startswith(f"node {MAIN_ID} answered its first queries, but no further ones: ")
    assert "bus-off" in finding["means"]


def test_overload_by_a_babbler(capsys: pytest.CaptureFixture[str]) -> None:
    stage = CanStage(bitrate=50_000)
    with stage.babbling(0x7F0):
        said = Command(stage.computer, capsys, stage.words)("doctor", "-b", 50_000, "--quiet-bus", "--json")
    found = expect(said, "bus-overloaded")
    assert "'other'" in found["bus-overloaded"]["seen"]
    assert "other-protocol" in found
    assert said.json["load"] > 0.9


def test_quiet_bus_sends_nothing(stage: CanStage, can_tool: Command) -> None:
    with stage.user() as onlooker:
        said = examine(can_tool, "--quiet-bus")
        text = can_tool("doctor", "-b", BITRATE, "--quiet-bus").words
        assert onlooker.frames == []
    assert (said.status, said.json["checked"][-1]) == (0, "traffic")
    assert "no frame was received and nothing was sent" in text


def test_other_bit_rates_are_listened_to(capsys: pytest.CaptureFixture[str]) -> None:
    stage = CanStage(bitrate=250_000)
    stage.add_node(MAIN, MAIN_ID)
    tool = Command(stage.computer, capsys, ("-i", "gs_usb", "-c", "can0"))
    with stage.repeating(CanFrame(0x109, b"12345678"), 0.005):
        said = examine(tool, "--try-bitrates", "--listen", "0.5")
    finding = expect(said, "other-bitrate")["other-bitrate"]
    assert re.search(r"but 10[01] frames were heard at 250000 bit/s", finding["seen"])
    assert "--bitrate 250000" in finding["do"]


@pytest.mark.parametrize(
    ("socketcan", "do"), [(True, "type can bitrate 250000 restart-ms 100"), (False, "--bitrate 250000")]
)
def test_nodes_at_another_bit_rate(socketcan: bool, do: str) -> None:
    nobody = Inventory((), NodeDiscovery().result(), ())
    facts = NodeFacts(inventory=nobody, heard_at={1_000_000: 0, 250_000: 37})
    bus = BusOptions(interface="socketcan" if socketcan else "gs_usb")
    (finding,) = check_nodes(facts, bus)
    assert finding.name == "other-bitrate"
    assert "37 frames were heard at 250000 bit/s" in finding.seen
    assert do in finding.do
    (finding,) = check_nodes(NodeFacts(inventory=nobody, heard_at={1_000_000: 0, 250_000: 0}), bus)
    assert finding.name == "no-nodes"
    assert "nothing heard at 1000000, 250000 either" in finding.seen


def test_a_bus_that_is_not_there(stage: CanStage, capsys: pytest.CaptureFixture[str]) -> None:
    nowhere = Command(stage.computer, capsys, ("-i", "canductor", "-c", "none"))
    assert "none" in expect(examine(nowhere), "bus-unusable")["bus-unusable"]["seen"]


@pytest.mark.parametrize("words", [["--listen", "0"], ["--quiet-bus", "--try-bitrates"], ["--bitrate", "3"]])
def test_usage(can_tool: Command, words: list[str]) -> None:
    assert can_tool("doctor", *words).status == 2
