// SPDX-License-Identifier: Apache-2.0
// Interface between the two files that read the description of a plant.
#ifndef BOARDS_PLANT_TEXT_H
#define BOARDS_PLANT_TEXT_H

#include "plant/plant.h"

enum plant_type { NAME, PIN, FLAG, SIGN, WHOLE, NUMBER, CURVE, AXIS, BED, DELTA, BODY, STEPPER, CHIP };

struct plant_field {
    const char *name;
    enum plant_type type;
    size_t offset;
    double min, max;  // of a number
    uint8_t may_lack; // optional; the default is already set
};

struct plant_reader {
    struct plant *plant;
    char *error;
    int line;
};

// Writes the error WHAT about TEXT in this line; returns -1.
int plant_text_fail(const struct plant_reader *reader, const char *text, const char *what);
// Reads the words of REST, name=value, into TARGET; returns -1 after writing an error.
int plant_text_fields(const struct plant_reader *reader, const struct plant_field *fields, size_t count,
                      char *rest, void *target);
// The numbers of the items described so far; -1: no item of that name.
int plant_text_stepper(const struct plant *plant, const char *name);
int plant_text_body(const struct plant *plant, const char *name);
int plant_text_tmc(const struct plant *plant, const char *name);
int plant_text_fan(const struct plant *plant, const char *name);
int plant_text_sensor(const struct plant *plant, const char *name);

#endif
