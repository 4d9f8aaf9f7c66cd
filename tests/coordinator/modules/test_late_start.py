"""A host that is kept from its work just as a node becomes ready: what begins then begins in time."""

import asyncio
from pathlib import Path

import pytest

from nodes.devices.ticks import start_clock
from nodes.node.node import Node
from tests.stages.heat_machine import HOTEND_PID, HeatMachine

STALL_S = 0.9
"""Longer than what begins is ahead of the last answer to get_clock (half a second, and a sensor's period at
most), and shorter than a link's patience."""


def ready_at_ns(folder: Path, monkeypatch: pytest.MonkeyPatch) -> int:
    """Return when the node of the hotend's sensor is ready, on a host that has nothing else to do."""
    stage, ready_ns = HeatMachine(folder, HOTEND_PID), list[int]()

    def note(node: Node) -> int:
        ready_ns.append(stage.stage.now_ns())
        return start_clock(node)

    async def main() -> None:
        await asyncio.sleep(0)

    with monkeypatch.context() as patch:
        patch.setattr("nodes.devices.analog_in.start_clock", note)
        stage.connected(main)
    return ready_ns[0]


@pytest.mark.parametrize("before_us", [10, 100, 200])
def test_a_sensor_is_started_by_a_host_that_stood_still(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before_us: int
) -> None:
    """The answer that made the node ready has arrived by then, and waits for Python."""
    stall_ns = ready_at_ns(tmp_path, monkeypatch) - 1000 * before_us
    stage = HeatMachine(tmp_path, HOTEND_PID)
    stage.stage.call_at(stall_ns, lambda: stage.stage.stall(STALL_S, io=False))

    async def main() -> None:
        await asyncio.sleep(2.0)
        assert stage.machine.stopped is None
        assert stage.status("extruder")["temperature"] == pytest.approx(25, abs=1)

    stage.connected(main)
