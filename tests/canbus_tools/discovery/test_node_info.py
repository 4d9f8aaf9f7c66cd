"""What is made of a node's answers, also of strange ones; without a bus."""

import json

import pytest

from canbus_tools.discovery import node_info
from canbus_tools.discovery.node_info import CanStatus, Firmware
from nodes.dictionary.dictionary import BOOTSTRAP, Dictionary
from nodes.dictionary.message_format import Message, Value
from nodes.virtual.firmware import MAINBOARD, firmware_dictionary

WORDS = firmware_dictionary(MAINBOARD)
UUID = bytes.fromhex("90a4ae022dfc")


def test_a_dictionary_that_says_nothing_says_nothing_of_the_board() -> None:
    empty = Firmware(mcu="", version="", app="", build="", clock_hz=None, bitrate=None)
    assert Firmware.of(BOOTSTRAP) == empty


@pytest.mark.parametrize(
    "config", [{"MCU": 3, "CLOCK_FREQ": "fast"}, {"MCU": 1.5, "CLOCK_FREQ": 0, "CANBUS_FREQUENCY": -1}]
)
def test_constants_of_a_wrong_kind_are_as_if_missing(config: dict[str, object]) -> None:
    said = Firmware.of(Dictionary.from_json(json.dumps({"config": config}).encode()))
    assert (said.mcu, said.clock_hz, said.bitrate) == ("", None, None)


def test_a_clock_in_two_words_is_an_uptime_also_beyond_its_rollover() -> None:
    def uptime(high: int, clock: int) -> float | None:
        return node_info._uptime_s(Message("uptime", {"high": high, "clock": clock}), 1_000_000)

    assert uptime(0, 2_500_000) == 2.5
    assert uptime(0, 0xFFFFFFFF) == 4294.967295
    assert uptime(1, 0) == 4294.967296
    assert node_info._uptime_s(Message("uptime", {"high": 0}), 1_000_000) is None
    assert node_info._uptime_s(Message("uptime", {"high": 0, "clock": 1}), None) is None
    assert node_info._uptime_s(None, 1_000_000) is None


@pytest.mark.parametrize(
    ("state", "name"), [(0, "active"), (1, "warn"), (2, "passive"), (3, "off"), (9, "?9")]
)
def test_the_state_of_a_controller_by_its_name(state: int, name: str) -> None:
    params: dict[str, Value] = {"rx_error": 1, "tx_error": 2, "tx_retries": 3, "canbus_bus_state": state}
    said = node_info._status(Message("canbus_status", params), WORDS)
    assert said == CanStatus(rx_errors=1, tx_errors=2, tx_retries=3, state=name)
    del params["tx_error"]
    assert node_info._status(Message("canbus_status", params), WORDS) is None


@pytest.mark.parametrize("value", [UUID[:5], UUID + b"x", b"", 7])
def test_a_uuid_of_a_wrong_size_is_none(value: Value) -> None:
    assert node_info._uuid(Message("canbus_id", {"canbus_uuid": value})) is None
    assert str(node_info._uuid(Message("canbus_id", {"canbus_uuid": UUID}))) == "90a4ae022dfc"
