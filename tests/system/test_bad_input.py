"""Bad input through the command: one sentence that says where and what to do, exit status 1, no traceback."""

from pathlib import Path

import pytest

from tests.stages.garbage_node import GarbageNode
from tests.stages.processes import (
    MCU_UUID,
    SQUARE,
    TOOLHEAD_UUID,
    Hardware,
    canductor,
    write_config,
    write_gcode,
)


def words_for(command: str, config: Path, gcode: Path) -> list[str | Path]:
    match command:
        case "run":
            return ["run", config, "--gcode", gcode, "--json"]
        case "demo":
            return ["demo", "--machine", str(config), "--gcode", gcode, "--json", "--no-web"]
        case _:
            return ["plan", config, gcode, "--json"]


def failure(*words: str | Path) -> str:
    """Return the sentence of a command that fails, which its JSON must tell, too."""
    ended = canductor(*words)
    sentence = ended.sentence()
    assert ended.json == {"ok": False, "error": sentence}
    assert len(sentence) < 600
    return sentence


def line_of(path: Path, words: str) -> int:
    """Return the number of the first line with WORDS in it."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return next(number for number, line in enumerate(lines, 1) if words in line)


@pytest.mark.parametrize(
    ("command", "spoil", "at", "about"),
    [
        ("run", ("microsteps: 32", "microstep: 32"), "microstep: 32", "microstep"),
        ("demo", ("microsteps: 32", "microstep: 32"), "microstep: 32", "microstep"),
        ("run", ("[fan]", "[fun]"), "[fun]", "[fun]"),
        ("plan", ("[fan]", "[fun]"), "[fun]", "[fun]"),
        ("run", ("step_pin: PB3", ""), "[stepper_y]", "step_pin"),
        ("run", ("step_pin: toolhead:PA0", "step_pin: toolbed:PA0"), "toolbed", "toolbed"),
    ],
)
def test_a_spoilt_configuration(
    tmp_path: Path, command: str, spoil: tuple[str, str], at: str, about: str
) -> None:
    config = write_config(tmp_path, **dict([spoil]))
    sentence = failure(*words_for(command, config, write_gcode(tmp_path, SQUARE)))
    assert about in sentence
    assert sentence.startswith(f"{config}:{line_of(config, at)}: ")


def test_a_pin_that_the_board_does_not_have(machine: Hardware) -> None:
    config = write_config(machine.folder, **{"step_pin: PB0": "step_pin: PZ99"})
    sentence = failure("run", config, "--gcode", write_gcode(machine.folder, SQUARE), "--json")
    assert sentence.startswith(f"{config}:{line_of(config, 'PZ99')}: ")
    assert "PZ99" in sentence


@pytest.mark.parametrize(
    ("last", "about"),
    [("G1 X999 Y10", "999"), ("G1 X2", None), ("G1 X30 Y", "Y"), ("G1 X30 Y1.5.", "cut short")],
    ids=["outside the limits", "ends in a whole word", "ends after a letter", "ends within a number"],
)
def test_a_bad_last_line_is_told_after_what_came_before_it(
    machine: Hardware, last: str, about: str | None
) -> None:
    gcode = machine.folder / "job.gcode"
    gcode.write_bytes(b"G28\nG1 X20 F6000\n" + last.encode())
    ended = canductor("run", machine.config, "--gcode", gcode, "--json")
    counters = machine.stop()
    assert not any(node["is_shutdown"] for node in counters)
    assert counters[0]["edges"] >= 2 * 20 * 160  # both motors of the corexy have moved
    if about is None:
        assert ended.status == 0
        return
    sentence = ended.sentence()
    assert ended.json["error"] == sentence
    assert sentence.startswith(f"{gcode}:3: ")
    assert about in sentence


def test_the_demo_with_g_code_outside_the_limits(tmp_path: Path) -> None:
    gcode = write_gcode(tmp_path, "G28\nG1 X10 F6000\nG1 Z-7\n")
    assert failure("demo", "--gcode", gcode, "--json", "--no-web").startswith(f"{gcode}:3: ")


def test_a_wrong_uuid_is_told_with_those_that_wait(machine: Hardware) -> None:
    config = write_config(machine.folder, **{TOOLHEAD_UUID: "0123456789ab"})
    sentence = failure("run", config, "--gcode", write_gcode(machine.folder, SQUARE), "--json")
    assert "0123456789ab" in sentence
    assert TOOLHEAD_UUID in sentence


@pytest.mark.parametrize(
    ("interface", "about"),
    [
        ("virtual:/nowhere/bus", "no virtual CAN bus answers there"),
        ("can77", "can77"),
        ("virtual:", "machine.cfg:"),
        ("nosuchbackend:0", "nosuchbackend"),
    ],
)
def test_a_bus_that_is_not_there(tmp_path: Path, interface: str, about: str) -> None:
    config = write_config(tmp_path, **{f"virtual:{tmp_path / 'bus'}": interface})
    assert about in failure("run", config, "--gcode", write_gcode(tmp_path, SQUARE), "--json")


def test_a_serial_device_that_is_not_there(machine: Hardware) -> None:
    config = write_config(machine.folder, **{str(machine.folder / "zboard.tty"): "/dev/ttyNONE7"})
    sentence = failure("run", config, "--gcode", write_gcode(machine.folder, SQUARE), "--json")
    assert "/dev/ttyNONE7" in sentence
    assert "no such device" in sentence


def test_a_serial_device_where_nothing_answers(machine: Hardware) -> None:
    machine.nodes["zboard"].kill()
    sentence = failure("run", machine.config, "--gcode", write_gcode(machine.folder, SQUARE), "--json")
    assert "zboard" in sentence


def test_a_dictionary_that_is_garbage(machine: Hardware) -> None:
    with GarbageNode() as node:
        config = write_config(machine.folder, **{str(machine.folder / "zboard.tty"): node.path})
        sentence = failure("run", config, "--gcode", write_gcode(machine.folder, SQUARE), "--json")
    assert sentence.startswith("node zboard: ")
    assert "dictionary" in sentence


def test_a_board_that_plays_no_role_is_not_disturbed(machine: Hardware) -> None:
    """The good nodes of a machine that cannot start are left as they were."""
    config = write_config(machine.folder, **{MCU_UUID: "0123456789ab"})
    failure("run", config, "--gcode", write_gcode(machine.folder, SQUARE), "--json")
    assert not any(node["is_shutdown"] for node in machine.stop())
