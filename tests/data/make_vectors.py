"""Makes dictionary.json and session.json beside it, with the slow twin only: golden vectors for the C codec.

Run from the project's root: ``python -m tests.data.make_vectors``.
"""

import json
from pathlib import Path

from tests.wire_twin import block, encode_message, vlq_encode

HERE = Path(__file__).parent
COMMANDS = {
    "identify offset=%u count=%c": 1,
    "emergency_stop": 2,
    "get_config": 3,
    "allocate_oids count=%c": 4,
    "finalize_config crc=%u": 5,
    "get_clock": 6,
    "get_uptime": 7,
    "reset": 8,
    "config_reset": -1,
    "config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c step_pulse_ticks=%u": 95,
    "queue_step oid=%c interval=%u count=%hu add=%hi": -32,
    "set_next_step_dir oid=%c dir=%c": -33,
    "reset_step_clock oid=%c clock=%u": 96,
    "stepper_get_position oid=%c": 97,
    "debug_ping data=%*s": 12,
    "set_digital_out pin=%u value=%c": 13,
}
RESPONSES = {
    "identify_response offset=%u data=%.*s": 0,
    "config is_config=%c crc=%u is_shutdown=%c move_count=%hu": -2,
    "clock clock=%u": -3,
    "uptime high=%u clock=%u": -4,
    "stats count=%u sum=%u sumsq=%u": -5,
    "shutdown clock=%u static_string_id=%hu": -6,
    "is_shutdown static_string_id=%hu": -7,
    "starting": -8,
    "pong data=%*s": -9,
    "stepper_position oid=%c pos=%i": 128,
}
DICTIONARY = {
    "version": "vectors-1",
    "build_versions": "none",
    "app": "canductor",
    "license": "Apache-2.0",
    "config": {"CLOCK_FREQ": 1000000, "MCU": "twin", "STATS_SUMSQ_BASE": 256, "STEPPER_BOTH_EDGE": 1},
    "commands": COMMANDS,
    "responses": RESPONSES,
    "output": {"heater %s at %i of %u%%": 129, "plain text": 130},
    "enumerations": {
        "pin": {"PA0": [0, 16], "PB0": [16, 16], "gpiochip1/gpio0": [288, 4], "ADC_TEMPERATURE": 254},
        "static_string_id": {"Timer too close": 1, "Emergency stop": 2, "Move queue overflow": 3},
    },
}
QUEUE_STEP = ["%c", "%u", "%hu", "%hi"]
# name, id, codes, values as the host meant them
SESSION: list[tuple[str, int, list[str], list[int | bytes]]] = [
    ("identify", 1, ["%u", "%c"], [0, 40]),
    ("config_stepper", 95, ["%c", "%c", "%c", "%c", "%u"], [7, 16, 17, -1, 0]),
    ("set_next_step_dir", -33, ["%c", "%c"], [7, 1]),
    ("reset_step_clock", 96, ["%c", "%u"], [7, 0xFFFFFFF0]),
    ("queue_step", -32, QUEUE_STEP, [7, 0x80000000, 1, 0]),
    ("queue_step", -32, QUEUE_STEP, [7, 40562, 65535, -11316]),
    ("finalize_config", 5, ["%u"], [564987776]),
    ("debug_ping", 12, ["%*s"], [b"\x7e\x00hello"]),
]


def main() -> None:
    (HERE / "dictionary.json").write_text(json.dumps(DICTIONARY, indent=1) + "\n")
    session = []
    for sequence, (name, message_id, codes, values) in enumerate(SESSION):
        content = encode_message(message_id, codes, values)
        shown = [value.hex() if isinstance(value, bytes) else value for value in values]
        session.append({"name": name, "values": shown, "block": block(sequence, content).hex()})
    # What hosts also send: a clock with its bits above 32, and a u32 in its long form.
    long_forms = (
        vlq_encode(13) + bytes.fromhex("90cca7cf40") + b"\x01" + vlq_encode(5) + vlq_encode(0xFFFFFFFF)
    )
    result = {"session": session, "long_forms": long_forms.hex()}
    (HERE / "session.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
