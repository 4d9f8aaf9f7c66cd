"""``canductor demo`` and ``canductor run`` as a user calls them."""

import os
import signal
import subprocess
from pathlib import Path

from tests.stages.processes import (
    CANDUCTOR,
    END_S,
    ROOT,
    SLOW,
    Hardware,
    canductor,
    write_config,
    write_gcode,
)


def test_the_demo_is_proved(tmp_path: Path) -> None:
    ended = canductor("demo", "--json", "--no-web", "--gcode", write_gcode(tmp_path, SLOW))
    assert ended.status == 0, ended
    report = ended.json
    assert report["ok"] is True
    assert report["steps"] == report["steps_planned"] > 1_000
    assert set(report["place_error_um"]) == set("xyz")
    assert report["frames_lost"] == 0


def test_a_file_is_printed(machine: Hardware, tmp_path: Path) -> None:
    ended = canductor("run", machine.config, "--gcode", write_gcode(tmp_path, SLOW), "--json")
    assert ended.status == 0, ended
    assert all(line.startswith("printing ") for line in ended.stderr.splitlines()), "only progress"
    moved = {name: stepper["steps_moved"] for name, stepper in ended.json["steppers"].items()}
    assert (moved["stepper_x"], moved["stepper_y"], moved["stepper_z"]) == (1440, 160, 240)
    assert set(ended.json["nodes"]) == {"mcu", "toolhead", "zboard"}


def test_lines_typed_at_a_terminal(machine: Hardware) -> None:
    ours, theirs = os.openpty()
    with subprocess.Popen(
        [*CANDUCTOR, "run", str(machine.config), "--name", "typed"],
        cwd=ROOT,
        stdin=theirs,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as command:
        os.close(theirs)
        assert command.stdout is not None
        assert "typed.sock" in command.stdout.readline()
        line = ""
        for line in command.stdout:
            if line == "ready\n":
                os.write(ours, b"G28\nG4 P1500\nG1 X2 F300\nG1 X9999\nM114\n")
            if line.startswith("X:"):
                break
        assert line == "X:2.000 Y:0.000 Z:0.000 E:0.000\n"
        command.send_signal(signal.SIGINT)
        said, failed = command.communicate(timeout=END_S)
        os.close(ours)
    assert "Traceback" not in said + failed
    assert command.returncode in (0, 130), (said, failed)


def test_a_broken_configuration_is_one_sentence(tmp_path: Path) -> None:
    config = write_config(tmp_path, **{"microsteps: 32": "microstep: 32"})
    lines = config.read_text(encoding="utf-8").splitlines()
    number = next(number for number, line in enumerate(lines, 1) if "microstep: 32" in line)
    ended = canductor("run", config, "--gcode", write_gcode(tmp_path, SLOW), "--json")
    sentence = ended.sentence()
    assert sentence.startswith(f"{config}:{number}: ")
    assert "microstep" in sentence
    assert ended.json == {"ok": False, "error": sentence}
