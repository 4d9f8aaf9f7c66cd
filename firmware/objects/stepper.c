// SPDX-License-Identifier: Apache-2.0
// Steppers: queues of "count steps, interval ticks apart, the interval changing by add after each".
//
// The timer's wake-up clock is the clock of the next edge. With steps on both edges one event is one step;
// else a pulse is two events, the step and its end.
#include "boards/board.h"
#include "objects/trsync.h"

DECL_CONSTANT("STEPPER_BOTH_EDGE", 1);
DECL_CONSTANT("STEPPER_STEP_BOTH_EDGE", 1);
DECL_STATIC_STRING(stepper_active, "Can't reset time when stepper active");
DECL_STATIC_STRING(invalid_count, "Invalid count parameter");
DECL_STATIC_STRING(stepper_in_past, "Stepper too far in past");

enum { MOVE_TOGGLES_DIR = 1 };

struct stepper {
    struct timer timer; // first: the timer leads back to the object
    uint32_t interval, count;
    int32_t add;
    uint32_t step_clock;   // of the next step as commanded; when idle, of the last one
    uint32_t pulse_ticks;  // 0: steps on both edges, or a pulse as short as the chip makes it
    uint32_t end_position; // where the move under way ends
    struct board_pin step_pin, dir_pin;
    struct move_queue queue;
    struct move *current; // its slot is in use until the last step
    struct trsync_signal signal;
    bool both_edges, inverted;
    bool dir;       // of the move under way
    bool next_dir;  // of the next command
    bool queue_dir; // of the last command queued
    bool needs_reset;
};

static const struct oid_type stepper_type = {"stepper"};

// Begins the next move, or goes idle. The direction changes right after the last step of the move before.
static bool load_next(struct node *node, struct stepper *s) {
    if (s->current)
        move_free(node, s->current);
    struct move *move = s->current = move_pop(&s->queue);
    if (!move)
        return false;
    if (move->step.flags & MOVE_TOGGLES_DIR) {
        s->dir = !s->dir;
        board_gpio_toggle(node, s->dir_pin);
    }
    s->count = move->step.count;
    s->add = move->step.add;
    s->interval = move->step.interval + (uint32_t)s->add;
    s->step_clock += move->step.interval;
    s->end_position += s->dir ? s->count : -s->count;
    return true;
}

// Plans the step after the one just made.
static bool next_step(struct node *node, struct stepper *s) {
    if (--s->count == 0)
        return load_next(node, s);
    s->step_clock += s->interval;
    s->interval += (uint32_t)s->add;
    return true;
}

static enum timer_result edge_run(struct node *node, struct timer *timer) {
    struct stepper *s = (struct stepper *)(void *)timer;
    board_gpio_toggle(node, s->step_pin);
    if (!next_step(node, s))
        return TIMER_DONE;
    timer->wake_clock = s->step_clock;
    return TIMER_RESCHEDULE;
}

static enum timer_result step_run(struct node *node, struct timer *timer);

static enum timer_result unstep_run(struct node *node, struct timer *timer) {
    struct stepper *s = (struct stepper *)(void *)timer;
    board_gpio_write(node, s->step_pin, s->inverted);
    timer->run = step_run;
    if (!next_step(node, s))
        return TIMER_DONE;
    // A pause is as long as a pulse at least; a step delayed by that does not delay the ones behind it. One
    // that is due even before the step just made is left in the past: the rate is more than pulses allow.
    uint32_t earliest = timer->wake_clock + s->pulse_ticks;
    uint32_t step_clock = s->step_clock;
    bool in_past = clock_before(step_clock, timer->wake_clock - s->pulse_ticks);
    timer->wake_clock = !in_past && clock_before(step_clock, earliest) ? earliest : step_clock;
    return TIMER_RESCHEDULE;
}

static enum timer_result step_run(struct node *node, struct timer *timer) {
    struct stepper *s = (struct stepper *)(void *)timer;
    board_gpio_write(node, s->step_pin, !s->inverted);
    timer->run = unstep_run;
    if (s->pulse_ticks == 0)
        return unstep_run(node, timer);
    timer->wake_clock += s->pulse_ticks;
    return TIMER_RESCHEDULE;
}

static uint32_t position(const struct stepper *s) {
    uint32_t left = s->current ? s->count : 0;
    if (left && s->timer.run == unstep_run)
        left--; // the pulse under way is a step made
    return s->end_position - (s->dir ? left : -left);
}

// Stops at once. The queue is given up, and what still arrives for it, until the host resets the step clock.
static void stop(struct node *node, struct stepper *s) {
    sched_del_timer(node, &s->timer);
    s->end_position = position(s);
    if (s->current)
        move_free(node, s->current);
    s->current = NULL;
    move_clear(node, &s->queue);
    s->count = 0;
    s->next_dir = s->queue_dir = s->dir;
    s->needs_reset = true;
    if (s->both_edges)
        return; // an edge would be a step
    s->timer.run = step_run;
    board_gpio_write(node, s->step_pin, s->inverted);
}

static void signal_stop(struct node *node, struct trsync_signal *signal) {
    stop(node, (struct stepper *)((char *)signal - offsetof(struct stepper, signal)));
}

static struct stepper *lookup(struct node *node, uint32_t oid) {
    return oid_lookup(node, (uint8_t)oid, &stepper_type);
}

DECL_STATIC_STRING(not_a_pin, "Not a valid pin");
DECL_COMMAND(command_config_stepper,
             "config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c step_pulse_ticks=%u");
void command_config_stepper(struct node *node, const struct wire_arg *args) {
    struct stepper *s = oid_alloc(node, (uint8_t)args[0].value, &stepper_type, sizeof(*s));
    if (!s)
        return;
    int8_t invert = (int8_t)args[3].value;
    s->pulse_ticks = args[4].value;
    s->both_edges = invert < 0 && s->pulse_ticks == 0;
    s->inverted = invert > 0;
    s->timer.run = s->both_edges ? edge_run : step_run;
    s->signal.stop = signal_stop;
    if (board_gpio_out_setup(node, args[1].value, s->inverted, &s->step_pin) ||
        board_gpio_out_setup(node, args[2].value, false, &s->dir_pin))
        node_shutdown(node, string_not_a_pin);
}

// Starts an idle stepper on its queue.
static void start(struct node *node, struct stepper *s) {
    if (!load_next(node, s))
        return;
    s->timer.wake_clock = s->step_clock;
    if (clock_before(s->step_clock, board_clock(node)))
        node_shutdown(node, string_stepper_in_past);
    else
        sched_add_timer(node, &s->timer);
}

DECL_COMMAND_FLAGS(command_queue_step, COMMAND_FREQUENT, "queue_step oid=%c interval=%u count=%hu add=%hi");
void command_queue_step(struct node *node, const struct wire_arg *args) {
    struct stepper *s = lookup(node, args[0].value);
    if (!s)
        return;
    if (args[2].value == 0) {
        node_shutdown(node, string_invalid_count);
        return;
    }
    if (s->needs_reset)
        return; // sent before the host knew of the stop
    struct move *move = move_alloc(node);
    if (!move)
        return;
    move->step.interval = args[1].value;
    move->step.count = (uint16_t)args[2].value;
    move->step.add = (int16_t)args[3].value;
    move->step.flags = s->next_dir != s->queue_dir ? MOVE_TOGGLES_DIR : 0;
    s->queue_dir = s->next_dir;
    uint32_t irq = board_irq_save(node);
    move_push(&s->queue, move);
    if (!s->current)
        start(node, s);
    board_irq_restore(node, irq);
}

DECL_COMMAND_FLAGS(command_set_next_step_dir, COMMAND_FREQUENT, "set_next_step_dir oid=%c dir=%c");
void command_set_next_step_dir(struct node *node, const struct wire_arg *args) {
    struct stepper *s = lookup(node, args[0].value);
    if (s)
        s->next_dir = args[1].value != 0;
}

DECL_COMMAND_FLAGS(command_reset_step_clock, COMMAND_FREQUENT, "reset_step_clock oid=%c clock=%u");
void command_reset_step_clock(struct node *node, const struct wire_arg *args) {
    struct stepper *s = lookup(node, args[0].value);
    if (!s)
        return;
    if (s->current) {
        node_shutdown(node, string_stepper_active);
        return;
    }
    s->step_clock = args[1].value;
    s->needs_reset = false;
}

DECL_RESPONSE(stepper_position, "stepper_position oid=%c pos=%i");
DECL_COMMAND_FLAGS(command_stepper_get_position, COMMAND_IN_SHUTDOWN, "stepper_get_position oid=%c");
void command_stepper_get_position(struct node *node, const struct wire_arg *args) {
    struct stepper *s = lookup(node, args[0].value);
    if (!s)
        return;
    uint32_t irq = board_irq_save(node);
    uint32_t at = position(s);
    board_irq_restore(node, irq);
    RESPOND(node, stepper_position, args[0], ARG(at));
}

DECL_COMMAND(command_stepper_stop_on_trigger, "stepper_stop_on_trigger oid=%c trsync_oid=%c");
void command_stepper_stop_on_trigger(struct node *node, const struct wire_arg *args) {
    struct stepper *s = lookup(node, args[0].value);
    struct trsync *group = s ? trsync_lookup(node, (uint8_t)args[1].value) : NULL;
    if (group)
        trsync_join(node, group, &s->signal);
}

DECL_SHUTDOWN_HOOK(stepper_shutdown);
void stepper_shutdown(struct node *node) {
    uint16_t oid = 0;
    struct stepper *s;
    while ((s = oid_next(node, &stepper_type, &oid)))
        stop(node, s);
}
