// SPDX-License-Identifier: Apache-2.0
// Filters of second-order sections: see sos_filter.h.
//
// A section has the coefficients b0, b1, b2, a1, a2 (a0 is 1) as fractions of 2^coeff_frac_bits and is
// computed in the transposed direct form II, with states that keep all bits of the products:
//   y = b0·x + s0;  s0 = b1·x - a1·y + s1;  s1 = b2·x - a2·y
#include "objects/sos_filter.h"

DECL_STATIC_STRING(sos_filter_sections, "Invalid sos_filter section");
DECL_STATIC_STRING(sos_filter_bits, "Invalid sos_filter fraction bits");

enum { MAX_SECTIONS = 16, MAX_BITS = 31, B0 = 0, B1, B2, A1, A2, COEFFICIENTS };

struct section {
    int32_t c[COEFFICIENTS];
    int64_t s0, s1; // as fractions of 2^coeff_frac_bits
};

struct sos_filter {
    int32_t offset, scale;
    uint8_t scale_bits, takes_offset; // the next reading is the offset
    uint8_t coeff_bits, active, max_sections;
    struct section sections[];
};

static const struct oid_type sos_filter_type = {"sos_filter"};

struct sos_filter *sos_filter_find(struct node *node, uint32_t oid) {
    return oid_find(node, oid, &sos_filter_type);
}

static int64_t rounded(int64_t value, uint8_t bits) {
    return bits ? (value + ((int64_t)1 << (bits - 1))) >> bits : value;
}

static int is_beyond(int64_t value) {
    return value > SOS_FILTER_LIMIT || value < -SOS_FILTER_LIMIT;
}

int sos_filter_apply(struct sos_filter *filter, int32_t reading, int32_t *out) {
    if (filter->takes_offset) {
        filter->offset = reading;
        filter->takes_offset = 0;
    }
    int64_t x = (int64_t)reading - filter->offset;
    if (x > INT32_MAX || x < INT32_MIN)
        return -1;
    x = rounded(x * filter->scale, filter->scale_bits);
    for (unsigned i = 0; i < filter->active && !is_beyond(x); i++) {
        struct section *section = &filter->sections[i];
        const int32_t *c = section->c;
        int64_t y = rounded(c[B0] * x + section->s0, filter->coeff_bits);
        if (is_beyond(y))
            return -1;
        section->s0 = c[B1] * x - c[A1] * y + section->s1;
        section->s1 = c[B2] * x - c[A2] * y;
        x = y;
    }
    *out = (int32_t)x;
    return is_beyond(x) ? -1 : 0;
}

// -------------------------------------------------------------------------------------------- commands

void command_config_sos_filter(struct node *node, const struct wire_arg *args) {
    if (args[1].value > MAX_SECTIONS) {
        node_shutdown(node, STRING(sos_filter_sections));
        return;
    }
    struct sos_filter *filter = oid_create(node, args[0].value, &sos_filter_type,
                                           sizeof(*filter) + args[1].value * sizeof(struct section));
    if (!filter)
        return;
    filter->scale = 1;
    filter->max_sections = (uint8_t)args[1].value;
}
DECL_COMMAND(command_config_sos_filter, "config_sos_filter oid=%c max_sections=%c", 0);

// Section INDEX of filter OID; null after a shutdown.
static struct section *find_section(struct node *node, uint32_t oid, uint32_t index) {
    struct sos_filter *filter = sos_filter_find(node, oid);
    if (!filter)
        return NULL;
    if (index >= filter->max_sections) {
        node_shutdown(node, STRING(sos_filter_sections));
        return NULL;
    }
    return &filter->sections[index];
}

void command_sos_filter_set_section(struct node *node, const struct wire_arg *args) {
    struct section *section = find_section(node, args[0].value, args[1].value);
    if (!section)
        return;
    for (int i = 0; i < COEFFICIENTS; i++)
        section->c[i] = (int32_t)args[2 + i].value;
}
DECL_COMMAND(command_sos_filter_set_section,
             "sos_filter_set_section oid=%c section_idx=%c sos0=%i sos1=%i sos2=%i sos3=%i sos4=%i", 0);

// The states are whole numbers here, in units of the filtered reading.
void command_sos_filter_set_state(struct node *node, const struct wire_arg *args) {
    struct section *section = find_section(node, args[0].value, args[1].value);
    if (!section)
        return;
    const struct sos_filter *filter = sos_filter_find(node, args[0].value);
    section->s0 = (int64_t)(int32_t)args[2].value * ((int64_t)1 << filter->coeff_bits);
    section->s1 = (int64_t)(int32_t)args[3].value * ((int64_t)1 << filter->coeff_bits);
}
DECL_COMMAND(command_sos_filter_set_state, "sos_filter_set_state oid=%c section_idx=%c state0=%i state1=%i",
             0);

void command_sos_filter_set_offset_scale(struct node *node, const struct wire_arg *args) {
    struct sos_filter *filter = sos_filter_find(node, args[0].value);
    if (!filter)
        return;
    if (args[3].value > MAX_BITS) {
        node_shutdown(node, STRING(sos_filter_bits));
        return;
    }
    filter->offset = (int32_t)args[1].value;
    filter->scale = (int32_t)args[2].value;
    filter->scale_bits = (uint8_t)args[3].value;
    filter->takes_offset = args[4].value != 0;
}
DECL_COMMAND(command_sos_filter_set_offset_scale,
             "sos_filter_set_offset_scale oid=%c offset=%i scale=%i scale_frac_bits=%c auto_offset=%c", 0);

// Comes before the states, which it makes fractions of.
void command_sos_filter_set_active(struct node *node, const struct wire_arg *args) {
    struct sos_filter *filter = sos_filter_find(node, args[0].value);
    if (!filter)
        return;
    if (args[1].value > filter->max_sections) {
        node_shutdown(node, STRING(sos_filter_sections));
        return;
    }
    if (args[2].value > MAX_BITS) {
        node_shutdown(node, STRING(sos_filter_bits));
        return;
    }
    filter->active = (uint8_t)args[1].value;
    filter->coeff_bits = (uint8_t)args[2].value;
}
DECL_COMMAND(command_sos_filter_set_active, "sos_filter_set_active oid=%c n_sections=%c coeff_frac_bits=%c",
             0);
