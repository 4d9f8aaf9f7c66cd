import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator.config.errors import ConfigError, Place
from coordinator.config.options import BadValue
from coordinator.config.pins import PinDescription, PinName, PinOption

INPUT = PinOption(name="pin", help="an input", pullable=True)
NODE = st.sampled_from(["mcu", "tool-head", "z_1"])
NAME = st.sampled_from(["PA3", "gpiochip0/gpio5", "P1.23", "ar54"])


@pytest.mark.parametrize(
    ("text", "pin"),
    [
        ("PA3", PinName("mcu", "PA3")),
        ("!^PA3", PinName("mcu", "PA3", invert=True, pull=1)),
        ("~toolhead:PA3", PinName("toolhead", "PA3", pull=-1)),
        ("toolhead:!PA3", PinName("toolhead", "PA3", invert=True)),
        ("^ toolhead : ! PA3", PinName("toolhead", "PA3", invert=True, pull=1)),
        ("gpiochip0/gpio5", PinName("mcu", "gpiochip0/gpio5")),
    ],
)
def test_pins_are_read(text: str, pin: PinName) -> None:
    assert INPUT.parse(text) == pin


@pytest.mark.parametrize(
    "text", ["", "!", "a:b:c", ":PA3", "^~PA3", "!!PA3", "^toolhead:^PA3", "P A", "PÄ3", "P" * 101]
)
def test_other_texts_are_not_pins(text: str) -> None:
    with pytest.raises(BadValue):
        INPUT.parse(text)


@given(NODE, NAME, st.booleans(), st.sampled_from([-1, 0, 1]))
def test_what_is_written_is_read(node: str, name: str, invert: bool, pull: int) -> None:
    text = "!" * invert + {-1: "~", 0: "", 1: "^"}[pull] + f"{node}:{name}"
    assert INPUT.parse(text) == PinName(node, name, invert, pull)


def test_marks_that_make_no_sense_are_refused() -> None:
    plain = PinOption(name="pin", help="neither", invertible=False)
    with pytest.raises(BadValue, match=r"cannot be inverted; remove the !"):
        plain.parse("!PA3")
    with pytest.raises(BadValue, match=r"is an output; remove the \^ or ~"):
        plain.parse("~PA3")


def test_the_dictionary_knows_the_number() -> None:
    pin = PinDescription("mcu", "PF13", False, 0, "'step_pin' of [stepper_x]", Place("printer.cfg", 14))
    assert pin.number({"PF12": 92, "PF13": 93}) == 93
    with pytest.raises(ConfigError) as error:
        pin.number({"PF12": 92})
    assert str(error.value) == (
        "printer.cfg:14: 'step_pin' of [stepper_x]: node 'mcu' has no pin 'PF13'; did you mean PF12?"
    )
