// SPDX-License-Identifier: Apache-2.0
// The hot path of G-code: runs of G0/G1 lines, blank lines and comments go straight to the planner; G92 and
// M204, which slicers write every few moves, are carried out here too. The first line that is anything else
// is left to the caller, in its place in the order.
//
// A line: [N digits] command {letter number} [*checksum], command G0|G1 (letters X Y Z E F), G92 (X Y Z E) or
// M204 (S P T; not above the configured acceleration), letters in any case and order, each at most once,
// blanks between words optional, "(...)" anywhere between words, ";" and what follows ignored, CR LF or LF. A
// number: [+-] digits with at most one point, no exponent (E is an axis); the result is the double nearest to
// the decimal, whatever the locale. Lines that break a rule are "other" lines: Python says what is wrong with
// them. So are numbers of more than 19 digits, which Python converts.
#ifndef MOTION_GCODE_LINES_H
#define MOTION_GCODE_LINES_H

#include "coordinator/motion/planner_queue.h"
#include <stddef.h>

// cffi: begin
enum gcode_status { GCODE_NEED_DATA, GCODE_OTHER_LINE, GCODE_FULL, GCODE_LIMIT };
// Places of the letters X Y Z E F S P T; the first four are the axes.
enum { GCODE_F = 4, GCODE_S, GCODE_P, GCODE_T, GCODE_WORDS };
enum { GCODE_AXIS_WORDS = 0x0F, GCODE_MOVE_WORDS = 0x1F, GCODE_ACCEL_WORDS = 0xE0 }; // bits of given

// The state of the G-code language, lengths in mm.
struct gcode_state {
    double position[4];    // machine position of the last G-code target
    double base[4];        // machine position of the G-code origin (G92)
    double unit;           // mm per unit of X Y Z E and F
    double speed;          // mm/s, from F
    double speed_factor;   // M220
    double extrude_factor; // M221
    double print_accel;    // mm/s², P of M204 since the last S; 0: none. The lower of the two holds
    double travel_accel;   // T
    int32_t relative, relative_extrude;
    uint64_t lines; // read so far
};

// The words of one line; bit i of given says that value[i] was.
struct gcode_words {
    double value[GCODE_WORDS];
    uint32_t given;
};

// Reads lines from text[*offset] up to SIZE and adds their moves. *offset then stands behind the last line
// consumed, at the line that the status is about:
//   GCODE_NEED_DATA   no whole line is left (FINAL: the last line may lack its line feed, all was consumed)
//   GCODE_OTHER_LINE  the caller's turn; it continues behind that line and counts it in state->lines
//   GCODE_FULL        planner_ready said no
//   GCODE_LIMIT       the move is refused, see planner->fault; nothing changed
int gcode_feed(struct gcode_state *state, struct planner *planner, const char *text, size_t size,
               size_t *offset, int final);

// Acts on the words of a G0/G1 line. Call planner_ready first. Returns 0, or -1 as planner_add.
int gcode_move(struct gcode_state *state, struct planner *planner, const struct gcode_words *words);

// Acts on the words of M204. Returns 0, or -1 with nothing changed when there is none, or one is too small,
// or the acceleration above what is configured.
int gcode_accel(struct gcode_state *state, struct planner *planner, const struct gcode_words *words);

// Reads a number from text[0..size). Returns the bytes it takes, 0 when there is no number or one of more
// than 19 digits.
size_t gcode_number(const char *text, size_t size, double *value);
// cffi: end

#endif
