// SPDX-License-Identifier: Apache-2.0
// Steps are counted where they are made; an axis adds up counts of any nodes, a switch looks at its axis.
#include "plant/plant.h"

#include <math.h>

// Threshold and place are sums of products: steps that meet exactly on paper may miss by their rounding.
static const double ROUNDING = 1e-9;
static const double LATE_MM = 0.2;

int64_t plant_term_count(struct plant *plant, struct plant_term *term, uint64_t ns) {
    struct plant_reference *stepper = &term->stepper;
    if (stepper->peer < 0)
        return atomic_load_explicit(&plant->page->steppers[stepper->found].count, memory_order_relaxed);
    int found = plant_find(plant, stepper, PLANT_NOTHING);
    if (found < 0)
        return 0;
    return plant_page_count_at(&plant->peers[stepper->peer].page->steppers[found], ns);
}

double plant_axis_position(struct plant *plant, struct plant_axis *axis, uint64_t ns) {
    double position = axis->origin;
    for (int i = 0; i < axis->term_count; i++)
        position += axis->terms[i].mm * (double)plant_term_count(plant, &axis->terms[i], ns);
    return position;
}

static void settle(struct plant *plant, const struct plant_axis *axis, uint64_t ns) {
    for (int i = 0; i < axis->term_count && plant->host.settle; i++)
        if (axis->terms[i].stepper.peer >= 0)
            plant->host.settle(plant->host.context, (unsigned)axis->terms[i].stepper.peer, ns);
}

// ------------------------------------------------------------------------------------------------- steppers

// Whether a step of STEPPER would push an axis against its stop. Other nodes' steppers count as they stand.
static int is_blocked(struct plant *plant, int stepper, int direction, uint64_t ns) {
    for (int i = 0; i < plant->axis_count; i++) {
        struct plant_axis *axis = &plant->axes[i];
        if (isinf(axis->min) && isinf(axis->max))
            continue;
        for (int t = 0; t < axis->term_count; t++) {
            const struct plant_term *term = &axis->terms[t];
            if (term->stepper.peer >= 0 || term->stepper.found != stepper)
                continue;
            double way = term->mm * direction;
            double after = plant_axis_position(plant, axis, ns) + way;
            if ((way > 0 && after > axis->max + ROUNDING) || (way < 0 && after < axis->min - ROUNDING))
                return 1;
        }
    }
    return 0;
}

static int is_enabled(const struct plant *plant, const struct plant_stepper *stepper) {
    return stepper->enable_pin < 0 || plant->level[stepper->enable_pin] != (stepper->enable_inverted != 0);
}

void plant_steps_lost(struct plant *plant, uint64_t ns, int stepper, uint64_t steps) {
    struct plant_page_stepper *shown = &plant->page->steppers[stepper];
    uint64_t before = atomic_load_explicit(&shown->lost, memory_order_relaxed);
    atomic_store_explicit(&shown->lost, before + steps, memory_order_relaxed);
    if (!before) // the page goes on counting; a line for each would fill the disk
        plant_note(plant, ns, "lost", plant->steppers[stepper].name, (double)steps);
}

static void step(struct plant *plant, uint64_t ns, int number) {
    const struct plant_stepper *stepper = &plant->steppers[number];
    struct plant_page_stepper *shown = &plant->page->steppers[number];
    int direction = plant->level[stepper->dir_pin] != (stepper->dir_inverted != 0) ? 1 : -1;
    if (is_enabled(plant, stepper) && stepper->tmc >= 0)
        plant_tmc_step(plant, &plant->tmcs[stepper->tmc], ns, direction);
    else if (!is_enabled(plant, stepper) || is_blocked(plant, number, direction, ns))
        plant_steps_lost(plant, ns, number, 1);
    else
        plant_page_step(shown, ns, atomic_load_explicit(&shown->count, memory_order_relaxed) + direction);
}

void plant_motion_edge(struct plant *plant, uint64_t ns, uint32_t pin, int level) {
    for (int i = 0; i < plant->stepper_count; i++) {
        const struct plant_stepper *stepper = &plant->steppers[i];
        if (stepper->step_pin != (int)pin)
            continue;
        int both_edges = stepper->both_edges;
        if (stepper->tmc >= 0) {
            plant_tmc_look(plant, &plant->tmcs[stepper->tmc], ns);
            both_edges = plant_tmc_both_edges(&plant->tmcs[stepper->tmc]);
        }
        if (both_edges || level != (stepper->step_inverted != 0))
            step(plant, ns, i);
    }
}

// ------------------------------------------------------------------------------------------------- switches

static void set_pressed(struct plant *plant, struct plant_switch *it, int pressed, uint64_t ns) {
    it->pressed = pressed;
    it->switched++;
    if (!pressed) // the next approach finds it a little elsewhere
        it->shift = it->noise * plant_even(plant, (uint64_t)it->pin, it->switched);
    struct plant_page_item *item = &plant->page->items[plant->first_switch + (int)(it - plant->switches)];
    plant_page_store(&item->value, pressed);
    plant_page_store(&item->extra, (double)it->switched);
    plant_note(plant, ns, "switch", it->name, pressed);
}

static double bed_height(const struct plant *plant, const struct plant_bed *bed, double x, double y) {
    double dx = x - bed->x0;
    double dy = y - bed->y0;
    double far = (dx * dx + dy * dy) / (bed->radius * bed->radius);
    double bow = bed->bow;
    if (bed->body.name[0]) {
        double celsius = bed->body.peer < 0 ? plant_body_temperature(plant, bed->body.found) : bed->remote;
        bow += bed->warm_bow * (celsius - plant->ambient);
    }
    return bed->z + bed->tilt_x * dx + bed->tilt_y * dy + bow * (1 - far);
}

// The place of an axis whose steps are all in at NS; 0 where there is none.
static double settled_position(struct plant *plant, int axis, uint64_t ns) {
    if (axis < 0)
        return 0;
    settle(plant, &plant->axes[axis], ns);
    return plant_axis_position(plant, &plant->axes[axis], ns);
}

// The same where NS may be past: by the history of the steppers.
static double past_position(struct plant *plant, int axis, uint64_t ns) {
    if (axis < 0)
        return 0;
    struct plant_axis *at = &plant->axes[axis];
    settle(plant, at, ns);
    double position = at->origin;
    for (int i = 0; i < at->term_count; i++) {
        struct plant_reference *stepper = &at->terms[i].stepper;
        int64_t count = stepper->peer < 0 ? plant_page_count_at(&plant->page->steppers[stepper->found], ns)
                                          : plant_term_count(plant, &at->terms[i], ns);
        position += at->terms[i].mm * (double)count;
    }
    return position;
}

typedef double (*position_function)(struct plant *plant, int axis, uint64_t ns);

static double probe_depth(struct plant *plant, const struct plant_switch *it, uint64_t ns,
                          position_function position) {
    double nozzle[3];
    const int own[3] = {it->x_axis, it->y_axis, it->axis};
    const int *axes = it->delta < 0 ? own : plant->deltas[it->delta].axes;
    for (int i = 0; i < 3; i++)
        nozzle[i] = position(plant, axes[i], ns);
    if (it->delta >= 0)
        plant_delta_nozzle(&plant->deltas[it->delta], nozzle, nozzle);
    double x = nozzle[0] + it->offset_x;
    double y = nozzle[1] + it->offset_y;
    double z =
        nozzle[2] + x * position(plant, it->slope_x_axis, ns) + y * position(plant, it->slope_y_axis, ns);
    const struct plant_bed *bed = &plant->beds[it->bed];
    double lean = it->lean_x * (x - bed->x0) + it->lean_y * (y - bed->y0);
    return bed_height(plant, bed, x, y) + it->offset_z + lean - z;
}

// How far the bed has pushed a probe in.
double plant_probe_depth(struct plant *plant, const struct plant_switch *it, uint64_t ns) {
    return probe_depth(plant, it, ns, settled_position);
}

double plant_probe_depth_at(struct plant *plant, const struct plant_switch *it, uint64_t ns) {
    return probe_depth(plant, it, ns, past_position);
}

static double switch_depth(struct plant *plant, const struct plant_switch *it, uint64_t ns) {
    if (it->bed >= 0)
        return plant_probe_depth(plant, it, ns);
    return it->direction * (settled_position(plant, it->axis, ns) - it->at);
}

static int is_pressed(struct plant *plant, struct plant_switch *it, uint64_t ns) {
    struct plant_page_item *item = &plant->page->items[plant->first_switch + (int)(it - plant->switches)];
    uint32_t fault = atomic_load_explicit(&item->fault, memory_order_relaxed);
    if (fault == PLANT_NEVER || fault == PLANT_ALWAYS)
        return fault == PLANT_ALWAYS;
    if (it->control_pin >= 0)
        return plant_bltouch_pressed(plant, it, ns, fault);
    if (fault == PLANT_STUCK)
        return it->pressed;
    double needed = (it->pressed ? -it->hysteresis : 0.0) + (fault == PLANT_LATE ? LATE_MM : 0.0);
    return switch_depth(plant, it, ns) - it->shift >= needed - ROUNDING;
}

int plant_switch_pressed(struct plant *plant, struct plant_switch *it, uint64_t ns) {
    int pressed = is_pressed(plant, it, ns);
    if (pressed != it->pressed)
        set_pressed(plant, it, pressed, ns);
    return pressed;
}
