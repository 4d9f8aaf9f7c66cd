"""A stop that another thread sent to the nodes keeps its cause, though their reports come first."""

import asyncio
from pathlib import Path

from tests.stages.heat_machine import HeatMachine


def test_the_cause_is_not_what_the_nodes_report(tmp_path: Path) -> None:
    stage = HeatMachine(tmp_path, "")

    async def main() -> None:
        machine = stage.machine
        machine.announced_stop = lambda: machine.stop("emergency stop by somebody")
        machine.stop_nodes()  # as the watchdog's thread does, whose call the loop has not come to yet
        await asyncio.sleep(1.0)
        assert str(machine.stopped) == "emergency stop by somebody"
        assert machine.announced_stop is None

    stage.connected(main)
