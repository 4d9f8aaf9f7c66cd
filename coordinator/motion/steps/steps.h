// SPDX-License-Identifier: Apache-2.0
// Step generation: planned moves in, one stream of timed commands per node out.
//
//   trapezoids ──► step times (closed form) ──► (interval, count, add) segments ──► merged per node ──► batch
//
// Where a stepper stands. Let u = sum(weights·position)/step_distance − origin. A stepper at n goes on to
// n + 1 when u crosses the boundary n + ½, if u then gets more than 1/STEP_TIE of a step beyond it before it
// comes back; downwards likewise at n − ½. So a rest or a turn at a half step (a tie) is decided once, by
// where the stepper came from, and neither the noise of floating point nor a rest makes a pair of opposite
// steps there. Where u rests within 1/STEP_TIE beyond a boundary and then goes on, the step is due when it
// goes on. Two opposite steps closer than the stepper's pulses allow (a turn just behind a boundary) cancel
// out: neither is done. If the first of them is already on its way (flushed), the second is put off until
// the pulses allow it.
//
// Segments. Step i (from 1) of a segment happens interval·i + add·i(i−1)/2 ticks after the last step before
// it, and not further from its true time than max_error and half the distance to either neighbour.
//
// All functions work on a struct in memory the caller owns, are safe without the interpreter lock, and must
// not be called for the same struct from two threads at once. None allocates or blocks.
#ifndef MOTION_STEPS_H
#define MOTION_STEPS_H

#include "coordinator/motion/trapezoid.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// cffi: begin
enum {
    STEP_MAX_STEPPERS = 64,
    STEP_MAX_NODES = 32,
    STEP_TRAPEZOIDS = 4096, // moves the generator holds
    STEP_BUFFER = 8192,     // steps of one stepper that wait for compression
    STEP_SEGMENTS = 8192,   // segments of one stepper that wait to be merged
    STEP_OUT_BYTES = 1 << 18,
    STEP_MOVE_COUNT_MAX = 65535,
    STEP_TIE = 1 << 20, // a tie is decided by more than 1/STEP_TIE of a step
    STEP_PARAMS = 8,
    STEP_IMPULSES = 8,         // of one axis' shaper
    STEP_TABLE_POINTS = 1024,  // of one axis' table
    STEP_SURFACE_POINTS = 256, // of a surface, along X and along Y
    STEP_SLACK_TICKS = 2,      // room for rounding that steps need beyond what the pulses need
    STEP_SMOOTH_MIN_US = 100,  // of a smooth time, but for 0
    STEP_SMOOTH_MAX_US = 200000,
};

enum step_status {
    STEP_OK = 0,
    STEP_FULL,       // batches wait to be taken; take them and repeat the call
    STEP_BAD_MOVE,   // a trapezoid's numbers are no legal move
    STEP_BAD_ORDER,  // a trapezoid begins before step_next_move
    STEP_JUMP,       // a trapezoid begins elsewhere than the stepper stands
    STEP_TOO_FAST,   // steps closer than the stepper's pulses allow
    STEP_TOO_DENSE,  // more segments at once than STEP_SEGMENTS
    STEP_NO_FIT,     // internal: a single step found no legal interval
    STEP_BAD_CHECK,  // internal: a segment did not replay to its step times
    STEP_NOT_IDLE,   // only possible when every appended move has been generated
    STEP_BAD_CLOCK,  // a clock that is no clock, or a time that it does not reach
    STEP_BAD_CONFIG, // see init
};

// How a stepper that is no sum of axes follows the head: see step_formula.h.
struct step_formula;

struct step_stepper_config {
    int32_t node, oid;
    const struct step_formula *formula; // NULL: position = Σ weights[i]·axis[i] over X Y Z E
    double weights[4];
    double params[8];
    double step_distance; // mm (angles: rad), > 0
    int32_t invert_dir;
    double step_pulse_s;
};

struct step_node_config {
    double clock_freq; // ticks/s
    int32_t move_count;
    int32_t queue_step_id, set_next_step_dir_id, reset_step_clock_id;
};

struct step_config {
    int32_t stepper_count, node_count;
    const struct step_stepper_config *steppers; // read by init only
    const struct step_node_config *nodes;
    double max_error_s;
    double start[4];  // mm, where the axes stand; steppers count steps from here
    double longest_s; // of a command, first step to last; 0: no limit
};

// What is added to an axis's planned position, at the end of the last move that was appended.
struct step_correction {
    int32_t points, reverse; // of its table; whether its reverse side is in use
    double offset, lag;      // mm: all of it; the part of it that will still fade
};

// The shape of a bed: see step_surface.h. Nodes in rows of X: height (mm), its slopes by X and by Y (mm/mm),
// its twist (by both, 1/mm). FADE_FROM and FADE_TO are the infinite where nothing fades.
// Patches, each between four nodes, in rows of X: the height as powers of U and V, the share of the way
// across the patch along X and Y; coefficient 4·i + j is of U^i·V^j. step_surface_make_patches writes them.
struct step_surface {
    int32_t points_x, points_y;            // 2..STEP_SURFACE_POINTS; points_x 0: no surface
    double from_x, from_y, step_x, step_y; // mm
    double fade_from, fade_to, fade_target;
    const double *nodes;   // 4 values each; must stay there until another surface is set
    const double *patches; // 16 values each; likewise
};

// What went wrong, for the sentence the user reads. Fields that do not apply are -1 or 0.
struct step_error {
    int32_t status, stepper;
    double print_time; // s
    double value;      // STEP_TOO_FAST: s between steps; STEP_JUMP: steps
};

struct step_stepper_stats {
    int64_t position;     // steps since init, what the last generated time asks for
    int64_t issued;       // steps since init, what the commands in batches add up to
    int64_t issued_clock; // the node's clock at the last of them
    uint64_t steps, queue_steps, direction_changes, commands, content_bytes;
    uint64_t cancelled, put_off; // opposite steps closer than the pulses allow, see above
    double worst_error_ticks;
    double worst_error_s;
    double max_step_rate; // steps/s
};

struct step_node_stats {
    uint64_t commands, content_bytes;
    uint64_t framed_bytes;  // content packed into blocks in this order, with their headers and trailers
    uint64_t late_slots;    // commands whose slot becomes free only after they are due: move_count too small
    int32_t max_slots;      // most slots in use at any command's req_clock
    uint32_t waiting_bytes; // batch not yet taken
};

struct step_gen;

// The formula of that name (coordinator/kinematics/NAME.c), or NULL.
const struct step_formula *step_find_formula(const char *name);

// Bytes that init needs, or 0 when CONFIG is not legal: counts within the limits above, node indices in
// range, every length, frequency and error finite and > 0, longest_s ≥ 0, ids in 32 bits, max_error at least
// one tick.
size_t step_gen_size(const struct step_config *config);

// Whether SURFACE can be a bed: counts and lengths in range, slopes and fading not steeper than 1/2.
bool step_surface_is_legal(const struct step_surface *surface);

// Writes the patches of a legal SURFACE: (points_x - 1)·(points_y - 1) times 16 values.
void step_surface_make_patches(const struct step_surface *surface, double *patches);

// The slope that SURFACE has nowhere more of, mm/mm.
double step_surface_steepest(const struct step_surface *surface);

// Where Z has to be for the planned Z at X and Y, and the other way round.
double step_surface_motor_z(const struct step_surface *surface, double x, double y, double z);
double step_surface_planned_z(const struct step_surface *surface, double x, double y, double motor_z);

// Prepares a generator in MEMORY of step_gen_size() bytes, aligned for a double. Node clocks begin as
// ticks = print time · clock_freq.
struct step_gen *step_gen_init(void *memory, const struct step_config *config);

// Takes over up to N moves; returns how many had room (0..N), or a negative step_status.
int step_append(struct step_gen *gen, const struct trapezoid *moves, int n);

// Produces commands for everything before print time UNTIL; every move that begins before it must have been
// appended. Without FLUSH the last STEP_HOLD_S may be held back, so that segments continue over the border.
// STEP_FULL: take the batches and repeat with the same arguments.
int step_generate(struct step_gen *gen, double until, int flush);

// The time before which nothing more can be changed: UNTIL of the last complete step_generate.
double step_generated_until(const struct step_gen *gen);

// The earliest begin of the next move. After a flush, and after a change of a shaper or smoothing, that may
// be later than step_generated_until: a move acts on step times up to step_look_ahead before it.
double step_next_move(const struct step_gen *gen);

// How a node's clock runs: ticks = ticks + (print time − time)·ticks_per_s. Only while no step waits.
int step_set_clock_base(struct step_gen *gen, int node, double time, int64_t ticks, double ticks_per_s);

// From the generated border on, NODE's clock runs with TICKS_PER_S; continuous at the border.
int step_set_clock(struct step_gen *gen, int node, double ticks_per_s);

// The node's clock at a print time, whole ticks rounded down.
int64_t step_clock_at(const struct step_gen *gen, int node, double print_time);

// The axes stand at POSITION (mm, X Y Z E) from now on, without a step.
int step_set_axis_position(struct step_gen *gen, const double *position);

// Axis X, Y or Z moves to its planned position plus what its table of N points says there; N = 0: none. How
// sides change and jumps fade: step_table.h. TAKE_UP: mm/s, the bound of fading, lowered to a quarter of what
// the steppers' pulses allow. Only linear steppers are corrected rightly. Not a step is made now. Declaring
// positions makes the offsets 0 and starts on the forward side. STEP_NOT_IDLE as step_set_axis_position.
int step_set_table(struct step_gen *gen, int axis, int n, const double *position, const double *forward,
                   const double *reverse, double take_up);

// The motors of X Y Z stand OFFSET beyond their axes' declared positions, with the table's side given.
int step_set_corrections(struct step_gen *gen, const double *offset, const int32_t *reverse);

int step_get_correction(const struct step_gen *gen, int axis, struct step_correction *out);

// Z follows the shape of a bed from now on, without a step: the axes then stand at the planned Z that *Z
// gets. STEP_BAD_CONFIG: no legal surface (steeper than 1/2 counts as none), or a stepper that Z moves
// follows E, too. STEP_NOT_IDLE unless all has settled.
int step_set_surface(struct step_gen *gen, const struct step_surface *surface, double *z);

// Axis X, Y or Z moves as the sum of its planned motion, moved later by time_s[i] and scaled by amplitude[i].
// Amplitudes sum to 1, times are centred (sum of amplitude·time 0). STEP_NOT_IDLE unless all has settled.
int step_set_shaper(struct step_gen *gen, int axis, int n, const double *amplitude, const double *time_s);

// The stepper follows other axes from now on, without a step. STEP_NOT_IDLE unless all has settled.
int step_set_weights(struct step_gen *gen, int stepper, const double *weights);

// The stepper's E part is E + pressure_advance·E', weighted by a triangle of full width SMOOTH_S, from
// STEP_SMOOTH_MIN_US to STEP_SMOOTH_MAX_US. 0: plain E. STEP_NOT_IDLE unless all has settled.
int step_set_smooth_time(struct step_gen *gen, int stepper, double smooth_s);

// How far (s) step times depend on moves later than themselves: so much more is held back without a flush.
double step_look_ahead(const struct step_gen *gen);

// How long (s) after the last move's end steps may still come.
double step_lag(const struct step_gen *gen);

// Copies whole records of NODE's batch (nodes/link/core/batch.h) to OUT and removes them; returns their
// bytes.
size_t step_take_batch(struct step_gen *gen, int node, uint8_t *out, size_t room);

void step_stepper_stats(const struct step_gen *gen, int stepper, struct step_stepper_stats *out);
void step_node_stats(const struct step_gen *gen, int node, struct step_node_stats *out);
void step_last_error(const struct step_gen *gen, struct step_error *out);
// cffi: end

// mm: an axis that has gone back so far has turned
#define STEP_TABLE_TURN_MM 0.001
// s: how much of the newest time is held back so that segments may grow
#define STEP_HOLD_S 0.050
// s: how early before its first step a command is due at the latest, when the stepper rested before
#define STEP_LEAD_S 0.050
// s: how long after a stepper's last step its clock may be reset
#define STEP_RESET_MARGIN_S 0.010

#endif
