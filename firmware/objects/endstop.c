// SPDX-License-Identifier: Apache-2.0
// Endstops: a pin sampled now and then; when it seems to have switched, sampled closely before a stop group
// is triggered.
#include "boards/board.h"
#include "objects/trsync.h"

struct endstop {
    struct timer timer; // first: the timer leads back to the object
    struct board_pin pin;
    uint32_t sample_ticks, rest_ticks;
    uint32_t rest_clock; // one rest behind the sample that first saw the pin switched: the host subtracts it
    struct trsync *group;
    uint8_t sample_count, samples_left, reason;
    bool wanted, homing;
};

static const struct oid_type endstop_type = {"endstop"};
DECL_STATIC_STRING(not_a_pin, "Not a valid pin");

static enum timer_result rest_run(struct node *node, struct timer *timer);

static enum timer_result sample_run(struct node *node, struct timer *timer) {
    struct endstop *e = (struct endstop *)(void *)timer;
    if (board_gpio_read(node, e->pin) != e->wanted) {
        timer->run = rest_run;
        timer->wake_clock = e->rest_clock;
        return TIMER_RESCHEDULE;
    }
    if (--e->samples_left == 0) {
        e->homing = false;
        trsync_fire(node, e->group, e->reason);
        return TIMER_DONE;
    }
    timer->wake_clock += e->sample_ticks;
    return TIMER_RESCHEDULE;
}

static enum timer_result rest_run(struct node *node, struct timer *timer) {
    struct endstop *e = (struct endstop *)(void *)timer;
    e->rest_clock = timer->wake_clock + e->rest_ticks;
    if (board_gpio_read(node, e->pin) != e->wanted) {
        timer->wake_clock = e->rest_clock;
        return TIMER_RESCHEDULE;
    }
    e->samples_left = e->sample_count;
    timer->run = sample_run;
    return sample_run(node, timer);
}

DECL_COMMAND(command_config_endstop, "config_endstop oid=%c pin=%c pull_up=%c");
void command_config_endstop(struct node *node, const struct wire_arg *args) {
    struct endstop *e = oid_alloc(node, (uint8_t)args[0].value, &endstop_type, sizeof(*e));
    if (e && board_gpio_in_setup(node, args[1].value, (int8_t)args[2].value, &e->pin))
        node_shutdown(node, string_not_a_pin);
}

DECL_COMMAND(command_endstop_home,
             "endstop_home oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u"
             " pin_value=%c trsync_oid=%c trigger_reason=%c");
void command_endstop_home(struct node *node, const struct wire_arg *args) {
    struct endstop *e = oid_lookup(node, (uint8_t)args[0].value, &endstop_type);
    if (!e)
        return;
    sched_del_timer(node, &e->timer);
    e->homing = false;
    e->sample_count = (uint8_t)args[3].value;
    if (e->sample_count == 0)
        return;
    e->group = trsync_lookup(node, (uint8_t)args[6].value);
    if (!e->group)
        return;
    e->timer.run = rest_run;
    e->timer.wake_clock = e->rest_clock = args[1].value;
    e->sample_ticks = args[2].value;
    e->rest_ticks = args[4].value;
    e->wanted = args[5].value != 0;
    e->reason = (uint8_t)args[7].value;
    e->homing = true;
    sched_add_timer(node, &e->timer);
}

DECL_RESPONSE(endstop_state, "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c");
DECL_COMMAND(command_endstop_query_state, "endstop_query_state oid=%c");
void command_endstop_query_state(struct node *node, const struct wire_arg *args) {
    struct endstop *e = oid_lookup(node, (uint8_t)args[0].value, &endstop_type);
    if (!e)
        return;
    uint32_t irq = board_irq_save(node);
    bool homing = e->homing;
    uint32_t next_clock = e->rest_clock;
    board_irq_restore(node, irq);
    RESPOND(node, endstop_state, args[0], ARG(homing), ARG(next_clock), ARG(board_gpio_read(node, e->pin)));
}

DECL_SHUTDOWN_HOOK(endstop_shutdown);
void endstop_shutdown(struct node *node) {
    uint16_t oid = 0;
    struct endstop *e;
    while ((e = oid_next(node, &endstop_type, &oid)))
        e->homing = false;
}
