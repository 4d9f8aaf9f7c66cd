// SPDX-License-Identifier: Apache-2.0
#include "coordinator/motion/gcode_lines.h"
#include <math.h>
#include <string.h>

// ---- Numbers
// -----------------------------------------------------------------------------------------------

__extension__ typedef unsigned __int128 wide;

enum { MAX_DIGITS = 19, EXACT_POWERS = 22 };
static const double POWER_OF_TEN[EXACT_POWERS + 1] = {1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,
                                                      1e8,  1e9,  1e10, 1e11, 1e12, 1e13, 1e14, 1e15,
                                                      1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};

static inline int is_digit(char c) {
    return c >= '0' && c <= '9';
}

// mantissa / 10^decimals, rounded once.
static double scale_down(uint64_t mantissa, uint32_t decimals) {
    // Both operands are exact doubles, so IEEE division rounds the exact quotient.
    if (mantissa <= UINT64_C(1) << 53)
        return (double)mantissa / POWER_OF_TEN[decimals];
    // At least 64 bits of quotient, the lowest of them set when a remainder is left: that rounds as the exact
    // value would. 10^decimals < 2^64 as decimals <= 19.
    uint64_t divisor = 1;
    for (uint32_t i = 0; i < decimals; i++)
        divisor *= 10;
    int up = __builtin_clzll(mantissa), down = __builtin_clzll(divisor);
    wide numerator = (wide)(mantissa << up) << 64;
    divisor <<= down;
    wide quotient = numerator / divisor;
    quotient |= numerator % divisor != 0;
    return ldexp((double)quotient, down - up - 64);
}

size_t gcode_number(const char *text, size_t size, double *value) {
    const char *at = text, *end = text + size;
    int negative = at < end && *at == '-';
    if (at < end && (*at == '-' || *at == '+'))
        at++;
    uint64_t mantissa = 0;
    uint32_t digits = 0, decimals = 0; // digits: without leading zeros
    int any = 0, point = 0;
    for (; at < end; at++) {
        if (is_digit(*at)) {
            any = 1;
            digits += digits || *at != '0';
            decimals += (uint32_t)point;
            if (digits > MAX_DIGITS || decimals > MAX_DIGITS)
                return 0;
            mantissa = mantissa * 10 + (uint64_t)(*at - '0');
        } else if (*at == '.' && !point) {
            point = 1;
        } else {
            break;
        }
    }
    if (!any)
        return 0;
    double magnitude = scale_down(mantissa, decimals);
    *value = negative ? -magnitude : magnitude;
    return (size_t)(at - text);
}

// ---- Lines
// -------------------------------------------------------------------------------------------------

enum line_kind { LINE_BLANK, LINE_MOVE, LINE_OTHER };

static inline char upper(char c) {
    return c >= 'a' && c <= 'z' ? (char)(c - 32) : c;
}

// Behind blanks and "(...)"; a parenthesis that does not close is left standing.
static const char *skip_blanks(const char *at, const char *end) {
    for (;;) {
        while (at < end && (*at == ' ' || *at == '\t' || *at == '\r'))
            at++;
        if (at == end || *at != '(')
            return at;
        const char *close = memchr(at, ')', (size_t)(end - at));
        if (!close)
            return at;
        at = close + 1;
    }
}

// An unsigned integer below 65536; returns the position behind it, or NULL.
static const char *read_count(const char *at, const char *end, uint32_t *value) {
    const char *start = at;
    for (*value = 0; at < end && is_digit(*at) && *value < 6553; at++)
        *value = *value * 10 + (uint32_t)(*at - '0');
    return at == start || (at < end && is_digit(*at)) ? NULL : at;
}

static int checksum_is(const char *line, const char *star, const char *end) {
    uint32_t told;
    const char *behind = read_count(star + 1, end, &told);
    if (!behind)
        return 0;
    behind = skip_blanks(behind, end);
    uint8_t sum = 0;
    for (const char *at = line; at < star; at++)
        sum = (uint8_t)(sum ^ (uint8_t)*at);
    return sum == told && (behind == end || *behind == ';');
}

static const char *skip_line_number(const char *at, const char *end) {
    if (at == end || upper(*at) != 'N')
        return at;
    const char *digits = at + 1;
    for (at = digits; at < end && is_digit(*at);)
        at++;
    return at == digits ? digits - 1 : skip_blanks(at, end);
}

// "G0", "G1", "G01" and the like; NULL for anything else.
static const char *skip_move_word(const char *at, const char *end) {
    uint32_t code;
    if (at == end || upper(*at) != 'G')
        return NULL;
    at = read_count(at + 1, end, &code);
    return at && code <= 1 && (at == end || *at != '.') ? at : NULL;
}

static int word_index(char letter) {
    switch (upper(letter)) {
    case 'X':
        return 0;
    case 'Y':
        return 1;
    case 'Z':
        return 2;
    case 'E':
        return 3;
    case 'F':
        return 4;
    default:
        return -1;
    }
}

static enum line_kind read_words(const char *line, const char *at, const char *end,
                                 struct gcode_words *words) {
    words->given = 0;
    for (;;) {
        at = skip_blanks(at, end);
        if (at == end || *at == ';')
            return LINE_MOVE;
        if (*at == '*')
            return checksum_is(line, at, end) ? LINE_MOVE : LINE_OTHER;
        int index = word_index(*at++);
        if (index < 0 || words->given >> index & 1)
            return LINE_OTHER;
        size_t taken = gcode_number(at, (size_t)(end - at), &words->value[index]);
        if (!taken)
            return LINE_OTHER;
        words->given |= 1u << index;
        at += taken;
    }
}

static enum line_kind read_line(const char *line, const char *end, struct gcode_words *words) {
    const char *at = skip_blanks(line, end);
    if (at == end || *at == ';')
        return LINE_BLANK;
    at = skip_move_word(skip_line_number(at, end), end);
    return at ? read_words(line, at, end, words) : LINE_OTHER;
}

int gcode_move(struct gcode_state *state, struct planner *planner, const struct gcode_words *words) {
    double target[4], speed = state->speed;
    for (int axis = 0; axis < 4; axis++) {
        target[axis] = state->position[axis];
        if (!(words->given >> axis & 1))
            continue;
        int relative = state->relative || (axis == AXIS_E && state->relative_extrude);
        double value = words->value[axis] * state->unit;
        if (axis == AXIS_E)
            value *= state->extrude_factor;
        target[axis] = value + (relative ? state->position[axis] : state->base[axis]);
    }
    if (words->given >> 4 & 1)
        speed = words->value[4] * state->unit / 60;
    planner->line = (int64_t)state->lines + 1;
    if ((words->given & 15) && planner_add(planner, target, speed * state->speed_factor))
        return -1;
    memcpy(state->position, target, sizeof target);
    state->speed = speed;
    return 0;
}

int gcode_feed(struct gcode_state *state, struct planner *planner, const char *text, size_t size,
               size_t *offset, int final) {
    const char *line = text + *offset, *end = text + size;
    int status = GCODE_NEED_DATA;
    while (line < end) {
        const char *stop = memchr(line, '\n', (size_t)(end - line));
        if (!stop && !final)
            break;
        struct gcode_words words;
        enum line_kind kind = read_line(line, stop ? stop : end, &words);
        if (kind == LINE_OTHER) {
            status = GCODE_OTHER_LINE;
            break;
        }
        if (kind == LINE_MOVE) {
            if (!planner_ready(planner)) {
                status = GCODE_FULL;
                break;
            }
            if (gcode_move(state, planner, &words)) {
                status = GCODE_LIMIT;
                break;
            }
        }
        state->lines++;
        line = stop ? stop + 1 : end;
    }
    if (status == GCODE_NEED_DATA)
        planner_plan(planner);
    *offset = (size_t)(line - text);
    return status;
}
