"""Hosts and nodes that are killed by SIGKILL, and that stand still by SIGSTOP."""

import re
import signal

import pytest

from tests.sim.safety import real_host
from tests.stages.processes import LONG, Command, Hardware, write_gcode

MOVING = "taken as already home"
"""Printed once the machine is ready and the job has begun."""


@pytest.mark.parametrize(
    ("end", "told"),
    [(real_host.killed, "^$"), (real_host.stopped, "node toolhead shut down|lost node")],
    ids=["SIGKILL", "SIGSTOP"],
)
def test_without_its_host_a_node_switches_its_heater_off(end: real_host.End, told: str) -> None:
    row = real_host.row("a host that ends", end)  # raises when the heater stays on
    assert row.off_after_s > 0
    assert re.search(told, row.told), row


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["SIGKILL", "SIGSTOP"])
def test_without_a_node_all_others_stop(own_machine: Hardware, number: signal.Signals) -> None:
    gcode = write_gcode(own_machine.folder, LONG)
    with Command("run", own_machine.config, "--gcode", gcode, "--json") as command:
        command.stdout.wait_for(MOVING)
        own_machine.nodes["toolhead"].signal(number)
        ended = command.end()
    sentence = ended.sentence()
    assert sentence.startswith("lost node toolhead: ")
    assert ended.json == {"ok": False, "error": sentence}
    confirmed = set(re.findall(r"(\w+) after \d+ ms", sentence))
    for name in ("mcu", "zboard"):
        (counters,) = own_machine.stop(name)
        assert name in confirmed or counters["is_shutdown"], sentence
