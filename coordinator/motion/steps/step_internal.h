// SPDX-License-Identifier: Apache-2.0
// What the files of step generation share. The manual is steps.h.
#ifndef MOTION_STEP_INTERNAL_H
#define MOTION_STEP_INTERNAL_H

#include "coordinator/motion/growing_ring.h"
#include "coordinator/motion/steps/steps.h"
#include "coordinator/motion/steps/times/step_formula.h"
#include "coordinator/motion/steps/times/step_surface.h"
#include "coordinator/motion/steps/times/step_table.h"

#include <math.h>
#include <stdbool.h>

enum {
    SEGMENT_COUNT_MAX = 65535,
    PREFIX_MAX = 10,     // id and oid as VLQ
    RESET_GAP = 1 << 30, // ticks; longer rests are bridged by reset_step_clock, far from the 2^31 of the wire
    FILL_BLOCK = 8,
    BUFFER_PAD = 16,     // the loops over steps work in blocks and may write behind the end
    STEP_STALLED = 1000, // internal status: no room for a segment now
    COMMANDS_PER_SEGMENT = 3,
    STEP_TAPS = 3 * STEP_IMPULSES + 1,
    USES_E = 1 << AXIS_E,
};

// What a stepper sees of a phase through a tap: its share of the position, powers of the time since TIME,
// which hold before BORDER.
struct seen {
    double time, border, poly[3];
    double axis[3][3]; // X Y Z, mm: of a stepper over a bed, instead of POLY
    bool still;
};

// Ticks of a node: whole + part + (print time − time)·ticks_per_s.
struct clock_map {
    double time, part, ticks_per_s;
    int64_t whole;
};

enum { SEGMENT_SET_DIR = 1, SEGMENT_DIR_VALUE = 2, SEGMENT_RESET = 4, SEGMENT_BACK = 8 };

struct segment {
    int64_t req, first, finish;
    int64_t reset_clock, reset_min;
    uint32_t interval;
    uint16_t count;
    int16_t add;
    uint8_t flags;
};

struct prefix {
    uint8_t bytes[PREFIX_MAX];
    uint8_t size;
};

struct stepper {
    struct step_stepper_config config;
    const struct clock_map *clock;
    double origin;    // steps
    int64_t position; // steps generated (cancelled ones included)
    uint64_t move;    // number of the trapezoid that is next
    uint64_t begun;   // one more than the number of the last trapezoid whose begin was checked

    // A stepper whose steps are not those of one move after the other: see step_curve.c.
    bool curve;
    bool follows_bed;       // its place depends on the shape of the bed
    bool between;           // linear, over a bed, and never beyond places of its axes
    uint64_t passed;        // the first move that it may still see
    unsigned uses;          // axes, a bit each
    double time, border;    // s: solved up to; to be solved up to
    double checked;         // s, where it was last seen to be where it should; -1: nowhere
    double reach, lag;      // s: how far it sees ahead; how long it moves on
    double smooth_s, angle; // angle: the last one, rad
    double crossed;         // s, when it came a tie's width beyond a boundary, still to be decided
    int crossed_direction;
    uint64_t cursor[STEP_TAPS + 3]; // moves; the last three are of the smoothing window
    struct seen seen[STEP_TAPS + 3];
    // Smoothed E: the last piece's polynomial and begin, and how many more pieces may go on from their last.
    double smoothed[5], smoothed_time;
    int trusted;

    // Steps that wait for compression: one direction, ticks relative to BASE. LOW and HIGH are their bands.
    double *ticks, *low, *high;
    size_t count;
    int direction; // +1, -1
    int64_t base;

    // The last step sent: its true time (relative to BASE), its clock, its direction (0: none yet).
    double sent_ticks;
    int64_t sent_clock;
    int sent_direction;
    uint32_t expected; // steps of the last segment: the next will not be much different

    double max_error_ticks, closest_ticks;
    int64_t pulse_ticks, lead_ticks, reset_margin_ticks;

    struct segment *segments; // ring
    uint64_t segments_from, segments_to;
    uint32_t segment_room; // see growing_ring.h
    struct prefix queue_step, set_dir, reset_clock;
    struct step_stepper_stats stats;
};

// Clocks in order, in a ring.
struct clocks {
    uint64_t *at;
    uint32_t first, count, room;
};

struct node {
    struct step_node_config config;
    struct clock_map clock;
    struct clocks slots; // finish clocks of the commands that may still hold a slot
    struct clocks busy;  // those of them that are unfinished at the newest req_clock
    uint64_t last_req;
    uint8_t *out;
    size_t out_from, out_to;
    uint32_t block_used;
    bool jammed; // OUT had no room for a command that is ready
    struct step_node_stats stats;
};

// The planned motion some time later, scaled for each axis.
struct tap {
    double time, amplitude[AXES];
    unsigned axes;
};

struct shaper {
    int n;
    double amplitude[STEP_IMPULSES], time[STEP_IMPULSES];
};

// Planned motion around a time: position and derivatives of each axis, constant acceleration up to BORDER.
struct motion {
    const double *from, *ratio; // of the axes: place is from + ratio·way
    double way, speed, accel;   // along the move
    double pressure_advance, border;
};

static inline double place_of(const struct motion *m, int axis) {
    return m->from[axis] + m->ratio[axis] * m->way;
}

static inline double speed_of(const struct motion *m, int axis) {
    return m->ratio[axis] * m->speed;
}

static inline double accel_of(const struct motion *m, int axis) {
    return m->ratio[axis] * m->accel;
}

// A stretch of constant acceleration in one direction; lengths in any unit.
struct phase {
    double time, seconds; // s
    double from, way;     // along the move
    double speed, accel;  // at the slow end; 0: cruise
    bool backwards;
    const double *solved; // or s from TIME of each step, FILL_BLOCK readable behind the last; x counts them
};

// Loops over steps, compiled for what the processor has; the same arithmetic either way.
#if defined(__x86_64__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__) &&                          \
    !defined(__SANITIZE_THREAD__)
#define STEP_VECTOR __attribute__((target_clones("avx2", "default")))
#else
#define STEP_VECTOR
#endif

struct step_arithmetic;

struct step_gen {
    const struct step_arithmetic *arithmetic;
    int32_t stepper_count, node_count;
    struct stepper *steppers;
    struct node *nodes;
    struct trapezoid *moves;                  // ring
    uint32_t move_room;                       // see growing_ring.h
    uint64_t kept_from, moves_from, moves_to; // kept, not yet generated, end
    double rest[AXES];                        // mm, where the axes stand before the first kept move
    struct axis_table tables[3];              // X Y Z; kept moves and REST include what they add
    double *table_values[3];                  // room for three columns of STEP_TABLE_POINTS each
    bool corrected;                           // a table acts
    struct surface surface;                   // of the bed; added when steppers are evaluated
    struct shaper shapers[3];
    struct tap taps[STEP_TAPS];
    int tap_count;
    double known;   // s, up to which the moves are known
    double assumed; // s, up to which a flush took the machine to rest
    double until;   // s, end of the last complete slice
    double slice;   // s, end of the slice in work; UNTIL when none is
    double moves_end, max_error_s, longest_s;
    struct step_error error;
};

static inline struct trapezoid *step_move(const struct step_gen *gen, uint64_t number) {
    return &gen->moves[number & (gen->move_room - 1)];
}

static inline struct segment *step_segment(const struct stepper *s, uint64_t number) {
    return &s->segments[number & (s->segment_room - 1)];
}

static inline double move_end(const struct trapezoid *m) {
    return m->print_time + m->accel_s + m->cruise_s + m->decel_s;
}

// Times that differ by less are the same: sums of durations round differently.
#define ROUNDING_S 1e-9

static inline bool is_over(double end, double until) {
    return end <= until + ROUNDING_S;
}

// Ticks at PRINT_TIME relative to BASE.
static inline double clock_relative(const struct clock_map *map, double print_time, int64_t base) {
    return (print_time - map->time) * map->ticks_per_s + map->part + (double)(map->whole - base);
}

static inline double clock_print_time(const struct clock_map *map, double ticks, int64_t base) {
    return (ticks - (double)(map->whole - base) - map->part) / map->ticks_per_s + map->time;
}

int step_fail(struct step_gen *gen, enum step_status status, const struct stepper *stepper, double print_time,
              double value);

// step_times.c: appends the stepper's steps before UNTIL to its buffer, compressing when it fills.
int step_times_advance(struct step_gen *gen, struct stepper *stepper, double until);

// Where a stepper at POSITION stands when it came to U: see steps.h.
int64_t step_settle(double u, int64_t position);

// Appends COUNT steps of a phase in DIRECTION, the first at X from the phase's begin, DX apart. On a status
// the stepper's position tells how far it came.
int step_put(struct step_gen *gen, struct stepper *stepper, const struct phase *phase, int direction,
             double x, double dx, int64_t count);

// step_axes.c: the planned motion at TIME; CURSOR remembers the move and only goes forward.
void step_locate(const struct step_gen *gen, uint64_t *cursor, double time, struct motion *out);
void step_forget(struct stepper *stepper);
void step_move_end_position(const struct trapezoid *move, double *position);
void step_end_position(const struct step_gen *gen, double *position);
void step_make_taps(struct step_gen *gen);
void step_choose_way(struct step_gen *gen, struct stepper *stepper);
bool step_settled(const struct step_gen *gen);

// step_smooth.c: E of a smoothed stepper as a polynomial of the time since TIME, valid up to the result. TIME
// is where the last polynomial still holds.
double step_smooth(const struct step_gen *gen, struct stepper *stepper, double time, double poly[5]);

// step_curve.c: as step_times_advance, for a stepper whose CURVE is set.
int step_curve_advance(struct step_gen *gen, struct stepper *stepper, double until);

void step_rebase(struct stepper *stepper, int64_t base);

// step_compress.c: turns the first FINAL waiting steps, which can no longer change, into segments. NEXT: when
// the step behind them comes at the earliest. A segment that might still grow is kept, unless its first step
// comes before FORCE. Times in ticks from the stepper's base.
int step_compress(struct step_gen *gen, struct stepper *stepper, size_t final, double next, double force);

// step_stream.c: moves what is certain from the steppers to the nodes' batches; returns the commands moved.
size_t step_merge(struct step_gen *gen, bool flush);
void step_make_prefix(struct prefix *prefix, int32_t id, int32_t oid);

#endif
