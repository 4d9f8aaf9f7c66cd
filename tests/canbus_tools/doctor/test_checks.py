"""The doctor's judgement of facts that no test can plant: of real controllers, kernels and adapters."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from canbus_tools.bus.bus_load import LoadMeter
from canbus_tools.bus.link_facts import LinkFacts, parse_link
from canbus_tools.bus.open_bus import BusOptions
from canbus_tools.discovery.inventory import Inventory, InventoryEntry, NodePresence
from canbus_tools.discovery.node_discovery import Application, NodeDiscovery
from canbus_tools.discovery.node_info import CanStatus, Firmware, NodeInfo
from canbus_tools.doctor.facts import (
    AdapterFacts,
    DirectionFacts,
    InterfaceFacts,
    NodeFacts,
    PingFacts,
    TrafficFacts,
)
from canbus_tools.doctor.finding import Finding, Severity
from canbus_tools.doctor.gather import error_kinds, read_adapter
from canbus_tools.doctor.interface import check_link, check_presence
from canbus_tools.doctor.known_faults import faults_of, kernel_version
from canbus_tools.doctor.population import check_nodes
from canbus_tools.doctor.traffic import check_traffic
from canbus_tools.protocol.frame import Frame, FrameKind
from nodes.bus.assign import Uuid
from nodes.support.errors import CanductorError

DATA = Path(__file__).parents[2] / "data" / "can"
BUS = BusOptions(bitrate=1_000_000)
HEALTHY = parse_link((DATA / "ip-link-healthy.json").read_text())
GS_USB = AdapterFacts(kernel="6.8.0-45-generic", driver="gs_usb", usb_id=(0x1D50, 0x606F), usb_name="candle")


def judge(link: LinkFacts | None, adapter: AdapterFacts = GS_USB) -> dict[str, Finding]:
    facts = InterfaceFacts(name="can0", link=link, adapter=adapter)
    return {finding.name: finding for check in (check_presence, check_link) for finding in check(facts)}


def judge_traffic(facts: TrafficFacts, adapter: AdapterFacts = GS_USB) -> dict[str, Finding]:
    interface = InterfaceFacts(name="can0", link=HEALTHY, adapter=adapter)
    return {finding.name: finding for finding in check_traffic(facts, interface, BUS)}


def test_a_healthy_interface() -> None:
    assert (
        LinkFacts(
            name="can0",
            kind="can",
            up=True,
            txqueuelen=128,
            bitrate=1_000_000,
            driver="gs_usb",
            state="ERROR-ACTIVE",
            restart_ms=100,
            tx_errors=0,
            rx_errors=0,
        )
        == HEALTHY
    )
    assert judge(HEALTHY) == {}


def test_error_passive_by_what_it_hears() -> None:
    found = judge(parse_link((DATA / "ip-link-error-passive.json").read_text()))
    assert list(found) == ["error-passive"]
    finding = found["error-passive"]
    assert finding.severity is Severity.PROBLEM
    assert "0 sending, 135 receiving" in finding.seen
    assert "terminator" in finding.means
    assert "60 ohm" in finding.do


def test_error_passive_by_what_it_sends() -> None:
    found = judge(replace(HEALTHY, state="ERROR-PASSIVE", tx_errors=128))
    assert "not acknowledged" in found["error-passive"].means


def test_bus_off_with_no_restart_and_a_short_queue() -> None:
    found = judge(parse_link((DATA / "ip-link-bus-off.json").read_text()))
    assert list(found) == ["txqueuelen-small", "no-restart", "bus-off"]
    assert "248 sending" in found["bus-off"].seen
    assert "bitrate 250000 restart-ms 100" in found["no-restart"].do
    assert "ENOBUFS" in found["txqueuelen-small"].means
    assert "txqueuelen 128" in found["txqueuelen-small"].do


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"state": "ERROR-WARNING", "rx_errors": 97}, "error-warning"),
        ({"modes": ("LISTEN-ONLY",)}, "listen-only"),
        ({"modes": ("ONE-SHOT",)}, "one-shot"),
        ({"bitrate": 800_000}, "bitrate-unusual"),
        ({"bus_offs": 2}, "was-bus-off"),
        ({"rx_overruns": 9}, "adapter-overruns"),
        ({"txqueuelen": 2500}, "txqueuelen-large"),
        ({"txqueuelen": 10}, "txqueuelen-small"),
        ({"up": False}, "interface-down"),
        ({"kind": ""}, "not-can"),
    ],
)
def test_each_setting_and_counter(change: dict[str, object], name: str) -> None:
    assert list(judge(replace(HEALTHY, **change))) == [name]  # type: ignore[arg-type]


def test_a_long_queue_is_told_in_milliseconds() -> None:
    assert "325 ms" in judge(replace(HEALTHY, txqueuelen=2500))["txqueuelen-large"].means


@pytest.mark.parametrize(
    ("driver", "release", "count"),
    [
        ("gs_usb", "6.1.0-rpi7-rpi-v8", 1),
        ("gs_usb", "5.15.0-91-generic", 1),
        ("gs_usb", "6.6.0", 0),
        ("gs_usb", "6.12.47+rpt-rpi-v8", 0),
        ("gs_usb", "10.0", 0),
        ("gs_usb", "no version", 0),
        ("mcp251xfd", "5.15.0", 0),
    ],
)
def test_kernels_known_to_reorder(driver: str, release: str, count: int) -> None:
    assert len(faults_of(driver, release)) == count
    found = judge(HEALTHY, AdapterFacts(kernel=release, driver=driver))
    assert list(found) == ["kernel-reorders"] * count
    if count:
        assert "24bc41b45583" in found["kernel-reorders"].means


def test_kernel_versions() -> None:
    assert kernel_version("6.10.3-arch1") == (6, 10)
    assert kernel_version("") is None


def test_an_adapter_is_read_from_sys(tmp_path: Path) -> None:
    usb = tmp_path / "devices" / "1-1"
    (usb / "1-1:1.0").mkdir(parents=True)
    for name, text in (("idVendor", "1d50\n"), ("idProduct", "606f\n"), ("product", "candleLight USB\n")):
        (usb / name).write_text(text)
    (tmp_path / "drivers" / "gs_usb").mkdir(parents=True)
    (usb / "1-1:1.0" / "driver").symlink_to(tmp_path / "drivers" / "gs_usb")
    interface = tmp_path / "net" / "can0"
    interface.mkdir(parents=True)
    (interface / "device").symlink_to(usb / "1-1:1.0")
    found = read_adapter(interface)
    assert (found.driver, found.usb_id, found.usb_name) == ("gs_usb", (0x1D50, 0x606F), "candleLight USB")
    assert found.kernel


def test_invalid_bytes_name_the_adapter_and_acquit_the_wiring() -> None:
    way = DirectionFacts(nodeid=5, to_blocks=900, invalid_bytes=40, repeated_blocks=0, naks=0)
    means = judge_traffic(TrafficFacts(listened_s=3.0, nodes=(way,)))["bytes-invalid"].means
    assert "candleLight firmware before 2.0" in means
    assert "Bad wiring does not do that" in means
    other = AdapterFacts(kernel="6.8", driver="peak_usb")
    assert (
        "peak_usb" in judge_traffic(TrafficFacts(listened_s=3.0, nodes=(way,)), other)["bytes-invalid"].means
    )


def test_repeats_and_slow_answers_of_another_host() -> None:
    way = DirectionFacts(
        nodeid=5,
        to_blocks=900,
        invalid_bytes=0,
        repeated_blocks=30,
        naks=4,
        rtt_median_s=0.001,
        rtt_p99_s=0.05,
    )
    found = judge_traffic(TrafficFacts(listened_s=3.0, nodes=(way,)))
    assert list(found) == ["bytes-retransmit", "round-trip-spread"]
    assert "50.0 ms" in found["round-trip-spread"].seen
    few = replace(way, repeated_blocks=1, rtt_p99_s=0.002)
    assert judge_traffic(TrafficFacts(listened_s=3.0, nodes=(few,))) == {}


def error(can_id: int, *data: int) -> Frame:
    return Frame(1.0, 0x2000_0000 | can_id, bytes(data).ljust(8, b"\0"), FrameKind.ERROR)


@pytest.mark.parametrize(
    ("frame", "kinds"),
    [
        (error(0x020), {"ack"}),
        (error(0x0A0), {"ack"}),
        (error(0x088, 0, 0, 0x02), {"form"}),
        (error(0x088, 0, 0, 0x04), {"stuff"}),
        (error(0x008, 0, 0, 0x10), {"bit"}),
        (error(0x040), {"bus off"}),
        (error(0x004, 0, 0x01), {"overflow"}),
        (error(0x004, 0, 0x10), {"other"}),
        (Frame(1.0, 0x2000_0008, b"", FrameKind.ERROR), {"other"}),
    ],
)
def test_error_frames_are_read(frame: Frame, kinds: set[str]) -> None:
    assert error_kinds(frame) == kinds


@pytest.mark.parametrize(
    ("errors", "frames", "name"),
    [
        ({"ack": 7}, 0, "nobody-acknowledges"),
        ({"stuff": 5, "form": 2}, 0, "only-damage"),
        ({"stuff": 5, "form": 2}, 100, "damaged-frames"),
        ({"bus off": 1}, 3, "went-bus-off"),
        ({"overflow": 2}, 3, "adapter-overflow"),
    ],
)
def test_error_reports(errors: dict[str, int], frames: int, name: str) -> None:
    facts = TrafficFacts(listened_s=3.0, frames=frames, errors=errors, error_reports=sum(errors.values()))
    assert list(judge_traffic(facts)) == [name]


def test_counters_that_grew_meanwhile() -> None:
    after = replace(HEALTHY, rx_dropped=5, bus_errors=3)
    facts = TrafficFacts(listened_s=3.0, before=HEALTHY, after=after)
    assert list(judge_traffic(facts)) == ["frames-dropped", "bus-errors"]
    assert judge_traffic(replace(facts, before=after)) == {}


@pytest.mark.parametrize("text", ["", "[]", "[{}]", "{", "[1]", json.dumps([{"ifname": "x", "linkinfo": 3}])])
def test_answers_of_ip_that_make_no_sense(text: str) -> None:
    with pytest.raises(CanductorError, match="cannot be read"):
        parse_link(text)


@pytest.mark.parametrize(("frames_per_s", "name"), [(100, None), (750, "bus-busy"), (1000, "bus-overloaded")])
def test_busy_and_too_busy(frames_per_s: int, name: str | None) -> None:
    meter = LoadMeter(bitrate=111_000)
    for i in range(frames_per_s):
        assert meter.feed(Frame(i / frames_per_s, 0x109, b"\x55" * 8)) == 111  # no stuff bit at all
    found = judge_traffic(TrafficFacts(listened_s=1.0, load=meter.load(), frames=frames_per_s))
    assert list(found) == ([] if name is None else [name])
    assert all("'from nodes'" in finding.seen for finding in found.values())


def test_a_node_that_counts_errors() -> None:
    firmware = Firmware(mcu="x", version="", app="", build="", clock_hz=None, bitrate=None)
    status = CanStatus(rx_errors=3, tx_errors=120, tx_retries=900, state="warn")
    entry = InventoryEntry(
        nodeid=5,
        uuid=Uuid.parse("90a4ae022dfc"),
        application=Application.KLIPPER,
        state=NodePresence.IDLE,
        facts=NodeInfo(firmware=firmware, can=status),
    )
    well = replace(entry, facts=NodeInfo(firmware=firmware, can=replace(status, tx_errors=0, state="active")))
    inventory = Inventory((entry, well), NodeDiscovery().result(), ())
    (finding,) = check_nodes(NodeFacts(inventory=inventory), BUS)
    assert finding.name == "node-can-errors"
    assert "120 sending, 900 retries, bus state warn" in finding.seen


@pytest.mark.parametrize(("lost", "severity"), [(1, Severity.WARNING), (5, Severity.PROBLEM)])
def test_lost_frames_by_their_number(lost: int, severity: Severity) -> None:
    ping = PingFacts(
        nodeid=4, asked=100, repeats=9, lost=lost, invalid_bytes=0, rtt_median_s=0.001, rtt_p99_s=0.002
    )
    anyone = InventoryEntry(nodeid=4, uuid=None, application=Application.KLIPPER, state=NodePresence.IDLE)
    inventory = Inventory((anyone,), NodeDiscovery().result(), ())
    (finding,) = check_nodes(NodeFacts(inventory=inventory, pings=(ping,)), BUS)
    assert (finding.name, finding.severity) == ("frames-lost", severity)
    slow = replace(ping, lost=0, rtt_p99_s=0.03)
    (finding,) = check_nodes(NodeFacts(inventory=inventory, pings=(slow,)), BUS)
    assert finding.name == "round-trip-spread"
