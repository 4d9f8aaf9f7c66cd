// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c firmware/core/*.c
// The core on a board and with tables that are this test's own: what runs, how often, in what order, with
// interrupts masked or not, and the exact limits of time, memory and statistics.
#include "boards/board.h"
#include "core/node.h"
#include "tests/check.h"

#include <string.h>

// ----------------------------------------------------------------------------------------------------- board

static uint32_t now;
static uint32_t irq_depth;
static unsigned resets;

uint32_t board_clock(struct node *node) {
    (void)node;
    return now;
}

uint32_t board_irq_save(struct node *node) {
    (void)node;
    return irq_depth++;
}

void board_irq_restore(struct node *node, uint32_t state) {
    (void)node;
    CHECK_EQUAL(--irq_depth, state);
}

volatile void *board_memory(struct node *node, uint32_t addr, uint32_t size, int write) {
    (void)node, (void)addr, (void)size, (void)write;
    return NULL;
}

void board_reset(struct node *node) {
    (void)node;
    resets++;
}

// ---------------------------------------------------------------------------------------------------- tables

enum { RUNS_MAX = 64, ARENA = 4096, SLACK = 7, FREQ = 1000 };

const uint16_t string_timer_too_close = 1, string_timer_in_past = 2, string_command_request = 3,
               string_not_shutdown = 4, string_invalid_command = 5, string_parser_error = 6,
               string_encode_error = 7, string_move_overflow = 8, string_alloc_failed = 9,
               string_oids_allocated = 10, string_cannot_assign_oid = 11, string_invalid_oid_type = 12,
               string_already_finalized = 13, string_debug_address = 14, string_second_host = 15;

static const uint8_t types_shutdown[] = {WIRE_U32, WIRE_U16};
const struct node_response response_shutdown = {.types = types_shutdown, .id = 20, .arg_count = 2};
static const uint8_t types_stats[] = {WIRE_U32, WIRE_U32, WIRE_U32};
const struct node_response response_stats = {.types = types_stats, .id = 21, .arg_count = 3};
static const uint8_t types_none[] = {0};
const struct node_response response_starting = {.types = types_none, .id = 22};
const struct node_response response_is_shutdown, response_config, response_identify_response, response_clock,
    response_uptime, response_pong, response_debug_result;

static char runs[RUNS_MAX];
static unsigned rounds_wanted, ticks_per_task;

static void note(char what) {
    size_t length = strlen(runs);
    CHECK(length + 1 < RUNS_MAX);
    runs[length] = what;
    runs[length + 1] = 0;
}

static void init_a(struct node *node) {
    CHECK_EQUAL(node->config.clock_freq, FREQ);
    CHECK_EQUAL(node->tasks_pending, 0);
    note('a');
}

static void init_b(struct node *node) {
    (void)node;
    note('b');
}

static void task_c(struct node *node) {
    CHECK_EQUAL(irq_depth, 0);
    CHECK_EQUAL(node->tasks_pending, 0);
    now += ticks_per_task;
    note('c');
}

static void task_d(struct node *node) {
    note('d');
    if (rounds_wanted) {
        rounds_wanted--;
        node_wake_tasks(node);
    }
}

static void hook_e(struct node *node) {
    CHECK_EQUAL(irq_depth, 1);
    CHECK(!node->sched.first);
    note('e');
}

static void hook_f(struct node *node) {
    (void)node;
    note('f');
}

static void (*const inits[])(struct node *) = {init_a, init_b};
static void (*const tasks[])(struct node *) = {task_c, task_d};
static void (*const hooks[])(struct node *) = {hook_e, hook_f};
static const uint8_t dictionary[] = {1, 2, 3};
const struct node_tables node_tables = {
    .inits = inits,
    .tasks = tasks,
    .hooks = hooks,
    .init_count = 2,
    .task_count = 2,
    .hook_count = 2,
    .dictionary = dictionary,
    .dictionary_size = sizeof(dictionary),
};

void sched_report_shutdown_task(struct node *node);
void command_task(struct node *node);
void command_allocate_oids(struct node *node, const struct wire_arg *args);
void command_finalize_config(struct node *node, const struct wire_arg *args);
void command_config_reset(struct node *node, const struct wire_arg *args);

// ----------------------------------------------------------------------------------------------------- stage

static struct node node;
static _Alignas(16) uint8_t arena[ARENA];

static void start(uint32_t clock) {
    struct node_config config = {.clock_freq = FREQ, .timer_slack = SLACK, .arena = arena};
    config.arena_size = ARENA, config.move_count = 2;
    memset(&node, 0xA5, sizeof(node));
    memset(arena, 0xA5, sizeof(arena));
    node.can = NULL;
    now = clock;
    rounds_wanted = ticks_per_task = 0;
    runs[0] = 0;
    node_start(&node, &config);
}

static void ran(const char *expected) {
    if (strcmp(runs, expected) != 0) {
        fprintf(stderr, "ran %s, expected %s\n", runs, expected);
        exit(1);
    }
    runs[0] = 0;
    CHECK_EQUAL(irq_depth, 0);
}

// Takes one block off the transmit buffer, which must be RESPONSE with these VALUES.
static void expect(const struct node_response *response, const uint32_t *values) {
    uint8_t out[NODE_TRANSMIT_SIZE];
    size_t size = node_transmit_peek(&node, out, sizeof(out)), skip, length;
    struct wire_scanner scanner = {0};
    CHECK_EQUAL(wire_scan(&scanner, out, size, &skip, &length), WIRE_BLOCK);
    const uint8_t *at = out + WIRE_HEADER, *end = out + length - WIRE_TRAILER;
    uint32_t value;
    CHECK(!wire_vlq_decode(&at, end, &value));
    CHECK_EQUAL(value, response->id);
    for (size_t i = 0; i < response->arg_count; i++) {
        CHECK(!wire_vlq_decode(&at, end, &value));
        CHECK_EQUAL(value, values[i]);
    }
    CHECK(at == end);
    node_transmitted(&node, length);
}

static size_t waiting(void) {
    uint8_t out[NODE_TRANSMIT_SIZE];
    return node_transmit_peek(&node, out, sizeof(out));
}

// ---------------------------------------------------------------------------------------------------- timers

static enum timer_result again_at_once(struct node *at, struct timer *timer) {
    (void)at;
    (void)timer;
    return TIMER_AGAIN;
}

static enum timer_result done(struct node *at, struct timer *timer) {
    (void)at;
    (void)timer;
    return TIMER_DONE;
}

static enum timer_result shuts_down(struct node *at, struct timer *timer) {
    timer->waketime += 5;
    node_shutdown(at, 77);
    return TIMER_AGAIN;
}

static uint32_t next_waketime;

static enum timer_result sets_waketime(struct node *at, struct timer *timer) {
    (void)at;
    timer->waketime = next_waketime;
    return TIMER_AGAIN;
}

static void a_start_leaves_nothing_of_before(void) {
    struct can_stream *can = (struct can_stream *)&node;
    struct node_config config = {.clock_freq = FREQ, .arena = arena, .arena_size = ARENA};
    memset(&node, 0xA5, sizeof(node));
    node.can = can;
    runs[0] = 0;
    node_start(&node, &config);
    ran("ab");
    CHECK(node.can == can);
    CHECK(!node.sched.first && !node.shutdown.active && !node.objects.oid_count && !node.alarm.set);
    CHECK_EQUAL(node.tasks_pending, 1);
}

static void tasks_run_in_rounds_until_none_is_wanted(void) {
    start(100);
    ran("ab");
    rounds_wanted = 2;
    node_run_tasks(&node);
    ran("cdcdcd");
    CHECK_EQUAL(node.tasks_pending, 0);
    CHECK_EQUAL(node.base.count, 3);
    node_run_tasks(&node);
    ran("cd");
    CHECK_EQUAL(node.base.count, 4);
}

// Rounds that take 16, 17, … ticks; squares are divided by 256 and rounded up.
static void statistics_add_up_time_and_its_square(void) {
    static const struct {
        uint32_t ticks, sum, sumsq;
    } round[] = {{0, 0, 0}, {1, 1, 1}, {16, 17, 2}, {17, 34, 4}, {100, 134, 44}, {1u << 16, 65670, 16777260}};
    start(0xFFFFFFF0);
    for (unsigned i = 0; i < sizeof(round) / sizeof(round[0]); i++) {
        ticks_per_task = round[i].ticks;
        node_run_tasks(&node);
        CHECK_EQUAL(node.base.sum, round[i].sum);
        CHECK_EQUAL(node.base.sumsq, round[i].sumsq);
    }
    node.base.sumsq = UINT32_MAX - 256;
    ticks_per_task = 256;
    node_run_tasks(&node);
    CHECK_EQUAL(node.base.sumsq, UINT32_MAX);
    node.base.sumsq = UINT32_MAX - 256;
    ticks_per_task = 257; // 259 would be too much for 32 bits
    node_run_tasks(&node);
    CHECK_EQUAL(node.base.sumsq, UINT32_MAX);
    ticks_per_task = UINT32_MAX;
    node_run_tasks(&node);
    CHECK_EQUAL(node.base.sumsq, UINT32_MAX);
}

static void timers_are_taken_now_and_later_but_not_before(void) {
    struct timer early = {.function = done}, late = {.function = done}, in = {.function = done};
    start(0xFFFFFFFF);
    early.waketime = 0xFFFFFFFF, late.waketime = 4;
    sched_add_timer(&node, &late);
    sched_add_timer(&node, &early);
    sched_add_timer_in(&node, &in, 3);
    CHECK_EQUAL(in.waketime, 2);
    CHECK(node.sched.first == &early && early.next == &in && in.next == &late && !late.next);
    sched_delete_timer(&node, &in);
    CHECK(early.next == &late);
    sched_delete_timer(&node, &in); // no longer queued
    CHECK(node.sched.first == &early && early.next == &late && !late.next);
    sched_delete_timer(&node, &late);
    CHECK(node.sched.first == &early && !early.next);
    sched_delete_timer(&node, &early);
    CHECK(!node.sched.first && !node.shutdown.active);

    late.waketime = 0xFFFFFFFE;
    sched_add_timer(&node, &late);
    CHECK_EQUAL(node.shutdown.reason, string_timer_too_close);
    CHECK(node.shutdown.active && !node.sched.first);
    late.waketime = 50;
    sched_add_timer(&node, &late);
    sched_add_timer_in(&node, &in, 8);
    CHECK(!node.sched.first);
    CHECK_EQUAL(in.waketime, 2);
}

static void a_timer_is_done_or_runs_again(void) {
    struct timer one = {.function = done, .waketime = 10},
                 other = {.function = sets_waketime, .waketime = 10};
    start(10);
    next_waketime = 12;
    sched_add_timer(&node, &one);
    sched_add_timer(&node, &other);
    CHECK_EQUAL(node.stats.timers_run, 0);
    sched_run_first(&node);
    CHECK_EQUAL(node.stats.timers_run, 1);
    CHECK(node.sched.first == &other && !other.next);
    sched_run_first(&node);
    CHECK_EQUAL(node.stats.timers_run, 2);
    CHECK(node.sched.first == &other && !other.next);
    CHECK_EQUAL(other.waketime, 12);
}

static void a_waketime_may_lie_back_by_the_slack(void) {
    for (uint32_t back = SLACK; back <= SLACK + 1; back++) {
        struct timer timer = {.function = sets_waketime, .waketime = 3};
        start(3);
        sched_add_timer(&node, &timer);
        next_waketime = now - back;
        sched_run_first(&node);
        CHECK_EQUAL(node.shutdown.active, back > SLACK);
        CHECK(node.sched.first == (back > SLACK ? NULL : &timer));
        if (node.shutdown.active)
            CHECK_EQUAL(node.shutdown.reason, string_timer_in_past);
    }
}

static void a_shutdown_within_a_timer_leaves_none(void) {
    struct timer timer = {.function = shuts_down, .waketime = 3}, other = {.function = done, .waketime = 9};
    start(3);
    sched_add_timer(&node, &timer);
    sched_add_timer(&node, &other);
    sched_run_first(&node);
    CHECK(!node.sched.first);
    CHECK_EQUAL(node.shutdown.reason, 77);
}

// 20,000 timers may run at one clock, on a board whose clock stands; the next one is a runaway.
static void timers_that_run_on_the_spot_are_stopped(void) {
    struct timer timer = {.function = again_at_once};
    start(0);
    timer.waketime = 5;
    sched_add_timer(&node, &timer);
    for (unsigned i = 0; i < 20000; i++)
        sched_run_first(&node);
    CHECK(!node.shutdown.active);
    timer.waketime = 6;
    for (unsigned i = 0; i < 20000; i++)
        sched_run_first(&node);
    CHECK(!node.shutdown.active);
    CHECK_EQUAL(node.stats.timers_run, 40000);
    sched_run_first(&node);
    CHECK(node.shutdown.active);
    CHECK_EQUAL(node.shutdown.reason, string_timer_in_past);
    CHECK_EQUAL(node.stats.timers_run, 40000);
}

// -------------------------------------------------------------------------------------------------- shutdown

static void a_shutdown_runs_every_hook_once_and_keeps_its_first_reason(void) {
    struct timer timer = {.function = done, .waketime = 400};
    start(300);
    node_run_tasks(&node);
    sched_add_timer(&node, &timer);
    runs[0] = 0;
    node.shutdown.reported = 1; // of an earlier one that was cleared
    node_shutdown(&node, 41);
    ran("ef");
    CHECK(!node.sched.first);
    CHECK_EQUAL(node.tasks_pending, 1);
    CHECK_EQUAL(node.shutdown.reported, 0);
    now = 350;
    node.tasks_pending = 0;
    node.sched.first = &timer;
    node_shutdown(&node, 42);
    ran("");
    CHECK(!node.sched.first);
    CHECK_EQUAL(node.tasks_pending, 1);
    CHECK_EQUAL(node.shutdown.reason, 41);
    CHECK_EQUAL(node.shutdown.clock, 300);
    CHECK_EQUAL(node.shutdown.active, 1);
}

static void a_shutdown_is_reported_once_as_soon_as_there_is_room(void) {
    start(300);
    sched_report_shutdown_task(&node);
    CHECK_EQUAL(waiting(), 0);
    node_shutdown(&node, 41);
    while (node_can_respond(&node))
        CHECK(!RESPOND_EMPTY(&node, starting));
    size_t full = waiting();
    sched_report_shutdown_task(&node);
    CHECK_EQUAL(waiting(), full);
    CHECK_EQUAL(node.shutdown.reported, 0);
    while (waiting())
        expect(&response_starting, NULL);
    now = 333;
    sched_report_shutdown_task(&node);
    expect(&response_shutdown, (const uint32_t[]){300, 41});
    sched_report_shutdown_task(&node);
    CHECK_EQUAL(waiting(), 0);
}

static void a_response_that_fits_no_block_is_a_shutdown(void) {
    static const uint8_t types_long[] = {WIRE_BYTES};
    static const struct node_response response_long = {.types = types_long, .id = 23, .arg_count = 1};
    uint8_t bytes[WIRE_CONTENT_MAX] = {0};
    start(0);
    CHECK_EQUAL(RESPOND(&node, long, BYTES(bytes, WIRE_CONTENT_MAX)), -1);
    CHECK(node.shutdown.active);
    CHECK_EQUAL(node.shutdown.reason, string_encode_error);
    CHECK_EQUAL(waiting(), 0);
    start(0);
    const struct wire_arg two[2] = {{.value = 1}, {.value = 2}};
    CHECK_EQUAL(node_respond(&node, &response_shutdown, two, 1), -1);
    CHECK_EQUAL(node.shutdown.reason, string_encode_error);
    CHECK_EQUAL(waiting(), 0);
}

// -------------------------------------------------------------------------------------------------- deadline

static void the_next_deadline_is_the_earliest_of_three(void) {
    struct timer timer = {.function = done};
    start(0xFFFFF000);
    node.base.report_clock = now;
    const uint32_t report = now + NODE_STATS_SECONDS * FREQ;
    CHECK_EQUAL(node_next_deadline(&node), report);
    node.alarm.clock = report - 10;
    CHECK_EQUAL(node_next_deadline(&node), report);
    node_set_alarm(&node, report - 10);
    CHECK_EQUAL(node_next_deadline(&node), report - 10);
    timer.waketime = report - 9;
    sched_add_timer(&node, &timer);
    CHECK_EQUAL(node_next_deadline(&node), report - 10);
    timer.waketime = report - 11;
    CHECK_EQUAL(node_next_deadline(&node), report - 11);
    node_set_alarm(&node, report + 1);
    timer.waketime = report + 2;
    CHECK_EQUAL(node_next_deadline(&node), report);
}

// --------------------------------------------------------------------------------------------------- objects

static const struct oid_type one_type = {"one"}, other_type = {"other"};

static void memory_is_zeroed_aligned_and_ends_where_the_arena_does(void) {
    start(0);
    uint8_t *first = node_alloc(&node, 1);
    uint8_t *second = node_alloc(&node, 16);
    uint8_t *third = node_alloc(&node, 17);
    CHECK(first == arena && second == arena + 16 && third == arena + 32);
    for (unsigned i = 0; i < 17; i++)
        CHECK_EQUAL(third[i], 0);
    CHECK_EQUAL(third[17], 0xA5);
    CHECK(node_alloc(&node, ARENA - 64 + 1) == NULL);
    CHECK_EQUAL(node.shutdown.reason, string_alloc_failed);
    CHECK(node_alloc(&node, ARENA - 64) == arena + 64);
    CHECK(node_alloc(&node, 1) == NULL);
}

static void objects_are_found_by_number_and_type(void) {
    unsigned oid = 0;
    start(0);
    command_allocate_oids(&node, (const struct wire_arg[]){{.value = 3}});
    void *one = oid_create(&node, 0, &one_type, 8), *two = oid_create(&node, 2, &one_type, 8);
    void *other = oid_create(&node, 1, &other_type, 8);
    CHECK(oid_find(&node, 0, &one_type) == one && oid_find(&node, 2, &one_type) == two);
    CHECK(oid_next(&node, &oid, &one_type) == one && oid == 1);
    CHECK(oid_next(&node, &oid, &one_type) == two && oid == 3);
    CHECK(!oid_next(&node, &oid, &one_type));
    oid = 0;
    CHECK(oid_next(&node, &oid, &other_type) == other && !oid_next(&node, &oid, &other_type));
    CHECK_EQUAL(irq_depth, 0);
    CHECK(!node.shutdown.active);
    CHECK(!oid_find(&node, 1, &one_type));
    CHECK_EQUAL(node.shutdown.reason, string_invalid_oid_type);
    node.shutdown.active = 0;
    CHECK(!oid_find(&node, 3, &one_type) && node.shutdown.active);
    node.shutdown.active = 0;
    CHECK(!oid_create(&node, 3, &one_type, 8) && node.shutdown.active);
    CHECK_EQUAL(node.shutdown.reason, string_cannot_assign_oid);
}

static void moves_are_as_many_as_configured_and_go_round(void) {
    struct move_queue queue = {0};
    start(0);
    command_allocate_oids(&node, (const struct wire_arg[]){{.value = 0}});
    command_finalize_config(&node, (const struct wire_arg[]){{.value = 9}});
    struct move *one = move_alloc(&node), *two = move_alloc(&node);
    CHECK(one && two && (uint8_t *)two - (uint8_t *)one == NODE_MOVE_SIZE);
    CHECK_EQUAL(move_queue_push(&queue, one), 1);
    CHECK_EQUAL(move_queue_push(&queue, two), 0);
    CHECK(move_queue_pop(&queue) == one && queue.first == two);
    CHECK_EQUAL(move_queue_push(&queue, one), 0);
    CHECK(move_queue_pop(&queue) == two && move_queue_pop(&queue) == one && !move_queue_pop(&queue));
    CHECK_EQUAL(move_queue_push(&queue, two), 1);
    CHECK(!node.shutdown.active);
    CHECK(!move_alloc(&node));
    CHECK_EQUAL(node.shutdown.reason, string_move_overflow);
    move_queue_clear(&node, &queue);
    CHECK(!queue.first && move_alloc(&node) == two && !move_alloc(&node));
}

// Twice: from a running node the hooks run, from one that is shut down they have run.
static void a_configuration_is_reset_with_its_outputs_at_their_defaults(void) {
    start(0);
    command_allocate_oids(&node, (const struct wire_arg[]){{.value = 1}});
    runs[0] = 0;
    command_config_reset(&node, NULL);
    ran("ef");
    CHECK(!node.objects.oids_allocated && !node.objects.oid_count && !node.objects.arena_used);
    node_shutdown(&node, 5);
    runs[0] = 0;
    command_config_reset(&node, NULL);
    ran("");
    CHECK(!node.shutdown.active);
}

// The tables have no command at all: the first id is behind the last one.
static void an_id_behind_the_last_command_is_invalid(void) {
    uint8_t block[WIRE_BLOCK_MAX] = {0};
    start(0);
    node_receive(&node, block, wire_block_finish(block, wire_vlq_encode(block + WIRE_HEADER, 0), 0));
    command_task(&node);
    CHECK(node.shutdown.active);
    CHECK_EQUAL(node.shutdown.reason, string_invalid_command);
}

int main(void) {
    a_start_leaves_nothing_of_before();
    tasks_run_in_rounds_until_none_is_wanted();
    statistics_add_up_time_and_its_square();
    timers_are_taken_now_and_later_but_not_before();
    a_timer_is_done_or_runs_again();
    a_waketime_may_lie_back_by_the_slack();
    a_shutdown_within_a_timer_leaves_none();
    timers_that_run_on_the_spot_are_stopped();
    a_shutdown_runs_every_hook_once_and_keeps_its_first_reason();
    a_shutdown_is_reported_once_as_soon_as_there_is_room();
    a_response_that_fits_no_block_is_a_shutdown();
    the_next_deadline_is_the_earliest_of_three();
    memory_is_zeroed_aligned_and_ends_where_the_arena_does();
    objects_are_found_by_number_and_type();
    moves_are_as_many_as_configured_and_go_round();
    a_configuration_is_reset_with_its_outputs_at_their_defaults();
    an_id_behind_the_last_command_is_invalid();
    CHECK_EQUAL(resets, 0);
    return 0;
}
