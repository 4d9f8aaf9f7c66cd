// SPDX-License-Identifier: Apache-2.0
// sources: firmware/wire/*.c firmware/core/*.c firmware/objects/*.c firmware/net/*.c
// sources: firmware/boards/virtual/*.c firmware/plant/*.c firmware/boards/sim/sim.c build/sim/tables.c
// A timed output by itself: what its stop leaves, whoever calls it.
#include "objects/timed_output.h"

#include "boards/board.h"
#include "boards/sim/sim.h"
#include "tests/check.h"

static uint32_t applied, applied_count;

static void apply(struct node *node, struct timed_output *output, uint32_t clock, uint32_t value) {
    CHECK_EQUAL(clock, board_clock(node));
    CHECK(output->apply == apply);
    applied = value;
    applied_count++;
}

void command_allocate_oids(struct node *node, const struct wire_arg *args);
void command_finalize_config(struct node *node, const struct wire_arg *args);

int main(void) {
    static const uint8_t uuid[NODE_UUID_SIZE] = {1};
    struct sim_board *board = sim_new(uuid, 1000, 0);
    struct node *node = (struct node *)board; // the first member of the first member
    struct timed_output output = {.apply = apply, .default_value = 7, .max_duration = 100};
    command_allocate_oids(node, (const struct wire_arg[]){{.value = 0}});
    command_finalize_config(node, (const struct wire_arg[]){{.value = 1}});
    timed_output_init(&output);

    // Stopped while a value is driven and others wait: nothing of them comes, and nothing has to be renewed.
    timed_output_queue(node, &output, 1010, 1);
    timed_output_queue(node, &output, 1050, 2);
    sim_run_until(board, 1020);
    CHECK_EQUAL(applied, 1);
    timed_output_stop(node, &output);
    CHECK_EQUAL(applied, 7);
    CHECK_EQUAL(applied_count, 2);
    CHECK(!node->sched.first && !output.queue.first);
    sim_run_until(board, 5000);
    CHECK_EQUAL(applied_count, 2);
    CHECK(!node->shutdown.active);

    // A value that may last until 5100 and the next one exactly then; it ends as late as it may.
    timed_output_update(node, &output, 3);
    timed_output_queue(node, &output, 5100, 4);
    sim_run_until(board, 5199);
    CHECK_EQUAL(applied, 4);
    CHECK(!node->shutdown.active);
    sim_run_until(board, 5200);
    CHECK(node->shutdown.active);
    sim_free(board);
    return 0;
}
