// SPDX-License-Identifier: Apache-2.0
// Reads the description of a plant: lines of a kind and of name=value (docs/plant.md). Each kind is a table
// of its fields.
#include "plant/plant_text.h"

#include <math.h>
#include <string.h>

enum { LINE = 1024 };

// --------------------------------------------------------------------------------------------- references

// Node "-" is this one, where FIND knows the name.
static int resolve(const struct plant_reader *reader, struct plant_reference *reference,
                   int (*find)(const struct plant *plant, const char *name)) {
    struct plant *plant = reader->plant;
    reference->peer = reference->found = -1;
    if (strcmp(reference->node, "-") == 0) {
        reference->found = find(plant, reference->name);
        return reference->found < 0 ? plant_text_fail(reader, reference->name, "is not described above") : 0;
    }
    for (int i = 0; i < plant->peer_count; i++)
        if (strcmp(plant->peers[i].node, reference->node) == 0)
            reference->peer = i;
    if (reference->peer >= 0)
        return 0;
    if (plant->peer_count == PLANT_PEERS)
        return plant_text_fail(reader, reference->node, "too many other nodes");
    reference->peer = plant->peer_count++;
    memcpy(plant->peers[reference->peer].node, reference->node, PLANT_NAME);
    return 0;
}

// ------------------------------------------------------------------------------------------------- kinds

#define AT(type, member) offsetof(struct type, member)
#define FIELDS(name) name, sizeof(name) / sizeof(*(name))

static int read_plant(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"node", NAME, AT(plant, node), 0, 0, 0},
        {"seed", NUMBER, AT(plant, seed), 0, 9007199254740992.0, 1},
        {"ambient", NUMBER, AT(plant, ambient), -50, 100, 1},
    };
    reader->plant->ambient = 25;
    return plant_text_fields(reader, FIELDS(fields), rest, reader->plant);
}

static int read_stepper(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_stepper, name), 0, 0, 0},
        {"step", PIN, AT(plant_stepper, step_pin), 0, 0, 0},
        {"dir", PIN, AT(plant_stepper, dir_pin), 0, 0, 0},
        {"enable", PIN, AT(plant_stepper, enable_pin), 0, 0, 1},
        {"step_inverted", FLAG, AT(plant_stepper, step_inverted), 0, 0, 1},
        {"dir_inverted", FLAG, AT(plant_stepper, dir_inverted), 0, 0, 1},
        {"enable_inverted", FLAG, AT(plant_stepper, enable_inverted), 0, 0, 1},
        {"both_edges", FLAG, AT(plant_stepper, both_edges), 0, 0, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->stepper_count == PLANT_STEPPERS)
        return plant_text_fail(reader, "stepper", "too many");
    struct plant_stepper *stepper = &plant->steppers[plant->stepper_count++];
    stepper->enable_pin = stepper->tmc = -1;
    return plant_text_fields(reader, FIELDS(fields), rest, stepper);
}

static int read_axis(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_axis, name), 0, 0, 0},
        {"origin", NUMBER, AT(plant_axis, origin), -1e6, 1e6, 1},
        {"min", NUMBER, AT(plant_axis, min), -INFINITY, INFINITY, 1},
        {"max", NUMBER, AT(plant_axis, max), -INFINITY, INFINITY, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->axis_count == PLANT_AXES)
        return plant_text_fail(reader, "axis", "too many");
    struct plant_axis *axis = &plant->axes[plant->axis_count];
    axis->min = -INFINITY;
    axis->max = INFINITY;
    if (plant_text_fields(reader, FIELDS(fields), rest, axis))
        return -1;
    plant->axis_count++;
    return 0;
}

static int read_term(const struct plant_reader *reader, char *rest) {
    struct line {
        int axis;
        struct plant_term term;
    } line = {0};
    static const struct plant_field fields[] = {
        {"axis", AXIS, AT(line, axis), 0, 0, 0},
        {"node", NAME, AT(line, term.stepper.node), 0, 0, 0},
        {"stepper", NAME, AT(line, term.stepper.name), 0, 0, 0},
        {"mm", NUMBER, AT(line, term.mm), -1e3, 1e3, 0},
    };
    if (plant_text_fields(reader, FIELDS(fields), rest, &line) ||
        resolve(reader, &line.term.stepper, plant_text_stepper))
        return -1;
    struct plant_axis *axis = &reader->plant->axes[line.axis];
    if (axis->term_count == PLANT_TERMS)
        return plant_text_fail(reader, axis->name, "an axis with too many terms");
    axis->terms[axis->term_count++] = line.term;
    return 0;
}

static int read_switch(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_switch, name), 0, 0, 0},
        {"pin", PIN, AT(plant_switch, pin), 0, 0, 0},
        {"axis", AXIS, AT(plant_switch, axis), 0, 0, 0},
        {"at", NUMBER, AT(plant_switch, at), -1e6, 1e6, 0},
        {"direction", SIGN, AT(plant_switch, direction), 0, 0, 0},
        {"hysteresis", NUMBER, AT(plant_switch, hysteresis), 0, 100, 1},
        {"noise", NUMBER, AT(plant_switch, noise), 0, 100, 1},
        {"inverted", FLAG, AT(plant_switch, inverted), 0, 0, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->switch_count == PLANT_SWITCHES)
        return plant_text_fail(reader, "switch", "too many");
    struct plant_switch *it = &plant->switches[plant->switch_count++];
    it->bed = it->control_pin = it->delta = -1;
    return plant_text_fields(reader, FIELDS(fields), rest, it);
}

static int read_bed(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_bed, name), 0, 0, 0},
        {"z", NUMBER, AT(plant_bed, z), -1e3, 1e3, 1},
        {"x0", NUMBER, AT(plant_bed, x0), -1e6, 1e6, 1},
        {"y0", NUMBER, AT(plant_bed, y0), -1e6, 1e6, 1},
        {"tilt_x", NUMBER, AT(plant_bed, tilt_x), -1, 1, 1},
        {"tilt_y", NUMBER, AT(plant_bed, tilt_y), -1, 1, 1},
        {"bow", NUMBER, AT(plant_bed, bow), -100, 100, 1},
        {"radius", NUMBER, AT(plant_bed, radius), 1, 1e6, 1},
        {"node", NAME, AT(plant_bed, body.node), 0, 0, 1},
        {"body", NAME, AT(plant_bed, body.name), 0, 0, 1},
        {"warm_bow", NUMBER, AT(plant_bed, warm_bow), -1, 1, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->bed_count == PLANT_BEDS)
        return plant_text_fail(reader, "bed", "too many");
    struct plant_bed *bed = &plant->beds[plant->bed_count];
    bed->radius = 100;
    bed->remote = plant->ambient;
    bed->body.node[0] = '-';
    if (plant_text_fields(reader, FIELDS(fields), rest, bed))
        return -1;
    if (bed->body.name[0] && resolve(reader, &bed->body, plant_text_body))
        return -1;
    plant->bed_count++;
    return 0;
}

static int read_delta(const struct plant_reader *reader, char *rest) {
#define TOWER(number, a, ax, ay, rod_a)                                                                      \
    {a, AXIS, AT(plant_delta, axes[number]), 0, 0, 0},                                                       \
        {ax, NUMBER, AT(plant_delta, x[number]), -1e4, 1e4, 0},                                              \
        {ay, NUMBER, AT(plant_delta, y[number]), -1e4, 1e4, 0},                                              \
        {rod_a, NUMBER, AT(plant_delta, rod[number]), 1, 1e4, 0}
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_delta, name), 0, 0, 0},
        TOWER(0, "a", "ax", "ay", "rod_a"),
        TOWER(1, "b", "bx", "by", "rod_b"),
        TOWER(2, "c", "cx", "cy", "rod_c"),
    };
#undef TOWER
    struct plant *plant = reader->plant;
    if (plant->delta_count == PLANT_DELTAS)
        return plant_text_fail(reader, "delta", "too many");
    struct plant_delta *delta = &plant->deltas[plant->delta_count];
    if (plant_text_fields(reader, FIELDS(fields), rest, delta))
        return -1;
    const double *x = delta->x, *y = delta->y;
    if (fabs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])) < 1)
        return plant_text_fail(reader, "delta", "its towers stand on one line");
    plant->delta_count++;
    return 0;
}

static int read_probe(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_switch, name), 0, 0, 0},
        {"pin", PIN, AT(plant_switch, pin), 0, 0, 0},
        {"bed", BED, AT(plant_switch, bed), 0, 0, 0},
        {"x", AXIS, AT(plant_switch, x_axis), 0, 0, 1},
        {"y", AXIS, AT(plant_switch, y_axis), 0, 0, 1},
        {"z", AXIS, AT(plant_switch, axis), 0, 0, 1},
        {"delta", DELTA, AT(plant_switch, delta), 0, 0, 1},
        {"slope_x", AXIS, AT(plant_switch, slope_x_axis), 0, 0, 1},
        {"slope_y", AXIS, AT(plant_switch, slope_y_axis), 0, 0, 1},
        {"offset_x", NUMBER, AT(plant_switch, offset_x), -1e3, 1e3, 1},
        {"offset_y", NUMBER, AT(plant_switch, offset_y), -1e3, 1e3, 1},
        {"offset_z", NUMBER, AT(plant_switch, offset_z), -1e3, 1e3, 1},
        {"hysteresis", NUMBER, AT(plant_switch, hysteresis), 0, 100, 1},
        {"noise", NUMBER, AT(plant_switch, noise), 0, 100, 1},
        {"inverted", FLAG, AT(plant_switch, inverted), 0, 0, 1},
        {"control", PIN, AT(plant_switch, control_pin), 0, 0, 1},
        {"lean_x", NUMBER, AT(plant_switch, lean_x), -1, 1, 1},
        {"lean_y", NUMBER, AT(plant_switch, lean_y), -1, 1, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->switch_count == PLANT_SWITCHES)
        return plant_text_fail(reader, "probe", "too many switches");
    struct plant_switch *it = &plant->switches[plant->switch_count++];
    it->x_axis = it->y_axis = it->axis = it->delta = -1;
    it->slope_x_axis = it->slope_y_axis = it->control_pin = -1;
    it->direction = -1;
    if (plant_text_fields(reader, FIELDS(fields), rest, it))
        return -1;
    int given = (it->x_axis >= 0) + (it->y_axis >= 0) + (it->axis >= 0);
    return given == (it->delta < 0 ? 3 : 0) ? 0
                                            : plant_text_fail(reader, it->name, "needs x, y and z, or delta");
}

static int read_coil(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_coil, name), 0, 0, 0},
        {"bus", WHOLE, AT(plant_coil, bus), 0, 1, 0},
        {"address", WHOLE, AT(plant_coil, address), 1, 127, 0},
        {"intb", PIN, AT(plant_coil, intb_pin), 0, 0, 1},
        {"body", BODY, AT(plant_coil, body), 0, 0, 1},
        {"drive", WHOLE, AT(plant_coil, drive), 0, 31, 1},
        {"clock", NUMBER, AT(plant_coil, clock), 1e6, 1e8, 1},
        {"far", NUMBER, AT(plant_coil, far), 1e3, 1e7, 1},
        {"gain", NUMBER, AT(plant_coil, gain), 1e-3, 1, 1},
        {"reach", NUMBER, AT(plant_coil, reach), 0.1, 100, 1},
        {"drift", NUMBER, AT(plant_coil, drift), -1e-2, 1e-2, 1},
        {"noise", NUMBER, AT(plant_coil, noise), 0, 1e6, 1},
        {"bed", BED, AT(plant_coil, place.bed), 0, 0, 0},
        {"x", AXIS, AT(plant_coil, place.x_axis), 0, 0, 0},
        {"y", AXIS, AT(plant_coil, place.y_axis), 0, 0, 0},
        {"z", AXIS, AT(plant_coil, place.axis), 0, 0, 0},
        {"slope_x", AXIS, AT(plant_coil, place.slope_x_axis), 0, 0, 1},
        {"slope_y", AXIS, AT(plant_coil, place.slope_y_axis), 0, 0, 1},
        {"offset_x", NUMBER, AT(plant_coil, place.offset_x), -1e3, 1e3, 1},
        {"offset_y", NUMBER, AT(plant_coil, place.offset_y), -1e3, 1e3, 1},
        {"offset_z", NUMBER, AT(plant_coil, place.offset_z), -1e3, 1e3, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->coil_count == PLANT_COILS)
        return plant_text_fail(reader, "coil", "too many");
    struct plant_coil *coil = &plant->coils[plant->coil_count++];
    coil->intb_pin = coil->body = coil->place.slope_x_axis = coil->place.slope_y_axis = coil->place.delta =
        -1;
    coil->drive = 15;
    coil->clock = 12e6;
    coil->far = 3e6;
    coil->gain = 0.1;
    coil->reach = 3;
    return plant_text_fields(reader, FIELDS(fields), rest, coil);
}

static int read_load_cell(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_load_cell, name), 0, 0, 0},
        {"dout", PIN, AT(plant_load_cell, dout_pin), 0, 0, 0},
        {"sclk", PIN, AT(plant_load_cell, sclk_pin), 0, 0, 0},
        {"rate", NUMBER, AT(plant_load_cell, rate), 1, 1000, 0},
        {"counts_per_gram", NUMBER, AT(plant_load_cell, counts_per_gram), -1e5, 1e5, 1},
        {"zero", NUMBER, AT(plant_load_cell, zero), -8e6, 8e6, 1},
        {"stiffness", NUMBER, AT(plant_load_cell, stiffness), 1, 1e6, 1},
        {"drift", NUMBER, AT(plant_load_cell, drift), -1e3, 1e3, 1},
        {"hum", NUMBER, AT(plant_load_cell, hum), 0, 1e4, 1},
        {"hum_hz", NUMBER, AT(plant_load_cell, hum_hz), 0, 1e4, 1},
        {"noise", NUMBER, AT(plant_load_cell, noise), 0, 1e6, 1},
        {"bed", BED, AT(plant_load_cell, place.bed), 0, 0, 1},
        {"x", AXIS, AT(plant_load_cell, place.x_axis), 0, 0, 1},
        {"y", AXIS, AT(plant_load_cell, place.y_axis), 0, 0, 1},
        {"z", AXIS, AT(plant_load_cell, place.axis), 0, 0, 1},
        {"slope_x", AXIS, AT(plant_load_cell, place.slope_x_axis), 0, 0, 1},
        {"slope_y", AXIS, AT(plant_load_cell, place.slope_y_axis), 0, 0, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->load_cell_count == PLANT_LOAD_CELLS)
        return plant_text_fail(reader, "load_cell", "too many");
    struct plant_load_cell *cell = &plant->load_cells[plant->load_cell_count++];
    cell->place.bed = cell->place.x_axis = cell->place.y_axis = cell->place.axis = -1;
    cell->place.slope_x_axis = cell->place.slope_y_axis = cell->place.delta = -1;
    cell->counts_per_gram = 100;
    cell->stiffness = 4000;
    cell->hum_hz = 50;
    return plant_text_fields(reader, FIELDS(fields), rest, cell);
}

static int read_tmc(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_tmc, name), 0, 0, 0},
        {"chip", CHIP, AT(plant_tmc, has_stallguard), 0, 0, 0},
        {"stepper", STEPPER, AT(plant_tmc, stepper), 0, 0, 0},
        {"tx", PIN, AT(plant_tmc, tx_pin), 0, 0, 0},
        {"rx", PIN, AT(plant_tmc, rx_pin), 0, 0, 0},
        {"address", WHOLE, AT(plant_tmc, address), 0, 3, 1},
        {"microsteps", WHOLE, AT(plant_tmc, microsteps), 1, 256, 0},
        {"free_load", NUMBER, AT(plant_tmc, free_load), 0, 510, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->tmc_count == PLANT_TMCS)
        return plant_text_fail(reader, "tmc", "too many");
    struct plant_tmc *tmc = &plant->tmcs[plant->tmc_count];
    tmc->free_load = 300;
    if (plant_text_fields(reader, FIELDS(fields), rest, tmc))
        return -1;
    if (plant->steppers[tmc->stepper].tmc >= 0)
        return plant_text_fail(reader, tmc->name, "its stepper has a driver already");
    plant->steppers[tmc->stepper].tmc = plant->tmc_count++;
    return 0;
}

static int read_diag(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"pin", PIN, AT(plant_diag, pin), 0, 0, 0},
        {"node", NAME, AT(plant_diag, tmc.node), 0, 0, 0},
        {"tmc", NAME, AT(plant_diag, tmc.name), 0, 0, 0},
    };
    struct plant *plant = reader->plant;
    if (plant->diag_count == PLANT_DIAGS)
        return plant_text_fail(reader, "diag", "too many");
    struct plant_diag *diag = &plant->diags[plant->diag_count++];
    return plant_text_fields(reader, FIELDS(fields), rest, diag) ||
           resolve(reader, &diag->tmc, plant_text_tmc);
}

static int read_body(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_body, name), 0, 0, 0},
        {"capacity", NUMBER, AT(plant_body, capacity), 1e-3, 1e9, 0},
        {"loss", NUMBER, AT(plant_body, loss), 0, 1e6, 0},
        {"start", NUMBER, AT(plant_body, start), -50, 1000, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->body_count == PLANT_BODIES)
        return plant_text_fail(reader, "body", "too many");
    struct plant_body *body = &plant->bodies[plant->body_count];
    body->start = plant->ambient;
    if (plant_text_fields(reader, FIELDS(fields), rest, body))
        return -1;
    plant->body_count++;
    return 0;
}

static int read_couple(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"a", BODY, AT(plant_couple, a), 0, 0, 0},
        {"b", BODY, AT(plant_couple, b), 0, 0, 0},
        {"conductance", NUMBER, AT(plant_couple, conductance), 0, 1e6, 0},
    };
    struct plant *plant = reader->plant;
    if (plant->couple_count == PLANT_COUPLES)
        return plant_text_fail(reader, "couple", "too many");
    struct plant_couple *couple = &plant->couples[plant->couple_count++];
    if (plant_text_fields(reader, FIELDS(fields), rest, couple))
        return -1;
    return couple->a == couple->b ? plant_text_fail(reader, "couple", "a body with itself") : 0;
}

static int read_fan(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_fan, name), 0, 0, 0},
        {"pin", PIN, AT(plant_fan, pin), 0, 0, 0},
        {"inverted", FLAG, AT(plant_fan, inverted), 0, 0, 1},
        {"rpm", NUMBER, AT(plant_fan, rpm), 0, 1e6, 1},
        {"lag", NUMBER, AT(plant_fan, lag), 0, 1e3, 1},
        {"tach", PIN, AT(plant_fan, tach_pin), 0, 0, 1},
        {"pulses", NUMBER, AT(plant_fan, pulses), 0.1, 100, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->fan_count == PLANT_FANS)
        return plant_text_fail(reader, "fan", "too many");
    struct plant_fan *fan = &plant->fans[plant->fan_count++];
    fan->tach_pin = -1;
    fan->rpm = 6000;
    fan->pulses = 2;
    return plant_text_fields(reader, FIELDS(fields), rest, fan);
}

static int read_cooling(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"body", BODY, AT(plant_cooling, body), 0, 0, 0},
        {"node", NAME, AT(plant_cooling, fan.node), 0, 0, 0},
        {"fan", NAME, AT(plant_cooling, fan.name), 0, 0, 0},
        {"conductance", NUMBER, AT(plant_cooling, conductance), 0, 1e6, 0},
    };
    struct plant *plant = reader->plant;
    if (plant->cooling_count == PLANT_COOLINGS)
        return plant_text_fail(reader, "cooling", "too many");
    struct plant_cooling *cooling = &plant->coolings[plant->cooling_count++];
    return plant_text_fields(reader, FIELDS(fields), rest, cooling) ||
           resolve(reader, &cooling->fan, plant_text_fan);
}

static int read_heater(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_heater, name), 0, 0, 0},
        {"pin", PIN, AT(plant_heater, pin), 0, 0, 0},
        {"inverted", FLAG, AT(plant_heater, inverted), 0, 0, 1},
        {"body", BODY, AT(plant_heater, body), 0, 0, 0},
        {"power", NUMBER, AT(plant_heater, power), 0, 1e6, 0},
    };
    struct plant *plant = reader->plant;
    if (plant->heater_count == PLANT_HEATERS)
        return plant_text_fail(reader, "heater", "too many");
    return plant_text_fields(reader, FIELDS(fields), rest, &plant->heaters[plant->heater_count++]);
}

// What a curve needs, else a division by zero would follow.
static int check_curve(const struct plant_reader *reader, const struct plant_sensor *sensor) {
    int good = sensor->curve >= PLANT_LINEAR || sensor->pullup > 0;
    if (sensor->curve == PLANT_BETA)
        good &= sensor->r0 > 0 && sensor->beta > 0;
    else if (sensor->curve == PLANT_STEINHART)
        good &= sensor->c2 > 0 && sensor->c3 >= 0;
    else if (sensor->curve == PLANT_RTD)
        good &= sensor->r0 > 0;
    return good ? 0
                : plant_text_fail(reader, sensor->name,
                                  "its curve needs pullup, and r0 and beta, c1 and c2, or r0");
}

static int read_sensor(const struct plant_reader *reader, char *rest) {
    static const struct plant_field fields[] = {
        {"name", NAME, AT(plant_sensor, name), 0, 0, 0},
        {"pin", PIN, AT(plant_sensor, pin), 0, 0, 0},
        {"node", NAME, AT(plant_sensor, body.node), 0, 0, 0},
        {"body", NAME, AT(plant_sensor, body.name), 0, 0, 0},
        {"lag", NUMBER, AT(plant_sensor, lag), 0, 1e4, 1},
        {"curve", CURVE, AT(plant_sensor, curve), 0, 0, 0},
        {"pullup", NUMBER, AT(plant_sensor, pullup), 1, 1e9, 1},
        {"r0", NUMBER, AT(plant_sensor, r0), 1e-3, 1e9, 1},
        {"t0", NUMBER, AT(plant_sensor, t0), -100, 1000, 1},
        {"beta", NUMBER, AT(plant_sensor, beta), 1, 1e6, 1},
        {"c1", NUMBER, AT(plant_sensor, c1), -1, 1, 1},
        {"c2", NUMBER, AT(plant_sensor, c2), 0, 1, 1},
        {"c3", NUMBER, AT(plant_sensor, c3), 0, 1, 1},
        {"a", NUMBER, AT(plant_sensor, a), -1, 1, 1},
        {"b", NUMBER, AT(plant_sensor, b), -1, 1, 1},
        {"zero", NUMBER, AT(plant_sensor, zero), -10, 10, 1},
        {"slope", NUMBER, AT(plant_sensor, slope), -10, 10, 1},
        {"noise", NUMBER, AT(plant_sensor, noise), 0, 1000, 1},
        {"bits", WHOLE, AT(plant_sensor, bits), 4, 16, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->sensor_count == PLANT_SENSORS)
        return plant_text_fail(reader, "sensor", "too many");
    struct plant_sensor *sensor = &plant->sensors[plant->sensor_count++];
    sensor->bits = 12;
    sensor->t0 = 25;
    return plant_text_fields(reader, FIELDS(fields), rest, sensor) ||
           resolve(reader, &sensor->body, plant_text_body) || check_curve(reader, sensor);
}

static int read_point(const struct plant_reader *reader, char *rest) {
    struct line {
        char sensor[PLANT_NAME];
        double celsius, ratio;
    } line;
    static const struct plant_field fields[] = {
        {"sensor", NAME, AT(line, sensor), 0, 0, 0},
        {"celsius", NUMBER, AT(line, celsius), -300, 10000, 0},
        {"ratio", NUMBER, AT(line, ratio), -1, 2, 0},
    };
    if (plant_text_fields(reader, FIELDS(fields), rest, &line))
        return -1;
    int found = plant_text_sensor(reader->plant, line.sensor);
    if (found < 0)
        return plant_text_fail(reader, line.sensor, "is not described above");
    struct plant_sensor *sensor = &reader->plant->sensors[found];
    int at = sensor->point_count;
    if (at == PLANT_POINTS)
        return plant_text_fail(reader, line.sensor, "a table of too many points");
    if (at && line.celsius <= sensor->celsius[at - 1])
        return plant_text_fail(reader, line.sensor, "a table whose temperatures do not rise");
    sensor->celsius[at] = line.celsius;
    sensor->ratio[at] = line.ratio;
    sensor->point_count++;
    return 0;
}

static int read_line(const struct plant_reader *reader, char *line) {
    static const struct {
        const char *kind;
        int (*read)(const struct plant_reader *reader, char *rest);
    } kinds[] = {
        {"plant", read_plant},
        {"stepper", read_stepper},
        {"axis", read_axis},
        {"term", read_term},
        {"switch", read_switch},
        {"body", read_body},
        {"fan", read_fan},
        {"couple", read_couple},
        {"cooling", read_cooling},
        {"heater", read_heater},
        {"sensor", read_sensor},
        {"point", read_point},
        {"tmc", read_tmc},
        {"diag", read_diag},
        {"bed", read_bed},
        {"probe", read_probe},
        {"coil", read_coil},
        {"delta", read_delta},
        {"load_cell", read_load_cell},
    };
    line += strspn(line, " \t\r");
    if (!*line || *line == '#')
        return 0;
    char *rest = line + strcspn(line, " \t\r");
    if (*rest)
        *rest++ = 0;
    for (size_t i = 0; i < sizeof(kinds) / sizeof(*kinds); i++)
        if (strcmp(line, kinds[i].kind) == 0)
            return kinds[i].read(reader, rest) ? -1 : 0;
    return plant_text_fail(reader, line, "there is no such kind of line");
}

int plant_parse(struct plant *plant, const char *text, size_t size, char *error) {
    struct plant_reader reader = {plant, error, 0};
    for (size_t at = 0; at < size;) {
        char line[LINE];
        const char *end = memchr(text + at, '\n', size - at);
        size_t length = end ? (size_t)(end - text) - at : size - at;
        reader.line++;
        if (length >= sizeof(line) || memchr(text + at, 0, length))
            return plant_text_fail(&reader, "this line", "is too long, or no text");
        memcpy(line, text + at, length);
        line[length] = 0;
        if (read_line(&reader, line))
            return -1;
        at += length + 1;
    }
    if (plant->node[0])
        return 0;
    reader.line = 1;
    return plant_text_fail(&reader, "plant node=NAME", "is missing; a plant begins with it");
}
