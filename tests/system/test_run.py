"""``canductor run`` on nodes that outlive it: files, typed commands, one job after the other."""

import pytest

from tests.stages.processes import (
    END_S,
    SQUARE,
    Command,
    Ended,
    Hardware,
    canductor,
    write_config,
    write_gcode,
)


def steps(ended: Ended) -> dict[str, int]:
    """Return what each stepper moved by, when all went well."""
    assert ended.status == 0, ended
    assert all(line.startswith("printing ") for line in ended.stderr.splitlines()), "only progress"
    report = ended.json
    assert report["ok"] is True
    for stepper in report["steppers"].values():
        assert stepper["steps_moved"] == stepper["steps_sent"]
    return {name: stepper["steps_moved"] for name, stepper in report["steppers"].items()}


def test_a_file_is_printed_and_every_node_counts_what_it_was_sent(machine: Hardware) -> None:
    gcode = write_gcode(machine.folder, SQUARE)
    ended = canductor("run", machine.config, "--gcode", gcode, "--json")
    moved = steps(ended)
    assert (moved["stepper_x"], moved["stepper_y"], moved["stepper_z"]) == (8000, -1600, 240)
    assert moved["extruder"] > 2000
    assert all(node["min_lead_ms"] > 0 for node in ended.json["nodes"].values())
    assert not any(node["is_shutdown"] for node in machine.stop())


def test_the_next_job_finds_the_same_nodes_configured(machine: Hardware) -> None:
    gcode = write_gcode(machine.folder, SQUARE)
    first, second = (canductor("run", machine.config, "--gcode", gcode, "--json") for _ in range(2))
    assert steps(first) == steps(second)


def test_a_job_with_another_configuration_configures_the_nodes_anew(machine: Hardware) -> None:
    gcode = write_gcode(machine.folder, SQUARE)
    first = canductor("run", machine.config, "--gcode", gcode, "--json")
    finer = write_config(machine.folder, name="finer.cfg", **{"step_pin: PB0": "step_pin: PB6"})
    second = canductor("run", finer, "--gcode", gcode, "--json")
    assert steps(first) == steps(second)


@pytest.mark.parametrize("shutdown", ["M112", "kill"])
def test_a_new_job_works_after_an_emergency_stop(machine: Hardware, shutdown: str) -> None:
    with Command("run", machine.config) as command:
        command.type("G28", "G1 X50 F3000")
        command.stdout.wait_for("already home")
        if shutdown == "M112":
            command.type("M112")
        else:
            command.process.terminate()
        assert command.process.wait(END_S) in (1, 143)
    gcode = write_gcode(machine.folder, SQUARE)
    assert steps(canductor("run", machine.config, "--gcode", gcode, "--json"))["stepper_x"] == 8000


def test_typed_commands_are_answered_as_they_come(machine: Hardware) -> None:
    with Command("run", machine.config, "--json") as command:
        command.type("G28", "G1 X10 Y5 F6000", "M400", "M114")
        command.stdout.wait_for("X:10.00")
        command.type("G91", "G1 X5", "G92 X100", "M114")
        command.stdout.wait_for("X:100.00")
        command.type("G90", "G1 X105", "G4 P200", "G1 Z1 F600", "G28", "M114")
        command.stdout.wait_for("X:0.00")
        command.type("G1 X2 F3000", "M400", "M114")
        command.stdout.wait_for("X:2.00")
        moved = steps(command.end())
    # What G28 declares moves nothing: 20 + 5 mm of corexy, 160 steps per mm; then 2 mm.
    assert moved["stepper_x"] == (20 + 5 + 2) * 160
    assert moved["stepper_y"] == (20 - 5 + 2) * 160
    assert moved["stepper_z"] == 400


def test_a_pause_in_typing_lets_the_machine_stand_and_start_again(machine: Hardware) -> None:
    """The clocks are followed meanwhile, or the next steps were late."""
    with Command("run", machine.config, "--json") as command:
        command.type("G28", "G1 X10 F6000", "M400", "M114")
        command.stdout.wait_for("X:10.00")
        with pytest.raises(AssertionError):
            command.stdout.wait_for("nobody types", limit_s=4.0)
        command.type("G1 X20 Z0.5 E1", "M400", "M114")
        command.stdout.wait_for("X:20.00")
        ended = command.end()
    moved = steps(ended)
    assert (moved["stepper_x"], moved["stepper_z"]) == (20 * 160, 200)
    for name, node in ended.json["nodes"].items():
        assert node["min_lead_ms"] > 0, name
        assert node["clock_error_us"] < 2000, name  # tens, on a computer that is not busy


def test_one_long_move_is_sent_piece_by_piece(machine: Hardware) -> None:
    """All of half a minute's motion is read at once, but not all is at the nodes when the user ends it."""
    with Command("run", machine.config) as command:
        command.type("G28", "G1 X30 F60")
        command.stdout.wait_for("already home")
        command.type("M114")
        command.stdout.wait_for("X:30.00")
        command.process.terminate()
        ended = command.end()
    ended.sentence(143)
    counters = machine.stop("mcu")[0]
    assert counters["is_shutdown"]
    assert counters["edges"] < 1000  # of 4800 per motor: those still queued were dropped
