// SPDX-License-Identifier: Apache-2.0
// Reads the description of a plant: lines of a kind and of name=value (docs/plant.md). Each kind is a table
// of its fields.
#include "boards/virtual/plant.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { LINE = 1024, WANT = 64 };

enum type { NAME, PIN, NO_PIN, FLAG, SIGN, WHOLE, NUMBER, CURVE, AXIS, BODY };

struct field {
    const char *name;
    enum type type;
    size_t offset;
    double min, max;  // of a number
    uint8_t may_lack; // the value stands there already
};

struct reader {
    struct plant *plant;
    char *error;
    int line;
};

static int fail(const struct reader *reader, const char *text, const char *what) {
    snprintf(reader->error, PLANT_ERROR, "line %d: %.60s: %.90s", reader->line, text, what);
    return -1;
}

// ------------------------------------------------------------------------------------------------- values

static int read_name(char *out, const char *text) {
    size_t size = strlen(text);
    if (size == 0 || size >= PLANT_NAME)
        return -1;
    memcpy(out, text, size + 1);
    return 0;
}

// PA0 is 0, PB0 is 16.
static int read_pin(int *out, const char *text) {
    char *end;
    if (text[0] != 'P' || text[1] < 'A' || text[1] > 'I' || text[2] < '0' || text[2] > '9')
        return -1;
    long number = strtol(text + 2, &end, 10);
    if (*end || number > 15)
        return -1;
    *out = (text[1] - 'A') * 16 + (int)number;
    return 0;
}

static int read_number(double *out, const char *text, double min, double max) {
    char *end;
    *out = strtod(text, &end);
    return *end || end == text || !(*out >= min && *out <= max) ? -1 : 0;
}

static int read_whole(int *out, const char *text, double min, double max) {
    double value;
    if (read_number(&value, text, min, max) || value != rint(value))
        return -1;
    *out = (int)value;
    return 0;
}

static int read_word(int *out, const char *text, const char *const *words, int count) {
    for (int i = 0; i < count; i++)
        if (strcmp(text, words[i]) == 0) {
            *out = i;
            return 0;
        }
    return -1;
}

static int find_axis(const struct plant *plant, const char *name) {
    for (int i = 0; i < plant->axis_count; i++)
        if (strcmp(plant->axes[i].name, name) == 0)
            return i;
    return -1;
}

static int find_body(const struct plant *plant, const char *name) {
    for (int i = 0; i < plant->body_count; i++)
        if (strcmp(plant->bodies[i].name, name) == 0)
            return i;
    return -1;
}

static int find_stepper(const struct plant *plant, const char *name) {
    for (int i = 0; i < plant->stepper_count; i++)
        if (strcmp(plant->steppers[i].name, name) == 0)
            return i;
    return -1;
}

static int find_fan(const struct plant *plant, const char *name) {
    for (int i = 0; i < plant->fan_count; i++)
        if (strcmp(plant->fans[i].name, name) == 0)
            return i;
    return -1;
}

static int read_value(const struct plant *plant, const struct field *field, void *target, const char *text) {
    static const char *const curves[] = {"beta", "steinhart", "rtd", "linear"};
    char *out = (char *)target + field->offset;
    switch (field->type) {
    case NAME:
        return read_name(out, text);
    case PIN:
    case NO_PIN:
        return read_pin((int *)out, text);
    case FLAG:
        return read_whole((int *)out, text, 0, 1);
    case SIGN:
        return read_whole((int *)out, text, -1, 1) || *(int *)out == 0 ? -1 : 0;
    case WHOLE:
        return read_whole((int *)out, text, field->min, field->max);
    case NUMBER:
        return read_number((double *)out, text, field->min, field->max);
    case CURVE:
        return read_word((int *)out, text, curves, 4);
    case AXIS:
        return (*(int *)out = find_axis(plant, text)) < 0 ? -1 : 0;
    case BODY:
        return (*(int *)out = find_body(plant, text)) < 0 ? -1 : 0;
    }
    return -1;
}

static void describe(const struct field *field, char *out) {
    static const char *const words[] = {[NAME] = "a name of 1 to 31 characters",
                                        [PIN] = "a pin, PA0 to PI15",
                                        [NO_PIN] = "a pin, PA0 to PI15",
                                        [FLAG] = "0 or 1",
                                        [SIGN] = "1 or -1",
                                        [CURVE] = "beta, steinhart, rtd or linear",
                                        [AXIS] = "an axis described above",
                                        [BODY] = "a body described above"};
    if (field->type == NUMBER || field->type == WHOLE)
        snprintf(out, WANT, "expected a number of %g to %g", field->min, field->max);
    else
        snprintf(out, WANT, "expected %s", words[field->type]);
}

// Reads the fields of one line into TARGET.
static int read_fields(const struct reader *reader, const struct field *fields, size_t count, char *rest,
                       void *target) {
    uint32_t seen = 0;
    char *save, want[WANT];
    for (char *word = strtok_r(rest, " \t\r", &save); word; word = strtok_r(NULL, " \t\r", &save)) {
        size_t i = 0;
        size_t size = strcspn(word, "=");
        while (i < count && (strlen(fields[i].name) != size || strncmp(fields[i].name, word, size) != 0))
            i++;
        if (i == count || word[size] != '=')
            return fail(reader, word, "there is no such field here");
        if (seen & 1u << i)
            return fail(reader, word, "given twice");
        seen |= 1u << i;
        if (read_value(reader->plant, &fields[i], target, word + size + 1)) {
            describe(&fields[i], want);
            return fail(reader, word, want);
        }
    }
    for (size_t i = 0; i < count; i++)
        if (!(seen & 1u << i) && !fields[i].may_lack)
            return fail(reader, fields[i].name, "is missing");
    return 0;
}

// -------------------------------------------------------------------------------------------------
// references

// Node "-" is this one, where FIND knows the name.
static int resolve(const struct reader *reader, struct plant_reference *reference,
                   int (*find)(const struct plant *plant, const char *name)) {
    struct plant *plant = reader->plant;
    reference->peer = reference->found = -1;
    if (strcmp(reference->node, "-") == 0) {
        reference->found = find(plant, reference->name);
        return reference->found < 0 ? fail(reader, reference->name, "is not described above") : 0;
    }
    for (int i = 0; i < plant->peer_count; i++)
        if (strcmp(plant->peers[i].node, reference->node) == 0)
            reference->peer = i;
    if (reference->peer >= 0)
        return 0;
    if (plant->peer_count == PLANT_PEERS)
        return fail(reader, reference->node, "too many other nodes");
    reference->peer = plant->peer_count++;
    memcpy(plant->peers[reference->peer].node, reference->node, PLANT_NAME);
    return 0;
}

// ------------------------------------------------------------------------------------------------- kinds

#define AT(type, member) offsetof(struct type, member)
#define FIELDS(name) name, sizeof(name) / sizeof(*(name))

static int read_plant(const struct reader *reader, char *rest) {
    static const struct field fields[] = {
        {"node", NAME, AT(plant, node), 0, 0, 0},
        {"seed", NUMBER, AT(plant, seed), 0, 9007199254740992.0, 1},
        {"ambient", NUMBER, AT(plant, ambient), -50, 100, 1},
    };
    reader->plant->ambient = 25;
    return read_fields(reader, FIELDS(fields), rest, reader->plant);
}

static int read_stepper(const struct reader *reader, char *rest) {
    static const struct field fields[] = {
        {"name", NAME, AT(plant_stepper, name), 0, 0, 0},
        {"step", PIN, AT(plant_stepper, step_pin), 0, 0, 0},
        {"dir", PIN, AT(plant_stepper, dir_pin), 0, 0, 0},
        {"enable", NO_PIN, AT(plant_stepper, enable_pin), 0, 0, 1},
        {"step_inverted", FLAG, AT(plant_stepper, step_inverted), 0, 0, 1},
        {"dir_inverted", FLAG, AT(plant_stepper, dir_inverted), 0, 0, 1},
        {"enable_inverted", FLAG, AT(plant_stepper, enable_inverted), 0, 0, 1},
        {"both_edges", FLAG, AT(plant_stepper, both_edges), 0, 0, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->stepper_count == PLANT_STEPPERS)
        return fail(reader, "stepper", "too many");
    struct plant_stepper *stepper = &plant->steppers[plant->stepper_count++];
    stepper->enable_pin = -1;
    return read_fields(reader, FIELDS(fields), rest, stepper);
}

static int read_axis(const struct reader *reader, char *rest) {
    static const struct field fields[] = {
        {"name", NAME, AT(plant_axis, name), 0, 0, 0},
        {"origin", NUMBER, AT(plant_axis, origin), -1e6, 1e6, 1},
        {"min", NUMBER, AT(plant_axis, min), -INFINITY, INFINITY, 1},
        {"max", NUMBER, AT(plant_axis, max), -INFINITY, INFINITY, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->axis_count == PLANT_AXES)
        return fail(reader, "axis", "too many");
    struct plant_axis *axis = &plant->axes[plant->axis_count];
    axis->min = -INFINITY;
    axis->max = INFINITY;
    if (read_fields(reader, FIELDS(fields), rest, axis))
        return -1;
    plant->axis_count++;
    return 0;
}

static int read_term(const struct reader *reader, char *rest) {
    struct line {
        int axis;
        struct plant_term term;
    } line = {0};
    static const struct field fields[] = {
        {"axis", AXIS, AT(line, axis), 0, 0, 0},
        {"node", NAME, AT(line, term.stepper.node), 0, 0, 0},
        {"stepper", NAME, AT(line, term.stepper.name), 0, 0, 0},
        {"mm", NUMBER, AT(line, term.mm), -1e3, 1e3, 0},
    };
    if (read_fields(reader, FIELDS(fields), rest, &line) || resolve(reader, &line.term.stepper, find_stepper))
        return -1;
    struct plant_axis *axis = &reader->plant->axes[line.axis];
    if (axis->term_count == PLANT_TERMS)
        return fail(reader, axis->name, "an axis with too many terms");
    axis->terms[axis->term_count++] = line.term;
    return 0;
}

static int read_switch(const struct reader *reader, char *rest) {
    static const struct field fields[] = {
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
        return fail(reader, "switch", "too many");
    return read_fields(reader, FIELDS(fields), rest, &plant->switches[plant->switch_count++]);
}

static int read_body(const struct reader *reader, char *rest) {
    static const struct field fields[] = {
        {"name", NAME, AT(plant_body, name), 0, 0, 0},
        {"capacity", NUMBER, AT(plant_body, capacity), 1e-3, 1e9, 0},
        {"loss", NUMBER, AT(plant_body, loss), 0, 1e6, 0},
        {"start", NUMBER, AT(plant_body, start), -50, 1000, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->body_count == PLANT_BODIES)
        return fail(reader, "body", "too many");
    struct plant_body *body = &plant->bodies[plant->body_count];
    body->start = plant->ambient;
    if (read_fields(reader, FIELDS(fields), rest, body))
        return -1;
    plant->body_count++;
    return 0;
}

static int read_couple(const struct reader *reader, char *rest) {
    static const struct field fields[] = {
        {"a", BODY, AT(plant_couple, a), 0, 0, 0},
        {"b", BODY, AT(plant_couple, b), 0, 0, 0},
        {"conductance", NUMBER, AT(plant_couple, conductance), 0, 1e6, 0},
    };
    struct plant *plant = reader->plant;
    if (plant->couple_count == PLANT_COUPLES)
        return fail(reader, "couple", "too many");
    struct plant_couple *couple = &plant->couples[plant->couple_count++];
    if (read_fields(reader, FIELDS(fields), rest, couple))
        return -1;
    return couple->a == couple->b ? fail(reader, "couple", "a body with itself") : 0;
}

static int read_fan(const struct reader *reader, char *rest) {
    static const struct field fields[] = {
        {"name", NAME, AT(plant_fan, name), 0, 0, 0},
        {"pin", PIN, AT(plant_fan, pin), 0, 0, 0},
        {"inverted", FLAG, AT(plant_fan, inverted), 0, 0, 1},
        {"rpm", NUMBER, AT(plant_fan, rpm), 0, 1e6, 1},
        {"lag", NUMBER, AT(plant_fan, lag), 0, 1e3, 1},
        {"tach", NO_PIN, AT(plant_fan, tach_pin), 0, 0, 1},
        {"pulses", NUMBER, AT(plant_fan, pulses), 0.1, 100, 1},
    };
    struct plant *plant = reader->plant;
    if (plant->fan_count == PLANT_FANS)
        return fail(reader, "fan", "too many");
    struct plant_fan *fan = &plant->fans[plant->fan_count++];
    fan->tach_pin = -1;
    fan->rpm = 6000;
    fan->pulses = 2;
    return read_fields(reader, FIELDS(fields), rest, fan);
}

static int read_cooling(const struct reader *reader, char *rest) {
    static const struct field fields[] = {
        {"body", BODY, AT(plant_cooling, body), 0, 0, 0},
        {"node", NAME, AT(plant_cooling, fan.node), 0, 0, 0},
        {"fan", NAME, AT(plant_cooling, fan.name), 0, 0, 0},
        {"conductance", NUMBER, AT(plant_cooling, conductance), 0, 1e6, 0},
    };
    struct plant *plant = reader->plant;
    if (plant->cooling_count == PLANT_COOLINGS)
        return fail(reader, "cooling", "too many");
    struct plant_cooling *cooling = &plant->coolings[plant->cooling_count++];
    return read_fields(reader, FIELDS(fields), rest, cooling) || resolve(reader, &cooling->fan, find_fan);
}

static int read_heater(const struct reader *reader, char *rest) {
    static const struct field fields[] = {
        {"name", NAME, AT(plant_heater, name), 0, 0, 0},
        {"pin", PIN, AT(plant_heater, pin), 0, 0, 0},
        {"inverted", FLAG, AT(plant_heater, inverted), 0, 0, 1},
        {"body", BODY, AT(plant_heater, body), 0, 0, 0},
        {"power", NUMBER, AT(plant_heater, power), 0, 1e6, 0},
    };
    struct plant *plant = reader->plant;
    if (plant->heater_count == PLANT_HEATERS)
        return fail(reader, "heater", "too many");
    return read_fields(reader, FIELDS(fields), rest, &plant->heaters[plant->heater_count++]);
}

// What a curve needs, else a division by zero would follow.
static int check_curve(const struct reader *reader, const struct plant_sensor *sensor) {
    int good = sensor->curve == PLANT_LINEAR || sensor->pullup > 0;
    if (sensor->curve == PLANT_BETA)
        good &= sensor->r0 > 0 && sensor->beta > 0;
    else if (sensor->curve == PLANT_STEINHART)
        good &= sensor->c2 > 0 && sensor->c3 >= 0;
    else if (sensor->curve == PLANT_RTD)
        good &= sensor->r0 > 0;
    return good ? 0 : fail(reader, sensor->name, "its curve needs pullup, and r0 and beta, c1 and c2, or r0");
}

static int read_sensor(const struct reader *reader, char *rest) {
    static const struct field fields[] = {
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
        return fail(reader, "sensor", "too many");
    struct plant_sensor *sensor = &plant->sensors[plant->sensor_count++];
    sensor->bits = 12;
    sensor->t0 = 25;
    return read_fields(reader, FIELDS(fields), rest, sensor) || resolve(reader, &sensor->body, find_body) ||
           check_curve(reader, sensor);
}

static int read_line(const struct reader *reader, char *line) {
    static const struct {
        const char *kind;
        int (*read)(const struct reader *reader, char *rest);
    } kinds[] = {
        {"plant", read_plant},   {"stepper", read_stepper}, {"axis", read_axis},
        {"term", read_term},     {"switch", read_switch},   {"body", read_body},
        {"fan", read_fan},       {"couple", read_couple},   {"cooling", read_cooling},
        {"heater", read_heater}, {"sensor", read_sensor},
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
    return fail(reader, line, "there is no such kind of line");
}

int plant_parse(struct plant *plant, const char *text, size_t size, char *error) {
    struct reader reader = {plant, error, 0};
    for (size_t at = 0; at < size;) {
        char line[LINE];
        const char *end = memchr(text + at, '\n', size - at);
        size_t length = end ? (size_t)(end - text) - at : size - at;
        reader.line++;
        if (length >= sizeof(line) || memchr(text + at, 0, length))
            return fail(&reader, "this line", "is too long, or no text");
        memcpy(line, text + at, length);
        line[length] = 0;
        if (read_line(&reader, line))
            return -1;
        at += length + 1;
    }
    if (plant->node[0])
        return 0;
    reader.line = 1;
    return fail(&reader, "plant node=NAME", "is missing; a plant begins with it");
}
