// SPDX-License-Identifier: Apache-2.0
// Words name=value of a line, by a table of fields.
#include "plant/plant_text.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { WANT = 64 };

int plant_text_fail(const struct plant_reader *reader, const char *text, const char *what) {
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

// The number of the item NAME of COUNT ITEMS of SIZE bytes, which begin with their names; -1: none.
static int find(const void *items, int count, size_t size, const char *name) {
    for (int i = 0; i < count; i++)
        if (strcmp((const char *)items + (size_t)i * size, name) == 0)
            return i;
    return -1;
}

static int find_axis(const struct plant *plant, const char *name) {
    return find(plant->axes, plant->axis_count, sizeof(*plant->axes), name);
}

static int find_delta(const struct plant *plant, const char *name) {
    return find(plant->deltas, plant->delta_count, sizeof(*plant->deltas), name);
}

static int find_bed(const struct plant *plant, const char *name) {
    return find(plant->beds, plant->bed_count, sizeof(*plant->beds), name);
}

int plant_text_body(const struct plant *plant, const char *name) {
    return find(plant->bodies, plant->body_count, sizeof(*plant->bodies), name);
}

int plant_text_stepper(const struct plant *plant, const char *name) {
    return find(plant->steppers, plant->stepper_count, sizeof(*plant->steppers), name);
}

int plant_text_fan(const struct plant *plant, const char *name) {
    return find(plant->fans, plant->fan_count, sizeof(*plant->fans), name);
}

int plant_text_sensor(const struct plant *plant, const char *name) {
    return find(plant->sensors, plant->sensor_count, sizeof(*plant->sensors), name);
}

int plant_text_tmc(const struct plant *plant, const char *name) {
    return find(plant->tmcs, plant->tmc_count, sizeof(*plant->tmcs), name);
}

static int read_value(const struct plant *plant, const struct plant_field *field, void *target,
                      const char *text) {
    static const char *const chips[] = {"tmc2208", "tmc2209"};
    static const char *const curves[] = {"beta", "steinhart", "rtd", "linear", "table"};
    char *out = (char *)target + field->offset;
    switch (field->type) {
    case NAME:
        return read_name(out, text);
    case PIN:
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
        return read_word((int *)out, text, curves, 5);
    case AXIS:
        return (*(int *)out = find_axis(plant, text)) < 0 ? -1 : 0;
    case BED:
        return (*(int *)out = find_bed(plant, text)) < 0 ? -1 : 0;
    case DELTA:
        return (*(int *)out = find_delta(plant, text)) < 0 ? -1 : 0;
    case BODY:
        return (*(int *)out = plant_text_body(plant, text)) < 0 ? -1 : 0;
    case STEPPER:
        return (*(int *)out = plant_text_stepper(plant, text)) < 0 ? -1 : 0;
    case CHIP:
        return read_word((int *)out, text, chips, 2);
    }
    return -1;
}

static void describe(const struct plant_field *field, char *out) {
    static const char *const words[] = {[NAME] = "a name of 1 to 63 characters",
                                        [PIN] = "a pin, PA0 to PI15",
                                        [FLAG] = "0 or 1",
                                        [SIGN] = "1 or -1",
                                        [CURVE] = "beta, steinhart, rtd, linear or table",
                                        [AXIS] = "an axis described above",
                                        [BED] = "a bed described above",
                                        [DELTA] = "a delta described above",
                                        [BODY] = "a body described above",
                                        [STEPPER] = "a stepper described above",
                                        [CHIP] = "tmc2208 or tmc2209"};
    if (field->type == NUMBER || field->type == WHOLE)
        snprintf(out, WANT, "expected a number of %g to %g", field->min, field->max);
    else
        snprintf(out, WANT, "expected %s", words[field->type]);
}

// Reads the fields of one line into TARGET.
int plant_text_fields(const struct plant_reader *reader, const struct plant_field *fields, size_t count,
                      char *rest, void *target) {
    uint32_t seen = 0;
    char *save, want[WANT];
    for (char *word = strtok_r(rest, " \t\r", &save); word; word = strtok_r(NULL, " \t\r", &save)) {
        size_t i = 0;
        size_t size = strcspn(word, "=");
        while (i < count && (strlen(fields[i].name) != size || strncmp(fields[i].name, word, size) != 0))
            i++;
        if (i == count || word[size] != '=')
            return plant_text_fail(reader, word, "there is no such field here");
        if (seen & 1u << i)
            return plant_text_fail(reader, word, "given twice");
        seen |= 1u << i;
        if (read_value(reader->plant, &fields[i], target, word + size + 1)) {
            describe(&fields[i], want);
            return plant_text_fail(reader, word, want);
        }
    }
    for (size_t i = 0; i < count; i++)
        if (!(seen & 1u << i) && !fields[i].may_lack)
            return plant_text_fail(reader, fields[i].name, "is missing");
    return 0;
}
