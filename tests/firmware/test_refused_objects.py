"""A command that is refused makes no object: for a pin or number that cannot be, or an oid in use."""

import pytest

from tests.firmware.host import Host

NEW, TAKEN, I2C, STEPPER, FILTER = 0, 1, 2, 3, 7
THERE = (
    f"config_trsync oid={TAKEN}",
    f"config_i2c oid={I2C}",
    f"config_sos_filter oid={FILTER} max_sections=1",
    f"config_stepper oid={STEPPER} step_pin=3 dir_pin=4 invert_step=0 step_pulse_ticks=0",
)
NO_PIN = 250
GOOD = {
    "config_analog_in": "pin=50",
    "config_buttons": "button_count=1",
    "config_counter": "pin=70 pull_up=1",
    "config_digital_out": "pin=10 value=0 default_value=0 max_duration=0",
    "config_endstop": "pin=60 pull_up=1",
    "config_hx71x": "gain_channel=1 dout_pin=37 sclk_pin=38",
    "config_i2c": "",
    "config_ldc1612": f"i2c_oid={I2C}",
    "config_ldc1612_with_intb": f"i2c_oid={I2C} intb_pin=38",
    "config_pwm_out": "pin=40 cycle_ticks=1000 value=0 default_value=0 max_duration=0",
    "config_sos_filter": "max_sections=16",
    "config_stepper": "step_pin=5 dir_pin=6 invert_step=0 step_pulse_ticks=0",
    "config_table": f"axle=1 capacity=8 stepper_oid={STEPPER}",
    "config_table_register": "",
    "config_tmcuart": "rx_pin=71 pull_up=1 tx_pin=72 bit_time=400",
    "config_trigger_analog": f"sos_filter_oid={FILTER}",
    "config_trsync": "",
}
"""Every command that makes an object, and how it does."""
BAD = {
    "config_analog_in": (f"pin={NO_PIN}",),
    "config_buttons": ("button_count=9",),
    "config_counter": (f"pin={NO_PIN} pull_up=1",),
    "config_digital_out": (f"pin={NO_PIN} value=0 default_value=0 max_duration=0",),
    "config_endstop": (f"pin={NO_PIN} pull_up=1",),
    "config_hx71x": (
        "gain_channel=0 dout_pin=37 sclk_pin=38",
        "gain_channel=5 dout_pin=37 sclk_pin=38",
        f"gain_channel=1 dout_pin={NO_PIN} sclk_pin=38",
        f"gain_channel=1 dout_pin=37 sclk_pin={NO_PIN}",
    ),
    "config_ldc1612": (f"i2c_oid={TAKEN}",),
    "config_ldc1612_with_intb": (f"i2c_oid={I2C} intb_pin={NO_PIN}", f"i2c_oid={TAKEN} intb_pin=38"),
    "config_pwm_out": (f"pin={NO_PIN} cycle_ticks=1000 value=0 default_value=0 max_duration=0",),
    "config_sos_filter": ("max_sections=17",),
    "config_stepper": (
        f"step_pin={NO_PIN} dir_pin=6 invert_step=0 step_pulse_ticks=0",
        f"step_pin=5 dir_pin={NO_PIN} invert_step=0 step_pulse_ticks=0",
    ),
    "config_table": (
        f"axle=0 capacity=8 stepper_oid={STEPPER}",
        f"axle=1 capacity=0 stepper_oid={STEPPER}",
        f"axle=1 capacity=65535 stepper_oid={STEPPER}",
        f"axle=1 capacity=8 stepper_oid={TAKEN}",
    ),
    "config_tmcuart": (
        "rx_pin=71 pull_up=1 tx_pin=72 bit_time=1",
        f"rx_pin={NO_PIN} pull_up=1 tx_pin=72 bit_time=400",
        f"rx_pin=71 pull_up=1 tx_pin={NO_PIN} bit_time=400",
    ),
    "config_trigger_analog": (f"sos_filter_oid={TAKEN}",),
}


def host_with_objects() -> Host:
    host = Host()
    for command in ("allocate_oids count=8", *THERE):
        assert host.send(command) == []
    return host


def goes_on(host: Host) -> None:
    """Make sure that the node obeys again."""
    assert host.send("clear_shutdown") == []
    assert host.send(f"config_trsync oid={TAKEN + STEPPER}") == []


def test_the_table_has_every_command_that_makes_an_object() -> None:
    commands = [text.split() for text in Host().words.raw["commands"]]
    assert {words[0] for words in commands if words[0].startswith("config_") and "oid=%c" in words} == set(
        GOOD
    )


@pytest.mark.parametrize("command", GOOD)
def test_an_oid_in_use_stays_what_it_is(command: str) -> None:
    host = host_with_objects()
    host.dies(f"{command} oid={TAKEN} {GOOD[command]}".strip())
    goes_on(host)
    host.send(f"trsync_start oid={TAKEN} report_clock=0 report_ticks=0 expire_reason=1")
    assert host.ask(f"trsync_trigger oid={TAKEN} reason=5")["trigger_reason"] == 5
    assert host.send(f"{command} oid={NEW} {GOOD[command]}".strip()) == [], "with its own oid it works"


@pytest.mark.parametrize(("command", "values"), [(command, bad) for command in BAD for bad in BAD[command]])
def test_what_cannot_be_leaves_the_oid_free(command: str, values: str) -> None:
    host = host_with_objects()
    host.dies(f"{command} oid={NEW} {values}")
    goes_on(host)
    assert host.send(f"{command} oid={NEW} {GOOD[command]}".strip()) == [], "its oid is still free"
