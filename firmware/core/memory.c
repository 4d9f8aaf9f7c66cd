// SPDX-License-Identifier: Apache-2.0
// The arena and what lives in it: objects by number, slots of the move queue.
#include "core/memory.h"

#include <stdalign.h>
#include <string.h>

#include "boards/board.h"

DECL_STATIC_STRING(alloc_failed, "alloc_chunk failed");
DECL_STATIC_STRING(oids_allocated, "oids already allocated");
DECL_STATIC_STRING(cant_assign_oid, "Can't assign oid");
DECL_STATIC_STRING(invalid_oid_type, "Invalid oid type");
DECL_STATIC_STRING(move_overflow, "Move queue overflow");

static size_t aligned(size_t size) {
    return (size + alignof(max_align_t) - 1) & ~(alignof(max_align_t) - 1);
}

void *arena_alloc(struct node *node, size_t size) {
    if (aligned(size) > node->config.arena_size - node->arena_used) {
        node_shutdown(node, string_alloc_failed);
        return NULL;
    }
    void *memory = node->config.arena + node->arena_used;
    node->arena_used += (uint32_t)aligned(size);
    memset(memory, 0, size);
    return memory;
}

// -------------------------------------------------------------------------------------------------- objects

void oids_allocate(struct node *node, uint8_t count) {
    if (node->oids) {
        node_shutdown(node, string_oids_allocated);
        return;
    }
    // One more than asked for: also a node without objects has allocated them.
    struct oid_entry *oids = arena_alloc(node, sizeof(*oids) * (count + 1U));
    if (!oids)
        return;
    node->oids = oids;
    node->oid_count = count;
}

void *oid_alloc(struct node *node, uint8_t oid, const struct oid_type *type, size_t size) {
    if (oid >= node->oid_count || node->oids[oid].type || node->is_configured) {
        node_shutdown(node, string_cant_assign_oid);
        return NULL;
    }
    void *object = arena_alloc(node, size);
    if (object) {
        node->oids[oid].object = object;
        node->oids[oid].type = type;
    }
    return object;
}

void *oid_lookup(struct node *node, uint8_t oid, const struct oid_type *type) {
    if (oid < node->oid_count && node->oids[oid].type == type)
        return node->oids[oid].object;
    node_shutdown(node, string_invalid_oid_type);
    return NULL;
}

void *oid_next(struct node *node, const struct oid_type *type, uint16_t *oid) {
    while (*oid < node->oid_count) {
        const struct oid_entry *entry = &node->oids[(*oid)++];
        if (entry->type == type)
            return entry->object;
    }
    return NULL;
}

// ----------------------------------------------------------------------------------------------- move queue

void moves_allocate(struct node *node) {
    uint32_t room = (node->config.arena_size - node->arena_used) / sizeof(struct move);
    uint32_t count = room < node->config.move_count ? room : node->config.move_count;
    struct move *moves = (struct move *)(void *)(node->config.arena + node->arena_used);
    node->arena_used += count * (uint32_t)sizeof(struct move);
    node->move_count = (uint16_t)count;
    for (uint32_t i = count; i-- > 0;)
        move_free(node, &moves[i]);
}

struct move *move_alloc(struct node *node) {
    uint32_t irq = board_irq_save(node);
    struct move *move = node->free_moves;
    if (move)
        node->free_moves = move->next;
    board_irq_restore(node, irq);
    if (!move)
        node_shutdown(node, string_move_overflow);
    return move;
}

void move_free(struct node *node, struct move *move) {
    move->next = node->free_moves;
    node->free_moves = move;
}

void move_push(struct move_queue *queue, struct move *move) {
    move->next = NULL;
    if (queue->first)
        queue->last->next = move;
    else
        queue->first = move;
    queue->last = move;
}

struct move *move_pop(struct move_queue *queue) {
    struct move *move = queue->first;
    if (move)
        queue->first = move->next;
    return move;
}

void move_clear(struct node *node, struct move_queue *queue) {
    struct move *move;
    while ((move = move_pop(queue)))
        move_free(node, move);
}
