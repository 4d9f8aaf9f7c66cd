// SPDX-License-Identifier: Apache-2.0
// A node on a CAN bus: node id assignment by admin frames, and the byte stream of its link in data frames.
#ifndef NET_CAN_STREAM_H
#define NET_CAN_STREAM_H

#include "core/node.h"
#include "net/can_uuid.h"

enum {
    CAN_ID_ADMIN = 0x3F0,          // host to all nodes
    CAN_ID_ADMIN_RESPONSE = 0x3F1, // node to host
    CAN_ID_DATA = 0x100,           // host to node: this + 2·nodeid; node to host: one more
    CAN_FRAME_MAX = 8,
};

// The transport's state, owned by the board: node->config.transport_state.
struct can_stream {
    uint8_t uuid[CAN_UUID_SIZE];
    uint8_t nodeid;      // 0: none yet
    uint8_t wants_reply; // a query waits for its answer to be sent
    uint8_t conflict;    // someone else has this node's id
};

extern const struct transport can_stream_transport;

// Asks the board for the ids a node without id listens to. Call after node_init().
void can_stream_start(struct node *node);

// Interrupt context: a frame of any id arrived.
void can_stream_receive(struct node *node, uint32_t id, const uint8_t *data, size_t size);

#endif
