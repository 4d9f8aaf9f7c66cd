// SPDX-License-Identifier: Apache-2.0
// A node's life: start, tasks, shutdown.
#include "core/node.h"

#include <string.h>

#include "boards/board.h"
#include "core/base.h"
#include "core/tables.h"

static void account_load(struct node *node, uint32_t ticks) {
    uint64_t sumsq = node->load_sumsq + (uint64_t)ticks * ticks / STATS_SUMSQ_BASE;
    node->load_count++;
    node->load_sum += ticks;
    node->load_sumsq = sumsq > UINT32_MAX ? UINT32_MAX : (uint32_t)sumsq;
}

void node_wake(struct node *node, uint8_t index) {
    uint32_t irq = board_irq_save(node);
    node->tasks_woken |= UINT32_C(1) << index;
    board_irq_restore(node, irq);
}

bool node_run_tasks(struct node *node) {
    if (!node->tasks_woken)
        return false;
    uint32_t start = board_busy_clock(node);
    for (uint8_t i = 0; i < node_tables.task_count; i++) {
        uint32_t bit = UINT32_C(1) << i;
        uint32_t irq = board_irq_save(node);
        bool woken = node->tasks_woken & bit;
        node->tasks_woken &= ~bit;
        board_irq_restore(node, irq);
        if (woken)
            node_tables.tasks[i](node);
    }
    account_load(node, board_busy_clock(node) - start);
    return node->tasks_woken;
}

void node_init(struct node *node, const struct node_config *config) {
    memset(node, 0, sizeof(*node));
    node->config = *config;
    if (!node->config.dictionary) {
        node->config.dictionary = node_tables.dictionary;
        node->config.dictionary_size = node_tables.dictionary_size;
    }
    base_start(node);
    for (uint8_t i = 0; i < node_tables.init_count; i++)
        node_tables.inits[i](node);
}

void node_shutdown(struct node *node, uint16_t reason) {
    uint32_t irq = board_irq_save(node);
    bool first = !node->is_shutdown;
    node->is_shutdown = true;
    if (first) {
        node->shutdown_reason = reason;
        node->shutdown_clock = board_clock(node);
        sched_reset(node);
        base_restart_housekeeping(node);
        for (uint8_t i = 0; i < node_tables.shutdown_hook_count; i++)
            node_tables.shutdown_hooks[i](node);
        base_report_shutdown(node);
    }
    board_irq_restore(node, irq);
}

void node_reset_config(struct node *node) {
    uint32_t irq = board_irq_save(node);
    sched_reset(node);
    base_restart_housekeeping(node);
    node->arena_used = 0;
    node->oids = NULL;
    node->oid_count = 0;
    node->free_moves = NULL;
    node->move_count = 0;
    node->is_configured = false;
    node->config_crc = 0;
    board_irq_restore(node, irq);
}
