"""``canductor can doctor`` names faults that are planted on a bus: the virtual one, or vcan0."""

import asyncio
import threading
from contextlib import closing
from pathlib import Path
from typing import Any, Self

import can
import pytest

from canbus_tools.census import Census
from canbus_tools.doctor_checks.facts import NodeFacts
from canbus_tools.doctor_checks.facts import Place as Bus
from canbus_tools.doctor_checks.population import check_nodes
from canbus_tools.doctor_facts import try_bitrates
from canbus_tools.open_bus import BusOptions
from canbus_tools.survey import SurveyResult
from canbus_tools.talk import NodeTalk
from nodes.assign import ADMIN_ID, ADMIN_RESPONSE_ID, NODE_IS_HERE, WHO_IS_HERE, Uuid
from nodes.transport import CanFrame
from nodes.virtual.faults import Fault, FaultKind
from nodes.virtual.hub import VirtualBus
from tests.canbus_tools.command import Command, Said
from tests.canbus_tools.stage import (
    BED,
    BOOT,
    MAIN,
    MAIN_ID,
    PATIENCE_S,
    TOOL,
    TWIN,
    Place,
    Stage,
    set_nodeid,
)

BITRATE = "1000000"


def findings(said: Said) -> dict[str, dict[str, Any]]:
    return {finding["name"]: finding for finding in said.json["findings"]}


def problems(said: Said) -> set[str]:
    """Return what is wrong. A vcan in a virtual machine on a busy computer may be slow: that is none here."""
    found = findings(said)
    slow = {"round-trip-spread"}
    return {name for name, finding in found.items() if finding["severity"] != "note"} - slow


def expect(said: Said, *names: str) -> dict[str, dict[str, Any]]:
    """Check that these problems were found and no others; return all findings."""
    assert problems(said) == set(names), said.out
    assert said.status == 1 or not names, said.out
    return findings(said)


def run(can_tool: Command, *words: str) -> Said:
    return can_tool("doctor", "--bitrate", BITRATE, "--listen", "0.5", "--json", *words)


class Babbler:
    """Sends frames to a bus as fast as it takes them."""

    def __init__(self, place: Place, can_id: int) -> None:
        self._place = place
        self._frame = CanFrame(can_id, b"\x55" * 8)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        with closing(self._place.open()) as bus:
            while not self._end.is_set():
                bus.send(self._frame, PATIENCE_S)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join(PATIENCE_S)


def test_a_good_bus_has_nothing_wrong(place: Place, can_tool: Command) -> None:
    with place.start_node("mainboard", MAIN) as node:
        node.wait_ready()
        with closing(place.open()) as host:
            set_nodeid(host, MAIN, MAIN_ID)
        said = run(can_tool)
    expect(said)
    ping = said.json["pings"][0]
    assert (ping["nodeid"], ping["asked"], ping["lost"]) == (MAIN_ID, 100, 0)
    assert 0 < ping["rtt_median_s"] <= ping["rtt_p99_s"]


def test_the_stage(stage: Stage, can_tool: Command) -> None:
    said = run(can_tool)
    found = expect(said, "duplicate-uuid", "node-shutdown", "node-in-bootloader")
    assert str(TWIN) in found["duplicate-uuid"]["seen"]
    assert str(TOOL) in found["node-shutdown"]["seen"]
    assert "reset" in found["node-shutdown"]["do"]
    assert str(BOOT) in found["node-in-bootloader"]["seen"]
    assert str(BED) in found["node-waits"]["seen"]


def test_as_text(stage: Stage, can_tool: Command) -> None:
    said = can_tool("doctor", "--listen", "0.2")
    assert said.status == 1
    assert "1 problem" in said.out.splitlines()[0]
    for words in ("PROBLEM duplicate-uuid", "seen", "means", "do", "WARNING node-shutdown", "p99"):
        assert words in said.out
    assert said.out.index("PROBLEM") < said.out.index("WARNING") < said.out.index("NOTE")


def test_nobody_on_the_bus(place: Place, can_tool: Command) -> None:
    said = run(can_tool)
    assert "0 uuids found" in expect(said, "no-nodes")["no-nodes"]["seen"]


class Squatter:
    """Says that it is board UUID and has node id NODEID; stands in for a board that missed whose id that is.

    Two processes cannot be brought there: each gives its id up when it hears that another gets it.
    """

    def __init__(self, place: Place, uuid: Uuid, nodeid: int) -> None:
        self._place = place
        self._answer = CanFrame(ADMIN_RESPONSE_ID, bytes([NODE_IS_HERE, *uuid.raw, nodeid]))
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        with closing(self._place.open()) as bus:
            while not self._end.is_set():
                frame = bus.receive(0.05)
                if frame == CanFrame(ADMIN_ID, bytes([WHO_IS_HERE])):
                    bus.send(self._answer)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join(PATIENCE_S)


def test_two_boards_with_one_id(place: Place, can_tool: Command) -> None:
    with place.start_node("mainboard", MAIN) as node, Squatter(place, TOOL, MAIN_ID):
        node.wait_ready()
        with closing(place.open()) as host:
            set_nodeid(host, MAIN, MAIN_ID)
        said = run(can_tool)
    seen = expect(said, "duplicate-nodeid")["duplicate-nodeid"]["seen"]
    assert f"{TOOL}, {MAIN}" in seen
    assert "node id 4" in seen


def test_a_node_that_another_host_lost(place: Place, can_tool: Command) -> None:
    """It says that it is here, but nobody answers on its id."""
    with Squatter(place, TOOL, 9):
        said = run(can_tool)
    assert "does not answer on its id" in expect(said, "node-unclear")["node-unclear"]["seen"]


def test_loss(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with VirtualBus(tmp_path / "bus", loss=0.03, seed=3) as bus:
        place = Place("canductor", str(bus.path))
        with place.start_node("mainboard", MAIN) as node:
            node.wait_ready()
            for _ in range(5):
                with closing(place.open()) as host:
                    set_nodeid(host, MAIN, MAIN_ID)
            said = run(Command(place, capsys))
    assert said.status == 1
    assert "frames-lost" in problems(said), said.out
    ping = said.json["pings"][0]
    assert ping["lost"] + ping["invalid_bytes"] > 0


def test_a_host_whose_blocks_get_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Somebody else's host repeats blocks, and an onlooker finds pieces of them: it only listens."""
    with VirtualBus(tmp_path / "bus") as bus:
        place = Place("canductor", str(bus.path))
        end = threading.Event()
        talks = threading.Event()

        async def host() -> None:
            async with NodeTalk.open(place.options, MAIN_ID, force=True) as talk:
                bus.set_faults([Fault(kind=FaultKind.LOSE, share=0.1)])
                while not end.is_set():
                    await talk.ask("get_uptime", "uptime", tries=100)
                    talks.set()

        with place.start_node("mainboard", MAIN) as node:
            node.wait_ready()
            with closing(place.open()) as opened:
                set_nodeid(opened, MAIN, MAIN_ID)
            thread = threading.Thread(target=lambda: asyncio.run(host()))
            thread.start()
            try:
                assert talks.wait(PATIENCE_S)
                said = Command(place, capsys)(
                    "doctor", "-b", BITRATE, "--listen", "3", "--quiet-bus", "--json"
                )
            finally:
                end.set()
                thread.join(PATIENCE_S)
    assert said.status == 1
    assert {"bytes-retransmit", "bytes-invalid"} <= problems(said), said.out


def test_a_node_that_goes_off_the_bus_while_it_is_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with VirtualBus(tmp_path / "bus") as bus:
        place = Place("canductor", str(bus.path))
        with place.start_node("mainboard", MAIN) as node:
            node.wait_ready()
            with closing(place.open()) as host:
                set_nodeid(host, MAIN, MAIN_ID)
            expect(run(Command(place, capsys)))
            # With the dictionary in the cache it says what it is in some forty frames.
            bus.set_faults([Fault(kind=FaultKind.BUS_OFF, sender=0, nth=100, time_s=3600)])
            said = run(Command(place, capsys))
    finding = expect(said, "node-went-silent")["node-went-silent"]
    assert finding["seen"].startswith(f"node {MAIN_ID} said what it is, and then answered no more: ")
    assert "bus-off" in finding["means"]


def test_overload_by_a_babbler(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with VirtualBus(tmp_path / "bus", bitrate=50_000) as bus:
        place = Place("canductor", str(bus.path))
        with Babbler(place, 0x7F0):
            said = Command(place, capsys)("doctor", "-b", "50000", "--listen", "1", "--quiet-bus", "--json")
    found = expect(said, "bus-overloaded")
    assert "'other'" in found["bus-overloaded"]["seen"]
    assert "other-protocol" in found
    assert said.json["load"] > 0.9


def test_quiet_bus_sends_nothing(place: Place, can_tool: Command) -> None:
    with closing(place.open()) as onlooker:
        said = run(can_tool, "--quiet-bus")
        assert onlooker.receive(0.05) is None
        text = can_tool("doctor", "-b", BITRATE, "--listen", "0.5", "--quiet-bus").words
    assert (said.status, said.json["checked"][-1]) == (0, "traffic")
    assert "nothing was heard and nothing was asked" in text


def test_other_bit_rates_are_listened_to() -> None:
    """On python-can's own virtual bus, where every bit rate hears everybody."""
    options = BusOptions(interface="virtual", channel="doctor")
    begun, end = threading.Event(), threading.Event()

    def talk() -> None:
        with can.Bus(interface="virtual", channel="doctor") as bus:
            while not end.wait(0.005):
                begun.set()
                bus.send(can.Message(arbitration_id=0x109, data=b"12345678", is_extended_id=False))

    thread = threading.Thread(target=talk)
    thread.start()
    assert begun.wait(PATIENCE_S)
    heard = try_bitrates(options, 0.5)
    end.set()
    thread.join(PATIENCE_S)
    assert list(heard) == [1_000_000, 500_000, 250_000, 125_000]
    assert all(heard.values())


@pytest.mark.parametrize(
    ("socketcan", "do"), [(True, "type can bitrate 250000 restart-ms 100"), (False, "--bitrate 250000")]
)
def test_nodes_at_another_bit_rate(socketcan: bool, do: str) -> None:
    nobody = SurveyResult((), Census().result(), ())
    facts = NodeFacts(survey=nobody, heard_at={1_000_000: 0, 250_000: 37})
    bus = Bus(name="can0", words="-c can0", socketcan=socketcan, bitrate=1_000_000)
    (finding,) = check_nodes(facts, bus)
    assert finding.name == "other-bitrate"
    assert "37 frames were heard at 250000 bit/s" in finding.seen
    assert do in finding.do
    (finding,) = check_nodes(NodeFacts(survey=nobody, heard_at={1_000_000: 0, 250_000: 0}), bus)
    assert finding.name == "no-nodes"
    assert "nothing heard at 1000000, 250000 either" in finding.seen


def test_a_bus_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = Place("canductor", str(tmp_path / "none"))
    said = run(Command(place, capsys))
    expect(said, "bus-unusable")


@pytest.mark.parametrize("words", [["--listen", "0"], ["--quiet-bus", "--try-bitrates"], ["--bitrate", "3"]])
def test_usage(place: Place, can_tool: Command, words: list[str]) -> None:
    assert can_tool("doctor", *words).status == 2
