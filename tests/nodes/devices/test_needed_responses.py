"""A node whose responses lack what its devices read is refused when it is configured, not when it reports."""

import json
from collections.abc import Callable
from typing import Final

import pytest

from nodes.devices.analog_in import REPORT, REPORT_OF_ONE, AnalogIn
from nodes.devices.button import Button
from nodes.devices.counter import Counter
from nodes.devices.endstop import Endstop
from nodes.devices.hx71x import Hx71x
from nodes.devices.ldc1612 import Ldc1612
from nodes.devices.stepper import Stepper
from nodes.devices.tmcuart import TmcUart
from nodes.devices.trsync import Trsync
from nodes.dictionary.dictionary import Dictionary
from nodes.dictionary.parts import DictionaryError
from nodes.dictionary.vocabulary import check_vocabulary
from nodes.mt.table import AxleTable
from nodes.node.config import NodeConfig, NodeConfigError
from nodes.virtual.firmware import MAINBOARD, firmware_path
from tests.nodes.devices.machine import Configured

SOURCE: Final = json.loads(firmware_path(MAINBOARD).with_suffix(".json").read_text())
TEXTS: Final = {text.split(" ")[0]: text for text in SOURCE["responses"]}
BULK: Final = ("sensor_bulk_data", "sensor_bulk_status")
DEVICES: Final[dict[str, tuple[Callable[[], Configured], tuple[str, ...]]]] = {
    "analog_in": (lambda: AnalogIn("x", pin="PA1"), ("analog_in_state",)),
    "button": (lambda: Button("x", pin="PA1"), ("buttons_state",)),
    "counter": (lambda: Counter("x", pin="PA1"), ("counter_state",)),
    "endstop": (lambda: Endstop("x", pin="PA1", pull=0, invert=False), ("endstop_state",)),
    "hx71x": (
        lambda: Hx71x(
            "x", dout_pin="PA1", sclk_pin="PA2", pulses=1, rate=80, kept_s=1.0, sections=[(1, 0, 0, 0, 0)]
        ),
        (*BULK, "trigger_analog_state"),
    ),
    "ldc1612": (
        lambda: Ldc1612("x", bus="", address=0x2A, rate=400_000, clock_hz=12e6, max_sensor_hz=5e6),
        (*BULK, "i2c_response", "ldc1612_home_state"),
    ),
    "stepper": (lambda: Stepper("x", step_pin="PA1", dir_pin="PA2"), ("stepper_position",)),
    "table": (lambda: AxleTable("x", 1, 16), ("table_state", "table_active")),
    "tmcuart": (lambda: TmcUart("x", rx_pin="PA1", pull=0, tx_pin="PA1"), ("tmcuart_response",)),
    "trsync": (lambda: Trsync("x"), ("trsync_state",)),
}
NOT_READ: Final = (("sensor_bulk_status", "query_ticks"), ("counter_state", "next_clock"))


def with_response(name: str, text: str) -> Dictionary:
    """Return the dictionary of the firmware with TEXT as its response NAME."""
    responses = {text if known == TEXTS[name] else known: i for known, i in SOURCE["responses"].items()}
    return Dictionary.from_json(json.dumps(SOURCE | {"responses": responses}).encode())


def configure(device: Configured, dictionary: Dictionary) -> None:
    device.configure(NodeConfig("n1", dictionary))


@pytest.mark.parametrize("name", DEVICES)
def test_a_response_that_lacks_what_is_read_is_refused(name: str) -> None:
    """Failed before: each of its reports ended in a KeyError."""
    make, responses = DEVICES[name]
    configure(make(), with_response(responses[0], TEXTS[responses[0]]))
    for response in responses:
        words = TEXTS[response].split(" ")
        for at, word in enumerate(words[1:], 1):
            param, _, code = word.partition("=")
            if (response, param) in NOT_READ:
                continue
            other_kind = f"{param}=%u" if code.endswith("s") else f"{param}=%*s"
            for others in ([], [other_kind]):
                text = " ".join([*words[:at], *others, *words[at + 1 :]])
                with pytest.raises(NodeConfigError, match=f"x.* node n1: .* has no response '{response} "):
                    configure(make(), with_response(response, text))


def test_numbers_of_any_size_and_more_of_them_will_do() -> None:
    analog = AnalogIn("x", pin="PA1")
    for report in (REPORT, REPORT_OF_ONE, "analog_in_state oid=%u more=%i value=%c next_clock=%u last=%*s"):
        configure(analog, with_response("analog_in_state", report))


@pytest.mark.parametrize("response", ["sync_pulse seq=%c", "clock clock=%*s", "is_shutdown"])
def test_what_every_node_is_asked_is_checked_when_its_dictionary_is_read(response: str) -> None:
    name = response.split(" ", maxsplit=1)[0]
    check_vocabulary(with_response(name, TEXTS[name]))
    with pytest.raises(DictionaryError, match=f"has no response '{TEXTS[name]}' and cannot be driven"):
        check_vocabulary(with_response(name, response))
