"""The dictionary that each node of a plan is checked against, without any node.

In this order: the file of ``--dictionary``; what the node at the same address had when it was last connected;
the pins of the chip that the comments of the configuration name; any name that is a pin of some chip. The
last two take commands and clock from canductor's own firmware, never its pins.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from coordinator.config.model import MachineDescription, NodeDescription
from coordinator.planning.options import PlanOptions
from nodes.dictionary.cache import DictionaryCache
from nodes.dictionary.dictionary import MAX_INFLATED_BYTES, Dictionary
from nodes.support.errors import CanductorError
from nodes.support.regular_file import read_regular
from nodes.virtual.firmware import MAINBOARD, TOOLHEAD, firmware_path

Ranges = Mapping[str, int]
"""By the first pin's name: how many follow, counted up."""


def _ports(letters: str, pins: int) -> dict[str, int]:
    return {f"P{letter}0": pins for letter in letters}


LINUX_PINS: Final = 256
FAMILIES: Final[Mapping[str, Ranges]] = {
    "stm32": _ports("ABCDEFGHIJK", 16),
    "gd32": _ports("ABCDEFGHI", 16),
    "n32": _ports("ABCDEFGHI", 16),
    "hc32": _ports("ABCDEH", 16),
    "rp2040": {"gpio0": 30},
    "rp2350": {"gpio0": 48},
    "atmega": _ports("ABCDEFGHJKL", 8),
    "at90": _ports("ABCDEF", 8),
    "lpc176": {f"P{port}.0": 32 for port in range(5)},
    "sam": _ports("ABCDE", 32),
    "linux": {
        "gpio0": LINUX_PINS,
        **{f"gpiochip{chip}/gpio0": LINUX_PINS for chip in range(10)},
        "analog0": 8,
        **{f"pwmchip{chip}/pwm0": 16 for chip in range(10)},
    },
    "pru": {f"gpio{chip}_0": 32 for chip in range(4)},
}
"""The pins of micro-controllers, by how the chip's name begins: their data sheets name the ports."""
ANYWHERE: Final[Ranges] = {"ADC_TEMPERATURE": 1}
CHIP: Final = re.compile(
    r"\b(stm32[a-z]\d{3}|gd32[a-z]\d{3}|n32[a-z]\d{3}|hc32[a-z]\d{3}|rp2040|rp2350|atmega\d+p?|at90usb\d+"
    r"|lpc176[\dx]|samd?[345cdes]\d+[a-z]?\d*)\w*",
    re.IGNORECASE,
)
COMPILED_FOR: Final = re.compile(
    r"compiled\s+(?:#\s*)?for\s+(?:#\s*)?(?:the|an?)?\s*(.{0,60})", re.IGNORECASE
)
I2C_BUSES: Final = (
    *("i2c1", "i2c2", "i2c2a", "i2c3", "i2c3a", "twi", "i2c.0"),
    *(f"i2c{block}{letter}" for block in "01" for letter in "abcdefgh"),
    *("i2c1_PA9_PA10", "i2c1_PB6_PB7", "i2c1_PB8_PB7", "i2c1_PB8_PB9", "i2c1_PF1_PF0", "i2c2_PA7_PA6"),
    *("i2c2_PB10_PB11", "i2c2_PB13_PB14", "i2c2_PF1_PF0", "i2c3_PA7_PA6", "i2c3_PA8_PC9", "i2c3_PB3_PB4"),
    *("i2c3_PC0_PC1",),
)
"""Names of buses that a board of any family may have."""


@dataclass(frozen=True, slots=True)
class NodeDictionary:
    """What a node of a plan is taken to be."""

    dictionary: Dictionary
    chip: str
    """Constant MCU, or the chip named in the configuration; may be empty."""
    notice: str = ""
    """What was not checked, as a sentence."""


def node_dictionaries(
    description: MachineDescription, options: PlanOptions, cache: DictionaryCache
) -> dict[str, NodeDictionary]:
    """Return the dictionary of each node; raises CanductorError for an option that fits none."""
    names = [node.name for node in description.nodes]
    for name in options.dictionaries:
        if name not in names:
            raise CanductorError(
                f"--dictionary {name}: the machine has no such node; it has {', '.join(names)}"
            )
    chip = named_chip(options.config.read_text(encoding="utf-8", errors="replace"))
    return {
        node.name: _of_node(
            node, options, cache, chip if node is description.nodes[0] else "", primary=not at
        )
        for at, node in enumerate(description.nodes)
    }


def _of_node(
    node: NodeDescription, options: PlanOptions, cache: DictionaryCache, chip: str, *, primary: bool
) -> NodeDictionary:
    known = None
    if node.name in options.dictionaries:
        known = _read_dictionary(options.dictionaries[node.name])
    else:
        known = cache.of_node(node.connection.address)
    if known is not None:
        return NodeDictionary(known, known.str_constant("MCU", ""))
    build = MAINBOARD if primary else TOOLHEAD
    cure = f"connect it once with canductor run, or name its dictionary with --dictionary {node.name}=FILE"
    family = next((f for f in FAMILIES if chip.startswith(f)), None)
    if family is not None:
        return NodeDictionary(
            _with_pins(build, {**FAMILIES[family], **ANYWHERE}),
            chip,
            f"node {node.name}: its pins were checked against those of the {chip} that the configuration's "
            f"comments name, its clock and commands are assumed; {cure}",
        )
    return NodeDictionary(
        _with_pins(build, _any_pin()),
        "",
        f"node {node.name}: its chip is not known, so only the form of its pins' names was checked, and its "
        f"clock and commands are assumed; {cure}",
    )


def named_chip(configuration: str) -> str:
    """Return the chip that the comments of a CONFIGURATION say the firmware is compiled for, or ""."""
    comments = " ".join(line for line in configuration.splitlines() if line.lstrip().startswith(("#", ";")))
    for sentence in COMPILED_FOR.finditer(comments):
        if found := CHIP.search(sentence[1]):
            return found[0].lower()
    return ""


def _any_pin() -> Ranges:
    """Return ranges that have every pin of every family once."""
    widest: dict[str, int] = dict(ANYWHERE)
    for ranges in FAMILIES.values():
        for first, count in ranges.items():
            widest[first] = max(widest.get(first, 0), count)
    return widest


def _with_pins(build: str, pins: Ranges) -> Dictionary:
    """Return the dictionary of canductor's firmware with other PINS."""
    path = firmware_path(build).with_suffix(".json")
    try:
        content: dict[str, Any] = json.loads(path.read_bytes())
    except OSError as error:
        raise CanductorError(
            f"the dictionary of {build} cannot be read ({error.strerror}); install the project again"
        ) from None
    # Only the names matter: each port is counted from 0, for the numbers of pins are bytes.
    content["enumerations"]["pin"] = {first: [0, count] for first, count in pins.items()}
    content["enumerations"]["i2c_bus"] = {name: number for number, name in enumerate(I2C_BUSES)}
    return Dictionary.from_json(json.dumps(content).encode())


def _read_dictionary(path: Path) -> Dictionary:
    try:
        text = read_regular(path, MAX_INFLATED_BYTES + 1)
    except OSError as error:
        raise CanductorError(f"cannot read the dictionary {path}: {error.strerror}; check the path") from None
    try:
        dictionary = Dictionary.from_json(text)
        dictionary.check_constants()
    except CanductorError as error:
        raise CanductorError(f"{path}: {error}") from None
    return dictionary
