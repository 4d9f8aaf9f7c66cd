"""Names users bring along: sections and options of modules that are not built yet.

Recognising them keeps a printer.cfg usable unchanged, and keeps a typo a typo. When a module is built, its
names leave this table.
"""


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


LATER_SECTIONS = frozenset(
    (
        *_words("manual_stepper delta_calibrate"),
        *_words(
            "heater_bed heater_generic verify_heater homing_heaters pid_profile thermistor adc_temperature"
        ),
        *_words("temperature_sensor temperature_probe temperature_fan adc_scaled ads1x1x ads1118"),
        *_words("fan heater_fan controller_fan fan_generic"),
        *_words("probe bltouch smart_effector probe_eddy_current axis_twist_compensation load_cell"),
        *_words("load_cell_probe"),
        *_words("dockable_probe z_calibration tools_calibrate"),
        *_words("bed_mesh bed_tilt bed_screws screws_tilt_adjust z_tilt z_tilt_ng quad_gantry_level"),
        *_words("skew_correction z_thermal_adjust endstop_phase"),
        *_words("gcode_macro delayed_gcode gcode_arcs gcode_button gcode_shell_command save_variables"),
        *_words("idle_timeout"),
        *_words("virtual_sdcard sdcard_loop pause_resume firmware_retraction respond exclude_object"),
        *_words("resonance_tester shaketune adxl345 icm20948 lis2dw lis3dh bmi160 mpu9250 angle"),
        *_words(
            "tmc2130 tmc2208 tmc2209 tmc2240 tmc2660 tmc5160 autotune_tmc ad5206 mcp4451 mcp4728 mcp4018"
        ),
        *_words("led neopixel dotstar pca9533 pca9632 led_effect servo output_pin pwm_tool pwm_cycle_time"),
        *_words("static_digital_output static_pwm_clock multi_pin sx1509 samd_sercom replicape"),
        *_words("display display_data display_template display_glyph display_status menu palette2"),
        *_words("filament_switch_sensor filament_motion_sensor"),
        *_words("tsl1401cl_filament_width_sensor hall_filament_width_sensor"),
        *_words("canbus_stats statistics danger_options constants trad_rack belay"),
    )
)
"""First words of sections that are recognised and reported as not yet acting."""

LATER_EXTRUDER_OPTIONS = (
    # the heater and its control
    *_words("heater_pin max_power control pid_kp pid_ki pid_kd pid_version pid_tolerance pwm_cycle_time"),
    *_words("min_temp max_temp min_extrude_temp smooth_time max_delta"),
    *_words("heater_power cooling_fan ambient_temp_sensor filament_density filament_heat_capacity"),
    *_words("fan_ambient_transfer block_heat_capacity ambient_transfer"),
    *_words("sensor_responsiveness target_reach_time steady_state_rate min_ambient_change"),
    # its sensor
    *_words("sensor_type sensor_pin pullup_resistor inline_resistor adc_voltage voltage_offset sensor_mcu"),
    *_words("sensor_path tc_type tc_use_50hz_filter tc_averaging_count rtd_nominal_r rtd_reference_r"),
    *_words("rtd_num_of_wires rtd_use_50hz_filter spi_speed spi_bus"),
    *_words("spi_software_sclk_pin spi_software_mosi_pin spi_software_miso_pin"),
    *_words("i2c_address i2c_mcu i2c_bus i2c_speed i2c_software_scl_pin i2c_software_sda_pin"),
    # filament under pressure
    *_words("per_move_pressure_advance shared_heater"),
)
LATER_MCU_OPTIONS = _words("is_non_critical reconnect_interval max_stepper_error")
LATER_STEPPER_OPTIONS = _words("homing_current min_home_dist use_sensorless_homing")
