"""Names users bring along: sections and options of modules that are not supported yet.

Recognising them keeps a printer.cfg usable unchanged, and keeps a typo a typo. When a module is built, its
names leave this table.
"""


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


UNSUPPORTED_SECTIONS = frozenset(
    (
        *_words("manual_stepper"),
        *_words("homing_heaters adc_scaled ads1x1x ads1118"),
        *_words("dockable_probe z_calibration tools_calibrate"),
        *_words("gcode_shell_command sdcard_loop"),
        *_words("resonance_tester shaketune adxl345 icm20948 lis2dw lis3dh bmi160 mpu9250 angle"),
        *_words("tmc2130 tmc2240 tmc2660 tmc5160 autotune_tmc ad5206 mcp4451 mcp4728 mcp4018 dac084S085"),
        *_words("led neopixel dotstar pca9533 pca9632 led_effect servo pwm_tool pwm_cycle_time"),
        *_words("static_pwm_clock multi_pin sx1509 samd_sercom replicape"),
        *_words("display display_data display_template display_glyph menu palette2"),
        *_words("filament_motion_sensor"),
        *_words("tsl1401cl_filament_width_sensor hall_filament_width_sensor"),
        *_words("canbus_stats statistics danger_options constants trad_rack belay mixing_extruder"),
        *_words("heated_fan indx"),
    )
)
"""First words of sections that are recognised and reported as not supported yet."""

UNSUPPORTED_EXTRUDER_OPTIONS = _words("per_move_pressure_advance shared_heater")
"""Those of its heater and sensor are in coordinator/config/sections/heater_options.py."""
UNSUPPORTED_MCU_OPTIONS = _words("is_non_critical reconnect_interval max_stepper_error")
UNSUPPORTED_STEPPER_OPTIONS = _words("homing_current min_home_dist use_sensorless_homing")
