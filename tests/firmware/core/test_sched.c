// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c firmware/core/*.c firmware/objects/*.c firmware/net/*.c
// sources: firmware/boards/virtual/*.c firmware/plant/*.c firmware/boards/sim/sim.c build/sim/tables.c
// Timers: their order, also over the rollover, and what happens to those that come too late.
#include "boards/sim/sim.h"
#include "core/node.h"
#include "tests/check.h"

enum { COUNT = 200 };

static const uint64_t START = 0x1FFFFF000u;

struct probe {
    struct timer timer;
    uint32_t again; // ticks between runs
    unsigned runs, runs_left;
    struct probe *victim; // deleted by the first run
};

static struct node *node_of(struct sim_board *board) {
    return (struct node *)board; // the first member of the first member
}

static uint32_t last_clock;
static unsigned last_index;

static enum timer_result run_probe(struct node *node, struct timer *timer) {
    struct probe *probe = (struct probe *)timer;
    CHECK_EQUAL((uint32_t)sim_clock((struct sim_board *)node), timer->waketime);
    CHECK(!clock_before(timer->waketime, last_clock));
    last_clock = timer->waketime;
    probe->runs++;
    if (probe->victim)
        sched_delete_timer(node, &probe->victim->timer);
    timer->waketime += probe->again;
    return probe->runs < probe->runs_left ? TIMER_AGAIN : TIMER_DONE;
}

static struct sim_board *new_board(void) {
    static const uint8_t uuid[NODE_UUID_SIZE] = {1};
    struct sim_board *board = sim_new(uuid, START, 0);
    CHECK(board);
    last_clock = (uint32_t)START;
    return board;
}

static void order_over_the_rollover(void) {
    struct sim_board *board = new_board();
    static struct probe probes[COUNT];
    for (unsigned i = 0; i < COUNT; i++) {
        probes[i] = (struct probe){.again = 1 + i * 37 % 101, .runs_left = 1 + i % 90};
        probes[i].timer.function = run_probe;
        probes[i].timer.waketime = (uint32_t)(START + i * 7919 % 6000);
        sched_add_timer(node_of(board), &probes[i].timer);
    }
    sim_run_until(board, START + 30000);
    for (unsigned i = 0; i < COUNT; i++)
        CHECK_EQUAL(probes[i].runs, probes[i].runs_left);
    CHECK(!node_of(board)->sched.first && !node_of(board)->shutdown.active);
    sim_free(board);
}

static enum timer_result run_in_turn(struct node *node, struct timer *timer) {
    (void)node;
    CHECK_EQUAL(((struct probe *)timer)->again, last_index++);
    return TIMER_DONE;
}

static void equal_waketimes_run_as_they_were_added(void) {
    struct sim_board *board = new_board();
    static struct probe probes[10];
    for (unsigned i = 0; i < 10; i++) {
        probes[i] =
            (struct probe){.timer = {.function = run_in_turn, .waketime = (uint32_t)START + 5}, .again = i};
        sched_add_timer(node_of(board), &probes[i].timer);
    }
    sim_run_until(board, START + 5);
    CHECK_EQUAL(last_index, 10);
    sim_free(board);
}

static void deleting(void) {
    struct sim_board *board = new_board();
    struct probe second = {.timer = {.function = run_probe, .waketime = (uint32_t)START + 2}, .runs_left = 1};
    struct probe first = {.timer = {.function = run_probe, .waketime = (uint32_t)START + 1},
                          .victim = &second};
    sched_add_timer(node_of(board), &second.timer);
    sched_add_timer(node_of(board), &first.timer);
    sim_run_until(board, START + 100);
    CHECK_EQUAL(first.runs, 1);
    CHECK_EQUAL(second.runs, 0);
    sched_delete_timer(node_of(board), &second.timer); // not queued: nothing happens
    sim_free(board);
}

static void too_late(void) {
    struct sim_board *board = new_board();
    struct node *node = node_of(board);
    struct probe probe = {.timer = {.function = run_probe, .waketime = (uint32_t)START}, .runs_left = 1};
    sched_add_timer(node, &probe.timer); // now is not too late
    CHECK(!node->shutdown.active);
    sim_run_until(board, START + 10);
    CHECK_EQUAL(probe.runs, 1);
    probe.timer.waketime = (uint32_t)START + 9;
    sched_add_timer(node, &probe.timer);
    CHECK(node->shutdown.active && !node->sched.first);
    probe.timer.waketime = (uint32_t)START + 100;
    sched_add_timer(node, &probe.timer);
    CHECK(!node->sched.first); // nothing is queued while shut down
    sim_free(board);

    board = new_board();
    node = node_of(board);
    probe =
        (struct probe){.timer = {.function = run_probe, .waketime = (uint32_t)START + 50}, .runs_left = 9};
    probe.again = 0u - 1;
    sched_add_timer(node, &probe.timer);
    sim_run_until(board, START + 100);
    CHECK_EQUAL(probe.runs, 1);
    CHECK(node->shutdown.active);
    sim_free(board);

    board = new_board();
    node = node_of(board);
    node->config.timer_slack = 3; // a chip's interrupts may be late by so much
    probe =
        (struct probe){.timer = {.function = run_probe, .waketime = (uint32_t)START + 50}, .runs_left = 1};
    sched_add_timer(node, &probe.timer);
    sim_run_until(board, START + 100);
    CHECK(!node->shutdown.active);
    sim_free(board);
}

static void clocks_compare_over_the_rollover(void) {
    CHECK(clock_before(0xFFFFFFFF, 0) && !clock_before(0, 0xFFFFFFFF));
    CHECK(clock_before(0, 0x7FFFFFFF) && !clock_before(5, 5));
    CHECK(clock_before(0x90000000, 0x0FFFFFFF));
}

int main(void) {
    clocks_compare_over_the_rollover();
    order_over_the_rollover();
    equal_waketimes_run_as_they_were_added();
    deleting();
    too_late();
    return 0;
}
