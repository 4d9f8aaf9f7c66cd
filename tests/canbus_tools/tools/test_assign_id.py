"""``canductor can assign`` and ``release``: what they do, and every refusal with what to do about it."""

import re
from typing import Any

import pytest

from nodes.support.can_protocol import ADMIN_ID, ADMIN_RESPONSE_ID, NEED_NODEID, QUERY_UNASSIGNED, SET_NODEID
from nodes.transport import CanFrame
from nodes.virtual.firmware import TOOLHEAD
from tests.canbus_tools.command import Command
from tests.stages.can_stage import BED, BOOT, MAIN, MAIN_ID, TOOL, TOOL_ID, TWIN, CanStage, SixNodes


def waiting(can_tool: Command) -> dict[str, Any]:
    return {node["uuid"]: node for node in can_tool("query", "--json").json["nodes"]}


def ask_uuid(stage: CanStage, nodeid: int) -> bytes:
    async def ask() -> bytes:
        async with stage.talk(nodeid) as talk:
            return (await talk.ask("get_canbus_id", "canbus_id")).message.data("canbus_uuid")

    return stage.computer.run(ask())


def test_a_node_gets_its_id_and_gives_it_back(six: SixNodes, can_tool: Command) -> None:
    said = can_tool("assign", str(BED), "17", "--json")
    assert (said.status, said.err) == (0, "")
    assert (said.json["uuid"], said.json["nodeid"], said.json["had_it_before"]) == (str(BED), 17, False)
    assert said.json["firmware"]["mcu"] == "virtual-mainboard"
    assert str(BED) not in waiting(can_tool)
    assert ask_uuid(six.stage, 17) == BED.raw

    said = can_tool("release", str(BED), "--json")
    assert (said.status, said.err) == (0, "")
    assert (said.json["uuid"], said.json["nodeid"], said.json["waited_before"]) == (str(BED), 17, False)
    assert waiting(can_tool)[str(BED)]["application"] == "klipper-type"
    assert six.bed.counters()["resets"] == 1


def test_told_in_words(six: SixNodes, can_tool: Command) -> None:
    del six

    def said(*words: str) -> str:
        return can_tool(*words).out.strip()

    board = "virtual-mainboard, canductor 0.1.0"
    kind = "(Klipper-type firmware)"
    assert said("assign", str(MAIN), "4") == f"{MAIN} had id 4 before: {board}"
    assert said("assign", str(BED), "17") == f"{BED} has id 17 now: {board}"
    assert said("release", "17") == f"{BED} had id 17, was reset and waits for an id now {kind}"
    assert said("release", str(BED)) == f"{BED} waits for an id already {kind}"


@pytest.mark.parametrize(("node", "uuid"), [(str(MAIN), MAIN), (str(TOOL_ID), TOOL), (str(TOOL), TOOL)])
def test_release_by_uuid_or_id_also_from_shutdown(
    six: SixNodes, can_tool: Command, node: str, uuid: object
) -> None:
    del six
    assert can_tool("release", node).status == 0
    assert waiting(can_tool)[str(uuid)]["several_boards"] is False


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ((str(TWIN), "9"), f"two boards on .* have the uuid {TWIN} .*disconnect one of them"),
        ((str(BOOT), "9"), f"node {BOOT} runs its bootloader .*flash it, or reset it"),
        ((str(BED), "4"), f"id {MAIN_ID} on .* belongs to {MAIN}, which would shut down; the id 6 is free"),
        ((str(BED), "5"), f"id {TOOL_ID} on .* belongs to {TOOL}, which would shut down; the id 6 is free"),
        ((str(MAIN), "9"), f"node {MAIN} has id 4 already; 'canductor can release 4 "),
        ((str(TOOL), "9"), f"node {TOOL} has id 5 already; 'canductor can release 5 "),
        (
            ("0123456789ab", "9"),
            r"node 0123456789ab was not found on .*\(nodes that wait for an id: .*canductor can query",
        ),
    ],
)
def test_refused_and_nothing_was_sent(
    six: SixNodes, can_tool: Command, words: tuple[str, str], sentence: str
) -> None:
    with six.stage.user() as witness:
        said = can_tool("assign", *words)
    assert said.sentence.startswith("canductor: ")
    assert re.search(sentence, said.sentence)
    asked = [frame for frame in witness.frames if frame.id == ADMIN_ID]
    assert asked
    assert [frame for frame in asked if frame.data[0] not in (0x00, 0x41)] == []
    assert not six.boot.addressed_as_application


def test_a_twin_that_has_an_id_is_not_given_another_one_beside_its_brother(
    stage: CanStage, can_tool: Command
) -> None:
    stage.add_node(TWIN, 5, build=TOOLHEAD, legacy=True)
    stage.add_node(TWIN, build=TOOLHEAD, legacy=True)
    assert "two boards" in can_tool("assign", str(TWIN), "9").sentence


def test_a_node_that_has_the_id_already_and_a_host(six: SixNodes, can_tool: Command) -> None:
    with six.stage.other_host(MAIN_ID):
        said = can_tool("assign", str(MAIN), str(MAIN_ID))
    assert f"has id {MAIN_ID} already, and another program uses it" in said.sentence


def test_an_id_that_only_a_host_uses_is_taken(six: SixNodes, can_tool: Command) -> None:
    with six.stage.other_host(6, every_s=0.98):  # as often as hosts ask for clocks
        assert "id 6 on" in can_tool("assign", str(BED), "6").sentence


def test_a_node_that_does_not_take_its_id_is_told_of(stage: CanStage, can_tool: Command) -> None:
    """A board whose firmware answers queries for ever."""
    answer = CanFrame(ADMIN_RESPONSE_ID, bytes([NEED_NODEID, *BED.raw, SET_NODEID]))
    question = CanFrame(ADMIN_ID, bytes([QUERY_UNASSIGNED]))
    with stage.user(lambda frame: answer if frame == question else None):
        said = can_tool("assign", str(BED), "9")
    assert f"{BED} on " in said.sentence
    assert "3 times, and it still waits for one" in said.sentence


def test_release_refuses_what_another_host_uses_unless_forced(six: SixNodes, can_tool: Command) -> None:
    with six.stage.other_host(MAIN_ID, every_s=0.98):
        for node in (str(MAIN), str(MAIN_ID)):
            assert f"node {MAIN_ID} on " in (said := can_tool("release", node).sentence)
            assert "is in use: another program talks to it" in said
        assert str(MAIN) not in waiting(can_tool)
        assert can_tool("release", str(MAIN), "--force").status == 0
    assert str(MAIN) in waiting(can_tool)


def test_release_of_nobody(can_tool: Command) -> None:
    assert "no node answers on id 66 of bus " in can_tool("release", "66").sentence
    stranger = "0123456789ab"
    assert f"no node with the uuid {stranger} was found" in can_tool("release", stranger).sentence


def test_release_of_twins_wants_one_named_by_its_id(stage: CanStage, can_tool: Command) -> None:
    stage.add_node(TWIN, 5, build=TOOLHEAD)
    stage.add_node(TWIN)
    assert (
        f"two boards on {stage.options.name} have the uuid {TWIN}" in can_tool("release", str(TWIN)).sentence
    )
    assert can_tool("release", "5").status == 0
    assert waiting(can_tool)[str(TWIN)]["several_boards"] is True


@pytest.mark.parametrize(
    "words",
    [
        ("assign", "12", "4"),
        ("assign", str(BED), "3"),
        ("assign", str(BED), "256"),
        ("assign", str(BED)),
        ("release", "0"),
        ("release", "256"),
        ("release", "90a4"),
        ("release",),
    ],
)
def test_words_that_make_no_command(can_tool: Command, words: tuple[str, ...]) -> None:
    said = can_tool(*words)
    assert (said.status, said.out) == (2, "")
    assert said.err.count("\n") == 1
