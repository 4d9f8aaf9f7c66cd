"""What is lost in the middle of a print, and who ends it: a clean stop, one sentence."""

import re
import signal

import pytest

from tests.stages.processes import LONG, Command, Ended, Hardware, write_config, write_gcode

MOVING = "taken as already home"
"""Said once the machine is ready and the job has begun."""
STOP_LIMIT_MS = 500
"""Most take a hundredth of it; but how late a busy computer gives a process its turn nobody knows."""


def printing(machine: Hardware, *words: str) -> Command:
    """Return a print that has begun."""
    command = Command("run", machine.config, "--gcode", write_gcode(machine.folder, LONG), *words)
    command.stdout.wait_for(MOVING)
    return command


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)], ids=["Ctrl-C", "SIGTERM"]
)
def test_a_start_ended_by_the_user_ends_at_once(
    machine: Hardware, number: signal.Signals, status: int
) -> None:
    machine.nodes["mcu"].kill()  # so that the start cannot come to its end before the signal
    config = write_config(machine.folder, name="more.cfg", **{"[fan]": "[bed_screws]\n\n[fan]"})
    with Command("run", config) as command:
        command.stdout.wait_for("not yet acting")
        command.signal(number)
        ended = command.end()
    assert ended.sentence(status).startswith("stopped by"), "not that a node is missing"


def check_others_stopped(ended: Ended, machine: Hardware, others: set[str]) -> None:
    """The others reported their shutdown in time, and are shut down."""
    delays = {name: int(ms) for name, ms in re.findall(r"(\w+) after (\d+) ms", ended.sentence())}
    assert set(delays) == others
    assert all(delay <= STOP_LIMIT_MS for delay in delays.values()), ended
    assert all(node["is_shutdown"] for node in machine.stop(*others))


@pytest.mark.parametrize("victim", ["mcu", "toolhead", "zboard"])
def test_a_node_killed_in_mid_print_stops_all_others(machine: Hardware, victim: str) -> None:
    with printing(machine, "--json") as command:
        machine.nodes[victim].kill()
        ended = command.end()
    assert ended.sentence().startswith(f"lost node {victim}: ")
    assert ended.json["ok"] is False
    assert ended.json["error"] == ended.sentence()
    check_others_stopped(ended, machine, {"mcu", "toolhead", "zboard"} - {victim})


def test_a_bus_that_ends_in_mid_print_stops_the_node_beside_it(machine: Hardware) -> None:
    with printing(machine) as command:
        machine.bus.kill()
        ended = command.end()
    assert str(machine.folder / "bus") in ended.sentence()
    check_others_stopped(ended, machine, {"zboard"})


def test_a_node_that_shuts_itself_down_stops_all_others(machine: Hardware) -> None:
    with Command("run", machine.config) as command:
        command.type("G28", "G1 X50 F600")
        command.stdout.wait_for(MOVING)
        command.type("M112")
        ended = command.end()
    assert "M112 stopped the machine" in ended.sentence()
    check_others_stopped(ended, machine, {"mcu", "toolhead", "zboard"})


@pytest.mark.parametrize(
    ("number", "status", "sentence"),
    [(signal.SIGINT, 130, "stopped by Ctrl-C"), (signal.SIGTERM, 143, "stopped by SIGTERM")],
)
def test_a_print_ended_by_the_user_leaves_all_nodes_shut_down(
    machine: Hardware, number: signal.Signals, status: int, sentence: str
) -> None:
    with printing(machine, "--json") as command:
        command.signal(number)
        ended = command.end()
    assert ended.sentence(status) == sentence
    assert ended.json == {"ok": False, "error": sentence}
    assert all(node["is_shutdown"] for node in machine.stop())


def test_an_impatient_user_changes_nothing(machine: Hardware) -> None:
    with printing(machine) as command:
        for _ in range(3):
            command.signal(signal.SIGINT)
        ended = command.end()
    assert ended.sentence(130) == "stopped by Ctrl-C"
    assert all(node["is_shutdown"] for node in machine.stop())
