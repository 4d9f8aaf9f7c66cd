// SPDX-License-Identifier: Apache-2.0
// Between the two files that read the description of a plant.
#ifndef BOARDS_PLANT_TEXT_H
#define BOARDS_PLANT_TEXT_H

#include "plant/plant.h"

enum plant_type { NAME, PIN, FLAG, SIGN, WHOLE, NUMBER, CURVE, AXIS, BED, BODY, STEPPER, CHIP };

struct plant_field {
    const char *name;
    enum plant_type type;
    size_t offset;
    double min, max;  // of a number
    uint8_t may_lack; // the value stands there already
};

struct plant_reader {
    struct plant *plant;
    char *error;
    int line;
};

// Says what is wrong with TEXT in this line; returns -1.
int plant_text_fail(const struct plant_reader *reader, const char *text, const char *what);
// Reads the words of REST, name=value, into TARGET; -1 after it has said what is wrong.
int plant_text_fields(const struct plant_reader *reader, const struct plant_field *fields, size_t count,
                      char *rest, void *target);
// The numbers of what has been described so far; -1: nothing of that name.
int plant_text_stepper(const struct plant *plant, const char *name);
int plant_text_body(const struct plant *plant, const char *name);
int plant_text_tmc(const struct plant *plant, const char *name);
int plant_text_fan(const struct plant *plant, const char *name);

#endif
