// SPDX-License-Identifier: Apache-2.0
// Steppers. A queued move means, COUNT times: wait INTERVAL ticks since the last step; step; INTERVAL += ADD.
//
// Step times are exact: each is computed from the previous one, never from when a timer really ran. Steps
// come as pulses of pulse_ticks, or (both edges) as one change of level each, which halves the work.
#include "objects/stepper.h"

#include "boards/board.h"
#include "objects/trsync.h"

#include <string.h>

DECL_CONSTANT("STEPPER_BOTH_EDGE", 1);
DECL_CONSTANT("STEPPER_STEP_BOTH_EDGE", 1);

DECL_STATIC_STRING(stepper_past, "Stepper too far in past");
DECL_STATIC_STRING(stepper_active, "Can't reset time when stepper active");
DECL_STATIC_STRING(invalid_count, "Invalid count parameter");
DECL_STATIC_STRING(invalid_pin, "Not a valid pin");

DECL_RESPONSE(stepper_position, "stepper_position oid=%c pos=%i");

enum { MAX_LAG_PER_S = 1000 }; // the reciprocal of the longest lag: 1 ms

struct stepper_move {
    struct move link;
    uint32_t interval;
    uint32_t add; // two's complement
    uint16_t count;
    uint8_t dir;
};
_Static_assert(sizeof(struct stepper_move) <= NODE_MOVE_SIZE, "a move fits into a slot");

struct stepper {
    struct timer timer;
    struct move_queue queue;
    uint32_t interval;   // from the last step to the next one
    uint32_t step_clock; // of the last step while idle, of the next one while moving
    uint32_t pulse_ticks;
    uint32_t position; // where the loaded move ends; two's complement
    uint32_t add;      // two's complement
    uint16_t count;    // steps left in the loaded move
    uint8_t step_pin, dir_pin;
    uint8_t level;    // of the step pin
    uint8_t inactive; // level between pulses
    uint8_t both_edges, moving;
    uint8_t dir, next_dir;       // of the loaded move, and of moves to be queued
    uint8_t needs_reset;         // stopped: moves are ignored until reset_step_clock
    struct stepper_move *loaded; // holds its slot until its last step
    struct trsync_member member;
};

static const struct oid_type stepper_type = {"stepper"};

static struct stepper *find(struct node *node, uint32_t oid) {
    return oid_find(node, oid, &stepper_type);
}

const struct stepper *stepper_find(struct node *node, uint32_t oid) {
    return find(node, oid);
}

int stepper_moves(const struct stepper *stepper) {
    return stepper->moving;
}

// -------------------------------------------------------------------------------------------------- stepping

// Takes the next move; returns 0 when there is none. step_clock is that of the last step.
static int load_move(struct node *node, struct stepper *stepper) {
    if (stepper->loaded)
        move_free(node, stepper->loaded);
    struct stepper_move *move = stepper->loaded = (struct stepper_move *)move_queue_pop(&stepper->queue);
    if (!move) {
        stepper->moving = 0;
        return 0;
    }
    if (move->dir != stepper->dir) {
        stepper->dir = move->dir;
        board_gpio_write(node, stepper->dir_pin, move->dir);
    }
    stepper->count = move->count;
    stepper->add = move->add;
    stepper->interval = move->interval + move->add;
    stepper->step_clock += move->interval;
    uint32_t steps = move->count;
    stepper->position += move->dir ? steps : 0 - steps;
    return 1;
}

// One step of the loaded move is done: when is the next one? Returns 0 when there is none.
static inline int plan_next(struct node *node, struct stepper *stepper) {
    if (stepper->count == 0)
        return load_move(node, stepper);
    stepper->step_clock += stepper->interval;
    stepper->interval += stepper->add;
    return 1;
}

static inline void toggle(struct node *node, struct stepper *stepper) {
    stepper->level ^= 1;
    board_gpio_write(node, stepper->step_pin, stepper->level);
}

static enum timer_result both_edges_event(struct node *node, struct timer *timer) {
    struct stepper *stepper = (struct stepper *)timer;
    toggle(node, stepper);
    stepper->count--;
    if (!plan_next(node, stepper))
        return TIMER_DONE;
    timer->waketime = stepper->step_clock;
    return TIMER_AGAIN;
}

// Alternates between the beginning of a pulse and its end. A step that is due sooner than a pulse's length
// after the last pulse waits for that, and the steps behind it catch up; beyond MAX_LAG it is an error of the
// host, which the scheduler finds.
static enum timer_result pulse_event(struct node *node, struct timer *timer) {
    struct stepper *stepper = (struct stepper *)timer;
    toggle(node, stepper);
    if (stepper->level != stepper->inactive) {
        stepper->count--;
        if (stepper->pulse_ticks) {
            timer->waketime += stepper->pulse_ticks;
            return TIMER_AGAIN;
        }
        toggle(node, stepper);
    }
    if (!plan_next(node, stepper))
        return TIMER_DONE;
    uint32_t soonest = timer->waketime + stepper->pulse_ticks;
    uint32_t lag = soonest - stepper->step_clock;
    int late = stepper->pulse_ticks && lag < node->config.clock_freq / MAX_LAG_PER_S;
    timer->waketime = late ? soonest : stepper->step_clock;
    return TIMER_AGAIN;
}

// Starts an idle stepper on its queue.
static void start(struct node *node, struct stepper *stepper) {
    load_move(node, stepper);
    stepper->moving = 1;
    if (clock_before(stepper->step_clock, board_clock(node))) {
        node_shutdown(node, STRING(stepper_past));
        return;
    }
    stepper->timer.waketime = stepper->step_clock;
    sched_add_timer(node, &stepper->timer);
}

static uint32_t position_of(const struct stepper *stepper) {
    uint32_t left = stepper->count;
    return stepper->position - (stepper->dir ? left : 0 - left);
}

// Stops at once, in place; from now on moves are ignored until reset_step_clock.
static void stop(struct node *node, struct stepper *stepper) {
    sched_delete_timer(node, &stepper->timer);
    stepper->position = position_of(stepper);
    stepper->count = 0;
    stepper->moving = 0;
    stepper->next_dir = stepper->dir;
    stepper->needs_reset = 1;
    if (!stepper->both_edges && stepper->level != stepper->inactive) {
        stepper->level = stepper->inactive;
        board_gpio_write(node, stepper->step_pin, stepper->level);
    }
    if (stepper->loaded)
        move_free(node, stepper->loaded);
    stepper->loaded = NULL;
    move_queue_clear(node, &stepper->queue);
}

static void member_stop(struct node *node, struct trsync_member *member) {
    stop(node, (struct stepper *)((char *)member - offsetof(struct stepper, member)));
}

// -------------------------------------------------------------------------------------------------- commands

void command_config_stepper(struct node *node, const struct wire_arg *args) {
    int invert = (int8_t)args[3].value;
    if (board_gpio_out(node, args[1].value, invert > 0) || board_gpio_out(node, args[2].value, 0)) {
        node_shutdown(node, STRING(invalid_pin));
        return;
    }
    struct stepper *stepper = oid_create(node, args[0].value, &stepper_type, sizeof(*stepper));
    if (!stepper)
        return;
    stepper->step_pin = (uint8_t)args[1].value;
    stepper->dir_pin = (uint8_t)args[2].value;
    stepper->pulse_ticks = args[4].value;
    stepper->both_edges = invert < 0 && stepper->pulse_ticks == 0;
    stepper->inactive = stepper->level = invert > 0;
    stepper->timer.function = stepper->both_edges ? both_edges_event : pulse_event;
}
DECL_COMMAND(command_config_stepper,
             "config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c step_pulse_ticks=%u", 0);

void command_queue_step(struct node *node, const struct wire_arg *args) {
    struct stepper *stepper = find(node, args[0].value);
    if (!stepper)
        return;
    if (!args[2].value) {
        node_shutdown(node, STRING(invalid_count));
        return;
    }
    if (stepper->needs_reset)
        return;
    uint32_t irq = board_irq_save(node);
    struct stepper_move *move = move_alloc(node);
    if (move) {
        move->interval = args[1].value;
        move->count = (uint16_t)args[2].value;
        move->add = args[3].value;
        move->dir = stepper->next_dir;
        move_queue_push(&stepper->queue, &move->link);
        if (!stepper->moving)
            start(node, stepper);
    }
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_queue_step, "queue_step oid=%c interval=%u count=%hu add=%hi", FREQUENT);

void command_set_next_step_dir(struct node *node, const struct wire_arg *args) {
    struct stepper *stepper = find(node, args[0].value);
    if (stepper)
        stepper->next_dir = args[1].value != 0;
}
DECL_COMMAND(command_set_next_step_dir, "set_next_step_dir oid=%c dir=%c", FREQUENT);

void command_reset_step_clock(struct node *node, const struct wire_arg *args) {
    struct stepper *stepper = find(node, args[0].value);
    if (!stepper)
        return;
    uint32_t irq = board_irq_save(node);
    if (stepper->moving) {
        node_shutdown(node, STRING(stepper_active));
    } else {
        stepper->step_clock = args[1].value;
        stepper->needs_reset = 0;
    }
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_reset_step_clock, "reset_step_clock oid=%c clock=%u", FREQUENT);

void command_stepper_get_position(struct node *node, const struct wire_arg *args) {
    struct stepper *stepper = find(node, args[0].value);
    if (!stepper)
        return;
    uint32_t irq = board_irq_save(node);
    uint32_t position = position_of(stepper);
    board_irq_restore(node, irq);
    RESPOND(node, stepper_position, INT(args[0].value), INT(position));
}
DECL_COMMAND(command_stepper_get_position, "stepper_get_position oid=%c", 0);

void command_stepper_stop_on_trigger(struct node *node, const struct wire_arg *args) {
    struct stepper *stepper = find(node, args[0].value);
    if (!stepper)
        return;
    struct trsync *trsync = trsync_find(node, args[1].value);
    if (!trsync)
        return;
    uint32_t irq = board_irq_save(node);
    trsync_join(node, trsync, &stepper->member, member_stop);
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_stepper_stop_on_trigger, "stepper_stop_on_trigger oid=%c trsync_oid=%c", 0);

void stepper_shutdown(struct node *node) {
    struct stepper *stepper;
    for (unsigned oid = 0; (stepper = oid_next(node, &oid, &stepper_type));)
        stop(node, stepper);
}
DECL_SHUTDOWN_HOOK(stepper_shutdown);
