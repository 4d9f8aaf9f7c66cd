// SPDX-License-Identifier: Apache-2.0
// Look-ahead: takes straight moves, gives trapezoids (trapezoid.h).
//
// Every move gets the highest speeds that all limits allow, given every move behind it. A move is handed out
// as soon as no later move can change it, so the result does not depend on how the input was cut into pieces
// (only an overflowing queue can, see planner_ready). The rules, v² being the speed squared at a junction:
//
//   * Junction. The corner is taken as an arc of deviation jd = scv²·(√2−1)/a, scv being the square corner
//     velocity and a the acceleration asked for: v² <= R·a', R = jd·sin(θ/2)/(1−sin(θ/2)), where a' is the
//     acceleration of the move (lower than a where Z or E limits it) and θ the inner angle of the corner. The
//     arc that touches both lines within half of each move bounds it too: v² <= a'·(length/2)·tan(θ/2). The
//     filament's speed jumps by at most the instantaneous corner velocity. Between a move of E alone and any
//     other move the machine stands still.
//   * Reach. Over a move v² changes by at most 2·a'·length.
//   * Minimum cruise. A second profile is computed with the lower acceleration a'·(1−minimum_cruise_ratio).
//     Between two of its valleys, no move is faster than the top of that hill; up to there it may use a'.
//
// The caller owns struct planner and everything in it; no function allocates or keeps other state. One thread
// at a time. Cost per move: constant (each is visited a handful of times), however long the program.
#ifndef MOTION_PLANNER_QUEUE_H
#define MOTION_PLANNER_QUEUE_H

#include "coordinator/motion/trapezoid.h"
#include <stdint.h>

// cffi: begin
// Moves that wait for what follows them, and trapezoids that wait for the caller. Powers of two.
enum { PLANNER_QUEUE = 4096, PLANNER_RING = 2048 };

// Why a move was refused.
enum planner_fault_kind {
    PLANNER_NO_FAULT,
    PLANNER_NOT_HOMED,     // axis
    PLANNER_OUTSIDE,       // axis; value: where to (mm), bounds low and high
    PLANNER_EXTRUDE_LONG,  // value: mm of filament in one move of E alone or backward, bound high
    PLANNER_EXTRUDE_RATIO, // value: mm of filament per mm of path, bound high
    PLANNER_SPEED,         // value: mm/s, below the bound low (or not a number)
    PLANNER_TOO_FAR,       // value: mm from the Z axis at the end, bound high
    PLANNER_TOO_NEAR,      // value: mm from the Z axis where the way is nearest, bound low
    PLANNER_COLD,          // value: mm of filament to be moved by an extruder that is cold
};

struct planner_fault {
    int32_t kind, axis;
    double value, low, high;
};

// Which limit of speed a move first runs into.
enum planner_speed_limit {
    PLANNER_LIMIT_PATH, // max_velocity
    PLANNER_LIMIT_X,    // max_x_velocity, and so on
    PLANNER_LIMIT_Y,
    PLANNER_LIMIT_Z,
    PLANNER_LIMIT_FILAMENT, // max_extrude_only_velocity
    PLANNER_SPEED_LIMITS
};

// Moves that a limit made slower than they asked for.
struct planner_slowed {
    uint64_t moves;
    int64_t first_line, worst_line;
    double asked, allowed; // mm/s along the move of WORST_LINE, which lost the largest share
};

// As MotionLimits in specs.py: mm, s.
struct planner_limits {
    double max_velocity, max_accel, max_z_velocity, max_z_accel;
    double square_corner_velocity, minimum_cruise_ratio;
    double position_min[3], position_max[3];
    double max_extrude_only_velocity, max_extrude_only_accel, max_extrude_only_distance;
    double max_extrude_ratio, instantaneous_corner_velocity;
    double max_x_velocity, max_x_accel, max_y_velocity, max_y_accel; // 0: none
    double max_radius, radius_min;                                   // 0: none
    double cone_top, cone_slope[2];                                  // slopes 0: none
    double tower_radius, tower_rod;                                  // rod 0: no delta
};

// v2: square of a speed, (mm/s)². The smooth values belong to the profile of the minimum cruise.
struct planned_move {
    double start[4], ratio[4];                // as in struct trapezoid
    double length, accel;                     // mm, mm/s²
    double cruise_v2;                         // highest speed
    double corner_v2;                         // scv²·(√2−1)·a'/a
    double junction_v2;                       // bound of the start by the corner
    double reach_v2, smooth_reach_v2;         // by how much v² may change over the move
    double max_start_v2, max_smooth_start_v2; // bound of the start by all moves before
    double start_v2, smooth_start_v2;         // start if the program ended after the last move
    double pressure_advance;
    int64_t line;
    int32_t extrude_only;
};

struct planner {
    struct planner_limits limits; // may change between moves; holds for moves added later
    double accel;                 // mm/s² asked for moves with filament, at most limits.max_accel
    double travel_accel;          // of moves without
    double position[4];           // mm, end of the last move added
    double pressure_advance;      // s; holds for the moves added later that print (E forward, X or Y moves)
    int64_t line;                 // of the program, noted with moves added later; 0: none
    uint32_t homed;               // bit per axis X Y Z
    uint32_t cold;                // whether moves of filament are refused
    double plan_until;            // print time, s: planner_ready says no when trapezoids reach beyond it
    struct planner_fault fault;   // why planner_add said no

    double print_time; // s, end of the last trapezoid handed out
    uint64_t moves_added, moves_dropped, moves_overflowed;
    struct planner_slowed slowed[PLANNER_SPEED_LIMITS];

    // Queue: moves [head, tail). Junctions up to settled_v2 (settled_smooth_v2) cannot change any more.
    uint64_t head, tail, settled_v2, settled_smooth_v2;
    uint32_t fresh, plan_after; // moves since the last backward pass, and after how many comes the next
    double fresh_s;             // what they last at least; a pass is also due after a while of motion
    double speed, speed_v2;     // mm/s and square of it at head
    // The hill of the minimum-cruise profile at head: top of its moves before scanned, whether that is the
    // top of the whole hill, and whether the top lies behind head.
    double hill_top_v2;
    uint64_t hill_scanned;
    int32_t hill_closed, falling;

    uint64_t ring_head, ring_tail;
    uint32_t queue_room, ring_room; // in use; see growing_ring.h
    struct planned_move queue[PLANNER_QUEUE];
    struct trapezoid ring[PLANNER_RING];
};

// Begins at standstill at POSITION, print time 0, nothing homed.
void planner_init(struct planner *p, const struct planner_limits *limits, const double position[4]);

// Whether a move can be added. No while the ring is full or reaches beyond plan_until: take trapezoids first.
// When the queue is full of moves that later ones could still change, the older half is planned as if the
// newest were the last: safe, perhaps slower than possible (moves_overflowed counts).
int planner_ready(struct planner *p);

// Adds a move to TARGET (mm, X Y Z E) at SPEED mm/s, measured as trapezoid.h says. Call planner_ready first.
// Returns 0, or -1 with the reason in p->fault (none: the queue is full) and nothing changed. Moves shorter
// than 1 nm are dropped; what they were short of goes to the next.
int planner_add(struct planner *p, const double target[4], double speed);

// Hands out what no later move can change.
void planner_plan(struct planner *p);

// Plans everything to a standstill. Returns 1 when done, 0 when the ring is full (take some, call again).
int planner_flush(struct planner *p);

// Print time moves on by SECONDS >= 0, or to PRINT_TIME if that is later. Only after a complete flush;
// returns -1 otherwise, or when the value is not a finite number.
int planner_wait(struct planner *p, double seconds);
int planner_begin_at(struct planner *p, double print_time);

// The machine stands at POSITION from now on. Only after a complete flush; returns -1 otherwise.
int planner_set_position(struct planner *p, const double position[4]);

// The oldest trapezoids, *count of them in one piece; more may follow after planner_release. They are void
// once a move is added or planned.
const struct trapezoid *planner_peek(const struct planner *p, uint32_t *count);
// Gives back the oldest COUNT; returns -1 when there are not so many.
int planner_release(struct planner *p, uint32_t count);
// cffi: end

#endif
