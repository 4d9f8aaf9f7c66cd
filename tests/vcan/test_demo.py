"""``canductor demo --socketcan``: whole machines on the kernel's CAN and a pty, every step proved."""

from pathlib import Path
from typing import Any

import pytest

from coordinator.demo.proof import EDGE_TOLERANCE_S
from tests.stages.printer_text import DEMO_CFG
from tests.stages.processes import canductor, write_gcode
from tests.vcan.kernel import (
    INTERFACE,
    SECOND_INTERFACE,
    bad_wire,
    frames_sent,
    netem_dropped,
    why_no_netem,
    why_no_socketcan,
)

REASON = why_no_socketcan() or why_no_socketcan(SECOND_INTERFACE)
pytestmark = pytest.mark.skipif(bool(REASON), reason=REASON)
loses_frames = pytest.mark.skipif(bool(why_no_netem()), reason=why_no_netem())

SHORT = "G28\nG1 Z0.2 F600\nG1 X15 Y10 F6000\nG91\nM83\nG1 X-5 Y5 E0.5 F1800\n"
"""All steppers of the demo machine, two of them both ways; one second."""


def prove(folder: Path, gcode: str, *words: str) -> dict[str, Any]:
    """Run the demo and return its figures, having checked that its proof holds."""
    ended = canductor("demo", "--json", "--no-web", "--gcode", write_gcode(folder, gcode), *words)
    assert ended.status == 0, ended
    report = ended.json
    assert report["ok"] is True
    assert report["nodes"] == ["mcu", "toolhead", "zboard"]
    assert report["steps"] == report["steps_planned"] > 5_000
    assert report["position_error_steps"] == report["stray_edges"] == 0
    assert report["worst_band_error_us"] <= EDGE_TOLERANCE_S * 1e6
    assert report["min_lead_ms"] > 0
    assert report["frames_lost"] == 0  # of virtual buses
    return report


def test_two_nodes_on_one_interface_and_one_on_a_uart(tmp_path: Path) -> None:
    before = frames_sent(INTERFACE)
    report = prove(tmp_path, SHORT, "--socketcan", INTERFACE)
    assert report["frames"] == frames_sent(INTERFACE) - before > 300


def test_nodes_on_two_interfaces(tmp_path: Path) -> None:
    where = "[mcu toolhead]\ncanbus_uuid: 5e1ec7ab1e02\ncanbus_interface: can"
    assert f"{where}0" in DEMO_CFG
    machine = tmp_path / "machine.cfg"
    machine.write_text(DEMO_CFG.replace(f"{where}0", f"{where}1"))
    before = [frames_sent(name) for name in (INTERFACE, SECOND_INTERFACE)]
    report = prove(
        tmp_path,
        SHORT,
        *("--machine", str(machine)),
        *("--socketcan", f"can0={INTERFACE}", "--socketcan", f"can1={SECOND_INTERFACE}"),
    )
    frames = [frames_sent(name) for name in (INTERFACE, SECOND_INTERFACE)]
    of_each = [after - at_first for after, at_first in zip(frames, before, strict=True)]
    assert min(of_each) > 200
    assert report["frames"] == sum(of_each)


@loses_frames
def test_a_print_in_spite_of_lost_and_late_frames(tmp_path: Path) -> None:
    with bad_wire("loss 1%", "delay 1ms"):
        report = prove(tmp_path, SHORT, "--socketcan", INTERFACE)
        assert netem_dropped() > 0
    assert report["retransmitted_bytes"] > 0
    assert report["round_trip_us"]["mcu"] > 2_000


def test_what_cannot_be_is_said_in_a_sentence(tmp_path: Path) -> None:
    gcode = write_gcode(tmp_path, SHORT)

    def sentence(*words: str) -> str:
        return canductor("demo", "--no-web", "--gcode", gcode, *words).sentence()

    assert "vcan7: cannot open: there is no such interface" in sentence("--socketcan", "vcan7")
    assert "has no CAN bus 'can3'; it has can0" in sentence("--socketcan", f"can3={INTERFACE}")
