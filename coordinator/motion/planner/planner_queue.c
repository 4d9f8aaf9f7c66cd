// SPDX-License-Identifier: Apache-2.0
#include "coordinator/motion/growing_ring.h"
#include "coordinator/motion/planner/planner_internal.h"
#include <math.h>
#include <stddef.h>
#include <string.h>

// Flanks of the smooth profile are equal but for rounding; less than this is neither rise nor fall.
static const double FLAT = 1e-9;
// Rounding bends straight runs by less than this; no corner limit, even 0, may stop them.
static const double STRAIGHT_COS2 = 1e-16; // turn of 2e-8 rad
static const double EVEN_FLOW = 1e-9;      // mm of filament per mm of path
enum { PLAN_AFTER_MIN = 32 };
// A streamer has to know early what long moves are: what is added beyond plan_until cannot be paused.
static const double PLAN_AFTER_S = 0.25;

static inline struct planned_move *move_at(struct planner *p, uint64_t index) {
    return &p->queue[index & (p->queue_room - 1)];
}

static inline int ring_is_full(const struct planner *p) {
    return p->ring_tail - p->ring_head == PLANNER_RING;
}

static void stand_still(struct planner *p) {
    p->settled_v2 = p->settled_smooth_v2 = p->hill_scanned = p->head;
    p->speed = p->speed_v2 = p->hill_top_v2 = 0;
    p->hill_closed = p->falling = 0;
    p->fresh = 0;
    p->fresh_s = 0;
    p->plan_after = PLAN_AFTER_MIN;
}

void planner_init(struct planner *p, const struct planner_limits *limits, const double position[4]) {
    memset(p, 0, offsetof(struct planner, queue));
    p->queue_room = p->ring_room = RING_FIRST_ROOM;
    p->limits = *limits;
    p->accel = p->travel_accel = limits->max_accel;
    memcpy(p->position, position, sizeof p->position);
    p->plan_until = INFINITY;
    stand_still(p);
}

// ---- Junctions
// ---------------------------------------------------------------------------------------------

// Bound of v² where A meets B.
static double junction_v2(const struct planned_move *a, const struct planned_move *b,
                          double corner_velocity) {
    if (a->extrude_only || b->extrude_only)
        return 0;
    double v2 = min_of(a->cruise_v2, b->cruise_v2);
    double jump = fabs(a->ratio[AXIS_E] - b->ratio[AXIS_E]);
    if (jump > EVEN_FLOW) {
        double speed = corner_velocity / jump;
        v2 = min_of(v2, speed * speed);
    }
    // cos² and sin² of θ/2, half the inner angle, from the difference and the sum of the directions: each is
    // precise where the other one's complement would not be.
    double cos2 = 0, sin2 = 0;
    for (int axis = 0; axis < 3; axis++) {
        double difference = a->ratio[axis] - b->ratio[axis], sum = a->ratio[axis] + b->ratio[axis];
        cos2 += 0.25 * difference * difference;
        sin2 += 0.25 * sum * sum;
    }
    if (cos2 <= STRAIGHT_COS2)
        return v2;
    double sine = sqrt(sin2);
    double arc = sine * (1 + sine) / cos2; // = sin/(1−sin)
    v2 = min_of(v2, min_of(a->corner_v2, b->corner_v2) * arc);
    double half_tangent = 0.5 * sine / sqrt(cos2);
    return min_of(v2, min_of(a->length * a->accel, b->length * b->accel) * half_tangent);
}

static void bound_start(struct planned_move *move, const struct planned_move *before) {
    move->max_start_v2 = min_of(move->junction_v2, before->max_start_v2 + before->reach_v2);
    move->max_smooth_start_v2 =
        min_of(move->junction_v2, before->max_smooth_start_v2 + before->smooth_reach_v2);
}

int planner_add(struct planner *p, const double target[4], double speed) {
    if (p->tail - p->head == PLANNER_QUEUE)
        return planner_refuse(p, PLANNER_NO_FAULT, 0, 0, 0, 0);
    ring_make_room(p->queue, sizeof *p->queue, p->head, p->tail, &p->queue_room, PLANNER_QUEUE);
    struct planned_move *move = move_at(p, p->tail);
    int what = planner_describe(p, move, target, speed);
    if (what <= 0) {
        p->moves_dropped += what == 0;
        return what;
    }
    planner_note_slowed(p, move, speed);
    const struct planner_limits *l = &p->limits;
    double corner_v2 = l->square_corner_velocity * l->square_corner_velocity * (M_SQRT2 - 1);
    move->corner_v2 = corner_v2 * (move->accel / planner_asked_accel(p, move));
    move->reach_v2 = 2 * move->accel * move->length;
    move->smooth_reach_v2 =
        move->extrude_only ? move->reach_v2 : move->reach_v2 * (1 - l->minimum_cruise_ratio);
    if (p->head == p->tail) { // begins at standstill
        move->junction_v2 = move->max_start_v2 = move->max_smooth_start_v2 = 0;
    } else {
        const struct planned_move *before = move_at(p, p->tail - 1);
        move->junction_v2 = junction_v2(before, move, l->instantaneous_corner_velocity);
        bound_start(move, before);
    }
    for (int axis = 0; axis < 4; axis++)
        if (move->ratio[axis] != 0)
            p->position[axis] = target[axis];
    int prints = move->ratio[AXIS_E] > 0 && (move->ratio[AXIS_X] != 0 || move->ratio[AXIS_Y] != 0);
    move->pressure_advance = prints ? p->pressure_advance : 0;
    move->line = p->line;
    p->tail++;
    p->moves_added++;
    p->fresh_s += move->length / sqrt(move->cruise_v2);
    if (++p->fresh >= p->plan_after || p->fresh_s >= PLAN_AFTER_S)
        planner_plan(p);
    return 0;
}

// ---- Backward pass
// -----------------------------------------------------------------------------------------

// Start speeds as if the program ended after the last move. A start that reaches its bound from the moves
// before is settled, and so is everything before it; there the pass may end.
static void look_back(struct planner *p) {
    uint64_t stop = p->settled_v2 < p->settled_smooth_v2 ? p->settled_v2 : p->settled_smooth_v2;
    uint64_t settled = p->settled_v2, settled_smooth = p->settled_smooth_v2;
    double end_v2 = 0, smooth_end_v2 = 0;
    for (uint64_t i = p->tail; i-- > stop;) {
        struct planned_move *move = move_at(p, i);
        end_v2 += move->reach_v2;
        if (end_v2 >= move->max_start_v2) {
            end_v2 = move->max_start_v2;
            settled = i > settled ? i : settled;
        }
        move->start_v2 = end_v2;
        smooth_end_v2 += move->smooth_reach_v2;
        if (smooth_end_v2 >= move->max_smooth_start_v2) {
            smooth_end_v2 = move->max_smooth_start_v2;
            settled_smooth = i > settled_smooth ? i : settled_smooth;
        }
        move->smooth_start_v2 = smooth_end_v2;
    }
    p->settled_v2 = settled;
    p->settled_smooth_v2 = settled_smooth;
    p->fresh = 0;
    p->fresh_s = 0;
}

// ---- Handing out
// -------------------------------------------------------------------------------------------

static double end_v2_of(struct planner *p, uint64_t index) {
    return index + 1 == p->tail ? 0 : move_at(p, index + 1)->start_v2;
}

static double smooth_end_v2_of(struct planner *p, uint64_t index) {
    return index + 1 == p->tail ? 0 : move_at(p, index + 1)->smooth_start_v2;
}

// Top of the smooth profile within a move.
static double smooth_peak_v2(struct planner *p, uint64_t index) {
    const struct planned_move *move = move_at(p, index);
    double start = move->smooth_start_v2, end = smooth_end_v2_of(p, index);
    double peak = min_of(move->cruise_v2, 0.5 * (start + end + move->smooth_reach_v2));
    return max_of(peak, max_of(start, end));
}

static int exceeds(double peak_v2, double base_v2) {
    return peak_v2 > base_v2 * (1 + FLAT);
}

// Enters the hill that begins at head if the junction there is a valley, then climbs as far as is settled.
static void climb_hill(struct planner *p) {
    if (p->falling && exceeds(smooth_peak_v2(p, p->head), move_at(p, p->head)->smooth_start_v2)) {
        p->hill_top_v2 = 0;
        p->hill_scanned = p->head;
        p->hill_closed = p->falling = 0;
    }
    while (!p->hill_closed && p->hill_scanned < p->settled_smooth_v2) {
        double peak = smooth_peak_v2(p, p->hill_scanned);
        p->hill_top_v2 = max_of(p->hill_top_v2, peak);
        p->hill_closed = exceeds(peak, smooth_end_v2_of(p, p->hill_scanned));
        p->hill_scanned++;
    }
}

static void hand_out(struct planner *p, const struct planned_move *move, double end_v2, double cruise_v2) {
    ring_make_room(p->ring, sizeof *p->ring, p->ring_head, p->ring_tail, &p->ring_room, PLANNER_RING);
    struct trapezoid *out = &p->ring[p->ring_tail++ & (p->ring_room - 1)];
    double start_v2 = p->speed_v2, accel = move->accel;
    double triangle_v2 = 0.5 * (start_v2 + end_v2 + move->reach_v2);
    double end = sqrt(end_v2);
    int cruises = cruise_v2 < triangle_v2;
    cruise_v2 = max_of(cruises ? cruise_v2 : triangle_v2, max_of(start_v2, end_v2));
    double cruise = sqrt(cruise_v2);
    // Equal squares need not have equal roots when one was carried along: no phase may last less than 0.
    out->accel_s = max_of(0, cruise - p->speed) / accel;
    out->decel_s = max_of(0, cruise - end) / accel;
    out->cruise_s = cruises ? (triangle_v2 - cruise_v2) / (accel * cruise) : 0;
    out->cruise_s = max_of(0, out->cruise_s);
    out->print_time = p->print_time;
    out->start_v = p->speed;
    out->cruise_v = cruise;
    out->accel = accel;
    memcpy(out->start, move->start, sizeof out->start);
    memcpy(out->ratio, move->ratio, sizeof out->ratio);
    out->pressure_advance = move->pressure_advance;
    out->line = move->line;
    p->print_time += out->accel_s + out->cruise_s + out->decel_s;
    p->speed = end;
    p->speed_v2 = end_v2;
}

// Hands out moves before STOP that are settled.
static void hand_out_settled(struct planner *p, uint64_t stop) {
    while (p->head < stop && !ring_is_full(p)) {
        climb_hill(p);
        const struct planned_move *move = move_at(p, p->head);
        double top_v2 = p->hill_top_v2, end_v2 = end_v2_of(p, p->head);
        double cruise_v2 = min_of(move->cruise_v2, 0.5 * (p->speed_v2 + end_v2 + move->reach_v2));
        if (!p->hill_closed && p->settled_smooth_v2 < p->tail) {
            // The hill goes on: it is at least this high. Wait if that could slow this move down.
            top_v2 = max_of(top_v2, smooth_peak_v2(p, p->settled_smooth_v2));
            if (cruise_v2 > top_v2)
                return;
        }
        p->falling |= exceeds(smooth_peak_v2(p, p->head), smooth_end_v2_of(p, p->head));
        hand_out(p, move, min_of(end_v2, top_v2), min_of(cruise_v2, top_v2));
        p->head++;
    }
}

void planner_plan(struct planner *p) {
    if (p->fresh)
        look_back(p);
    hand_out_settled(p, p->settled_v2 < p->settled_smooth_v2 ? p->settled_v2 : p->settled_smooth_v2);
    uint32_t open = (uint32_t)(p->tail - p->head) / 2;
    p->plan_after = open > PLAN_AFTER_MIN ? open : PLAN_AFTER_MIN;
}

// Hands out moves before STOP as if no move came after the last one. The speed at the new head is a fact for
// all that follow.
static void hand_out_unsettled(struct planner *p, uint64_t stop) {
    planner_plan(p);
    p->settled_v2 = p->settled_smooth_v2 = p->tail;
    hand_out_settled(p, stop);
    if (p->head == p->tail) {
        stand_still(p);
        return;
    }
    struct planned_move *move = move_at(p, p->head);
    move->max_start_v2 = move->start_v2 = p->speed_v2;
    move->max_smooth_start_v2 = move->smooth_start_v2;
    for (uint64_t i = p->head + 1; i < p->tail; i++)
        bound_start(move_at(p, i), move_at(p, i - 1));
    p->settled_v2 = p->settled_smooth_v2 = p->hill_scanned = p->head;
    // Only where both profiles meet may a new hill begin, that is, may a lower top bound what comes.
    p->falling = p->falling && !exceeds(p->speed_v2, move->smooth_start_v2);
    p->hill_closed = p->falling;
    p->fresh = 1; // the pass is due
}

int planner_ready(struct planner *p) {
    if (ring_is_full(p) || p->print_time >= p->plan_until)
        return 0;
    if (p->tail - p->head < PLANNER_QUEUE)
        return 1;
    planner_plan(p);
    if (p->tail - p->head == PLANNER_QUEUE && !ring_is_full(p)) {
        uint64_t before = p->head;
        hand_out_unsettled(p, p->head + PLANNER_QUEUE / 2);
        p->moves_overflowed += p->head - before;
    }
    return p->tail - p->head < PLANNER_QUEUE;
}

int planner_flush(struct planner *p) {
    if (p->head != p->tail)
        hand_out_unsettled(p, p->tail);
    return p->head == p->tail;
}

// ---- Between moves
// -----------------------------------------------------------------------------------------

int planner_wait(struct planner *p, double seconds) {
    if (p->head != p->tail || !(seconds >= 0) || isinf(seconds))
        return -1;
    p->print_time += seconds;
    return 0;
}

int planner_begin_at(struct planner *p, double print_time) {
    if (p->head != p->tail || !isfinite(print_time))
        return -1;
    p->print_time = max_of(p->print_time, print_time);
    return 0;
}

int planner_set_position(struct planner *p, const double position[4]) {
    if (p->head != p->tail)
        return -1;
    memcpy(p->position, position, sizeof p->position);
    return 0;
}

const struct trapezoid *planner_peek(const struct planner *p, uint32_t *count) {
    uint32_t first = (uint32_t)p->ring_head & (p->ring_room - 1);
    uint32_t all = (uint32_t)(p->ring_tail - p->ring_head);
    *count = all < p->ring_room - first ? all : p->ring_room - first;
    return &p->ring[first];
}

int planner_release(struct planner *p, uint32_t count) {
    if (count > p->ring_tail - p->ring_head)
        return -1;
    p->ring_head += count;
    return 0;
}
