// SPDX-License-Identifier: Apache-2.0
// The plant: what stands around a virtual node and makes its pins behave as hardware does. Heaters heat,
// sensors follow, endstops switch where they are, fans turn. This header is its manual.
//
// Nothing runs by itself. The board tells what its outputs do and asks for its inputs, each with the true
// time NS, and the plant works out what has become of the world since: temperatures by the exact solution of
// the linear equations between two changes of power, positions by counting steps. Times that go back count as
// the latest ones. Each node has a plant of its own; what it needs of others it reads in their pages
// (plant_page.h).
//
// Temperatures °C, powers W, capacities J/K, conductances W/K, lengths mm (of an angle: rad), resistances
// ohm.
#ifndef BOARDS_PLANT_H
#define BOARDS_PLANT_H

#include "plant/plant_page.h"

#include <stddef.h>

enum {
    PLANT_PINS = 144,
    PLANT_PEERS = 8,
    PLANT_AXES = 16,
    PLANT_TERMS = 8,
    PLANT_SWITCHES = 16,
    PLANT_BEDS = 4,
    PLANT_DELTAS = 1,
    PLANT_TMCS = 16,
    PLANT_TMC_EDGES = 96, // more than a datagram has
    PLANT_DIAGS = 16,
    PLANT_COILS = 2,
    PLANT_COIL_REGISTERS = 128,
    PLANT_LOAD_CELLS = 2,
    PLANT_BODIES = 12,
    PLANT_HEATERS = 12,
    PLANT_FANS = 12,
    PLANT_SENSORS = 12,
    PLANT_COUPLES = 16,
    PLANT_COOLINGS = 16,
    PLANT_POINTS = 64,      // of a sensor's table
    PLANT_ZONE_STATES = 12, // bodies and sensors that heat flows between
    PLANT_ERROR = 200,
};
_Static_assert(PLANT_BODIES + PLANT_HEATERS + PLANT_FANS + PLANT_SENSORS + PLANT_SWITCHES + PLANT_TMCS +
                       PLANT_COILS + PLANT_LOAD_CELLS <=
                   PLANT_ITEMS,
               "all items have a place in the page");

// Something of this node (peer -1) or of another's page. FOUND: its number there, once it is known.
struct plant_reference {
    char node[PLANT_NAME], name[PLANT_NAME];
    int peer, found;
};

struct plant_peer {
    char node[PLANT_NAME];
    struct plant_page *page; // the board's to set; NULL: nothing is known of it
};

// Step and direction pins as the driver sees them. Without enable pin (-1) the driver is always on.
struct plant_stepper {
    char name[PLANT_NAME];
    int step_pin, dir_pin, enable_pin;
    int step_inverted, dir_inverted, enable_inverted;
    int both_edges; // each change of the step pin is a step
    int tmc;        // its driver, which knows better; -1: any
};

// A place along a line: origin + the sum of each term's mm per step times its stepper's count.
struct plant_term {
    struct plant_reference stepper;
    double mm;
};
struct plant_axis {
    char name[PLANT_NAME];
    double origin, min, max; // steps beyond min and max are lost
    struct plant_term terms[PLANT_TERMS];
    int term_count;
};

// A delta: three joints at x, y, whose heights are axes, hold the nozzle by rods (mm).
struct plant_delta {
    char name[PLANT_NAME];
    int axes[3];
    double x[3], y[3], rod[3];
};

// The height of a bed at x, y: z + tilt_x·(x - x0) + tilt_y·(y - y0)
// + bow·(1 - ((x - x0)² + (y - y0)²) / radius²), so that a bowed bed is highest, or lowest, at x0, y0.
struct plant_bed {
    char name[PLANT_NAME];
    double z, x0, y0, tilt_x, tilt_y, bow, radius;
    struct plant_reference body; // which warms it; without a name none does
    double warm_bow, remote;     // mm per K above the ambient; of a body of another node, °C
};

// What moves the pin of a BLTouch: a servo's signal, whose pulses are commands by their lengths. Two equal
// pulses are needed. Out: the pin is down.
struct plant_bltouch {
    uint64_t rise_ns;
    int heard, command; // of the last pulse, what is being done; 0: none
    int lowers, out, touch_mode, alarm;
    uint64_t moved_ns, pulse_ns; // when the pin is where it is to be, until when its touch is shown
};

// Pressed (high, or low when inverted) from AT on in DIRECTION (1 or -1). It is released HYSTERESIS before
// that again, and each approach finds it up to NOISE beside AT.
// A probe is a switch that the bed presses: it is at OFFSET_X, OFFSET_Y from the nozzle, and pressed when the
// nozzle is OFFSET_Z above the bed there, or lower. The height of the nozzle is that of AXIS; with slopes
// (mm per mm, axes as well; -1: none) that height is of x = y = 0 and grows along x and y. A twisted axis
// makes OFFSET_Z grow by LEAN_X and LEAN_Y per mm that the probe is away from x0, y0 of the bed. The nozzle
// of a DELTA (-1: none) is where its rods hold it.
struct plant_switch {
    char name[PLANT_NAME];
    int pin, axis, direction, inverted;
    double at, hysteresis, noise;
    int bed; // of a probe; -1: it is an endstop
    int x_axis, y_axis, slope_x_axis, slope_y_axis, delta;
    double offset_x, offset_y, offset_z, lean_x, lean_y;
    int control_pin; // of a probe with a pin that a servo's signal moves; -1: it has none
    struct plant_bltouch bltouch;
    int pressed;
    double shift; // of this approach
    uint64_t switched;
};

// The coil of an eddy current probe with its LDC1612 at ADDRESS of an I2C bus (plant_coil.c). PLACE: where
// the coil is, by the fields of a probe; the height is that of the nozzle above the bed there, plus its
// offset_z.
struct plant_coil {
    char name[PLANT_NAME];
    int bus, address, intb_pin, body, drive; // body -1: it has the surroundings' temperature
    struct plant_switch place;
    double clock;                          // Hz, true
    double far, gain, reach, drift, noise; // Hz, share, mm, 1/K, Hz (standard deviation)
    uint16_t registers[PLANT_COIL_REGISTERS];
    int pointer;
    uint64_t woken_ns, taken; // readings that were read or missed
    uint32_t latched;
};

// A load cell that carries the nozzle, with its converter (plant_load_cell.c). PLACE: of the nozzle, by the
// fields of a probe; without a bed (-1) nothing presses. A reading is zero + counts_per_gram · force, where
// the force is stiffness times the depth, plus what drifts, and a hum.
struct plant_load_cell {
    char name[PLANT_NAME];
    int dout_pin, sclk_pin;
    struct plant_switch place;
    double rate;                                 // conversions per second, as it truly is
    double counts_per_gram, zero;                // counts
    double stiffness, drift, hum;                // g/mm, g/s, g
    double hum_hz, noise;                        // Hz, counts (standard deviation)
    uint64_t start_ns, woken_ns, rise_ns, taken; // conversions that were read or missed
    uint32_t shown;                              // what is shifted out
    int pulses;                                  // of SCLK since it was latched
    int missed;                                  // the pulse before, by a fault
    int gain;                                    // which the last pulses have chosen
};

// A driver TMC2209, or without StallGuard a TMC2208, of a stepper whose axes count MICROSTEPS to a full step.
// tx and rx are the node's pins. SG_RESULT is free_load while nothing holds the motor.
struct plant_tmc {
    char name[PLANT_NAME];
    int stepper, tx_pin, rx_pin, address, microsteps, has_stallguard;
    double free_load;
    uint32_t registers[128];
    uint8_t written; // datagrams, rolls over
    uint32_t fault;
    int line, edge_count; // of the datagram that is being heard
    uint64_t edge_ns[PLANT_TMC_EDGES];
    uint8_t reply[8];
    uint64_t reply_ns; // when it begins; 0: there is none
    double reply_bit_ns;
    int64_t field;    // of the motor, in 1/256 of a full step
    uint64_t step_ns; // of the last step
    int step_size;    // in 1/256 of a full step
    double tstep, sg_result;
    int stalled;
};
// A pin that a driver's DIAG is wired to.
struct plant_diag {
    int pin;
    struct plant_reference tmc;
};

struct plant_body {
    char name[PLANT_NAME];
    double capacity, loss, start;
    int zone, state;
};
struct plant_couple {
    int a, b;
    double conductance;
};
struct plant_cooling {
    int body;
    struct plant_reference fan;
    double conductance; // beside its loss, at full duty
    double duty;        // what it was reckoned with last
};
struct plant_heater {
    char name[PLANT_NAME];
    int pin, inverted, body;
    double power;
    double wanted, duty, energy; // what the pin says, what it does
    uint32_t fault;
};
// The tachometer gives PULSES a turn. LAG: s to follow its duty, in turns per minute at full duty.
struct plant_fan {
    char name[PLANT_NAME];
    int pin, inverted, tach_pin;
    double rpm, lag, pulses;
    double wanted, duty, speed, turns; // speed: share of rpm
    uint64_t at_ns;
    uint32_t fault;
};

enum plant_curve { PLANT_BETA, PLANT_STEINHART, PLANT_RTD, PLANT_LINEAR, PLANT_TABLE };
// Below a pull-up resistor to the converter's reference: a thermistor (r0 at t0 °C and beta; or c1, c2, c3 of
// Steinhart and Hart), or a resistor r0·(1 + a·T + b·T²). Linear: zero + slope·T of full scale.
// Table: straight between points of °C and share of full scale, level beyond them.
struct plant_sensor {
    char name[PLANT_NAME];
    int pin, curve, bits;
    struct plant_reference body;
    double lag; // s; 0: none
    double pullup, r0, t0, beta, c1, c2, c3, a, b, zero, slope;
    int point_count;
    double celsius[PLANT_POINTS], ratio[PLANT_POINTS];
    double noise; // steps of the converter, standard deviation
    int zone, state;
    double remote; // °C of a body on another node
    uint64_t samples;
    uint32_t fault;
};

// Bodies and sensors between which heat flows: x' = m·x, the last of x is 1.
struct plant_zone {
    int count;
    double x[PLANT_ZONE_STATES + 1];
    double m[PLANT_ZONE_STATES + 1][PLANT_ZONE_STATES + 1];
    uint64_t at_ns;
    uint8_t stale;    // m is to be made anew
    uint64_t step_ns; // of which `step` is the solution; 0: none
    double step[PLANT_ZONE_STATES + 1][PLANT_ZONE_STATES + 1];
};

// What the plant asks of its board; each may be NULL.
struct plant_host {
    void *context;
    // The page of a peer is about to be read at NS: see that all its steps before are in.
    void (*settle)(void *context, unsigned peer, uint64_t ns);
    // The same, where its items are to be of NS as well as can be.
    void (*refresh)(void *context, unsigned peer, uint64_t ns);
    // KIND of NAME has become VALUE: power (W), fan (duty), switch (pressed), lost (steps), fault (its
    // number).
    void (*note)(void *context, uint64_t ns, const char *kind, const char *name, double value);
};

struct plant {
    struct plant_page *page; // the board's, at least as long-lived
    struct plant_host host;  // the board's, set after plant_start()
    char node[PLANT_NAME];
    double seed, ambient;
    double adc_max, pwm_max;
    uint8_t refreshing;
    uint8_t level[PLANT_PINS];
    uint8_t floating[PLANT_PINS]; // not driven since the board (re)started
    // Whether its level matters, whether more than that happens when it changes, whether the plant drives it.
    uint8_t cares[PLANT_PINS], writes[PLANT_PINS], reads[PLANT_PINS];
    int peer_count, stepper_count, axis_count, switch_count, body_count, couple_count, cooling_count;
    int heater_count, fan_count, sensor_count, zone_count, tmc_count, diag_count, bed_count, coil_count,
        delta_count, load_cell_count;
    int first_heater, first_fan, first_sensor, first_switch, first_tmc, first_coil,
        first_load_cell; // their first items in the page
    struct plant_peer peers[PLANT_PEERS];
    struct plant_stepper steppers[PLANT_STEPPERS];
    struct plant_axis axes[PLANT_AXES];
    struct plant_switch switches[PLANT_SWITCHES];
    struct plant_bed beds[PLANT_BEDS];
    struct plant_delta deltas[PLANT_DELTAS];
    struct plant_coil coils[PLANT_COILS];
    struct plant_load_cell load_cells[PLANT_LOAD_CELLS];
    struct plant_tmc tmcs[PLANT_TMCS];
    struct plant_diag diags[PLANT_DIAGS];
    struct plant_body bodies[PLANT_BODIES];
    struct plant_couple couples[PLANT_COUPLES];
    struct plant_cooling coolings[PLANT_COOLINGS];
    struct plant_heater heaters[PLANT_HEATERS];
    struct plant_fan fans[PLANT_FANS];
    struct plant_sensor sensors[PLANT_SENSORS];
    struct plant_zone zones[PLANT_BODIES + PLANT_SENSORS];
};

// Makes the plant that TEXT describes (docs/plant.md). Returns 0, or -1 with one sentence in ERROR
// (PLANT_ERROR bytes). ADC_MAX and PWM_MAX: full scale of the board's converters and of its hardware PWM.
int plant_read(struct plant *plant, const char *text, size_t size, uint32_t adc_max, uint32_t pwm_max,
               char *error);
// Begins at NS with everything at rest, and makes PAGE: one that is of the same steppers keeps their counts,
// the machine stands where it stood. Then the board sets the peers' pages and the host.
void plant_start(struct plant *plant, struct plant_page *page, uint64_t ns);

// An output of the board has changed, its hardware PWM is set to VALUE.
void plant_output(struct plant *plant, uint64_t ns, uint32_t pin, int level);
void plant_pwm(struct plant *plant, uint64_t ns, uint32_t pin, uint32_t value);
// A pin is no output any more.
void plant_float(struct plant *plant, uint64_t ns, uint32_t pin);
// The board restarts: its outputs float, nothing is driven until they are set again.
void plant_reset(struct plant *plant, uint64_t ns);
// What an input reads, or a converter gives; LEVEL and VALUE when the plant has nothing there.
int plant_input(struct plant *plant, uint64_t ns, uint32_t pin, int level);
uint16_t plant_sample(struct plant *plant, uint64_t ns, uint32_t pin, uint16_t value);
// A transfer on an I2C bus; returns 0, or -1: nothing answers at that address.
int plant_i2c(struct plant *plant, uint64_t ns, uint32_t bus, uint8_t address, const uint8_t *write,
              size_t write_size, uint8_t *read, size_t read_size);
// Takes new faults to heart and brings the page up to date. To be called now and then.
void plant_update(struct plant *plant, uint64_t ns);

// ---------------------------------------------------------------------------------------- between its files

// plant_text.c: fills PLANT's lists.
int plant_parse(struct plant *plant, const char *text, size_t size, char *error);
// plant_motion.c
void plant_motion_edge(struct plant *plant, uint64_t ns, uint32_t pin, int level);
double plant_axis_position(struct plant *plant, struct plant_axis *axis, uint64_t ns);
int plant_switch_pressed(struct plant *plant, struct plant_switch *it, uint64_t ns);
int64_t plant_term_count(struct plant *plant, struct plant_term *term, uint64_t ns);
void plant_steps_lost(struct plant *plant, uint64_t ns, int stepper, uint64_t steps);
double plant_probe_depth(struct plant *plant, const struct plant_switch *it, uint64_t ns);
double plant_probe_depth_at(struct plant *plant, const struct plant_switch *it,
                            uint64_t ns); // also in the past
// plant_delta.c: the nozzle's x, y and z by the heights of the joints.
void plant_delta_nozzle(const struct plant_delta *delta, const double heights[3], double nozzle[3]);
// plant_coil.c
void plant_coil_start(struct plant_coil *coil);
int plant_coil_ready(const struct plant *plant, const struct plant_coil *coil, uint64_t ns);
// plant_load_cell.c
void plant_load_cell_edge(struct plant *plant, struct plant_load_cell *cell, uint64_t ns, int level);
int plant_load_cell_level(struct plant *plant, const struct plant_load_cell *cell, uint64_t ns);
// plant_bltouch.c
void plant_bltouch_edge(struct plant *plant, struct plant_switch *it, uint64_t ns, int level);
int plant_bltouch_pressed(struct plant *plant, struct plant_switch *it, uint64_t ns, uint32_t fault);
// plant_tmc.c
void plant_tmc_start(struct plant *plant, struct plant_tmc *tmc, uint64_t ns);
void plant_tmc_look(struct plant *plant, struct plant_tmc *tmc, uint64_t ns); // takes what has come since
void plant_tmc_line(struct plant *plant, struct plant_tmc *tmc, uint64_t ns, int level);
int plant_tmc_answer(struct plant *plant, struct plant_tmc *tmc, uint64_t ns);
void plant_tmc_step(struct plant *plant, struct plant_tmc *tmc, uint64_t ns, int direction);
int plant_tmc_both_edges(const struct plant_tmc *tmc);
int plant_diag_level(struct plant *plant, struct plant_diag *diag, uint64_t ns);
// plant_heat.c
int plant_heat_make(struct plant *plant, char *error);
void plant_heat_advance(struct plant *plant, uint64_t ns);
void plant_heat_changed(struct plant *plant, int body); // after its heaters' or fans' duty has changed
double plant_body_temperature(const struct plant *plant, int body);
double plant_sensor_temperature(const struct plant *plant, const struct plant_sensor *sensor);
// plant_sensor.c
double plant_sensor_ratio(const struct plant_sensor *sensor, double temperature);
uint16_t plant_sensor_sample(struct plant *plant, struct plant_sensor *sensor);
// plant_fan.c
void plant_fan_advance(struct plant_fan *fan, uint64_t ns);
int plant_fan_tach(struct plant_fan *fan, uint64_t ns);
// Numbers that hang on the seed, WHO and the n-th time alone: evenly in -1..1, and normally distributed.
double plant_even(const struct plant *plant, uint64_t who, uint64_t nth);
double plant_normal(const struct plant *plant, uint64_t who, uint64_t nth);
// Of another node's page: the number of what REFERENCE names, once it is there; else -1.
int plant_find(struct plant *plant, struct plant_reference *reference, enum plant_kind kind);
void plant_note(const struct plant *plant, uint64_t ns, const char *kind, const char *name, double value);

#endif
