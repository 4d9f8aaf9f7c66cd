// SPDX-License-Identifier: Apache-2.0
// Fuzzes the way from G-code text to commands: gcode_lines, planner_queue and step generation in a row.
//
// Input: three bytes of options (limits; unshaped or shaped with pressure advance; cartesian or delta), then
// text. Lines that the hot path leaves to its caller stand for what the caller does between lines: the first
// letter says what, the second byte how much (act). Whatever the text, no sanitizer may report, no number may
// become NaN, trapezoids must join without gaps and jumps and keep all limits, and the steps replayed from
// the emitted commands must stay in the machine.
#include "coordinator/motion/planner/gcode_lines.h"
#include "coordinator/motion/steps/steps.h"
#include "nodes/link/core/batch.h"
#include "wire/wire.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MUST(condition)                                                                                      \
    do {                                                                                                     \
        if (!(condition)) {                                                                                  \
            fprintf(stderr, "%s:%d: %s does not hold\n", __FILE__, __LINE__, #condition);                    \
            abort();                                                                                         \
        }                                                                                                    \
    } while (0)

enum { STEPPERS = 4, QUEUE_STEP = 11, SET_DIR = 12, RESET_CLOCK = 13, MAX_TEXT = 4096 };
static const double SIZE = 100, STEP = 0.1, MAX_RADIUS = 95, HOLE = 5;
static const double ARM = 400, TOWER = 150; // of a delta, mm
static const double NEAR = 1 + 1e-9;
static const double MAX_PRINT_TIME = 120; // s; step generation costs CPU for time, not only for steps

static const struct planner_limits LIMITS = {
    .max_velocity = 300,
    .max_accel = 8000,
    .max_z_velocity = 15,
    .max_z_accel = 500,
    .square_corner_velocity = 5,
    .minimum_cruise_ratio = 0.5,
    .position_min = {-100, -100, -100},
    .position_max = {100, 100, 100},
    .max_extrude_only_velocity = 100,
    .max_extrude_only_accel = 3000,
    .max_extrude_only_distance = 50,
    .max_extrude_ratio = 2,
    .instantaneous_corner_velocity = 1,
};

// One machine on its way through one input. Static: too big for the stack; set anew for each input.
static struct run {
    struct planner planner;
    struct gcode_state gcode;
    struct step_gen *steps;
    double speed, print_time, position[4]; // where the last trapezoid left off
    int64_t replayed[STEPPERS];            // steps, from the commands
    double origin[STEPPERS];               // steps: where a stepper stands when it has done none
    int delta, shaped;
    int direction[STEPPERS];
    uint64_t count;
    int over; // the text takes more print time than there is time to generate
} run;

// Place of a tower of a delta: 120 degrees apart.
static void tower(int i, double at[2]) {
    at[0] = TOWER * cos(i * 2 * M_PI / 3);
    at[1] = TOWER * sin(i * 2 * M_PI / 3);
}

// Where a stepper has to stand, in steps.
static double place(int i, const double p[4]) {
    double at[2];
    if (i == AXIS_E || !run.delta)
        return p[i] / STEP;
    tower(i, at);
    double dx = at[0] - p[0], dy = at[1] - p[1];
    return (p[2] + sqrt(ARM * ARM - dx * dx - dy * dy)) / STEP;
}

// X and Y shaped, E smoothed over 40 ms.
static void shape(void) {
    static const double AMPLITUDE[] = {0.25, 0.5, 0.25}, TIME_S[] = {-0.01, 0, 0.01};
    MUST(step_set_shaper(run.steps, AXIS_X, 3, AMPLITUDE, TIME_S) == STEP_OK);
    MUST(step_set_shaper(run.steps, AXIS_Y, 3, AMPLITUDE, TIME_S) == STEP_OK);
    MUST(step_set_smooth_time(run.steps, AXIS_E, 0.04) == STEP_OK);
    MUST(planner_begin_at(&run.planner, step_next_move(run.steps)) == 0);
}

static void begin(const uint8_t *options) {
    static void *memory;
    static const struct step_node_config NODE = {16e6, 1024, QUEUE_STEP, SET_DIR, RESET_CLOCK};
    struct step_stepper_config steppers[STEPPERS] = {0};
    run.delta = options[0] >> 7 & 1;
    for (int i = 0; i < STEPPERS; i++) {
        steppers[i].oid = i;
        steppers[i].weights[i] = 1;
        if (run.delta && i != AXIS_E) {
            steppers[i].formula = step_find_formula("delta");
            steppers[i].params[0] = ARM * ARM;
            tower(i, steppers[i].params + 1);
        }
        steppers[i].step_distance = STEP;
        steppers[i].step_pulse_s = 2e-6;
        run.direction[i] = 1;
    }
    struct step_config config = {.stepper_count = STEPPERS,
                                 .node_count = 1,
                                 .steppers = steppers,
                                 .nodes = &NODE,
                                 .max_error_s = 12.5e-6};
    if (options[0] & 4) // beginning outside of the hole
        run.position[0] = config.start[0] = SIZE / 2;
    for (int i = 0; i < STEPPERS; i++)
        run.origin[i] = place(i, run.position);
    if (!memory)
        memory = malloc(step_gen_size(&config));
    run.steps = step_gen_init(memory, &config);
    MUST(run.steps);
    struct planner_limits limits = LIMITS;
    if (options[0] & 1) {
        limits.max_x_velocity = 90;
        limits.max_y_accel = 700;
    }
    if (options[0] & 2)
        limits.max_radius = MAX_RADIUS;
    if (options[0] & 4)
        limits.radius_min = HOLE;
    planner_init(&run.planner, &limits, run.position);
    run.planner.homed = options[0] & 8 ? 3 : 7;
    run.planner.pressure_advance = options[0] & 16 ? 0.05 : 0;
    run.gcode = (struct gcode_state){.unit = options[0] & 32 ? 25.4 : 1, .speed = 25};
    memcpy(run.gcode.position, run.position, sizeof run.position);
    run.gcode.speed_factor = run.gcode.extrude_factor = 1;
    run.gcode.arc_piece = options[0] & 1 ? 10 : 1;
    run.gcode.arc_deviation = options[0] & 2 ? 0.5 : 0.005;
    run.gcode.plane = options[0] >> 3 & 1 ? GCODE_XY : options[0] & 16 ? GCODE_ZX : GCODE_YZ;
    if (options[0] & 64)
        shape();
}

// Distance of the way from BEFORE to AFTER from the Z axis.
static double nearest(const double before[4], const double after[4]) {
    double dx = after[0] - before[0], dy = after[1] - before[1];
    double ends = fmin(hypot(before[0], before[1]), hypot(after[0], after[1]));
    int passes = (dx * before[0] + dy * before[1] < 0) && (dx * after[0] + dy * after[1] > 0);
    return passes ? fabs(before[0] * dy - before[1] * dx) / hypot(dx, dy) : ends;
}

static void check_trapezoid(const struct trapezoid *t) {
    const struct planner_limits *l = &run.planner.limits;
    const double *numbers = (const double *)t;
    for (size_t i = 0; i < offsetof(struct trapezoid, line) / sizeof *numbers; i++)
        MUST(isfinite(numbers[i]));
    MUST(t->accel_s >= 0 && t->cruise_s >= 0 && t->decel_s >= 0 && t->accel > 0);
    MUST(t->print_time >= run.print_time && fabs(t->start_v - run.speed) < 1e-6);
    MUST(t->print_time == run.print_time || t->start_v == 0);
    MUST(t->cruise_v <= LIMITS.max_velocity * NEAR && t->accel <= LIMITS.max_accel * NEAR);
    MUST(fabs(t->ratio[2]) * t->cruise_v <= l->max_z_velocity * NEAR);
    MUST(fabs(t->ratio[2]) * t->accel <= l->max_z_accel * NEAR);
    MUST(l->max_x_velocity == 0 || fabs(t->ratio[0]) * t->cruise_v <= l->max_x_velocity * NEAR);
    MUST(l->max_y_accel == 0 || fabs(t->ratio[1]) * t->accel <= l->max_y_accel * NEAR);
    double accel_way = (t->start_v + t->accel * t->accel_s / 2) * t->accel_s;
    double way =
        accel_way + t->cruise_v * t->cruise_s + (t->cruise_v - t->accel * t->decel_s / 2) * t->decel_s;
    double before[4];
    memcpy(before, run.position, sizeof before);
    for (int axis = 0; axis < 4; axis++) {
        MUST(fabs(t->start[axis] - run.position[axis]) < 1e-6);
        run.position[axis] = t->start[axis] + t->ratio[axis] * way;
        MUST(axis == AXIS_E || fabs(run.position[axis]) <= SIZE + 1e-6);
    }
    if (t->ratio[0] != 0 || t->ratio[1] != 0) {
        MUST(l->max_radius == 0 || hypot(run.position[0], run.position[1]) <= MAX_RADIUS + 1e-6);
        MUST(l->radius_min == 0 || nearest(before, run.position) >= HOLE - 1e-6);
    }
    run.speed = t->cruise_v - t->accel * t->decel_s;
    run.print_time = t->print_time + (t->accel_s + t->cruise_s + t->decel_s);
    run.count++;
}

// ---- Steps
// -------------------------------------------------------------------------------------------------

static void replay(const struct batch_record *record) {
    const uint8_t *at = record->payload, *end = at + record->size;
    uint32_t words[5] = {0};
    for (int i = 0; i < 5 && at < end; i++)
        MUST(wire_vlq_decode(&at, end, &words[i]) == 0);
    uint32_t oid = words[1];
    MUST(oid < STEPPERS);
    if (words[0] == SET_DIR)
        run.direction[oid] = words[2] ? 1 : -1;
    if (words[0] != QUEUE_STEP)
        return;
    MUST(words[2] > 0 && words[3] > 0 && words[3] <= 65535);
    run.replayed[oid] += run.direction[oid] * (int64_t)words[3];
    double stands = ((double)run.replayed[oid] + run.origin[oid]) * STEP;
    if (run.delta && oid < 3)
        MUST(stands >= -SIZE - STEP && stands <= SIZE + ARM + STEP);
    else if (oid < 3) // nobody limits the filament
        MUST(fabs(stands) <= SIZE + STEP);
}

static void take_commands(void) {
    uint8_t out[4096];
    for (size_t size; (size = step_take_batch(run.steps, 0, out, sizeof out));) {
        struct batch_record record;
        for (size_t at = 0, whole; at < size; at += whole) {
            whole = batch_read(out + at, size - at, &record);
            MUST(whole);
            replay(&record);
        }
    }
}

static void generate(double until, int flush) {
    int status;
    while ((status = step_generate(run.steps, until, flush)) == STEP_FULL)
        take_commands();
    if (status != STEP_OK)
        fprintf(stderr, "step_generate: status %d\n", status);
    MUST(status == STEP_OK);
    take_commands();
}

static void take(uint32_t most) {
    uint32_t count;
    const struct trapezoid *waiting = planner_peek(&run.planner, &count);
    count = count < most ? count : most;
    for (uint32_t i = 0; i < count; i++) {
        check_trapezoid(&waiting[i]);
        run.over |= run.print_time > MAX_PRINT_TIME;
        if (run.over)
            continue;
        int taken;
        while ((taken = step_append(run.steps, &waiting[i], 1)) == 0)
            generate(waiting[i].print_time, 0);
        if (taken != 1)
            fprintf(stderr, "step_append: status %d\n", taken);
        MUST(taken == 1);
    }
    MUST(planner_release(&run.planner, count) == 0);
}

static void stand_still(void) {
    while (!planner_flush(&run.planner))
        take(PLANNER_RING);
    while (run.planner.ring_head != run.planner.ring_tail)
        take(PLANNER_RING);
    MUST(fabs(run.speed) < 1e-6);
    MUST(run.count == run.planner.moves_added);
    if (run.over)
        return;
    generate(fmax(run.planner.print_time + step_lag(run.steps), step_generated_until(run.steps)), 1);
    MUST(planner_begin_at(&run.planner, step_next_move(run.steps)) == 0);
    for (int i = 0; i < STEPPERS; i++) {
        struct step_stepper_stats stats;
        step_stepper_stats(run.steps, i, &stats);
        MUST(stats.issued == run.replayed[i] && stats.position == stats.issued);
        MUST(stats.worst_error_s <= 12.5e-6 * 1.001);
        MUST(fabs(place(i, run.position) - run.origin[i] - (double)run.replayed[i]) <= 0.5 + 1e-6);
    }
}

// ---- Lines
// -------------------------------------------------------------------------------------------------

static void declare(const double position[4]) {
    MUST(planner_set_position(&run.planner, position) == 0);
    MUST(step_set_axis_position(run.steps, position) == STEP_OK);
    memcpy(run.position, position, sizeof run.position);
    memcpy(run.gcode.position, position, sizeof run.gcode.position);
    for (int i = 0; i < STEPPERS; i++)
        run.origin[i] = place(i, position) - (double)run.replayed[i];
}

// What a caller may do between lines. Positions are whole steps.
static void act(char what, uint8_t much) {
    switch (what) {
    case 'A':
        run.planner.accel = LIMITS.max_accel / (1 + much);
        break;
    case 'V':
        run.planner.limits.max_velocity = LIMITS.max_velocity / (1 + much);
        break;
    case 'C':
        run.planner.limits.square_corner_velocity = much;
        break;
    case 'R':
        run.gcode.relative = much & 1;
        run.gcode.relative_extrude = much >> 1 & 1;
        break;
    case 'D':
        stand_still();
        MUST(planner_wait(&run.planner, much / 16.0) == 0);
        break;
    case 'H':
        stand_still();
        if (!run.over)
            declare((const double[4]){(much & 15) - 8.0, (much >> 4) - 8.0, 0, much});
        break;
    default:
        break;
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    if (size < 3 || size > MAX_TEXT)
        return 0;
    memset(&run, 0, sizeof run);
    begin(data);
    size_t piece = 1 + (size_t)data[1], offset = 0, end = 0;
    uint32_t portion = 1 + data[2];
    // A copy that ends where its bytes end: reading one byte beyond is a sanitizer's report.
    char *text = malloc(size - 3 + (size == 3));
    memcpy(text, data + 3, size -= 3);
    while (offset < size && !run.over) {
        end = end > offset ? end : offset;
        int status = gcode_feed(&run.gcode, &run.planner, text, end, &offset, end == size);
        take(portion);
        if (status == GCODE_NEED_DATA) {
            if (end == size)
                break;
            end = size - end < piece ? size : end + piece;
        } else if (status != GCODE_FULL) {
            const char *stop = memchr(text + offset, '\n', size - offset);
            size_t behind = stop ? (size_t)(stop + 1 - text) : size;
            if (status == GCODE_OTHER_LINE && behind - offset > 1)
                act(text[offset], (uint8_t)text[offset + 1]);
            run.gcode.lines++;
            offset = behind;
        }
        for (int i = 0; i < 4; i++)
            MUST(isfinite(run.gcode.position[i]) && isfinite(run.planner.position[i]));
    }
    stand_still();
    free(text);
    return 0;
}
