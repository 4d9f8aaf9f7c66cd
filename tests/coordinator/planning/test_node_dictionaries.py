"""What the pins of a plan are checked against, when no node is there to be asked."""

import json
import zlib
from pathlib import Path

import pytest

from coordinator.config.errors import ConfigError
from coordinator.planning.node_dictionaries import named_chip
from coordinator.planning.options import PlanOptions
from coordinator.planning.plan import plan_file
from coordinator.planning.report import PlanReport
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.dictionary import Dictionary
from nodes.node.config import NodeConfigError
from nodes.support.errors import CanductorError
from nodes.virtual.firmware import MAINBOARD, firmware_path

MACHINE = (Path(__file__).parents[3] / "config" / "cartesian_uart.cfg").read_text(encoding="utf-8")


def planned(
    folder: Path,
    config: str,
    cache: DictionaryCache | None = None,
    dictionaries: dict[str, Path] | None = None,
) -> PlanReport:
    (folder / "printer.cfg").write_text(config, encoding="utf-8")
    (folder / "move.gcode").write_text("G28\nG1 X10 F6000\n", encoding="utf-8")
    machine, program = folder / "printer.cfg", folder / "move.gcode"
    options = PlanOptions(config=machine, gcode=program, dictionaries=dictionaries or {})
    return plan_file(options, cache=cache or DictionaryCache(folder / "cache"))


def with_step_pin(name: str) -> str:
    lines = MACHINE.splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("step_pin"))
    lines[at] = f"step_pin: {name}"
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("comment", "chip"),
    [
        ("# the firmware should be compiled for the\n# STM32F407 with a bootloader", "stm32f407"),
        ("# firmware should be compiled for the AVR atmega2560.", "atmega2560"),
        ("# compiled for the Raspberry Pi RP2040", "rp2040"),
        ("# compiled for the LPC176x.", "lpc176x"),
        ("# this board has an STM32F103", ""),
        ("[mcu]\nserial: /dev/serial/by-id/usb_compiled for the rp2040", ""),
    ],
)  # fmt: skip
def test_the_chip_is_the_one_that_a_comment_names(comment: str, chip: str) -> None:
    assert named_chip(comment) == chip


@pytest.mark.parametrize("pin", ["gpio29", "P1.26", "PL7", "PK9", "gpiochip1/gpio3"])
def test_without_a_dictionary_only_the_form_of_a_pin_is_checked_and_a_notice_says_so(
    tmp_path: Path, pin: str
) -> None:
    report = planned(tmp_path, with_step_pin(pin))
    (notice,) = [text for text in report.notices if text.startswith("node mcu:")]
    assert "only the form of its pins' names was checked" in notice
    assert "--dictionary mcu=FILE" in notice


def test_what_is_no_pin_of_any_chip_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="node 'mcu' has no pin 'PX1'"):
        planned(tmp_path, with_step_pin("PX1"))


def test_an_i2c_bus_is_one_that_some_board_has(tmp_path: Path) -> None:
    eddy = "\n[probe_eddy_current coil]\nsensor_type: ldc1612\ni2c_bus: {}\n"
    planned(tmp_path, MACHINE + eddy.format("i2c1_PB6_PB7"))
    with pytest.raises(NodeConfigError, match=r"has no I2C bus 'i2c9'; it has i2c1, .*: correct i2c_bus"):
        planned(tmp_path, MACHINE + eddy.format("i2c9"))


def test_a_chip_named_in_a_comment_has_its_own_pins(tmp_path: Path) -> None:
    comment = "# The firmware should be compiled for the STM32F446.\n"
    report = planned(tmp_path, comment + with_step_pin("PA15"))
    assert any("those of the stm32f446" in text for text in report.notices)
    with pytest.raises(ConfigError, match="has no pin 'gpio29'"):
        planned(tmp_path, comment + with_step_pin("gpio29"))


def test_a_node_that_was_connected_once_has_the_pins_of_its_dictionary(tmp_path: Path) -> None:
    content = json.loads(firmware_path(MAINBOARD).with_suffix(".json").read_bytes())
    content["enumerations"]["pin"] = {"PA0": [0, 16], "PB0": [16, 16], "PC0": [32, 16], "odd7": 99}
    content["enumerations"]["pin"] |= {f"P{port}0": [at * 16 + 200, 16] for at, port in enumerate("DEFG")}
    content["config"]["CLOCK_FREQ"] = 48_000_000
    compressed = zlib.compress(json.dumps(content).encode())
    cache = DictionaryCache(tmp_path / "cache")
    dictionary = Dictionary.parse(compressed)
    cache.store(compressed, dictionary)
    address = "serial " + next(
        line.split(":", 1)[1].split("#")[0].strip()
        for line in MACHINE.splitlines()
        if line.startswith("serial")
    )
    cache.remember(address, dictionary)
    again = DictionaryCache(tmp_path / "cache")
    found = again.of_node(address)
    assert found is not None
    assert found.clock_freq_hz == 48_000_000
    assert again.of_node("serial /dev/other") is None
    report = planned(tmp_path, with_step_pin("odd7"), again)
    assert not any(text.startswith("node mcu:") for text in report.notices)
    with pytest.raises(ConfigError, match="has no pin 'PH3'"):
        planned(tmp_path, with_step_pin("PH3"), again)


def test_a_dictionary_with_a_constant_that_cannot_be_is_refused_by_its_file(tmp_path: Path) -> None:
    content = json.loads(firmware_path(MAINBOARD).with_suffix(".json").read_bytes())
    content["config"]["ADC_MAX"] = 0
    file = tmp_path / "odd.json"
    file.write_text(json.dumps(content))
    with pytest.raises(CanductorError, match=r"odd\.json: dictionary: constant ADC_MAX must be .* and is 0;"):
        planned(tmp_path, MACHINE, dictionaries={"mcu": file})


@pytest.mark.parametrize("content", [b"", b"[]", b"{broken", b'{"serial /dev/ttyS0": "0"}'])
def test_a_damaged_list_of_nodes_is_as_none(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "nodes.json").write_bytes(content)
    assert DictionaryCache(tmp_path).of_node("serial /dev/ttyS0") is None
