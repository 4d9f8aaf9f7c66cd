// SPDX-License-Identifier: Apache-2.0
#include "coordinator/motion/planner/gcode_internal.h"
#include "coordinator/motion/planner/planner_internal.h"
#include <math.h>
#include <string.h>

static const double MIN_ACCEL = 1e-3; // mm/s²

// ---- Numbers
// -----------------------------------------------------------------------------------------------

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
    // 10^decimals < 2^64 as decimals <= 19.
    uint64_t divisor = 1;
    for (uint32_t i = 0; i < decimals; i++)
        divisor *= 10;
    int up = __builtin_clzll(mantissa), down = __builtin_clzll(divisor);
    uint64_t rest = mantissa << up;
    divisor <<= down;
    // The quotient has 63 bits or more, the lowest of them set when a remainder is left: that rounds as the
    // exact value would. Bit by bit, since not every processor divides 128 bits; few numbers are so long.
    uint64_t quotient = rest >= divisor;
    rest -= quotient ? divisor : 0;
    for (int i = 0; i < 63; i++) {
        uint64_t bit = rest >> 63 || rest << 1 >= divisor;
        rest = (rest << 1) - (bit ? divisor : 0);
        quotient = quotient << 1 | bit;
    }
    return ldexp((double)(quotient | (rest != 0)), down - up - 63);
}

// Digits of up to 7 characters at once: the length of a number in a program is not predictable, so a loop
// over its digits costs a mispredicted branch each time.
enum { CHUNK = 8 };
static const uint32_t SMALL_POWER[CHUNK] = {1, 10, 100, 1000, 10000, 100000, 1000000, 10000000};

// Bytes of TEXT as a number, the first in the lowest byte.
static inline uint64_t load_chunk(const char *text) {
    uint64_t chunk;
    memcpy(&chunk, text, sizeof chunk);
#if __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
    chunk = __builtin_bswap64(chunk);
#endif
    return chunk;
}

// The digits that TEXT begins with: returns how many, CHUNK when there may be more.
static inline uint32_t read_digits(const char *text, uint32_t *value) {
    // '0' to '9' become 0 to 9; what then is 10 or above sets its byte's highest bit. A carry out of a byte
    // only disturbs characters behind the first that is no digit.
    uint64_t digits = load_chunk(text) ^ UINT64_C(0x3030303030303030);
    uint64_t others = ((digits + UINT64_C(0x7676767676767676)) | digits) & UINT64_C(0x8080808080808080);
    if (!others)
        return CHUNK;
    uint32_t count = (uint32_t)__builtin_ctzll(others) / 8;
    digits = (digits << 8) << (56 - 8 * count); // zeros in front; 64 at once would be undefined
    digits = digits * 10 + (digits >> 8);       // pairs, in every other byte
    digits = (digits & UINT64_C(0x000000FF000000FF)) * (100 + (UINT64_C(1000000) << 32)) +
             (digits >> 16 & UINT64_C(0x000000FF000000FF)) * (1 + (UINT64_C(10000) << 32));
    *value = (uint32_t)(digits >> 32);
    return count;
}

// Any number, digit by digit.
static size_t read_long_number(const char *text, size_t size, double *value) {
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

size_t gcode_number(const char *text, size_t size, double *value) {
    if (size < 2 * CHUNK + 2) // sign, digits, point, digits
        return read_long_number(text, size, value);
    const char *at = text + (*text == '-' || *text == '+');
    uint32_t whole, decimals = 0, count = read_digits(at, &whole), places = 0;
    at += count;
    if (*at == '.')
        places = read_digits(++at, &decimals);
    if (count == CHUNK || places == CHUNK)
        return read_long_number(text, size, value);
    if (count + places == 0)
        return 0;
    // Both operands are exact doubles, so IEEE division rounds the exact quotient.
    double magnitude =
        (double)(int64_t)((uint64_t)whole * SMALL_POWER[places] + decimals) / SMALL_POWER[places];
    *value = *text == '-' ? -magnitude : magnitude;
    return (size_t)(at - text) + places;
}

// ---- Lines
// -------------------------------------------------------------------------------------------------

static inline char upper(char c) {
    return (char)(c >= 'a' && c <= 'z' ? c - 32 : c);
}

static const char *skip_comments(const char *at, const char *end) {
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

// Behind blanks and "(...)"; a parenthesis that does not close is left standing.
static inline const char *skip_blanks(const char *at, const char *end) {
    if (at < end && *at == ' ')
        at++;
    return at < end && *at > '(' ? at : skip_comments(at, end);
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

// "G1", "M204", "G01" and the like; NULL for what has no place here.
static const char *read_command(const char *at, const char *end, enum gcode_kind *kind) {
    if (at == end)
        return NULL;
    char letter = upper(*at);
    uint32_t code;
    at = read_count(at + 1, end, &code);
    if (!at || (at < end && *at == '.'))
        return NULL;
    if (letter == 'G' && code <= 1)
        *kind = GCODE_MOVE;
    else if (letter == 'G' && code <= 3)
        *kind = code == 2 ? GCODE_ARC_CW : GCODE_ARC_CCW;
    else if (letter == 'G' && code == 92)
        *kind = GCODE_ORIGIN;
    else if (letter == 'M' && code == 204)
        *kind = GCODE_ACCEL;
    else
        return NULL;
    return at;
}

// 1 + index into gcode_words.value; 0 for letters that have none.
static inline int word_place(char letter) {
    static const uint8_t PLACE[32] = {['X' & 31] = 1, ['Y' & 31] = 2,  ['Z' & 31] = 3,  ['E' & 31] = 4,
                                      ['F' & 31] = 5, ['S' & 31] = 6,  ['P' & 31] = 7,  ['T' & 31] = 8,
                                      ['I' & 31] = 9, ['J' & 31] = 10, ['K' & 31] = 11, ['R' & 31] = 12};
    return (letter & 0xC0) == 0x40 ? PLACE[letter & 31] : 0;
}

// The words of a command from AT on, which may be those of ALLOWED; READABLE: end of the text.
static int read_words(const char *line, const char *at, const char *end, const char *readable,
                      uint32_t allowed, struct gcode_words *words) {
    uint32_t given = 0;
    for (;;) {
        at = skip_blanks(at, end);
        if (at == end || *at == ';')
            break;
        if (*at == '*') {
            if (!checksum_is(line, at, end))
                return 0;
            break;
        }
        int place = word_place(*at++);
        uint32_t bit = place ? 1u << (place - 1) : 0;
        if (!(allowed & bit & ~given))
            return 0;
        // No number goes beyond its line: a line feed ends it.
        size_t taken = gcode_number(at, (size_t)(readable - at), &words->value[place - 1]);
        if (!taken)
            return 0;
        given |= bit;
        at += taken;
    }
    words->given = given;
    return 1;
}

static enum gcode_kind read_line(const char *line, const char *end, const char *readable,
                                 struct gcode_words *words) {
    static const uint32_t ALLOWED[] = {[GCODE_MOVE] = GCODE_MOVE_WORDS,   [GCODE_ORIGIN] = GCODE_AXIS_WORDS,
                                       [GCODE_ACCEL] = GCODE_ACCEL_WORDS, [GCODE_ARC_CW] = GCODE_ARC_WORDS,
                                       [GCODE_ARC_CCW] = GCODE_ARC_WORDS, [GCODE_OTHER] = 0};
    const char *at = skip_blanks(line, end);
    if (at == end || *at == ';')
        return GCODE_BLANK;
    enum gcode_kind kind = GCODE_OTHER;
    at = read_command(skip_line_number(at, end), end, &kind);
    return at && read_words(line, at, end, readable, ALLOWED[kind], words) ? kind : GCODE_OTHER;
}

// ---- What a line does
// --------------------------------------------------------------------------------------

double gcode_speed(const struct gcode_state *state, const struct gcode_words *words) {
    return words->given >> GCODE_F & 1 ? words->value[GCODE_F] * state->unit / 60 : state->speed;
}

void gcode_target(const struct gcode_state *state, const struct gcode_words *words, double target[4]) {
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
}

int gcode_go(struct gcode_state *state, struct planner *planner, const double target[4], double speed) {
    if (!state->excluded && planner_add(planner, target, speed * state->speed_factor))
        return -1;
    memcpy(state->position, target, sizeof state->position);
    if (target[AXIS_E] > state->filament_top)
        state->filament_top = target[AXIS_E];
    return 0;
}

static void set_origin(struct gcode_state *state, const struct gcode_words *words) {
    for (int axis = 0; axis < 4; axis++) {
        double scale = axis == AXIS_E ? state->unit * state->extrude_factor : state->unit;
        double value = words->given >> axis & 1 ? words->value[axis] : 0;
        if (!words->given || words->given >> axis & 1)
            state->base[axis] = state->position[axis] - value * scale;
    }
}

int gcode_accel(struct planner *planner, const struct gcode_words *words) {
    const uint32_t print = words->given >> GCODE_P & 1, travel = words->given >> GCODE_T & 1;
    double accel = planner->accel, travel_accel = planner->travel_accel;
    if (words->given >> GCODE_S & 1) {
        accel = travel_accel = words->value[GCODE_S];
    } else if (print && travel) {
        accel = travel_accel = fmin(words->value[GCODE_P], words->value[GCODE_T]);
    } else if (print) {
        accel = words->value[GCODE_P];
    } else if (travel) {
        travel_accel = words->value[GCODE_T];
    }
    for (int i = GCODE_S; i <= GCODE_T; i++)
        if (words->given >> i & 1 && !(words->value[i] >= MIN_ACCEL))
            return -1;
    if (!words->given || !(fmax(accel, travel_accel) <= planner->limits.max_accel))
        return -1;
    planner->accel = accel;
    planner->travel_accel = travel_accel;
    return 0;
}

int gcode_move(struct gcode_state *state, struct planner *planner, const struct gcode_words *words) {
    double target[4], speed = gcode_speed(state, words);
    gcode_target(state, words, target);
    planner->line = (int64_t)state->lines + 1;
    if (speed < 0) // also where nothing moves: it would be saved, and refused when it is restored
        return planner_refuse(planner, PLANNER_SPEED, 0, speed, 0, INFINITY);
    if ((words->given & GCODE_AXIS_WORDS) && gcode_go(state, planner, target, speed))
        return -1;
    state->speed = speed;
    return 0;
}

// Whether a move with these words prints at another height than the tower has seen.
static int at_new_height(struct gcode_state *state, const struct gcode_words *words) {
    double target[4];
    if (state->excluded)
        return 0;
    gcode_target(state, words, target);
    const double *here = state->position;
    if (!(target[AXIS_E] > here[AXIS_E]) || target[AXIS_Z] == state->tower_z ||
        (target[AXIS_X] == here[AXIS_X] && target[AXIS_Y] == here[AXIS_Y]))
        return 0;
    state->tower_next_z = target[AXIS_Z];
    state->tower = GCODE_TOWER_DUE;
    return 1;
}

// Whether the line was carried out; *STATUS says why not.
static int act(struct gcode_state *state, struct planner *planner, enum gcode_kind kind,
               const struct gcode_words *words, int *status) {
    *status = GCODE_OTHER_LINE;
    if (kind == GCODE_OTHER || state->left_out >> kind & 1)
        return 0;
    if (kind == GCODE_ACCEL)
        return !gcode_accel(planner, words);
    if (kind == GCODE_ORIGIN)
        set_origin(state, words);
    if (kind == GCODE_BLANK || kind == GCODE_ORIGIN)
        return 1;
    if (state->tower && at_new_height(state, words))
        return 0;
    *status = GCODE_FULL;
    if (!planner_ready(planner))
        return 0;
    if (kind == GCODE_MOVE) {
        *status = GCODE_LIMIT;
        return !gcode_move(state, planner, words);
    }
    *status = GCODE_OTHER_LINE; // the caller says what is wrong with the arc
    if (gcode_arc_begin(state, planner, words, kind == GCODE_ARC_CW))
        return 0;
    *status = gcode_arc_go_on(state, planner);
    return *status == GCODE_NEED_DATA;
}

int gcode_feed(struct gcode_state *state, struct planner *planner, const char *text, size_t size,
               size_t *offset, int final) {
    const char *line = text + *offset, *end = text + size;
    int status = GCODE_NEED_DATA;
    while (line < end) {
        const char *stop = memchr(line, '\n', (size_t)(end - line));
        if (!stop && !final)
            break;
        if (state->arc.done < state->arc.pieces) { // of this line, which the planner had no room for
            status = gcode_arc_go_on(state, planner);
            if (status != GCODE_NEED_DATA)
                break;
        } else {
            struct gcode_words words;
            enum gcode_kind kind = read_line(line, stop ? stop : end, end, &words);
            if (!act(state, planner, kind, &words, &status))
                break;
            status = GCODE_NEED_DATA;
        }
        state->lines++;
        line = stop ? stop + 1 : end;
    }
    if (status == GCODE_NEED_DATA)
        planner_plan(planner);
    *offset = (size_t)(line - text);
    return status;
}
