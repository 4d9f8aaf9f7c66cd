// SPDX-License-Identifier: Apache-2.0
// Who is on the bus: see discovery.h.
#include "net/discovery.h"

#include "boards/board.h"
#include "net/can_stream.h"

#include <string.h>

DECL_CONSTANT("CAN_WHO_IS_HERE", 1);

// FNV-1a over the uuid, started anew by the clock, and MurmurHash3's last step to spread it over 32 bits.
static uint32_t next_random(struct node *node) {
    uint32_t value = node->can->discovery.random + board_clock(node);
    for (unsigned i = 0; i < NODE_UUID_SIZE; i++)
        value = (value ^ node->config.uuid[i]) * 16777619u;
    value = (value ^ (value >> 16)) * 0x85EBCA6Bu;
    value = (value ^ (value >> 13)) * 0xC2B2AE35u;
    value ^= value >> 16;
    node->can->discovery.random = value;
    return value;
}

void discovery_query(struct node *node, uint8_t query) {
    struct discovery *discovery = &node->can->discovery;
    int has_id = node->can->node_id != 0;
    if (has_id != (query == WHO_IS_HERE) || (query == WHO_IS_HERE && node->config.legacy))
        return;
    uint8_t reply = has_id ? NODE_HERE : NEED_NODEID;
    if (discovery->reply == reply)
        return;
    discovery->reply = reply;
    discovery->due = node->config.legacy;
    if (discovery->due) {
        node_wake_tasks(node);
        return;
    }
    uint32_t spread = node->config.clock_freq / REPLY_SPREAD_PER_S;
    discovery->reply_clock = board_clock(node) + (uint32_t)((uint64_t)next_random(node) * spread >> 32);
    node_set_alarm(node, discovery->reply_clock);
}

// Returns the reply that is due, or 0. One that an id given or lost meanwhile made untrue is dropped.
static uint8_t due_reply(struct node *node) {
    struct discovery *discovery = &node->can->discovery;
    uint32_t irq = board_irq_save(node);
    if (discovery->reply && !discovery->due && !clock_before(board_clock(node), discovery->reply_clock))
        discovery->due = 1;
    if (discovery->due) {
        node->alarm.set = 0;
        if ((discovery->reply == NODE_HERE) != (node->can->node_id != 0))
            discovery->reply = discovery->due = 0;
    }
    uint8_t reply = discovery->due ? discovery->reply : 0;
    board_irq_restore(node, irq);
    return reply;
}

void discovery_run(struct node *node) {
    uint8_t reply = due_reply(node);
    if (!reply)
        return;
    uint8_t data[CAN_FRAME_MAX] = {reply};
    memcpy(data + 1, node->config.uuid, NODE_UUID_SIZE);
    data[1 + NODE_UUID_SIZE] = reply == NODE_HERE ? node->can->node_id : SET_NODEID;
    if (board_can_send(node, CAN_ID_ADMIN_RESPONSE, data, sizeof(data)))
        return; // the board wakes the tasks
    uint32_t irq = board_irq_save(node);
    node->can->discovery.reply = node->can->discovery.due = 0;
    board_irq_restore(node, irq);
}
