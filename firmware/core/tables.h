// SPDX-License-Identifier: Apache-2.0
// What the generator makes from all declarations of one build.
#ifndef CORE_TABLES_H
#define CORE_TABLES_H

#include "core/node.h"

typedef void (*node_function)(struct node *node);

struct tables {
    const struct command *commands; // commands[id - first_id]
    int16_t first_id;
    uint16_t command_count;
    const node_function *inits, *tasks, *shutdown_hooks;
    uint8_t init_count, task_count, shutdown_hook_count;
    const uint8_t *dictionary; // zlib-compressed JSON
    uint32_t dictionary_size;
};

extern const struct tables node_tables;

#endif
