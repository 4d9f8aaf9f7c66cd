"""``canductor run`` on nodes that outlive it: files, typed commands, one job after the other."""

import signal

import pytest

from tests.system.stage import SQUARE, Command, Hardware, canductor, write_config, write_gcode


def test_a_file_is_printed_and_every_node_counts_what_it_was_sent(machine: Hardware) -> None:
    gcode = write_gcode(machine.folder, SQUARE)
    ended = canductor("run", machine.config, "--gcode", gcode, "--json")
    assert ended.status == 0, ended
    report = ended.json
    assert report["ok"] is True
    assert report["steppers"]["stepper_x"] == {"steps_moved": 8000, "steps_sent": 8000}
    assert report["steppers"]["stepper_y"] == {"steps_moved": -1600, "steps_sent": -1600}
    assert report["steppers"]["stepper_z"] == {"steps_moved": 240, "steps_sent": 240}
    assert all(node["min_lead_ms"] > 0 for node in report["nodes"].values())
    assert not any(node["is_shutdown"] for node in machine.stop())


def test_the_next_job_finds_the_same_nodes_configured(machine: Hardware) -> None:
    gcode = write_gcode(machine.folder, SQUARE)
    first = canductor("run", machine.config, "--gcode", gcode, "--json")
    second = canductor("run", machine.config, "--gcode", gcode, "--json")
    assert (first.status, second.status) == (0, 0), (first, second)
    assert first.json["steppers"] == second.json["steppers"]
