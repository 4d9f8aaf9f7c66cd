// SPDX-License-Identifier: Apache-2.0
// What a configuration makes: objects by number (oid) and the slots of the move queue, all from one arena.
#include "boards/board.h"
#include "core/node.h"

#include <string.h>

DECL_STATIC_STRING(move_overflow, "Move queue overflow");
DECL_STATIC_STRING(alloc_failed, "alloc_chunk failed");
DECL_STATIC_STRING(oids_allocated, "oids already allocated");
DECL_STATIC_STRING(cannot_assign_oid, "Can't assign oid");
DECL_STATIC_STRING(invalid_oid_type, "Invalid oid type");
DECL_STATIC_STRING(already_finalized, "Already finalized");

DECL_RESPONSE(config, "config is_config=%c crc=%u is_shutdown=%c move_count=%hu");

enum { ALIGNMENT = 16 };

void node_forget_objects(struct node *node) {
    memset(&node->objects, 0, sizeof(node->objects));
    node->sched.first = NULL;
}

void *node_alloc(struct node *node, size_t size) {
    size_t rounded = (size + ALIGNMENT - 1) & ~(size_t)(ALIGNMENT - 1);
    if (rounded > node->config.arena_size - node->objects.arena_used) {
        node_shutdown(node, STRING(alloc_failed));
        return NULL;
    }
    uint8_t *memory = (uint8_t *)node->config.arena + node->objects.arena_used;
    node->objects.arena_used += rounded;
    memset(memory, 0, size);
    return memory;
}

// ------------------------------------------------------------------------------------------------------ oids

void command_allocate_oids(struct node *node, const struct wire_arg *args) {
    if (node->objects.oids_allocated) {
        node_shutdown(node, STRING(oids_allocated));
        return;
    }
    node->objects.oids = node_alloc(node, args[0].value * sizeof(struct oid_slot));
    if (!node->objects.oids)
        return;
    node->objects.oids_allocated = 1;
    node->objects.oid_count = (uint8_t)args[0].value;
}
DECL_COMMAND(command_allocate_oids, "allocate_oids count=%c", 0);

void *oid_create(struct node *node, uint32_t oid, const struct oid_type *type, size_t size) {
    if (oid >= node->objects.oid_count || node->objects.finalized || node->objects.oids[oid].type) {
        node_shutdown(node, STRING(cannot_assign_oid));
        return NULL;
    }
    void *object = node_alloc(node, size);
    if (object) {
        uint32_t irq = board_irq_save(node); // interrupts look through all objects of a type
        node->objects.oids[oid] = (struct oid_slot){.type = type, .object = object};
        board_irq_restore(node, irq);
    }
    return object;
}

void *oid_find(struct node *node, uint32_t oid, const struct oid_type *type) {
    if (oid >= node->objects.oid_count || node->objects.oids[oid].type != type) {
        node_shutdown(node, STRING(invalid_oid_type));
        return NULL;
    }
    return node->objects.oids[oid].object;
}

void *oid_next(const struct node *node, unsigned *oid, const struct oid_type *type) {
    while (*oid < node->objects.oid_count) {
        const struct oid_slot *slot = &node->objects.oids[(*oid)++];
        if (slot->type == type)
            return slot->object;
    }
    return NULL;
}

// -------------------------------------------------------------------------------------------------- move
// queue

void *move_alloc(struct node *node) {
    struct move *move = node->objects.free_moves;
    if (!move) {
        node_shutdown(node, STRING(move_overflow));
        return NULL;
    }
    node->objects.free_moves = move->next;
    return move;
}

void move_free(struct node *node, void *memory) {
    struct move *move = memory;
    move->next = node->objects.free_moves;
    node->objects.free_moves = move;
}

void move_queue_clear(struct node *node, struct move_queue *queue) {
    struct move *move;
    while ((move = move_queue_pop(queue)))
        move_free(node, move);
}

// ---------------------------------------------------------------------------------------------------- config

void command_finalize_config(struct node *node, const struct wire_arg *args) {
    if (!node->objects.oids_allocated || node->objects.finalized) {
        node_shutdown(node, STRING(already_finalized));
        return;
    }
    uint8_t *slots = node_alloc(node, (size_t)node->config.move_count * NODE_MOVE_SIZE);
    if (!slots)
        return;
    for (unsigned i = node->config.move_count; i-- > 0;)
        move_free(node, slots + (size_t)i * NODE_MOVE_SIZE);
    node->objects.move_count = node->config.move_count;
    node->objects.crc = args[0].value;
    node->objects.finalized = 1;
}
DECL_COMMAND(command_finalize_config, "finalize_config crc=%u", 0);

void command_get_config(struct node *node, const struct wire_arg *args) {
    (void)args;
    RESPOND(node, config, INT(node->objects.finalized), INT(node->objects.crc), INT(node->shutdown.active),
            INT(node->objects.move_count));
}
DECL_COMMAND(command_get_config, "get_config", ALLOWED_IN_SHUTDOWN);

// Back to an unconfigured node that still has its id and its uptime. Outputs go to their defaults first, by
// the same hooks as in a shutdown.
void command_config_reset(struct node *node, const struct wire_arg *args) {
    (void)args;
    uint32_t irq = board_irq_save(node);
    if (!node->shutdown.active)
        for (unsigned i = 0; i < node_tables.hook_count; i++)
            node_tables.hooks[i](node);
    node_forget_objects(node);
    memset(&node->shutdown, 0, sizeof(node->shutdown));
    board_irq_restore(node, irq);
}
DECL_COMMAND(command_config_reset, "config_reset", ALLOWED_IN_SHUTDOWN);
