// SPDX-License-Identifier: Apache-2.0
// The hot path of G-code: runs of G0/G1 and G2/G3 lines, blank lines and comments go straight to the planner;
// G92 and M204, which slicers write every few moves, are carried out here too. The first line that is
// anything else is left to the caller, in its place in the order.
//
// A line: [N digits] command {letter number} [*checksum], command G0|G1 (letters X Y Z E F), G2|G3 (also
// I J K R), G92 (X Y Z E) or M204 (S P T; not above the configured acceleration), letters in any case and
// order, each at most once, blanks between words optional, "(...)" anywhere between words, ";" and what
// follows ignored, CR LF or LF. A number: [+-] digits with at most one point, no exponent (E is an axis); the
// result is the double nearest to the decimal, whatever the locale. Lines that break a rule are "other"
// lines: Python says what is wrong with them. So are numbers of more than 19 digits, which Python converts.
#ifndef MOTION_GCODE_LINES_H
#define MOTION_GCODE_LINES_H

#include "coordinator/motion/planner/planner_queue.h"
#include <stddef.h>

// cffi: begin
enum gcode_status { GCODE_NEED_DATA, GCODE_OTHER_LINE, GCODE_FULL, GCODE_LIMIT };
// Places of the letters X Y Z E F S P T I J K R; the first four are the axes.
enum { GCODE_F = 4, GCODE_S, GCODE_P, GCODE_T, GCODE_I, GCODE_J, GCODE_K, GCODE_R, GCODE_WORDS };
// Bits of given.
enum { GCODE_AXIS_WORDS = 0x0F, GCODE_MOVE_WORDS = 0x1F, GCODE_ACCEL_WORDS = 0xE0, GCODE_ARC_WORDS = 0xF1F };
// Kinds of lines; bits 1 << kind of gcode_state.left_out.
enum gcode_kind {
    GCODE_BLANK,
    GCODE_MOVE,
    GCODE_ORIGIN,
    GCODE_ACCEL,
    GCODE_ARC_CW,
    GCODE_ARC_CCW,
    GCODE_OTHER
};
enum gcode_plane { GCODE_XY, GCODE_ZX, GCODE_YZ };
// Of gcode_state.tower.
enum { GCODE_NO_TOWER, GCODE_TOWER, GCODE_TOWER_DUE };

// An arc on its way: a polygon of PIECES, of which DONE are planned. Its corners lie on the arc (on a spiral
// where the radii at its ends differ); it ends exactly where the line says.
struct gcode_arc {
    double start[4], target[4], center[2]; // mm; the center in the plane's two axes
    double angle, sweep;                   // rad: of the start as seen from the center, and to the end
    double radius, radius_change, speed;   // mm, mm, mm/s
    int32_t axis[2];                       // of the plane, the first turns towards the second
    uint32_t pieces, done;
};

// Why an arc cannot be made.
enum gcode_arc_fault {
    GCODE_ARC_FINE,
    GCODE_ARC_NO_CENTER, // neither I J K of the plane nor R, or both
    GCODE_ARC_RADIUS,    // R is too short for the way, or the way is none
    GCODE_ARC_UNEQUAL,   // the center is not as far from the end as from the start
    GCODE_ARC_SPEED,     // F is below 0
    GCODE_ARC_HUGE,      // beyond what can be calculated, or more than 2^20 pieces
};

// The state of the G-code language, lengths in mm.
struct gcode_state {
    double position[4];    // machine position of the last G-code target
    double base[4];        // machine position of the G-code origin (G92)
    double unit;           // mm per unit of X Y Z E and F
    double speed;          // mm/s, from F
    double speed_factor;   // M220
    double extrude_factor; // M221
    int32_t relative, relative_extrude;
    uint64_t lines; // read so far

    double arc_piece;     // mm, longest piece of an arc
    double arc_deviation; // mm, how far a piece may be from its arc
    int32_t plane;        // enum gcode_plane, of arcs
    int32_t excluded;     // whether moves only change position, and are not made
    uint32_t left_out;    // kinds of lines that are the caller's
    double filament_top;  // mm, the highest E so far
    double tower_z;       // mm, height of the print that the caller knows of; a move that prints at another
    double tower_next_z;  // one is the caller's turn: tower becomes DUE, tower_next_z is that height
    int32_t tower;        // GCODE_TOWER: the caller wants to know the height of what is printed
    struct gcode_arc arc; // where arc.done < arc.pieces, it comes before the next line
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

// Acts on the words of a G0/G1 line. Call planner_ready first. Returns 0, or -1 as planner_add; F below 0 is
// refused also where nothing moves.
int gcode_move(struct gcode_state *state, struct planner *planner, const struct gcode_words *words);

// Begins the arc of a G2 or G3 line; gcode_arc_go_on plans it. Returns an enum gcode_arc_fault; with any but
// GCODE_ARC_FINE nothing changed.
int gcode_arc_begin(struct gcode_state *state, struct planner *planner, const struct gcode_words *words,
                    int clockwise);

// Plans what is left of the arc. Returns GCODE_NEED_DATA when it is done, GCODE_FULL when planner_ready said
// no (call again), GCODE_LIMIT when a piece is refused: nothing is left of it then.
int gcode_arc_go_on(struct gcode_state *state, struct planner *planner);

// Acts on the words of M204: S is for all moves, P for those with filament, T for others; of both P and T the
// lower one is for all. Returns 0, or -1 with nothing changed when there is none, or one is too small,
// or the acceleration above what is configured.
int gcode_accel(struct planner *planner, const struct gcode_words *words);

// Reads a number from text[0..size). Returns the bytes it takes, 0 when there is no number or one of more
// than 19 digits.
size_t gcode_number(const char *text, size_t size, double *value);
// cffi: end

#endif
